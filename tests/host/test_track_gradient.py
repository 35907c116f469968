"""Derivatives through ten tracked frames, in float64: forward mode and reverse mode agree, and nothing is lost or NaN.

Which points agree, and which keyframes are looked into, are constants of the derivative.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxtyping import Array
from small_scene import QUICK_COMPILE, SIZES, Clip, at, clip, new_state, params, stacked, truth_from_start

from jaxslam.state import FrameArrays, TrackState
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
    evaluate: Callable[[Inputs, Inputs], tuple[Array, Inputs, Array]]
    """Loss, gradient and directional derivative."""
    counted: Array
    """Which points exist."""


@pytest.fixture(scope="module")
def problem() -> Iterator[Problem]:
    recording = clip()
    with jax.enable_x64(True):
        yield _problem(recording)


def _problem(recording: Clip) -> Problem:
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

    def loss(inputs: Inputs) -> Array:
        fx, fy, cx, cy = inputs.camera
        changed = given._replace(
            intrinsics=given.intrinsics._replace(fx=fx, fy=fy, cx=cx, cy=cy),
            loss_scale=inputs.loss_scale,
            pixel_sigma=inputs.pixel_sigma,
            readout_s=inputs.readout_s,
        )

        def advance(state: TrackState, frame: FrameArrays) -> tuple[TrackState, Array]:
            state, output = track_step(state, frame, changed, SIZES)
            return state, output.T_world_cam.translation()

        points = state.points._replace(weight=inputs.weight, X_world=inputs.X_world)
        seen = window._replace(image=window.image + inputs.image * change)
        _, positions = lax.scan(advance, state._replace(points=points), seen)
        return jnp.sum(jnp.square(positions - truth))

    def evaluate(inputs: Inputs, direction: Inputs) -> tuple[Array, Inputs, Array]:
        value, slope = jax.jvp(loss, (inputs,), (direction,))
        return value, jax.grad(loss)(inputs), slope

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
    compiled = jax.jit(evaluate).lower(inputs, inputs).compile(QUICK_COMPILE)
    return Problem(inputs, compiled(inputs, inputs)[1], compiled, state.points.valid)


class TestGradient:
    def test_forward_equals_reverse(self, problem: Problem) -> None:
        """Along a random change of everything, scaled so that every input contributes as much as any other."""
        random = np.random.default_rng(1)
        directions: dict[str, Array] = {}
        for name, gradient in problem.gradient._asdict().items():
            along = jnp.asarray(random.normal(size=gradient.shape))
            share = float(jnp.vdot(gradient, along))
            assert share != 0, name
            directions[name] = along / abs(share)
        direction = Inputs(**directions)
        expected = sum(float(jnp.vdot(a, b)) for a, b in zip(problem.gradient, direction, strict=True))
        forward = float(problem.evaluate(problem.inputs, direction)[2])
        assert forward == pytest.approx(expected, abs=1e-5)

    def test_is_finite(self, problem: Problem) -> None:
        for name, gradient in problem.gradient._asdict().items():
            assert jnp.isfinite(gradient).all(), name

    def test_points_without_a_slot_have_none(self, problem: Problem) -> None:
        assert not jnp.where(problem.counted, 0, problem.gradient.weight).any()
