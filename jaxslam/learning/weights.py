"""Learn the weights of the cue `learned`: from true labels of rendered scenes, then through the pose error.

1. Scenes are rendered (`weights_recipe`), with true poses and true masks of what moves.
2. They are tracked; what the network sees of each point is kept with its label, and the network is trained on it. Which
   points there are depends on the verdicts, so that scenes are tracked again with the network, and it is trained on all
   that was seen, until it has been judged on what comes of its own verdicts (Ross, Gordon and Bagnell, "A Reduction of
   Imitation Learning and Structured Prediction to No-Regret Online Learning", AISTATS 2011).
3. The network is fine-tuned by the gradient of the tracker itself: that of the pose error at the end of windows of
   frames, with soft verdicts.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.point_network import PointNetwork
from jaxslam_kernels.types import Scalar
from jaxtyping import Array, Bool, Float

from jaxslam.learning.fit import fit
from jaxslam.learning.label_training import joined_samples, new_network, train_on_labels
from jaxslam.learning.labeled_scene import LabeledScene, open_still, render_room, render_world
from jaxslam.learning.losses import relative_pose_loss
from jaxslam.learning.point_samples import (
    TrackedScene,
    WrongPoints,
    ate_of,
    edges,
    track_scene,
    tracker_with,
    wrong_points,
)
from jaxslam.learning.weights_recipe import WeightsRecipe
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.tracking.state import TrackOutput, TrackState

OnProgress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""
_POSE_STEP = 5
"""Number of frames over which the motion is compared with the true one."""
_FLOOR_M2 = 1e-8
"""Square of an error of pose that is small enough: 0.1 mm."""
_LEAST = 1e-4
"""Smallest probability of a label, so that its logarithm stays finite."""


class StageFigures(NamedTuple):
    """Figures on the held-out scenes after a stage.

    Attributes:
        stage: Name of the stage.
        wrong: Numbers of wrong verdicts.
        ate_m: Geometric mean of the absolute trajectory errors of the scenes, meters.
    """

    stage: str
    wrong: WrongPoints
    ate_m: float


@dataclass(frozen=True)
class LearnedWeights:
    """Result of `learn_weights`.

    Attributes:
        network: The network.
        stages: Figures on the held-out scenes: of the cue `clusters`, and after each stage.
        label_losses: Losses of all steps of the training on labels, one after the other.
        pose_losses: Losses of the held-out windows after each step of the training on poses.
        scenes: Names of the scenes that were trained on.
    """

    network: PointNetwork
    stages: tuple[StageFigures, ...]
    label_losses: np.ndarray
    pose_losses: np.ndarray
    scenes: tuple[str, ...]

    def weights(self) -> Mapping[str, np.ndarray]:
        """Return the arrays of the network, by name."""
        return {name: np.asarray(array) for name, array in self.network._asdict().items()}


def learn_weights(recipe: WeightsRecipe, *, seed: int = 0, on_progress: OnProgress = lambda *_: None) -> LearnedWeights:
    """Learn the weights of the cue `learned`; the same recipe and seed give the same weights on the same machine.

    Args:
        recipe: Scenes and numbers of the training.
        seed: Seed of the first weights, and of the order of the frames.
        on_progress: Called as the work goes on.

    Raises:
        ConfigError: If a world of the recipe does not exist.
        FloatingPointError: If a loss or a derivative is not finite.
    """
    scenes, held_out = render_scenes(recipe, on_progress)
    stages = [_judged("clusters", held_out, None, recipe, on_progress)]
    network, losses, samples = new_network(seed, recipe.num_hidden), [], []
    tracked: list[TrackedScene] = []
    for number in range(recipe.rounds):
        tracked = _tracked(scenes, network if number else None, recipe, on_progress)
        samples += [each.samples for each in tracked]
        on_progress(f"training on labels, round {number + 1}", number, recipe.rounds)
        network, of_round = train_on_labels(
            new_network(seed, recipe.num_hidden),
            joined_samples(samples),
            jax.random.fold_in(jax.random.key(seed), number),
            steps=recipe.label_steps,
            rate=recipe.label_rate,
            moving_weight=recipe.moving_weight,
            noise=recipe.noise,
        )
        losses.append(of_round)
        stages.append(_judged(f"labels, round {number + 1}", held_out, network, recipe, on_progress))
    pose_losses = np.zeros(0)
    if recipe.pose_steps:
        network, pose_losses = train_on_poses(network, scenes, held_out, recipe, on_progress)
        stages.append(_judged("poses", held_out, network, recipe, on_progress))
    names = tuple(scene.name for scene in scenes)
    return LearnedWeights(network, tuple(stages), np.concatenate(losses), pose_losses, names)


def render_scenes(
    recipe: WeightsRecipe, on_progress: OnProgress = lambda *_: None
) -> tuple[list[LabeledScene], list[LabeledScene]]:
    """Render the scenes of a recipe: those to train on, and those held out."""
    total = len(recipe.rooms) + len(recipe.worlds) + len(recipe.still) + len(recipe.held_out)
    done = itertools.count()

    def rendered(render: Callable[[Any, int], LabeledScene | None], chosen: Sequence[Any]) -> list[LabeledScene]:
        found = []
        for each in chosen:
            on_progress("rendering scenes", next(done), total)
            scene = render(each, recipe.frames)
            found += [] if scene is None else [scene]
        return found

    scenes = rendered(render_room, recipe.rooms) + rendered(render_world, recipe.worlds)
    scenes += rendered(open_still, recipe.still)
    return scenes, rendered(render_room, recipe.held_out)


def _tracked(
    scenes: Sequence[LabeledScene], network: PointNetwork | None, recipe: WeightsRecipe, on_progress: OnProgress
) -> list[TrackedScene]:
    found = []
    for number, scene in enumerate(scenes):
        on_progress("tracking scenes", number, len(scenes))
        plan, params = tracker_with(scene.camera, network)
        found.append(track_scene(scene, plan, params, window=recipe.window))
    return found


def _judged(
    stage: str,
    scenes: Sequence[LabeledScene],
    network: PointNetwork | None,
    recipe: WeightsRecipe,
    on_progress: OnProgress,
) -> StageFigures:
    """Track the held-out scenes, with hard verdicts as in use."""
    tracked = _tracked(scenes, network, recipe, on_progress)
    wrong = sum((wrong_points(each) for each in tracked), start=WrongPoints(0, 0, 0, 0))
    errors = [ate_of(each) for each in tracked]
    return StageFigures(stage, wrong, float(np.exp(np.mean(np.log(errors)))))


class WindowTruth(NamedTuple):
    """Ground truth of the `t` frames of a window.

    Attributes:
        T_world_cam: `(t, 7)` poses, `wxyz_xyz`.
        moving: `(t, h, w)` which pixels show something that moves.
        sure: `(t, h, w)` which pixels are not near its edge.
    """

    T_world_cam: Float[Array, "t 7"]
    moving: Bool[Array, "t h w"]
    sure: Bool[Array, "t h w"]


class Window(NamedTuple):
    """Some frames of a scene, with the state of the tracker before them and what is true of them."""

    state: TrackState
    clip: FrameArrays
    truth: WindowTruth


def windows_of(tracked: Sequence[TrackedScene], length: int, number: int) -> list[Window]:
    """Cut windows out of tracked scenes, spread evenly over all but the first window of each, which has no map yet."""
    places = [
        (each, index) for index in range(1, len(tracked[0].states)) for each in tracked
        if (index + 1) * length <= len(each.status)
    ]  # fmt: skip
    chosen = np.unique(np.linspace(0, len(places) - 1, min(number, len(places))).round().astype(int))
    found = []
    for scene, index in (places[place] for place in chosen):
        part = slice(index * length, (index + 1) * length)
        moving = scene.scene.moving[part]
        poses: Any = np.asarray(scene.scene.T_world_cam[part], np.float32)
        labels: Any = moving, ~edges(moving)
        truth = WindowTruth(poses, *labels)
        found.append(Window(scene.states[index], scene.scene.part(part.start, part.stop), truth))
    return found


def window_loss(outputs: TrackOutput, truth: WindowTruth, label_share: float) -> Scalar:
    """Return the logarithm of the error of motion over some frames, plus a share of the loss of true labels.

    The mean over windows is then that of relative changes: a window with ten times the error of another one counts as
    much.

    Args:
        outputs: Outputs of the tracker, whose only cue is `recording(learned_cue)`.
        truth: Ground truth of the frames.
        label_share: Weight of the loss of labels.
    """
    step = min(_POSE_STEP, len(truth.T_world_cam) - 1)
    error = relative_pose_loss(outputs, SE3(truth.T_world_cam), step=step)
    verdict = outputs.cue_results[0]
    column, row = (jnp.round(lax.stop_gradient(verdict.extra.uv[:, axis])).astype(jnp.int32) for axis in (0, 1))
    frame = jnp.arange(len(column), dtype=jnp.int32)[:, None]
    moving, sure = (
        array.at[frame, row, column].get(mode="fill", fill_value=False) for array in (truth.moving, truth.sure)
    )
    probability = jnp.clip(0.5 * verdict.evidence, _LEAST, 1 - _LEAST)
    entropy = -jnp.log(jnp.where(moving, probability, 1 - probability))
    counts = (sure & verdict.known).astype(entropy.dtype)
    of_labels = jnp.sum(counts * entropy) / jnp.maximum(jnp.sum(counts), 1)
    return 0.5 * jnp.log(error + _FLOOR_M2) + label_share * of_labels


def train_on_poses(
    network: PointNetwork,
    scenes: Sequence[LabeledScene],
    held_out: Sequence[LabeledScene],
    recipe: WeightsRecipe,
    on_progress: OnProgress = lambda *_: None,
    *,
    progress: bool = True,
) -> tuple[PointNetwork, Float[np.ndarray, " steps"]]:
    """Fine-tune a network by the gradient of the pose error through the tracker, and of the labels beside it.

    Args:
        network: Network to begin with.
        scenes: Scenes to train on; those with the camera of the first held-out scene of the smallest width are used.
        held_out: Scenes to judge by.
        recipe: Numbers of the training.
        on_progress: Called as the work goes on.
        progress: Whether to show the progress bar of `fit`.

    Returns:
        The network with the smallest loss on windows of the held-out scenes, and that loss after each number of steps.

    Raises:
        FloatingPointError: If a loss or a derivative is not finite.
    """
    camera = min((scene.camera for scene in held_out), key=lambda camera: camera.width)
    alike = [[each for each in some if _optics(each.camera) == _optics(camera)] for some in (scenes, held_out)]
    own, others = (
        windows_of(_tracked(some, network, recipe, on_progress), recipe.window, number)
        for some, number in zip(alike, (recipe.num_windows, max(recipe.num_windows // 2, 1)), strict=True)
    )
    plan, params = tracker_with(camera, network, temperature=recipe.temperature)
    on_progress("training on poses", 0, recipe.pose_steps)
    found = fit(
        params,
        lambda outputs, truth: window_loss(outputs, truth, recipe.label_share),
        [window.clip for window in own],
        [window.truth for window in own],
        states=[window.state for window in own],
        held_out=([window.clip for window in others], [window.truth for window in others]),
        held_out_states=[window.state for window in others],
        select=lambda params: params.cues[0].network,
        plan=plan,
        optimizer=optax.adam(recipe.pose_rate),
        max_steps=recipe.pose_steps,
        progress=progress,
    )
    return found.params.cues[0].network, found.losses


def _optics(camera: Camera) -> tuple[float, ...]:
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
