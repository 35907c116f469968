"""Soft masks of ignored pixels: from 0 to 1, the same as a mask of `bool` at both ends, and with a gradient between."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick_compile import quick_compile
from small_scene import PLAN, WIDTH, at, clip, new_state, params, stacked

from jaxslam import FrameArrays, TrackOutput, TrackState, TrackStatus, track_step
from jaxslam.dynamics.regions import RegionPlan, Regions, moving_pixels, moving_shares
from jaxslam.sensors.measurement import PreparedFrame
from jaxslam.tracking.dynamic_rejection import DynamicRejection

FRAMES = 5
step = quick_compile(partial(track_step, plan=PLAN))


@pytest.fixture(scope="module")
def frames() -> FrameArrays:
    """Frames with people, whose left third is masked."""
    recording = stacked(clip(2).frames[:FRAMES])
    return recording._replace(ignore=recording.ignore.at[:, :, : WIDTH // 3].set(True))


def tracked(frames: FrameArrays) -> tuple[TrackState, TrackOutput]:
    state = new_state()
    for index in range(FRAMES - 1):
        state, _ = step(state, at(frames, index), params())
    return step(state, at(frames, FRAMES - 1), params())


@pytest.fixture(scope="module")
def hard(frames: FrameArrays) -> tuple[TrackState, TrackOutput]:
    return tracked(frames)


@pytest.mark.slow
def test_of_zeros_and_ones_is_as_of_bool(frames: FrameArrays, hard: tuple[TrackState, TrackOutput]) -> None:
    soft = tracked(frames._replace(ignore=frames.ignore.astype(jnp.float32)))
    np.testing.assert_allclose(hard[1].T_world_cam.wxyz_xyz, soft[1].T_world_cam.wxyz_xyz, atol=1e-5)
    np.testing.assert_array_equal(hard[1].id, soft[1].id)
    np.testing.assert_array_equal(hard[1].weights, soft[1].weights)
    assert not (hard[0].points.valid & (hard[0].points.uv[0] < WIDTH // 3 - 1)).any()


@pytest.mark.slow
def test_between_them_points_count_in_part(frames: FrameArrays, hard: tuple[TrackState, TrackOutput]) -> None:
    """A mask of 0.25 leaves all points with three quarters of their weight, in the pose and in keyframes."""
    quarter = jnp.full(frames.ignore.shape, 0.25)
    state, output = tracked(frames._replace(ignore=quarter))
    counted = output.weights > 0
    assert int(counted.sum()) > int((hard[1].weights > 0).sum())
    np.testing.assert_allclose(output.weights[counted], 0.75)
    assert float(state.keyframes.weight.max()) == pytest.approx(0.75 * float(hard[0].keyframes.weight.max()))


@pytest.mark.slow
def test_arrays_of_numpy_outside_of_jit(frames: FrameArrays) -> None:
    """With nothing traced, the step takes them as they are."""
    first = jax.device_get(at(frames, 0))
    state, output = track_step(new_state(), first, params(), PLAN)
    expected, _ = step(new_state(), at(frames, 0), params())
    assert int(output.status) == TrackStatus.STARTED
    np.testing.assert_array_equal(state.points.valid, expected.points.valid)


class TestMovingRegions:
    """Four regions, of weight 1, 0.8, 0.3 and 0, one block of pixels each; the fifth block has no depth."""

    PLAN = RegionPlan(num_regions=4, step_px=4)
    WEIGHT = jnp.array([1.0, 0.8, 0.3, 0.0])
    REGIONS = Regions(jnp.array([[0, 1, 2, 3, -1]]), jnp.zeros(1, jnp.int32), jnp.zeros((3, 4)), jnp.ones(4, jnp.int32))

    def test_share_of_each_pixel(self) -> None:
        shares = moving_shares(self.REGIONS, self.WEIGHT, 3, 20, self.PLAN)
        assert shares.shape == (3, 20)
        np.testing.assert_allclose(shares[1, ::4], [0.0, 0.2, 0.7, 1.0, 0.0], atol=1e-7)
        np.testing.assert_array_equal(shares > 0.5, moving_pixels(self.REGIONS, self.WEIGHT, 3, 20, self.PLAN))
        slope = jax.grad(lambda weight: moving_shares(self.REGIONS, weight, 3, 20, self.PLAN).sum())(self.WEIGHT)
        np.testing.assert_allclose(slope, -12.0)  # three rows of four pixels

    def test_soft_mask_takes_the_larger_part(self) -> None:
        shares, moving = (made(self.REGIONS, self.WEIGHT, 3, 20, self.PLAN) for made in (moving_shares, moving_pixels))
        frame = at(stacked(clip().frames[:1]), 0)._replace(ignore=jnp.full((3, 20), 0.5))
        view = PreparedFrame(frame, new_state().pyramid, frame.dt_s)
        left = DynamicRejection(moving=moving, ignored=shares).without_moving_pixels(view)
        np.testing.assert_allclose(left.frame.ignore[0, ::4], [0.5, 0.5, 0.7, 1.0, 0.5], atol=1e-7)
