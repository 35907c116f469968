"""The motion since the last tracked frame, as something other than the images measured it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.geometry.se3 import IDENTITY, displacement, retract
from jaxslam.geometry.types import Pose
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.gyro import Gyro
from jaxslam.sensors.imu import ImuSheet
from jaxslam.sensors.motion_prior import MotionPrior

_FIRST_COVARIANCE = 1e-6 * np.eye(6)
"""Of a pose before the first tracked frame; the smallest one of others is 1e-12, that of the first frame."""


class MeasuredMotion(NamedTuple):
    """Motion since the last tracked frame that was measured by something other than the images.

    Attributes:
        prior: The motion.
        information: `(6, 6)` information on the pose that comes with it, in the tangent space at the camera; 0 for what
            was not measured.
    """

    prior: MotionPrior
    information: Float[np.ndarray, "6 6"]


class OutsideMotion:
    """Adds up the motion since the last tracked frame, of priors that are given and of the gyro where none is."""

    def __init__(self, imu: ImuSheet | None) -> None:
        """Begin before the first frame.

        Args:
            imu: Data sheet of the IMU; `None` without one.
        """
        self._gyro = None if imu is None else Gyro(imu)
        self._since: MotionPrior | None = None
        self._is_broken, self._is_gyro = True, True
        self._elapsed_s, self._num_frames = 0.0, 0
        self._covariance = _FIRST_COVARIANCE

    def of_frame(self, frame: Frame, prior: MotionPrior | None, dt_s: float) -> MeasuredMotion | None:
        """Return the motion from the last tracked frame to this one; `None` if some of it is not known.

        Args:
            frame: The frame.
            prior: Motion since the frame before that was given with it.
            dt_s: Time since the frame before, in seconds.
        """
        turned = None if self._gyro is None else self._gyro.motion(frame)
        motion = turned if prior is None else prior
        self._is_gyro &= prior is None
        self._elapsed_s, self._num_frames = self._elapsed_s + dt_s, self._num_frames + 1
        if motion is None:
            self._is_broken = True
        elif not self._is_broken:
            self._since = motion if self._since is None else self._since.then(motion)
        if self._is_broken or self._since is None:
            return None
        if self._is_gyro and self._gyro is not None:
            variance = self._gyro.variance(self._elapsed_s, self._num_frames)
            self._since = MotionPrior(self._since.T_last_cam, variance * np.eye(3))
        return MeasuredMotion(self._since, self._since.information_from(self._covariance))

    def frame_tracked(
        self, twist: Float[np.ndarray, "6"], covariance: Float[np.ndarray, "6 6"], *, is_ok: bool
    ) -> None:
        """Begin anew at a frame that was tracked, and tell the gyro how the images say that the camera has turned.

        Args:
            twist: `(6,)` mean velocity of the camera since the last tracked frame, in its own axes, m/s, then rad/s.
            covariance: `(6, 6)` covariance of its pose in the tangent space at the camera.
            is_ok: Whether its pose is one to learn from.
        """
        covariance = np.asarray(covariance, np.float64)
        # The pose before is still in `self._covariance`, which tells what the gyro said of this one.
        if self._gyro is not None and self._since is not None and self._is_gyro and not self._is_broken and is_ok:
            self._correct(self._gyro, self._since, retract(IDENTITY, twist * self._elapsed_s), covariance)
        self._since, self._is_broken, self._is_gyro = None, False, True
        self._elapsed_s, self._num_frames = 0.0, 0
        self._covariance = covariance

    def _correct(self, gyro: Gyro, turned: MotionPrior, T_last_cam: Pose, covariance: np.ndarray) -> None:
        """Correct the gyro by what the images alone say: the pose without the share that the gyro has in it."""
        known, given = np.linalg.inv(covariance[3:, 3:]), turned.information_from(self._covariance)[3:, 3:]
        of_images = known - given
        if np.linalg.eigvalsh(of_images)[0] <= 0:  # of rounding, where the images say next to nothing
            return
        alone = np.linalg.inv(of_images)
        error = alone @ known @ displacement(turned.T_last_cam, T_last_cam)[3:]
        seen = retract(turned.T_last_cam, np.concatenate([np.zeros(3), error]))
        gyro.correct(turned, seen, alone, self._elapsed_s)
