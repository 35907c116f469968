"""Fit of settings through the tracker, on a small rendered room."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from quick_compile import quick_compile
from small_scene import PLAN, clip, new_state, params, stacked

from jaxslam import FrameArrays, TrackOutput, TrackParams, rollout
from jaxslam.learning import ate_loss, fit, pose_loss

FRAMES = 6


@pytest.fixture(scope="module")
def frames() -> FrameArrays:
    return jax.device_get(stacked(clip(frames=60).frames[: 5 * FRAMES : 5]))


def with_focal(factor: float) -> TrackParams:
    given = params()
    camera = given.sensor.intrinsics
    wrong = camera._replace(fx=camera.fx * np.float32(factor), fy=camera.fy * np.float32(factor))
    return given._replace(sensor=given.sensor._replace(intrinsics=wrong))


def focal(given: TrackParams) -> tuple[Any, Any]:
    return given.sensor.intrinsics.fx, given.sensor.intrinsics.fy


@pytest.mark.slow
def test_finds_a_focal_length(frames: FrameArrays) -> None:
    """From 5 % off, that with which the tracker itself has made the poses; the best settings have the smallest loss."""
    state = new_state()
    truth = quick_compile(partial(rollout, plan=PLAN))(state, frames, params())[1].T_world_cam
    found = fit(with_focal(1.05), pose_loss, frames, truth, select=focal, plan=PLAN, max_steps=15, progress=False)
    right = float(params().sensor.intrinsics.fx)
    print(found.losses, [float(value) / right for value in focal(found.params)])
    assert found.losses[found.best] == found.losses.min() < 0.05 * found.losses[0]
    assert all(abs(float(value) / right - 1) < 0.015 for value in focal(found.params))
    assert len(found.losses) <= 16


class TestOfOutputs:
    """Losses that need no tracking to be right or wrong: compiled once each, with few frames."""

    @staticmethod
    def away_from(outputs: TrackOutput, goal: Any) -> jax.Array:
        """Loss that the settings cannot change but through the size of the covariance."""
        return jnp.square(jnp.log(outputs.covariance[-1, 0, 0]) - goal)

    @pytest.mark.slow
    def test_stops_when_nothing_gets_better(self, frames: FrameArrays) -> None:
        two = jax.tree.map(lambda array: array[:2], frames)
        constant = lambda outputs, truth: truth + 0 * outputs.residual_px.sum()
        select = lambda given: given.pixel_sigma
        found = fit(
            params(), constant, two, jnp.ones(()), select=select, plan=PLAN, patience=3, max_steps=50, progress=False
        )
        assert found.stopped_early
        assert found.best == 0
        assert len(found.losses) == 4

    @pytest.mark.slow
    def test_several_clips_and_held_out_ones(self, frames: FrameArrays) -> None:
        """The held-out clip has its own loss, and an optimizer of the caller's moves the setting."""
        two = jax.tree.map(lambda array: array[:2], frames)
        select = lambda given: given.pixel_sigma
        found = fit(
            params(), self.away_from, [two, two], [jnp.zeros(()), jnp.zeros(())], select=select, plan=PLAN,
            held_out=(two, jnp.ones(())), optimizer=optax.sgd(1e-3), max_steps=3, progress=False,
        )  # fmt: skip
        assert len(found.losses) == 4
        assert found.losses[-1] < found.losses[0]
        assert float(found.params.pixel_sigma) > float(params().pixel_sigma) > 0

    @pytest.mark.slow
    def test_not_finite(self, frames: FrameArrays) -> None:
        two = jax.tree.map(lambda array: array[:2], frames)
        nothing = lambda outputs, truth: truth * outputs.residual_px.sum()
        select = lambda given: given.pixel_sigma
        with pytest.raises(FloatingPointError, match="loss: expected a finite loss and derivative, got nan"):
            fit(params(), nothing, two, jnp.array(jnp.nan), select=select, plan=PLAN, progress=False)


class TestRefused:
    def test_numbers(self, frames: FrameArrays) -> None:
        select = lambda given: given.pixel_sigma
        with pytest.raises(ValueError, match="clips: expected at least one, got none"):
            fit(params(), ate_loss, [], [], select=select, plan=PLAN)
        with pytest.raises(ValueError, match="truth: expected one for each of 2 clips, got 1"):
            fit(params(), ate_loss, [frames, frames], [None], select=select, plan=PLAN)

    def test_nothing_to_fit(self, frames: FrameArrays) -> None:
        with pytest.raises(ValueError, match="select: expected at least one setting, got none"):
            fit(params(), ate_loss, frames, None, select=lambda given: (), plan=PLAN)
        whole = params()._replace(min_inliers=jnp.zeros((), jnp.int32))
        with pytest.raises(TypeError, match="select: expected a floating-point array, got int32"):
            fit(whole, ate_loss, frames, None, select=lambda given: given.min_inliers, plan=PLAN)
