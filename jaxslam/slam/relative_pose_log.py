"""Log of the poses of a run relative to their reference keyframes, to compare their errors with their covariances."""

from collections import deque
from typing import NamedTuple

import numpy as np

from jaxslam.geometry.se3 import IDENTITY, between, compose
from jaxslam.geometry.types import Pose
from jaxslam.runtime.record_array import RecordArray
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.consistency import RelativePoses

_SPAN_S = 1.0
"""Longest time from the reference keyframe to a frame. Over a longer time the drift of the map prevails, which
covariances do not tell."""

_RECORD = np.dtype(
    [
        ("timestamp_ns", np.int64),
        ("reference_ns", np.int64),
        ("T_reference_cam", np.float64, 7),
        ("covariance", np.float32, (6, 6)),
    ]
)
"""A pose: 216 bytes, so that an hour at 30 Hz takes 23 MB."""


class _Earlier(NamedTuple):
    """A pose that later ones may be relative to.

    Attributes:
        timestamp_ns: Time of its frame, nanoseconds.
        T_world_cam: `(7,)` pose in the world of the latest frame.
        is_keyframe: Whether the frame became a keyframe.
    """

    timestamp_ns: int
    T_world_cam: Pose
    is_keyframe: bool


class RelativePoseLog:
    """Log of every `OK` pose relative to the latest keyframe of the last second: an `on_frame` of `Slam.run`.

    In a second without a keyframe, the pose is relative to the earliest frame of that second.
    """

    def __init__(self) -> None:
        """Start with no poses."""
        self._records = RecordArray(_RECORD)
        self._earlier: deque[_Earlier] = deque()
        self._submap = -1

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame."""
        if isinstance(result, Rejected):
            return
        if result.submap != self._submap:
            self._submap = result.submap
            self._earlier.clear()
        if not np.array_equal(result.correction, IDENTITY):
            moved = [pose._replace(T_world_cam=compose(result.correction, pose.T_world_cam)) for pose in self._earlier]
            self._earlier = deque(moved)
        begin_ns = result.timestamp_ns - round(_SPAN_S * 1e9)
        while self._earlier and not begin_ns <= self._earlier[0].timestamp_ns < result.timestamp_ns:
            self._earlier.popleft()
        if result.status == TrackStatus.OK and self._earlier:
            keyframes = [pose for pose in self._earlier if pose.is_keyframe]
            reference = keyframes[-1] if keyframes else self._earlier[0]
            T_reference_cam = between(reference.T_world_cam, result.T_world_cam)
            record = (result.timestamp_ns, reference.timestamp_ns, T_reference_cam, result.covariance)
            self._records.append(record)
        if result.status in (TrackStatus.OK, TrackStatus.STARTED) or result.is_keyframe:
            self._earlier.append(_Earlier(result.timestamp_ns, result.T_world_cam, result.is_keyframe))

    def poses(self) -> RelativePoses:
        """Return all poses so far."""
        records = self._records.array()
        return RelativePoses(*(records[name] for name in _RECORD.names or ()))
