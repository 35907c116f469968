"""Derivatives through ten tracked frames, in float64: forward mode, reverse mode and finite differences agree.

Which points agree, and which keyframes are looked into, are constants of the derivative. Searches run to the end
(`TrackPlan.exact`): those that stop early are functions of where they start too.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.camera import Intrinsics
from jaxtyping import Array
from quick_compile import quick_compile
from small_scene import PLAN, Clip, at, clip, new_state, params, stacked, truth_from_start
from step_inputs import CONSTANT_PARAMS, STEP_INPUTS, STEPS, STEPS_TWICE

from jaxslam.tracking.rollout import rollout
from jaxslam.tracking.state import TrackParams
from jaxslam.tracking.step import track_step

BEFORE = 10
EXACT = PLAN.exact()


class Inputs(NamedTuple):
    """What the loss is differentiated by; `image` and `ignore` scale one random change of all images and masks each."""

    camera: Array
    weight: Array
    X_world: Array
    loss_scale: Array
    pixel_sigma: Array
    readout_s: Array
    image: Array
    ignore: Array
    distortion: Array
    depth_sigma_per_m2: Array


class Problem(NamedTuple):
    inputs: Inputs
    gradient: Inputs
    loss: Callable[[Inputs], Array]
    slope: Callable[[Inputs], Array]
    """Directional derivative, by forward mode."""
    counted: Array
    """Which points exist."""
    of_params: TrackParams
    """Gradient by the parameters, but for those that are inputs."""

    def direction(self, seed: int) -> Inputs:
        """A random change of every input, of the size of one."""
        random = np.random.default_rng(seed)
        return jax.tree.map(lambda array: jnp.asarray(random.normal(size=array.shape)), self.inputs)


@pytest.fixture(scope="module")
def problem() -> Iterator[Problem]:
    recording = clip()
    with jax.enable_x64(True):
        yield _problem(*_loss(recording, STEPS))


def _problem(loss: Callable[..., Array], inputs: Inputs, counted: Array, given: TrackParams) -> Problem:
    gradient, of_params = quick_compile(jax.grad(loss, argnums=(0, 1)))(inputs, given)
    forward = quick_compile(lambda direction: jax.jvp(loss, (inputs,), (direction,))[1])
    return Problem(inputs, gradient, quick_compile(loss), forward, counted, of_params)


def _loss(recording: Clip, steps: int) -> tuple[Callable[..., Array], Inputs, Array, TrackParams]:
    """The squared error of the position over some frames, what it depends on, which points exist, and parameters."""
    frames = stacked(recording.frames[: BEFORE + steps], np.float64, np.float64)
    given = params(np.float64)
    given = given._replace(sensor=given.sensor._replace(readout_s=jnp.asarray(0.005, np.float64)))
    step = quick_compile(track_step, static_argnums=3)
    state = new_state(np.float64, np.float64)
    for index in range(BEFORE):
        state, _ = step(state, at(frames, index), given, EXACT)
    given = given._replace(detect_below=jnp.zeros(()), keyframe_below=jnp.zeros(()))
    window = jax.tree.map(lambda array: array[BEFORE:], frames)
    random = np.random.default_rng(0)
    change = jnp.asarray(random.normal(size=window.image.shape))
    ignore, other = (jnp.asarray(random.uniform(size=window.image.shape)) for _ in range(2))
    truth = jnp.asarray(truth_from_start(recording.source.ground_truth)[BEFORE : BEFORE + steps, :3, 3])

    def loss(inputs: Inputs, given: TrackParams = given) -> Array:
        fx, fy, cx, cy = inputs.camera
        sensor = given.sensor._replace(
            intrinsics=Intrinsics(fx, fy, cx, cy, inputs.distortion),
            readout_s=inputs.readout_s,
            depth_sigma_per_m2=inputs.depth_sigma_per_m2,
        )
        changed = given._replace(sensor=sensor, loss_scale=inputs.loss_scale, pixel_sigma=inputs.pixel_sigma)

        points = state.points._replace(weight=inputs.weight, X_world=inputs.X_world)
        mask = 0.8 * ignore + inputs.ignore * (other - ignore)
        seen = window._replace(
            image=window.image + inputs.image * change,
            ignore=mask,
        )
        _, outputs = rollout(state._replace(points=points), seen, changed, EXACT)
        return jnp.sum(jnp.square(outputs.T_world_cam.translation() - truth))

    camera = given.sensor.intrinsics
    inputs = Inputs(
        camera=jnp.stack([camera.fx, camera.fy, camera.cx, camera.cy]),
        weight=0.9 * state.points.weight,
        X_world=state.points.X_world,
        loss_scale=given.loss_scale,
        pixel_sigma=given.pixel_sigma,
        readout_s=given.sensor.readout_s,
        image=jnp.zeros(()),
        ignore=jnp.zeros(()),
        distortion=jnp.asarray(camera.distortion),
        depth_sigma_per_m2=given.sensor.depth_sigma_per_m2,
    )
    return loss, inputs, state.points.valid, given


def test_every_input_is_listed() -> None:
    assert tuple(STEP_INPUTS) == Inputs._fields


def test_one_frame_along_a_change_of_everything() -> None:
    """Each input by what its own comparison takes, so that none drowns the others."""
    with jax.enable_x64(True):
        loss, inputs, *_ = _loss(clip(), steps=1)
        random = np.random.default_rng(2)
        lengths = Inputs(**{name: jnp.asarray(each.first) for name, each in STEP_INPUTS.items()})
        # Steps a tenth as long: all together cross ten times as many bends of interpolation, 0.1 % of the difference.
        along = jax.tree.map(lambda value, h: jnp.asarray(0.1 * h * random.normal(size=value.shape)), inputs, lengths)
        moved = lambda sign: jax.tree.map(lambda value, change: value + sign * change, inputs, along)
        both = quick_compile(lambda at: jax.jvp(loss, (at,), (along,)))
        expected = (float(both(moved(1))[0]) - float(both(moved(-1))[0])) / 2
        assert abs(expected) > 0
        assert float(both(inputs)[1]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
class TestGradient:
    @pytest.mark.parametrize("name", Inputs._fields)
    def test_equals_finite_differences(self, problem: Problem, name: str) -> None:
        along = getattr(problem.direction(seed=2), name)
        h = STEP_INPUTS[name].first
        moved = lambda step: problem.inputs._replace(**{name: getattr(problem.inputs, name) + step * along})
        expected = (float(problem.loss(moved(h))) - float(problem.loss(moved(-h)))) / (2 * h)
        derivative = float(jnp.vdot(getattr(problem.gradient, name), along))
        print(f"{name}: derivative {derivative:.6e}, finite difference {expected:.6e}")
        assert abs(expected) > 0
        assert derivative == pytest.approx(expected, rel=1e-3)

    def test_forward_equals_reverse(self, problem: Problem) -> None:
        """Along a random change of everything, scaled so that every input contributes as much as any other."""
        shares = jax.tree.map(jnp.vdot, problem.gradient, problem.direction(seed=1))
        assert all(float(share) != 0 for share in shares)
        direction = jax.tree.map(lambda along, share: along / jnp.abs(share), problem.direction(seed=1), shares)
        expected = sum(float(jnp.vdot(a, b)) for a, b in zip(problem.gradient, direction, strict=True))
        assert float(problem.slope(direction)) == pytest.approx(expected, abs=1e-6)

    def test_is_finite(self, problem: Problem) -> None:
        for name, gradient in problem.gradient._asdict().items():
            assert jnp.isfinite(gradient).all(), name

    def test_is_zero_by_what_only_compares(self, problem: Problem) -> None:
        for name in CONSTANT_PARAMS:
            assert not jnp.any(getattr(problem.of_params, name)), name

    def test_points_without_a_slot_have_none(self, problem: Problem) -> None:
        assert not jnp.where(problem.counted, 0, problem.gradient.weight).any()


@pytest.mark.slow
def test_second_derivative_equals_finite_differences() -> None:
    """Of the gradient, along a change of each input; forward over reverse, as `jax.hessian` computes it."""
    recording = clip()
    with jax.enable_x64(True):
        loss, inputs, *_ = _loss(recording, STEPS_TWICE)
        both = quick_compile(lambda at, along: jax.jvp(jax.grad(loss), (at,), (along,)))
        nothing = jax.tree.map(jnp.zeros_like, inputs)
        lengths = {name: each.second for name, each in STEP_INPUTS.items() if each.second is not None}
        for name, h in lengths.items():
            value = getattr(inputs, name)
            change = jnp.asarray(np.random.default_rng(2).normal(size=value.shape))
            along = nothing._replace(**{name: change})
            moved = [both(inputs._replace(**{name: value + k * h * change}), along)[0] for k in (-1, 1)]
            second = both(inputs, along)[1]
            for by in lengths:
                before, after, derivative = (getattr(of, by) for of in (*moved, second))
                expected = (after - before) / (2 * h)
                largest = float(jnp.abs(expected).max())
                print(
                    f"{name}, {by}: {largest:.3e}, off by {float(jnp.abs(derivative - expected).max()) / largest:.1e}"
                )
                assert largest > 0
                np.testing.assert_allclose(derivative, expected, atol=1e-3 * largest, err_msg=f"{name}, {by}")
