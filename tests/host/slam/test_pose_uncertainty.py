"""Uncertainty of poses: what it adds to the covariance of the fit, and when."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frame_results import RESULT

from jaxslam.config.schema import TrackConfig
from jaxslam.geometry.se3 import IDENTITY, inverse, retract
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.pose_uncertainty import PoseUncertainty
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.points import KeyframeRing
from jaxslam.tracking.state import KeyframeReason, TrackOutput, TrackPlan, TrackStatus

CAMERA = Camera("test", width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
PLAN = TrackPlan(num_points=8, num_keyframes=2)
FIT = np.diag([1e-6, 2e-6, 4e-6, 1e-7, 2e-7, 3e-7]).astype(np.float32)
"""Covariance of a fit: 1 to 2 mm, and some 0.02 degrees."""
POINTS = np.vstack([np.linspace(-1, 1, 8), np.zeros(8), np.full(8, 2.0)]).astype(np.float32)
EVERY = np.ones(8, bool)


@pytest.fixture
def uncertainty() -> PoseUncertainty:
    """Uncertainty after a first frame at the origin."""
    made = PoseUncertainty(CAMERA, sensor_model(CAMERA, TrackConfig()), 1.0)
    started = replace(RESULT, status=TrackStatus.STARTED, covariance=1e-12 * np.eye(6, dtype=np.float32))
    np.testing.assert_array_equal(made.of_pose(started, output(), ring()), started.covariance)
    return made


def output(
    fit: np.ndarray = FIT, followed: np.ndarray = EVERY, matched: float = 0.0, scale: float = 1.0
) -> TrackOutput:
    """Output of a frame of eight points."""
    blank: Any = dict.fromkeys(TrackOutput._fields)
    matches: Any = type("Matches", (), {"weight": np.full(8, matched / 8)})
    values = {"covariance": fit, "weights": np.ones(8), "tracked": followed, "X_world": scale * POINTS}
    return TrackOutput(**blank | values | {"keyframe_matches": matches})


def ring(shift: np.ndarray | None = None) -> KeyframeRing:
    """A ring with one keyframe; at the origin unless it is shifted."""
    empty = init_state(48, 64, PLAN).keyframes
    poses = np.tile(IDENTITY, (len(empty.weight), 1)).astype(np.float32)
    poses[0, 4:] += 0 if shift is None else shift
    weight = np.zeros(empty.weight.shape, np.float32)
    weight[0] = 1
    return empty._replace(T_world_cam=poses, weight=weight)  # type: ignore[arg-type]


def result(pose: np.ndarray = IDENTITY, residual_px: float = 0.2, **values: Any) -> FrameResult:
    """Result of a frame whose covariance is that of the fit."""
    values = {"covariance": FIT, **values}
    return replace(RESULT, T_world_cam=pose, residual_px=residual_px, **values)


def test_at_a_keyframe(uncertainty: PoseUncertainty) -> None:
    """Half of the assumed pixels, as residuals do not tell all errors; more where residuals are larger."""
    covariance = uncertainty.of_pose(result(), output(), ring())
    assert covariance.dtype == np.float32
    np.testing.assert_allclose(covariance, 0.25 * FIT, rtol=1e-3)
    blurred = uncertainty.of_pose(result(residual_px=1.5), output(), ring())
    np.testing.assert_allclose(blurred, 2.25 * FIT, rtol=1e-3)


def test_grows_with_the_way_from_a_keyframe(uncertainty: PoseUncertainty) -> None:
    """At 2 m, depth is known to 1.65 %, and 0.4 m shift points by 10 px: their errors by 0.165 px."""
    for way, pixels in ((0.4, 0.165), (4.0, 1.65)):
        there = retract(IDENTITY, np.array([way, 0, 0, 0, 0, 0]))
        uncertainty.of_pose(result(there), output(), ring(there[4:]))  # where it was before does not matter
        covariance = uncertainty.of_pose(result(there), output(), ring())
        np.testing.assert_allclose(covariance, (0.25 + pixels**2) * FIT, rtol=1e-3, atol=3e-11)
    near = uncertainty.of_pose(result(there), output(), ring(np.array([4.0, 0, 0])))
    np.testing.assert_allclose(near, 0.25 * FIT, rtol=1e-3, atol=3e-11)


def test_a_turn_needs_no_depth(uncertainty: PoseUncertainty) -> None:
    turned = retract(IDENTITY, np.array([0, 0, 0, 0.1, 0.2, 0]))
    np.testing.assert_allclose(uncertainty.of_pose(result(turned), output(), ring()), 0.25 * FIT, rtol=1e-3, atol=3e-11)


def test_new_points_are_as_unsure_as_the_pose_that_put_them_there(uncertainty: PoseUncertainty) -> None:
    unsure = 100 * FIT
    none, half = ~EVERY, np.arange(8) < 4
    first = uncertainty.of_pose(result(covariance=unsure), output(unsure, followed=none), ring())
    np.testing.assert_allclose(first, 25 * FIT, rtol=1e-3)
    followed = uncertainty.of_pose(result(), output(), ring())
    np.testing.assert_allclose(followed, 25.25 * FIT, rtol=1e-3)
    held = uncertainty.of_pose(result(), output(matched=8), ring())  # half of the points are those of a keyframe
    np.testing.assert_allclose(held, (0.25 + 25 / 4) * FIT, rtol=1e-3)
    uncertainty.of_pose(result(), output(followed=half), ring())  # half of them are replaced, at 25.25
    mixed = uncertainty.of_pose(result(), output(), ring())
    np.testing.assert_allclose(mixed, (0.25 + (25 + 25.25) / 2) * FIT, rtol=1e-3)


def test_a_keyframe_is_the_new_reference(uncertainty: PoseUncertainty) -> None:
    """Its own errors are those of all frames that are relative to it, whatever points they share."""
    unsure = 100 * FIT
    uncertainty.of_pose(result(covariance=unsure), output(unsure, followed=~EVERY), ring())
    keyframe = uncertainty.of_pose(result(keyframe=KeyframeReason.FEW_POINTS), output(), ring())
    np.testing.assert_allclose(keyframe, 25.25 * FIT, rtol=1e-3)  # it is relative to the keyframe before
    np.testing.assert_allclose(uncertainty.of_pose(result(), output(), ring()), 0.5 * FIT, rtol=1e-3)


def test_turns_with_the_camera(uncertainty: PoseUncertainty) -> None:
    """A variance along x is one along z after a quarter turn about y, also when the world is corrected."""
    unsure = 1e-8 * np.eye(6, dtype=np.float32)
    unsure[0, 0] = 4e-4
    uncertainty.of_pose(result(covariance=unsure), output(unsure, followed=~EVERY), ring())
    turned = retract(IDENTITY, np.array([0, 0, 0, 0, np.pi / 2, 0]))
    correction = retract(IDENTITY, np.array([0.3, 0, 0, 0, 0, 0.5]))
    lost = result(status=TrackStatus.LOST, covariance=100 * np.eye(6, dtype=np.float32), correction=correction)
    np.testing.assert_array_equal(uncertainty.of_pose(lost, output(), ring()), lost.covariance)
    back = result(turned, correction=inverse(correction))
    covariance = uncertainty.of_pose(back, output(), ring())
    np.testing.assert_allclose(np.diag(covariance)[:3], [2.5e-9 + 0.25e-6, 2.5e-9 + 0.5e-6, 1e-4 + 1e-6], rtol=1e-3)


def test_places_that_are_recognized_begin_anew(uncertainty: PoseUncertainty) -> None:
    unsure = 100 * FIT
    uncertainty.of_pose(result(covariance=unsure), output(unsure, followed=~EVERY), ring())
    recognized = result(status=TrackStatus.RELOCALIZED, covariance=3 * FIT)
    np.testing.assert_array_equal(uncertainty.of_pose(recognized, output(), ring()), 3 * FIT)
    np.testing.assert_allclose(uncertainty.of_pose(result(), output(), ring()), 3.25 * FIT, rtol=1e-3)


def test_doubt_of_others_stays(uncertainty: PoseUncertainty) -> None:
    """`BackgroundConsistency` adds the motion that the background does not confirm, which is not of the fit."""
    doubt = np.diag([1e-2, 1e-2, 1e-2, 0, 0, 0]).astype(np.float32)
    covariance = uncertainty.of_pose(result(covariance=FIT + doubt), output(), ring())
    np.testing.assert_allclose(covariance, 0.25 * FIT + doubt, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("factor", [0.25, 8.0])
def test_any_scale(factor: float) -> None:
    """With all lengths times a factor, translations are as many times less sure, and rotations as sure."""
    units = np.repeat([factor, 1.0], 3)
    there, after = [], []
    for scale, found in ((1.0, there), (factor, after)):
        config = TrackConfig(
            depth_sigma_m=0.005 * scale,
            depth_sigma_per_m2=0.007 / scale,
            min_depth_m=0.1 * scale,
            max_depth_m=6 * scale,
        )
        made = PoseUncertainty(CAMERA, sensor_model(CAMERA, config), 1.0)
        nothing = np.zeros((6, 6), np.float32)
        made.of_pose(replace(RESULT, status=TrackStatus.STARTED, covariance=nothing), output(), ring())
        fit = (FIT * np.outer(np.repeat([scale, 1], 3), np.repeat([scale, 1], 3))).astype(np.float32)
        for step in range(3):
            pose = retract(IDENTITY, scale * step * np.array([0.5, 0, 0, 0, 0, 0]))
            seen = output(fit, followed=np.arange(8) > step, scale=scale)
            found.append(made.of_pose(result(pose, covariance=fit), seen, ring()))
    np.testing.assert_allclose(after, np.outer(units, units) * np.array(there), rtol=1e-3, atol=1e-12)
