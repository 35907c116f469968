"""Log of relative poses: which pose a pose is relative to."""

from dataclasses import replace

import numpy as np
import pytest
from frame_results import RESULT

from jaxslam.errors import DatasetError
from jaxslam.geometry.se3 import IDENTITY, between, compose, retract
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.relative_pose_log import RelativePoseLog
from jaxslam.tracking.state import KeyframeReason, TrackStatus

STEP_NS = 100_000_000


def result(index: int, **values: object) -> FrameResult:
    """Frame `index`, a step further each."""
    pose = retract(IDENTITY, index * np.array([0.1, 0, 0.02, 0, 0.03, 0]))
    return replace(RESULT, timestamp_ns=index * STEP_NS, T_world_cam=pose, **values)  # type: ignore[arg-type]


def logged(results: list[FrameResult]) -> RelativePoseLog:
    log = RelativePoseLog()
    for each in results:
        log(None, each)
    return log


KEYFRAME = KeyframeReason.STARTED


def test_latest_keyframe_of_the_last_second() -> None:
    results = [result(index, keyframe=KEYFRAME if index in (0, 5, 30) else KeyframeReason.NONE) for index in range(35)]
    poses = logged(results).poses()
    references = dict(zip(poses.timestamps_ns // STEP_NS, poses.reference_ns // STEP_NS, strict=True))
    # After frame 15, keyframe 5 is older than a second; a keyframe is relative to the one before.
    expected = dict.fromkeys(range(1, 6), 0) | dict.fromkeys(range(6, 16), 5) | {i: i - 10 for i in range(16, 31)}
    assert references == expected | dict.fromkeys(range(31, 35), 30)
    for at, (now, before) in enumerate(references.items()):
        expected_motion = between(results[before].T_world_cam, results[now].T_world_cam)
        np.testing.assert_allclose(poses.T_reference_cam[at], expected_motion, atol=1e-12)
    assert poses.covariance.shape == (34, 6, 6)


def test_world_that_is_corrected() -> None:
    """Motions do not depend on where the map puts the world."""
    shift = retract(IDENTITY, np.array([0.3, -0.2, 0.1, 0.05, 0.1, -0.2]))
    results = [result(index) for index in range(6)]
    moved = [
        *results[:3],
        replace(results[3], T_world_cam=compose(shift, results[3].T_world_cam), correction=shift),
        *(replace(each, T_world_cam=compose(shift, each.T_world_cam)) for each in results[4:]),
    ]
    expected, got = logged(results).poses(), logged(moved).poses()
    np.testing.assert_array_equal(got.reference_ns, expected.reference_ns)
    np.testing.assert_allclose(got.T_reference_cam, expected.T_reference_cam, atol=1e-12)


@pytest.mark.parametrize("status", [TrackStatus.WEAK, TrackStatus.LOST, TrackStatus.RELOCALIZED])
@pytest.mark.parametrize("keyframe", [KeyframeReason.NONE, KEYFRAME])
def test_only_ok_poses_count(status: TrackStatus, keyframe: KeyframeReason) -> None:
    """Those of other frames are relative to nothing, and only those of keyframes are references."""
    results = [result(0, status=TrackStatus.STARTED), result(1, status=status, keyframe=keyframe), result(2)]
    poses = logged(results).poses()
    assert poses.timestamps_ns.tolist() == [2 * STEP_NS]
    assert poses.reference_ns.tolist() == [0 if keyframe == KeyframeReason.NONE else STEP_NS]


def test_submaps_have_nothing_in_common() -> None:
    poses = logged([result(0), result(1), result(2, submap=1), result(3, submap=1)]).poses()
    assert (poses.reference_ns // STEP_NS).tolist() == [0, 2]


def test_rejected_frames_and_clocks_that_are_set_back() -> None:
    log = logged([result(5), result(6)])
    log(None, Rejected(7 * STEP_NS, DatasetError("no image")))
    log(None, result(2))
    log(None, result(3))
    assert (log.poses().reference_ns // STEP_NS).tolist() == [5, 2]


def test_empty() -> None:
    poses = RelativePoseLog().poses()
    assert [len(values) for values in poses] == [0, 0, 0, 0]
