"""Samples of an inertial measurement unit (IMU), and its data sheet."""

from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from jaxslam.config.validation import Positive, Range, ValidatedConfig
from jaxslam.errors import ConfigError, FrameError, brief_repr
from jaxslam.geometry.types import Poses, Positions, Timestamps

_Density: TypeAlias = Annotated[float, Range(at_least=0)]
_Pose: TypeAlias = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Angular rates and specific forces in the order of time; its arrays are read-only copies.

    Attributes:
        timestamps_ns: `(n,)` int64 times on the clock of the frames, strictly increasing, nanoseconds.
        gyro_rad_per_s: `(n, 3)` float64 angular rates in IMU axes, rad/s.
        accel_m_per_s2: `(n, 3)` float64 specific forces in IMU axes, m/s^2: acceleration minus gravity, so that an IMU
            at rest measures 9.81 m/s^2 upward.

    Raises:
        FrameError: If a field has the wrong type or shape, a number is not finite, or times do not increase.
    """

    timestamps_ns: Timestamps
    gyro_rad_per_s: Positions
    accel_m_per_s2: Positions

    def __post_init__(self) -> None:
        stamps = _checked_times(self.timestamps_ns)
        fields = {"timestamps_ns": stamps}
        for name in ("gyro_rad_per_s", "accel_m_per_s2"):
            fields[name] = _checked_vectors(name, getattr(self, name), len(stamps))
        for name, array in fields.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def between(self, after_ns: int, until_ns: int) -> "ImuSamples":
        """Select the samples of a span of time; there may be none.

        Args:
            after_ns: Time after which the samples lie, nanoseconds.
            until_ns: Time of the last possible sample, nanoseconds.
        """
        first, last = np.searchsorted(self.timestamps_ns, [after_ns, until_ns], side="right")
        part = slice(int(first), int(last))
        return ImuSamples(self.timestamps_ns[part], self.gyro_rad_per_s[part], self.accel_m_per_s2[part])

    def since_last_frame(self, frames_ns: Timestamps, index: int, fps: float) -> "ImuSamples":
        """Select the samples after the frame before, up to a frame; for the first frame, those of one frame time.

        Args:
            frames_ns: `(m,)` times of all frames, nanoseconds.
            index: Index of the frame, from 0.
            fps: Nominal frames per second, which tell the frame time before the first frame.
        """
        now_ns = int(frames_ns[index])
        return self.between(int(frames_ns[index - 1]) if index > 0 else now_ns - round(1e9 / fps), now_ns)


@dataclass(frozen=True)
class ImuSheet(ValidatedConfig):
    """Data sheet of an IMU: its rate, its noise, and where the camera is on it.

    Attributes:
        rate_hz: Samples per second.
        gyroscope_noise_density: Density of the white noise of angular rates, rad/s/sqrt(Hz).
        gyroscope_random_walk: Density of the random walk of their bias, rad/s^2/sqrt(Hz).
        accelerometer_noise_density: Density of the white noise of specific forces, m/s^2/sqrt(Hz).
        accelerometer_random_walk: Density of the random walk of their bias, m/s^3/sqrt(Hz).
        T_imu_cam: `qw qx qy qz x y z` pose of the camera in IMU axes, meters.

    Raises:
        ConfigError: If a value has the wrong type or is out of range, or the quaternion is not of unit length.
    """

    rate_hz: Annotated[float, Positive]
    gyroscope_noise_density: _Density
    gyroscope_random_walk: _Density
    accelerometer_noise_density: _Density
    accelerometer_random_walk: _Density
    T_imu_cam: _Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        length = float(np.linalg.norm(self.T_imu_cam[:4]))
        if abs(length - 1) > 1e-3:
            raise ConfigError(f"ImuSheet.T_imu_cam: expected a unit quaternion first, got one of length {length:g}")


@dataclass(frozen=True, eq=False)
class ImuStates:
    """True states of an IMU at some times.

    Attributes:
        timestamps_ns: `(n,)` int64 times, nanoseconds.
        T_world_imu: `(n, 7)` float64 poses of the IMU, wxyz_xyz.
        velocity_m_per_s: `(n, 3)` float64 velocities of the IMU in world axes, m/s.
        gyro_bias_rad_per_s: `(n, 3)` float64 biases of the angular rates, rad/s; `None` if unknown.
        accel_bias_m_per_s2: `(n, 3)` float64 biases of the specific forces, m/s^2; `None` if unknown.
    """

    timestamps_ns: Timestamps
    T_world_imu: Poses
    velocity_m_per_s: Positions
    gyro_bias_rad_per_s: Positions | None = None
    accel_bias_m_per_s2: Positions | None = None


def _checked_times(given: object) -> np.ndarray:
    stamps = np.array(given)
    if stamps.ndim != 1 or (stamps.size and stamps.dtype.kind not in "iu"):
        raise FrameError(
            f"timestamps_ns: expected (n,) integers in nanoseconds, got {stamps.dtype.name} {stamps.shape}"
        )
    stamps = stamps.astype(np.int64)
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if late.size:
        before, after = stamps[late[0] : late[0] + 2].tolist()
        raise FrameError(
            f"timestamps_ns: expected times that increase, got {after} after {before}, index {late[0] + 1}"
        )
    return stamps


def _checked_vectors(name: str, given: object, count: int) -> np.ndarray:
    if not isinstance(given, np.ndarray) or given.dtype.kind not in "fiu":
        what = given.dtype.name if isinstance(given, np.ndarray) else brief_repr(given)
        raise FrameError(f"{name}: expected ({count}, 3) floats, got {what}")
    if given.shape != (count, 3):
        raise FrameError(f"{name}: expected shape ({count}, 3), one row a time, got {given.shape}")
    vectors = given.astype(np.float64)
    wrong = np.flatnonzero(~np.isfinite(vectors).all(axis=1))
    if wrong.size:
        raise FrameError(f"{name}: expected finite numbers, got {vectors[wrong[0]].tolist()} at index {wrong[0]}")
    return vectors
