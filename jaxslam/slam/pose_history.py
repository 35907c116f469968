"""The poses that a tracker has given out, and the constant velocity that predicts the next one."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.geometry.se3 import IDENTITY, compose, retract
from jaxslam.geometry.types import Pose
from jaxslam.slam.tracker_map_sync import AnchoredPose
from jaxslam.trajectory.trajectory import Trajectory

_PREDICTED_S = 1.0
"""Longest time for which a constant velocity is believed."""


class _RecordedPose(NamedTuple):
    """A pose that was given out.

    Attributes:
        timestamp_ns: Time of its frame.
        T_world_cam: `(7,)` pose as it was given out.
        anchored: The same pose relative to a keyframe, with which it moves.
        in_map_frame: Whether its world was the frame of the map.
    """

    timestamp_ns: int
    T_world_cam: Pose
    anchored: AnchoredPose
    in_map_frame: bool


class PoseHistory:
    """Every pose that was given out, as it was and relative to its keyframe."""

    def __init__(self) -> None:
        """Start with no poses."""
        self._poses: list[_RecordedPose] = []

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._poses)

    def add(self, timestamp_ns: int, T_world_cam: Pose, anchored: AnchoredPose, *, in_map_frame: bool) -> None:
        """Record a pose.

        Args:
            timestamp_ns: Time of its frame.
            T_world_cam: `(7,)` the pose.
            anchored: The pose relative to a keyframe.
            in_map_frame: Whether its world is the frame of the map.
        """
        self._poses.append(_RecordedPose(timestamp_ns, T_world_cam, anchored, in_map_frame))

    def online(self) -> Trajectory:
        """Return the poses in the map's frame as they were given out."""
        return ordered_trajectory([(pose.timestamp_ns, pose.T_world_cam) for pose in self._poses if pose.in_map_frame])

    def by_submap(
        self, pose_of: Callable[[AnchoredPose], np.ndarray], submap_of: Callable[[AnchoredPose], int]
    ) -> dict[int, Trajectory]:
        """Return all poses as the map has them now, by the number of their submap.

        Args:
            pose_of: Function from an anchored pose to its current pose `(7,)`.
            submap_of: Function from an anchored pose to the number of its submap.
        """
        found: dict[int, list[tuple[int, np.ndarray]]] = {}
        for pose in self._poses:
            found.setdefault(submap_of(pose.anchored), []).append((pose.timestamp_ns, pose_of(pose.anchored)))
        return {submap: ordered_trajectory(found[submap]) for submap in sorted(found)}


def ordered_trajectory(stamped: Sequence[tuple[int, np.ndarray]]) -> Trajectory:
    """Make a trajectory of poses and their times, in the order of time also where a clock was set back."""
    times_ns = np.array([time_ns for time_ns, _ in stamped], np.int64)
    poses = np.array([pose for _, pose in stamped]).reshape(-1, 7)
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    order = np.argsort(times_ns, kind="stable")
    return Trajectory(times_ns[order], poses[order])


class ConstantVelocity:
    """Prediction of the camera's pose from its last pose and velocity, for frames that are lost.

    Attributes:
        lost_s: Time since the last frame that was tracked, in seconds.
    """

    def __init__(self) -> None:
        """Start at the origin, at rest."""
        self._pose, self._twist, self.lost_s = np.array(IDENTITY), np.zeros(6), 0.0

    def tracked(self, T_world_cam: Float[np.ndarray, "7"], twist: Float[np.ndarray, "6"]) -> None:
        """Take over the pose and the velocity of a frame that was tracked."""
        self._pose, self._twist, self.lost_s = T_world_cam, twist, 0.0

    def lost(self, dt_s: float, correction: Float[np.ndarray, "7"]) -> None:
        """Take in that a frame was lost.

        Args:
            dt_s: Time since the frame before, in seconds.
            correction: Correction of the world `(7,)` that came with the frame.
        """
        self.lost_s += dt_s
        self._pose = compose(correction, self._pose)

    def after(self, dt_s: float) -> Float[np.ndarray, "7"] | None:
        """Predict the pose this many seconds after the last frame; `None` if the last pose is too old."""
        lost_s = self.lost_s + dt_s
        return retract(self._pose, self._twist * lost_s) if lost_s < _PREDICTED_S else None

    def now(self) -> Float[np.ndarray, "7"]:
        """Predict the pose at the last frame, from at most one second of constant velocity."""
        return retract(self._pose, self._twist * min(self.lost_s, _PREDICTED_S))
