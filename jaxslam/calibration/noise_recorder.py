"""Records what a run tells of its noise: residuals of points, and motions within a second with their covariances."""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxslam.geometry.se3 import IDENTITY, between, compose, displacement, inverse, to_local, transform
from jaxslam.geometry.types import Pose, Timestamps
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.sensor_model import depth_noise
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.relative_pose_log import RelativePoseLog
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

_SPAN_NS = 1_000_000_000
"""Longest time between two poses of a motion: that of `RelativePoseLog`."""
_OWN_SHARE = 0.6
"""Share of the variance of a motion's error that a run forward does not have in common with one backward: both see the
same noise of images and depth. Against the ground truth of twelve rendered scenes: 0.26 to 1.5, geometric mean 0.62."""
_POINTS_OF_FRAME = 64
"""Points of a frame that are recorded, evenly over the slots of the tracker: neighbors say the same."""


class PointResiduals(NamedTuple):
    """Differences between where points were seen and where the map had them before that frame, at its pose.

    Attributes:
        timestamps_ns: `(n,)` times of the frames, nanoseconds.
        pixel: `(2, n)` differences of the pixels, undistorted, pixels.
        depth: `(n,)` differences of the depths in standard deviations of the settings; NaN where none was measured.
    """

    timestamps_ns: Timestamps
    pixel: Float[np.ndarray, "2 n"]
    depth: Float[np.ndarray, " n"]


class Disagreements(NamedTuple):
    """Differences between the motions of two runs over the same frames.

    Attributes:
        frames: `(n,)` numbers of the frames at the end of the motions.
        error: `(n, 6)` differences in the tangent space at the camera: translation (m), then rotation (rad).
        covariance: `(n, 6, 6)` their covariances if those that the tracker gave out are right: twice that of one run,
            less what both runs have in common.
    """

    frames: Int[np.ndarray, " n"]
    error: Float[np.ndarray, "n 6"]
    covariance: Float[np.ndarray, "n 6 6"]

    def normalized(self) -> Float[np.ndarray, " n"]:
        """Return the squared differences `eᵀ Σ⁻¹ e`, whose mean is 6 if covariances are right."""
        return np.sum(self.error * np.linalg.solve(self.covariance, self.error[..., None])[..., 0], axis=1)


class NoiseRecorder:
    """Records frame after frame of a run of `Slam`, as its `on_frame`."""

    def __init__(self, slam: Slam) -> None:
        """Begin without frames.

        Args:
            slam: The tracker, before its first frame.
        """
        self._slam, self.log = slam, RelativePoseLog()
        self.num_tracked = 0
        self._noise = depth_noise(slam.camera, slam.config.track)
        self._X_world: Float[np.ndarray, "3 n"] | None = None
        self._poses: deque[tuple[int, Pose]] = deque()
        self._motions: dict[tuple[int, int], Pose] = {}
        self._residuals: list[PointResiduals] = []

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Record a frame."""
        self.log(frame, result)
        if isinstance(result, Rejected):
            return
        if not np.array_equal(result.correction, IDENTITY):
            self._poses = deque((stamp, compose(result.correction, pose)) for stamp, pose in self._poses)
        if result.status == TrackStatus.STARTED:
            self._poses.clear()
        is_tracked = result.status == TrackStatus.OK
        if is_tracked:
            self.num_tracked += 1
            self._record_motions(result)
            if self._X_world is not None:
                self._residuals.append(self._residuals_of(result, transform(result.correction, self._X_world)))
        if is_tracked or result.status == TrackStatus.STARTED:
            self._poses.append((result.timestamp_ns, result.T_world_cam))
        there = is_tracked or result.status in (TrackStatus.STARTED, TrackStatus.WEAK)
        self._X_world = np.array(self._slam.points.X_world, np.float64) if there else None

    def _record_motions(self, result: FrameResult) -> None:
        while self._poses and self._poses[0][0] < result.timestamp_ns - _SPAN_NS:
            self._poses.popleft()
        if self._poses:
            stamps, poses = zip(*self._poses, strict=True)
            motions = between(np.array(poses), result.T_world_cam)
            self._motions.update(zip([(stamp, result.timestamp_ns) for stamp in stamps], motions, strict=True))

    def _residuals_of(self, result: FrameResult, X_world: Float[np.ndarray, "3 n"]) -> PointResiduals:
        points, camera = self._slam.points, self._slam.camera
        xy, depth = np.asarray(points.xy, np.float64), np.asarray(points.depth, np.float64)
        X_cam = to_local(result.T_world_cam, X_world)
        seen = np.flatnonzero(result.followed & (result.weights > 0) & (X_cam[2] > 0))
        seen = seen[:: max(1, len(seen) // _POINTS_OF_FRAME)]
        X, Y, Z = X_cam[:, seen]
        pixel = np.stack([camera.fx * (X / Z - xy[0, seen]), camera.fy * (Y / Z - xy[1, seen])])
        measured = depth[seen]
        sigma = self._noise.sigma_m + self._noise.sigma_per_m2 * measured**2
        apart = np.where(measured > 0, (Z - measured) / np.where(measured > 0, sigma, 1.0), np.nan)
        return PointResiduals(np.full(len(seen), result.timestamp_ns), pixel, apart)

    def residuals(self) -> PointResiduals:
        """Return the residuals of all points so far."""
        if not self._residuals:
            return PointResiduals(np.zeros(0, np.int64), np.zeros((2, 0)), np.zeros(0))
        return PointResiduals(*(np.concatenate(arrays, axis=-1) for arrays in zip(*self._residuals, strict=True)))

    def disagreements(
        self, other: "NoiseRecorder", own_ns: Int[np.ndarray, " f"], others_ns: Int[np.ndarray, " f"]
    ) -> Disagreements:
        """Compare the logged motions of this run with those of another one that saw the frames in the reverse order.

        Args:
            other: The other run.
            own_ns: `(f,)` times of the frames in this run, nanoseconds.
            others_ns: `(f,)` times of the same frames in the other run, nanoseconds.
        """
        to_other = dict(zip(own_ns.tolist(), others_ns.tolist(), strict=True))
        number = {stamp: index for index, stamp in enumerate(own_ns.tolist())}
        frames, errors, covariances = [], [], []
        for stamp, reference, motion, covariance in zip(*self.log.poses(), strict=True):
            # In the other run, the end of this motion comes first.
            back = other._motions.get((to_other[int(stamp)], to_other[int(reference)]))
            if back is not None:
                frames.append(number[int(stamp)])
                errors.append(displacement(inverse(back), motion))
                covariances.append(2 * _OWN_SHARE * covariance.astype(np.float64))
        return Disagreements(
            np.array(frames, np.int64), np.reshape(errors, (-1, 6)), np.reshape(covariances, (-1, 6, 6))
        )
