"""Derivatives through ten tracked frames: reverse mode, forward mode and finite differences agree, in float64.

Which points agree, and which keyframes are looked into, are constants of the derivative; the finite differences are
taken where no such choice changes. The search for keyframe points stops at a twentieth of a pixel while tracking; here
it runs to the end, since the derivative is that of the end.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxslam_kernels.lk_search import LevelPlan
from jaxslam_kernels.patch_align import align_patches
from jaxtyping import Array
from small_scene import QUICK_COMPILE, SIZES, at, clip, new_state, params, stacked, truth_from_start

from jaxslam import keyframes
from jaxslam.track import track_step

BEFORE, STEPS = 10, 10


class Inputs(NamedTuple):
    """What the loss is differentiated by; `image` scales one random change of all pictures."""

    camera: Array
    weight: Array
    X_world: Array
    loss_scale: Array
    pixel_sigma: Array
    readout_s: Array
    image: Array


class Problem(NamedTuple):
    inputs: Inputs
    gradient: Inputs
    evaluate: Callable[[Inputs, Inputs], tuple[Any, ...]]
    """Loss, choices, gradient and directional derivative."""
    counted: Array
    """Which points exist."""


@pytest.fixture(scope="module")
def problem() -> Iterator[Problem]:
    patched = pytest.MonkeyPatch()
    patched.setattr(keyframes, "align_patches", partial(align_patches, plan=LevelPlan(21, 40, 1e-7)))
    recording = clip()
    with jax.enable_x64(True):
        yield _problem(recording)
    patched.undo()


def _problem(recording: Any) -> Problem:
    frames = stacked(recording.frames[: BEFORE + STEPS], np.float64, np.float64)
    given = params(np.float64)._replace(readout_s=jnp.asarray(0.005))
    step = jax.jit(track_step, static_argnums=3, compiler_options=QUICK_COMPILE)
    state = new_state(np.float64, np.float64)
    for index in range(BEFORE):
        state, _ = step(state, at(frames, index), given, SIZES)
    given = given._replace(refill_below=jnp.zeros(()), keyframe_below=jnp.zeros(()))
    window = jax.tree.map(lambda array: array[BEFORE:], frames)
    change = jnp.asarray(np.random.default_rng(0).normal(size=window.image.shape))
    truth = jnp.asarray(truth_from_start(recording.source.ground_truth)[BEFORE : BEFORE + STEPS, :3, 3])

    def loss(inputs: Inputs) -> tuple[Array, tuple[Array, ...]]:
        fx, fy, cx, cy = inputs.camera
        camera = given.intrinsics._replace(fx=fx, fy=fy, cx=cx, cy=cy)
        changed = given._replace(
            intrinsics=camera,
            loss_scale=inputs.loss_scale,
            pixel_sigma=inputs.pixel_sigma,
            readout_s=inputs.readout_s,
        )
        points = state.points._replace(weight=inputs.weight, X_world=inputs.X_world)

        def track(state: Any, frame: Any) -> tuple[Any, tuple[Array, ...]]:
            state, output = track_step(state, frame, changed, SIZES)
            choices = (output.status, output.num_inliers, output.num_looked_up, output.is_keyframe)
            return state, (output.T_world_cam.translation(), *choices)

        seen = window._replace(image=window.image + inputs.image * change)
        _, (positions, *choices) = lax.scan(track, state._replace(points=points), seen)
        return jnp.sum(jnp.square(positions - truth)), tuple(choices)

    @partial(jax.jit, compiler_options=QUICK_COMPILE)
    def evaluate(inputs: Inputs, direction: Inputs) -> tuple[Any, ...]:
        value, slope, choices = jax.jvp(loss, (inputs,), (direction,), has_aux=True)
        return value, choices, jax.grad(loss, has_aux=True)(inputs)[0], slope

    camera = given.intrinsics
    inputs = Inputs(
        camera=jnp.stack([camera.fx, camera.fy, camera.cx, camera.cy]),
        weight=0.9 * state.points.weight,
        X_world=state.points.X_world,
        loss_scale=given.loss_scale,
        pixel_sigma=given.pixel_sigma,
        readout_s=given.readout_s,
        image=jnp.zeros(()),
    )
    gradient = evaluate(inputs, jax.tree.map(jnp.zeros_like, inputs))[2]
    return Problem(inputs, gradient, evaluate, state.points.valid)


class TestGradient:
    @pytest.mark.parametrize(
        ("name", "size"),
        [
            ("camera", 1e-4),
            ("weight", 1e-4),
            ("X_world", 1e-6),
            ("loss_scale", 1e-4),
            ("pixel_sigma", 1e-4),
            ("readout_s", 1e-6),
            ("image", 1e-4),
        ],
    )
    def test_modes_and_differences_agree(self, problem: Problem, name: str, size: float) -> None:
        shape = getattr(problem.inputs, name).shape
        random = jnp.asarray(np.random.default_rng(1).normal(size=shape))
        if shape and shape[-1] == problem.counted.size:
            random = jnp.where(jnp.broadcast_to(problem.counted, shape), random, 0)
        direction = jax.tree.map(jnp.zeros_like, problem.inputs)._replace(**{name: random})
        reverse = float(jnp.vdot(getattr(problem.gradient, name), random))
        _, here, _, forward = problem.evaluate(problem.inputs, direction)
        values = []
        for sign in (1, -1):
            moved = jax.tree.map(lambda value, along: value + sign * size * along, problem.inputs, direction)  # noqa: B023
            value, choices, _, _ = problem.evaluate(moved, direction)
            for now, then in zip(choices, here, strict=True):
                np.testing.assert_array_equal(now, then)
            values.append(float(value))
        difference = (values[0] - values[1]) / (2 * size)
        assert reverse != 0
        assert reverse == pytest.approx(float(forward), rel=1e-6)
        assert reverse == pytest.approx(difference, rel=2e-3)

    def test_is_finite(self, problem: Problem) -> None:
        for name, gradient in problem.gradient._asdict().items():
            assert jnp.isfinite(gradient).all(), name
