"""Poses that were given out, and the constant velocity that predicts the next one."""

import numpy as np

from jaxslam.geometry.se3 import IDENTITY, compose, retract
from jaxslam.slam.pose_history import ConstantVelocity, PoseHistory
from jaxslam.slam.tracker_map_sync import AnchoredPose

POSE = retract(IDENTITY, np.array([0.1, 0.2, -0.3, 0.05, 0.0, 0.1]))
TWIST = np.array([1.0, 0.0, 0.0, 0.0, 0.5, 0.0])


EXACT = np.array([0.5, 0.5, -0.5, 0.5, 0.25, -1.5, 2.0])
"""A pose that float32 holds without rounding, as those of the tracker."""


class TestPoseHistory:
    def filled(self) -> PoseHistory:
        history = PoseHistory()
        for number, in_map_frame in enumerate((True, True, False)):
            anchored = AnchoredPose(number, POSE)
            history.add(30 - 10 * number, EXACT, anchored, in_map_frame=in_map_frame)
        return history

    def test_online(self) -> None:
        """In the order of time, and those of the map's frame only."""
        online = self.filled().online()
        assert online.timestamps_ns.tolist() == [20, 30]
        np.testing.assert_array_equal(online.T_world_cam, [EXACT, EXACT])

    def test_by_submap(self) -> None:
        found = self.filled().by_submap(
            lambda keyframe: retract(POSE, keyframe * TWIST), lambda keyframe: keyframe // 2
        )
        assert {submap: trajectory.timestamps_ns.tolist() for submap, trajectory in found.items()} == {
            0: [20, 30],
            1: [10],
        }
        np.testing.assert_allclose(found[0].T_world_cam[0], compose(retract(POSE, TWIST), POSE), atol=1e-6)

    def test_an_hour(self) -> None:
        """More poses than one block holds, in 10 MB an hour at 30 Hz."""
        history, number = PoseHistory(), 10_000
        for frame in range(number):
            history.add(frame, POSE, AnchoredPose(frame // 100, POSE), in_map_frame=True)
        assert len(history) == number
        assert history.online().timestamps_ns.tolist() == list(range(number))
        assert history.num_bytes / number * 30 * 3600 < 10e6

    def test_empty(self) -> None:
        assert not PoseHistory()
        assert len(PoseHistory().online().timestamps_ns) == 0


class TestConstantVelocity:
    def test_predicts(self) -> None:
        motion = ConstantVelocity()
        motion.tracked(POSE, TWIST)
        motion.lost(0.1, IDENTITY)
        np.testing.assert_allclose(motion.now(), retract(POSE, 0.1 * TWIST))
        after = motion.after(0.2)
        assert after is not None
        np.testing.assert_allclose(after, retract(POSE, 0.3 * TWIST))

    def test_velocity_to_a_recognized_place(self) -> None:
        """The mean one; none if the last pose is too old to tell."""
        motion = ConstantVelocity()
        motion.tracked(POSE, np.zeros(6))
        motion.lost(0.1, IDENTITY)
        np.testing.assert_allclose(motion.velocity_to(retract(POSE, 0.3 * TWIST), 0.2), TWIST, atol=1e-9)
        motion.lost(5.0, IDENTITY)
        assert not motion.velocity_to(POSE, 0.2).any()

    def test_moves_with_the_world(self) -> None:
        motion, change = ConstantVelocity(), retract(IDENTITY, np.full(6, 0.3))
        motion.tracked(POSE, np.zeros(6))
        motion.lost(0.1, change)
        np.testing.assert_allclose(motion.now(), compose(change, POSE))

    def test_believes_a_second(self) -> None:
        motion = ConstantVelocity()
        motion.tracked(POSE, TWIST)
        motion.lost(5.0, IDENTITY)
        assert motion.after(0.1) is None
        np.testing.assert_allclose(motion.now(), retract(POSE, TWIST))

    def test_a_tracked_frame_ends_the_loss(self) -> None:
        motion = ConstantVelocity()
        motion.lost(0.5, IDENTITY)
        motion.tracked(POSE, TWIST)
        assert motion.lost_s == 0
