"""Uncertainty of a pose relative to the keyframes around: what the fit of one frame does not tell.

The refinement of a pose takes errors of pixels for independent and the points for exact. The points of a keyframe share
the errors of its depth, which matter the more the camera has moved since, and points that are found anew lie where a
pose put them that was itself unsure.
"""

import math

import numpy as np
from jaxtyping import Float32

from jaxslam.geometry.se3 import adjoint, between, compose
from jaxslam.geometry.so3 import matrices
from jaxslam.geometry.types import Pose
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.sensor_model import SensorModel
from jaxslam.slam.frame_result import FrameResult
from jaxslam.tracking.points import KeyframeRing
from jaxslam.tracking.state import TrackOutput, TrackStatus

_LEAST_SCALE = 0.5
"""Smallest ratio of the errors of pixels to their assumed standard deviation. In rendered rooms the residuals are 0.15
to 0.4 of it, but a part of the errors is common to many points, and leaves no residuals."""


class PoseUncertainty:
    """Covariance of each pose relative to the keyframes around the camera."""

    def __init__(self, camera: Camera, sensor: SensorModel, pixel_sigma: float) -> None:
        """Begin without a pose.

        Args:
            camera: Camera that takes the frames.
            sensor: Camera with the noise of its depth.
            pixel_sigma: Standard deviation of a pixel that the tracker assumes, pixels.
        """
        self._focal_px, self._pixel_sigma = (camera.fx + camera.fy) / 2, pixel_sigma
        self._sigma_m, self._sigma_per_m2 = float(sensor.depth_sigma_m), float(sensor.depth_sigma_per_m2)
        self._T_world_cam: Pose | None = None
        self._reference = np.zeros((6, 6))
        """Covariance of the latest keyframe, at the last pose: it is not where it was thought to be either."""
        self._inherited = np.zeros((6, 6))
        """Covariance, at the last pose, of the poses at which the points were found that are followed."""

    def of_pose(self, tracked: FrameResult, output: TrackOutput, keyframes: KeyframeRing) -> Float32[np.ndarray, "6 6"]:
        """Return the covariance of the pose of a frame that was tracked, or what its result says of another one.

        Args:
            tracked: Result of the frame.
            output: Output of the tracker for it.
            keyframes: Keyframes of the tracker after the frame.
        """
        if tracked.status == TrackStatus.LOST:
            if self._T_world_cam is not None:
                self._T_world_cam = compose(tracked.correction, self._T_world_cam)
            return tracked.covariance
        if tracked.status not in (TrackStatus.OK, TrackStatus.WEAK) or self._T_world_cam is None:
            self._T_world_cam, self._inherited = tracked.T_world_cam, np.zeros((6, 6))
            self._reference = tracked.covariance.astype(np.float64)
            return tracked.covariance
        moved = adjoint(between(tracked.T_world_cam, compose(tracked.correction, self._T_world_cam)))
        reference, inherited = (moved @ covariance @ moved.T for covariance in (self._reference, self._inherited))
        fit = np.asarray(output.covariance, np.float64)
        own = self._variance_factor(tracked, output, keyframes) * fit
        weights, matched = np.asarray(output.weights), np.asarray(output.keyframe_matches.weight)
        followed, new = np.asarray(output.tracked), (weights > 0) & ~np.asarray(output.tracked)
        share = weights[followed].sum() / max(weights[followed].sum() + matched.sum(), 1e-9)
        share_new = new.sum() / max((weights > 0).sum(), 1)
        since = own + share**2 * inherited
        self._T_world_cam, self._reference = tracked.T_world_cam, reference
        self._inherited = (1 - share_new) * inherited + share_new * since
        if tracked.is_keyframe:
            self._reference, self._inherited = own, np.zeros((6, 6))
        # The result may hold more than the fit: what `BackgroundConsistency` adds stays as it is.
        return (since + reference + (tracked.covariance - fit)).astype(np.float32)

    def _variance_factor(self, tracked: FrameResult, output: TrackOutput, keyframes: KeyframeRing) -> float:
        """Factor of the assumed variance of pixels: what residuals say, and what common errors of depth add."""
        residual = max(tracked.residual_px / self._pixel_sigma, _LEAST_SCALE)
        there = np.asarray(keyframes.weight).any(axis=1)
        seen = np.asarray(output.weights) > 0
        if not there.any() or not seen.any():
            return residual**2
        apart = np.asarray(keyframes.T_world_cam)[there, 4:] - tracked.T_world_cam[4:]
        moved_m = math.sqrt((apart * apart).sum(axis=1).min())
        from_camera = np.asarray(output.X_world)[:, seen] - tracked.T_world_cam[4:, None]
        depths_m = matrices(tracked.T_world_cam[:4])[:, 2] @ from_camera
        middle = len(depths_m) // 2
        depth_m = float(np.partition(depths_m, middle)[middle])
        if depth_m <= 0:
            return residual**2
        depth_error = self._sigma_m / depth_m + self._sigma_per_m2 * depth_m
        shifted_px = self._focal_px * moved_m / depth_m * depth_error
        return residual**2 + (shifted_px / self._pixel_sigma) ** 2
