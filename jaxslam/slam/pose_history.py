"""The poses that a tracker has given out, and the constant velocity that predicts the next one."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float64, Int64

from jaxslam.geometry.se3 import IDENTITY, compose, displacement, retract
from jaxslam.geometry.types import Pose
from jaxslam.runtime.record_array import RecordArray
from jaxslam.slam.tracker_map_sync import AnchoredPose
from jaxslam.trajectory.trajectory import Trajectory

_PREDICTED_S = 1.0
"""Longest time for which a constant velocity is believed."""


_RECORD = np.dtype(
    [
        ("timestamp_ns", np.int64),
        ("T_world_cam", np.float32, 7),
        ("keyframe", np.int32),
        ("T_keyframe_cam", np.float32, 7),
        ("in_map_frame", np.bool_),
    ]
)
"""A pose: time of its frame, the pose as it was given out, the same one relative to a keyframe with which it moves, and
whether its world was the frame of the map. 69 bytes: an hour at 30 Hz takes 7.5 MB. The tracker itself computes in
float32."""


class PoseHistory:
    """Every pose that was given out, as it was and relative to its keyframe."""

    def __init__(self) -> None:
        """Start with no poses."""
        self._poses = RecordArray(_RECORD)

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._poses)

    @property
    def num_bytes(self) -> int:
        """Memory that the poses take, bytes."""
        return self._poses.nbytes

    def add(self, timestamp_ns: int, T_world_cam: Pose, anchored: AnchoredPose, *, in_map_frame: bool) -> None:
        """Record a pose.

        Args:
            timestamp_ns: Time of its frame.
            T_world_cam: `(7,)` the pose.
            anchored: The pose relative to a keyframe.
            in_map_frame: Whether its world is the frame of the map.
        """
        self._poses.append((timestamp_ns, T_world_cam, anchored.keyframe, anchored.T_keyframe_cam, in_map_frame))

    def online(self) -> Trajectory:
        """Return the poses in the map's frame as they were given out."""
        poses = self._poses.array()
        poses = poses[poses["in_map_frame"]]
        return ordered_trajectory(poses["timestamp_ns"], poses["T_world_cam"].astype(np.float64))

    def by_submap(self, pose_of: Callable[[int], Pose], submap_of: Callable[[int], int]) -> dict[int, Trajectory]:
        """Return all poses as the map has them now, by the number of their submap.

        Args:
            pose_of: Function from the id of a keyframe to its current pose `(7,)`.
            submap_of: Function from the id of a keyframe to the number of its submap.
        """
        poses = self._poses.array()
        keyframes, which = np.unique(poses["keyframe"], return_inverse=True)
        T_world_keyframe = np.array([pose_of(int(keyframe)) for keyframe in keyframes]).reshape(-1, 7)
        T_world_cam = compose(T_world_keyframe[which], poses["T_keyframe_cam"].astype(np.float64))
        submaps = np.array([submap_of(int(keyframe)) for keyframe in keyframes], np.int64)[which]
        return {
            int(submap): ordered_trajectory(poses["timestamp_ns"][submaps == submap], T_world_cam[submaps == submap])
            for submap in np.unique(submaps)
        }


def ordered_trajectory(timestamps_ns: Int64[np.ndarray, " n"], T_world_cam: Float64[np.ndarray, "n 7"]) -> Trajectory:
    """Make a trajectory of poses and their times, in the order of time also where a clock was set back."""
    order = np.argsort(timestamps_ns, kind="stable")
    return Trajectory(timestamps_ns[order], T_world_cam[order])


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

    def velocity_to(self, T_world_cam: Pose, dt_s: float) -> Float[np.ndarray, "6"]:
        """Return the mean velocity to a pose this many seconds after the last frame; 0 if the last pose is too old."""
        lost_s = self.lost_s + dt_s
        return displacement(self._pose, T_world_cam) / lost_s if 0 < lost_s < _PREDICTED_S else np.zeros(6)

    def now(self) -> Float[np.ndarray, "7"]:
        """Predict the pose at the last frame, from at most one second of constant velocity."""
        return retract(self._pose, self._twist * min(self.lost_s, _PREDICTED_S))
