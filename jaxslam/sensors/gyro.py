"""The rotation of a camera from the angular rates of an IMU, whose bias is estimated on the way."""

import numpy as np
from jaxtyping import Float64

from jaxslam.geometry.se3 import compose, displacement, inverse, rotate
from jaxslam.geometry.types import Pose
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.sensors.imu_preintegration import preintegrate
from jaxslam.sensors.motion_prior import MotionPrior

_FIRST_BIAS_RAD_PER_S = 0.1
"""Standard deviation of the bias when the IMU is switched on: that of the IMU of EuRoC is 0.08 rad/s."""
_LONGEST_GAP = 2.5
"""Longest time without a sample, in intervals of the data sheet: one may be missing. At either end of the interval of a
frame, the rate of the nearest sample holds. In a longer gap, nothing is known."""
_FORGET = 0.95
"""Share of the errors of earlier frames that is kept."""
_LARGEST_SIGMAS = 5.0
"""A rotation of the images that is farther away is a wrong one, and says nothing of the bias."""


class Gyro:
    """Integrates the angular rates from frame to frame, and estimates their bias from the rotation in the images.

    A gyro is believed by how well it has done: the data sheet knows of its noise, but not of clocks that are apart by
    a millisecond, which is 1 mrad where the camera turns by 1 rad/s, and ten times the noise of 50 ms.

    Attributes:
        bias_rad_per_s: `(3,)` estimated bias in IMU axes, rad/s.
    """

    def __init__(self, sheet: ImuSheet) -> None:
        """Begin before the first frame.

        Args:
            sheet: Data sheet of the IMU, with the place of the camera on it.
        """
        self._sheet = sheet
        place = np.array(sheet.T_imu_cam, np.float64)
        self._T_imu_cam = np.concatenate([place[:4] / np.linalg.norm(place[:4]), np.zeros(3)])
        self.bias_rad_per_s = np.zeros(3)
        self._variance = _FIRST_BIAS_RAD_PER_S**2
        self._squares, self._weight = 0.0, 0.0
        self._last_ns: int | None = None
        self._kept: ImuSamples | None = None

    def motion(self, frame: Frame) -> MotionPrior | None:
        """Return the rotation of the camera since the frame before; `None` where samples are missing.

        Args:
            frame: The frame after the one of the last call.
        """
        last_ns, self._last_ns = self._last_ns, frame.timestamp_ns
        if frame.imu is None:
            self._kept = None
            return None
        samples = _after(self._kept, frame.imu)
        self._kept = samples
        if last_ns is None:
            return None
        held = self._held(samples, last_ns, frame.timestamp_ns)
        if held is None:
            return None
        turned = preintegrate(held, last_ns, frame.timestamp_ns, self.bias_rad_per_s).rotation
        T_imu = np.concatenate([turned, np.zeros(3)])
        T_last_cam = compose(inverse(self._T_imu_cam), compose(T_imu, self._T_imu_cam))
        elapsed_s = 1e-9 * (frame.timestamp_ns - last_ns)
        self._variance += self._sheet.gyroscope_random_walk**2 * elapsed_s
        return MotionPrior(T_last_cam, self.variance(elapsed_s) * np.eye(3))

    def correct(
        self, predicted: MotionPrior, T_last_cam: Pose, covariance: Float64[np.ndarray, "3 3"], elapsed_s: float
    ) -> None:
        """Take in how the images say that the camera has turned.

        Args:
            predicted: What the gyro said of the same time.
            T_last_cam: `(7,)` pose of the camera in the axes of the camera before, from the images alone.
            covariance: `(3, 3)` covariance of its rotation in the tangent space at the camera.
            elapsed_s: The time, in seconds.
        """
        error = displacement(predicted.T_last_cam, T_last_cam)[3:]
        expected = np.trace(covariance + predicted.covariance[-3:, -3:])
        if elapsed_s <= 0 or error @ error > _LARGEST_SIGMAS**2 * expected:
            return
        self._squares = _FORGET * self._squares + error @ error / 3
        self._weight = _FORGET * self._weight + 1
        # In IMU axes: the images turn less than a gyro with a bias that is estimated too small.
        error_imu = rotate(self._T_imu_cam, error)
        measured = (np.trace(covariance) / 3 + self._noise(elapsed_s)) / elapsed_s**2
        gain = self._variance / (self._variance + measured)
        self.bias_rad_per_s = self.bias_rad_per_s - gain * error_imu / elapsed_s
        self._variance *= 1 - gain

    def variance(self, elapsed_s: float, num_frames: int = 1) -> float:
        """Return the variance of the rotation about each axis over some frames in turn, rad^2.

        The bias is the same in all of them, so that its error grows with time, and its variance with the square.

        Args:
            elapsed_s: Time from the first frame to the last, in seconds.
            num_frames: Number of frames after the first.
        """
        by_sheet = self._noise(elapsed_s) + self._variance * elapsed_s**2
        so_far = num_frames * self._squares / max(self._weight, 1.0)
        return max(by_sheet, so_far, np.finfo(np.float32).tiny)

    def _noise(self, elapsed_s: float) -> float:
        return self._sheet.gyroscope_noise_density**2 * elapsed_s

    def _held(self, samples: ImuSamples, from_ns: int, until_ns: int) -> ImuSamples | None:
        """Return samples that reach from one time to the other, the first and last rate held; `None` if they do not."""
        if not len(samples) or until_ns <= from_ns:
            return None
        longest_ns = _LONGEST_GAP * 1e9 / self._sheet.rate_hz
        times = samples.timestamps_ns
        around = np.concatenate([[min(from_ns, times[0])], times, [max(until_ns, times[-1])]])
        inside = (around[:-1] < until_ns) & (around[1:] > from_ns)
        if (np.diff(around)[inside] > longest_ns).any():
            return None
        keep = np.concatenate([[around[0] < times[0]], np.ones(len(times), bool), [around[-1] > times[-1]]])
        which = np.concatenate([[0], np.arange(len(times)), [len(times) - 1]])[keep]
        return ImuSamples(around[keep], samples.gyro_rad_per_s[which], samples.accel_m_per_s2[which])


def _after(before: ImuSamples | None, samples: ImuSamples) -> ImuSamples:
    """Put the last of some samples before others that come after it."""
    if before is None or not len(before):
        return samples
    if not len(samples):
        return before
    if before.timestamps_ns[-1] >= samples.timestamps_ns[0]:
        return samples
    return ImuSamples(
        *(
            np.concatenate([getattr(before, field)[-1:], getattr(samples, field)])
            for field in ("timestamps_ns", "gyro_rad_per_s", "accel_m_per_s2")
        )
    )
