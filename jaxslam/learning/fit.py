"""Fit settings of the tracker to clips with known poses, by gradient descent through the tracker itself."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxslam_kernels.se3 import lenient_promotion
from jaxslam_kernels.types import Scalar
from jaxtyping import Float, PyTree
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.tracking.initial_state import DEFAULT_PLAN, init_state
from jaxslam.tracking.rollout import rollout
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackState

_RATE = 0.02
"""Learning rate of the default optimizer: a step changes a positive setting by about 2 %."""

Loss = Callable[[TrackOutput, Any], Scalar]
"""Loss of the outputs of a clip, stacked along a first axis, against what is true of the clip."""
_Tree = TypeVar("_Tree")


class Fit(NamedTuple):
    """Result of `fit`.

    Attributes:
        params: Settings with the smallest loss.
        losses: `(steps,)` loss after each number of steps, the first one of the settings given; of the held-out clips
            if there are any.
        best: Number of steps after which the loss was smallest.
        stopped_early: Whether it ended because the loss no longer fell.
    """

    params: TrackParams
    losses: Float[np.ndarray, " steps"]
    best: int
    stopped_early: bool


class _Example(NamedTuple):
    """A clip with the state before it and what is true of it."""

    state: TrackState
    clip: FrameArrays
    truth: Any


def fit(
    params: TrackParams,
    loss: Loss,
    clips: FrameArrays | Sequence[FrameArrays],
    truth: Any,
    *,
    select: Callable[[TrackParams], PyTree],
    plan: TrackPlan = DEFAULT_PLAN,
    held_out: tuple[FrameArrays | Sequence[FrameArrays], Any] | None = None,
    states: TrackState | Sequence[TrackState] | None = None,
    held_out_states: TrackState | Sequence[TrackState] | None = None,
    optimizer: optax.GradientTransformation | None = None,
    max_steps: int = 100,
    patience: int = 10,
    tolerance: float = 1e-3,
    progress: bool = True,
) -> Fit:
    """Fit settings of the tracker to clips, by gradient descent on the mean loss of all clips.

    A positive scalar, such as a focal length or a threshold, is changed by a factor; everything else, such as the
    weights of a network, by a difference. So one learning rate suits settings of any unit, and a positive scalar stays
    positive. Cue thresholds have a derivative if the cue's `temperature` is above 0.

    Args:
        params: Settings to begin with.
        loss: Function of the outputs of a clip and its `truth`, such as `ate_loss`.
        clips: Clips from `stack_frames`, one or several. Each shape is compiled once.
        truth: What `loss` compares the outputs of each clip with, such as true poses; a list if `clips` is one.
        select: Function that picks what to fit out of the settings: floating-point arrays, in a tuple if several.
        plan: Array sizes and search settings, static.
        held_out: More clips with their truth, whose loss decides when to stop and which settings are best.
        states: State before each clip; by default new ones.
        held_out_states: State before each held-out clip; by default new ones.
        optimizer: Optimizer of optax; Adam by default.
        max_steps: Largest number of steps.
        patience: Number of steps without a smaller loss after which it ends.
        tolerance: Fraction by which a loss must be smaller to count as such.
        progress: Whether to show a progress bar on standard error.

    Raises:
        ValueError: If the numbers of clips, truths and states differ, there is no clip, or nothing is selected.
        TypeError: If what is selected is not floating point.
        FloatingPointError: If the loss or its derivative is not finite.
    """
    examples = _examples(clips, truth, states, plan)
    others = None if held_out is None else _examples(*held_out, held_out_states, plan)
    start = _selected(params, select)

    def mean_loss(shift: PyTree, example: _Example) -> Scalar:
        changed = eqx.tree_at(select, params, jax.tree.map(_shifted, start, shift))
        return loss(rollout(example.state, example.clip, changed, plan)[1], example.truth)

    slope = jax.jit(jax.value_and_grad(mean_loss), compiler_options=FAST_COMPILE or None)
    value = jax.jit(mean_loss, compiler_options=FAST_COMPILE or None)
    optimizer = optax.adam(_RATE) if optimizer is None else optimizer
    shift = best_shift = jax.tree.map(jnp.zeros_like, start)
    memory, losses, lowest, since = optimizer.init(shift), [], np.inf, 0
    with _progress(progress) as bar:
        task = bar.add_task("fit", total=max_steps, loss="")
        while True:
            mean, gradient = _mean([slope(shift, example) for example in examples])
            judged = mean if others is None else _mean([value(shift, example) for example in others])
            losses.append(_finite(judged, gradient, len(losses)))
            since = 0 if losses[-1] < (1 - tolerance) * lowest else since + 1
            if losses[-1] < lowest:
                lowest, best_shift = losses[-1], shift
            bar.update(task, completed=len(losses) - 1, loss=f"loss {losses[-1]:.3g}, lowest {lowest:.3g}")
            if since >= patience or len(losses) > max_steps:
                break
            with lenient_promotion():  # optax relies on it
                updates, memory = optimizer.update(gradient, memory, shift)
                shift = optax.apply_updates(shift, updates)
    found = eqx.tree_at(select, params, jax.tree.map(_shifted, start, best_shift))
    return Fit(found, np.array(losses), int(np.argmin(losses)), since >= patience)


def _examples(clips: Any, truth: Any, states: Any, plan: TrackPlan) -> list[_Example]:
    """Pair clips with their states and what is true of them, after checking their numbers."""
    if isinstance(clips, FrameArrays):
        clips, truth, states = [clips], [truth], None if states is None else [states]
    if not clips:
        raise ValueError("clips: expected at least one, got none")
    states = [_new_state(clip, plan) for clip in clips] if states is None else states
    for name, given in (("truth", truth), ("states", states)):
        if len(given) != len(clips):
            raise ValueError(f"{name}: expected one for each of {len(clips)} clips, got {len(given)}")
    return [_Example(*each) for each in zip(states, clips, truth, strict=True)]


def _new_state(clip: FrameArrays, plan: TrackPlan) -> TrackState:
    height, width = clip.image.shape[-2:]
    return init_state(height, width, plan, image_dtype=clip.image.dtype, dtype=clip.depth.dtype)


def _selected(params: TrackParams, select: Callable[[TrackParams], PyTree]) -> PyTree:
    """Return what is selected, as arrays, after checking it."""
    chosen = jax.tree.map(jnp.asarray, select(params))
    if not jax.tree.leaves(chosen):
        raise ValueError("select: expected at least one setting, got none")
    for path, leaf in jax.tree_util.tree_leaves_with_path(chosen):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise TypeError(f"select{jax.tree_util.keystr(path)}: expected a floating-point array, got {leaf.dtype}")
    return chosen


def _shifted(start: jax.Array, shift: jax.Array) -> jax.Array:
    """Change a setting: by a factor if it is a positive scalar, else by a difference."""
    if start.ndim:
        return start + shift
    return jnp.where(start > 0, start * jnp.exp(jnp.where(start > 0, shift, 0)), start + shift)


def _mean(values: Sequence[_Tree]) -> _Tree:
    """Average trees of the same structure."""
    return jax.tree.map(lambda *leaves: sum(leaves[1:], start=leaves[0]) / len(leaves), *values)


def _finite(loss: Any, gradient: PyTree, step: int) -> float:
    """Return the loss, after checking that it and its derivative are finite."""
    slopes = [float(np.max(np.abs(leaf), initial=0)) for leaf in jax.tree.leaves(gradient)]
    if not np.isfinite([float(loss), *slopes]).all():
        raise FloatingPointError(
            f"loss: expected a finite loss and derivative, got {float(loss):.3g} and at most {max(slopes):.3g} after"
            f" {step} steps"
        )
    return float(loss)


def _progress(shown: bool) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[loss]}"), console=Console(stderr=True), disable=not shown)
