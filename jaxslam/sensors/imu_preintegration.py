"""Preintegration of IMU samples: the motion between two times in the axes of the IMU at the first one.

Source: Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", T-RO 2017.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxslam.errors import FrameError
from jaxslam.geometry.so3 import matrices, multiply
from jaxslam.geometry.types import Pose
from jaxslam.sensors.imu import ImuSamples

GRAVITY_M_PER_S2 = np.array([0.0, 0.0, -9.81])
"""Gravity in a world whose z axis points up, `(3,)` m/s^2."""

_NO_BIAS = np.zeros(3)


class ImuDelta(NamedTuple):
    """Preintegrated motion from time i to time j, without gravity and the velocity at i (eq. 33).

    Attributes:
        seconds: Time from i to j.
        rotation: `(4,)` float64 unit quaternion wxyz: turns vectors in IMU axes at j into IMU axes at i.
        velocity_m_per_s: `(3,)` float64 change of velocity in IMU axes at i, m/s.
        position_m: `(3,)` float64 change of position in IMU axes at i, meters.
    """

    seconds: float
    rotation: Float64[np.ndarray, "4"]
    velocity_m_per_s: Float64[np.ndarray, "3"]
    position_m: Float64[np.ndarray, "3"]


class ImuState(NamedTuple):
    """Pose and velocity of an IMU.

    Attributes:
        T_world_imu: `(7,)` float64 pose, wxyz_xyz.
        velocity_m_per_s: `(3,)` float64 velocity in world axes, m/s.
    """

    T_world_imu: Pose
    velocity_m_per_s: Float64[np.ndarray, "3"]


class IntervalMeans(NamedTuple):
    """What an IMU measured on average over each of `n` intervals, bias subtracted.

    Attributes:
        seconds: `(n,)` float64 lengths of the intervals.
        gyro_rad_per_s: `(n, 3)` float64 angular rates, rad/s.
        accel_m_per_s2: `(n, 3)` float64 specific forces in IMU axes at the beginning of the interval, m/s^2.
    """

    seconds: Float64[np.ndarray, " n"]
    gyro_rad_per_s: Float64[np.ndarray, "n 3"]
    accel_m_per_s2: Float64[np.ndarray, "n 3"]


def preintegrate(
    samples: ImuSamples,
    from_ns: int,
    until_ns: int,
    gyro_bias_rad_per_s: Float64[np.ndarray, "3"] = _NO_BIAS,
    accel_bias_m_per_s2: Float64[np.ndarray, "3"] = _NO_BIAS,
) -> ImuDelta:
    """Preintegrate samples between two times (eqs. 33 to 38, without the noise).

    Args:
        samples: Samples that reach from `from_ns` or before to `until_ns` or after.
        from_ns: Time i, nanoseconds.
        until_ns: Time j, later than i, nanoseconds.
        gyro_bias_rad_per_s: `(3,)` bias of the angular rates, rad/s.
        accel_bias_m_per_s2: `(3,)` bias of the specific forces, m/s^2.

    Raises:
        FrameError: If time j is not after time i, or the samples do not reach from one to the other.
    """
    means = interval_means(samples, from_ns, until_ns, gyro_bias_rad_per_s, accel_bias_m_per_s2)
    steps_s = means.seconds[:, None]
    rotations = _products(_exp(means.gyro_rad_per_s * steps_s))
    at_start = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], rotations[:-1]])
    accel = np.einsum("nij,nj->ni", matrices(at_start), means.accel_m_per_s2)
    velocities = np.cumsum(accel * steps_s, axis=0)
    before = np.concatenate([np.zeros((1, 3)), velocities[:-1]])
    position_m = (before * steps_s + 0.5 * accel * steps_s**2).sum(axis=0)
    return ImuDelta(1e-9 * (until_ns - from_ns), rotations[-1], velocities[-1], position_m)


def interval_means(
    samples: ImuSamples,
    from_ns: int,
    until_ns: int,
    gyro_bias_rad_per_s: Float64[np.ndarray, "3"] = _NO_BIAS,
    accel_bias_m_per_s2: Float64[np.ndarray, "3"] = _NO_BIAS,
) -> IntervalMeans:
    """Return the means of neighboring samples between two times; at both ends samples are interpolated linearly.

    The specific force at the end of an interval is turned into IMU axes at its beginning before the mean is taken:
    in the paper, the rotation at the beginning holds for the interval, which delays the force by half an interval.

    Args:
        samples: Samples that reach from `from_ns` or before to `until_ns` or after.
        from_ns: Time of the beginning, nanoseconds.
        until_ns: Time of the end, nanoseconds.
        gyro_bias_rad_per_s: `(3,)` bias of the angular rates, rad/s.
        accel_bias_m_per_s2: `(3,)` bias of the specific forces, m/s^2.

    Raises:
        FrameError: If the end is not after the beginning, or the samples do not reach from one to the other.
    """
    _check_span(samples, from_ns, until_ns)
    inner = samples.between(from_ns, until_ns - 1).timestamps_ns
    # Differences of int64 are exact, epoch nanoseconds in float64 are not.
    own_s = 1e-9 * (samples.timestamps_ns - from_ns)
    at_s = 1e-9 * (np.concatenate([[from_ns], inner, [until_ns]]) - from_ns)
    gyro = _interpolated(at_s, own_s, samples.gyro_rad_per_s) - gyro_bias_rad_per_s
    accel = _interpolated(at_s, own_s, samples.accel_m_per_s2) - accel_bias_m_per_s2
    steps_s, mean_gyro = np.diff(at_s), 0.5 * (gyro[:-1] + gyro[1:])
    turned = np.einsum("nij,nj->ni", matrices(_exp(mean_gyro * steps_s[:, None])), accel[1:])
    return IntervalMeans(steps_s, mean_gyro, 0.5 * (accel[:-1] + turned))


def predict(
    start: ImuState, delta: ImuDelta, gravity_m_per_s2: Float64[np.ndarray, "3"] = GRAVITY_M_PER_S2
) -> ImuState:
    """Return the state at time j from the state at time i and the motion between them (eq. 33 solved for j).

    Args:
        start: State at time i.
        delta: Preintegrated motion from i to j.
        gravity_m_per_s2: `(3,)` gravity in world axes, m/s^2.
    """
    T, velocity, seconds = start.T_world_imu, start.velocity_m_per_s, delta.seconds
    R_world_imu = matrices(T[:4])
    rotation = multiply(T[:4], delta.rotation)
    position = T[4:] + velocity * seconds + 0.5 * gravity_m_per_s2 * seconds**2 + R_world_imu @ delta.position_m
    return ImuState(
        np.concatenate([rotation / np.linalg.norm(rotation), position]),
        velocity + gravity_m_per_s2 * seconds + R_world_imu @ delta.velocity_m_per_s,
    )


def _check_span(samples: ImuSamples, from_ns: int, until_ns: int) -> None:
    if until_ns <= from_ns:
        raise FrameError(f"until_ns: expected a time after from_ns, {from_ns}, got {until_ns}")
    if not len(samples):
        raise FrameError("samples: expected samples from from_ns to until_ns, got none")
    first, last = samples.timestamps_ns[[0, -1]].tolist()
    if first > from_ns or last < until_ns:
        raise FrameError(f"samples: expected samples from {from_ns} to {until_ns} ns, got {first} to {last} ns")


def _interpolated(at_s: np.ndarray, own_s: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Interpolate `(n, 3)` vectors at `own_s` linearly at `(m,)` times `at_s`."""
    return np.stack([np.interp(at_s, own_s, column) for column in vectors.T], axis=1)


def _exp(turns: np.ndarray) -> np.ndarray:
    """Return the `(n, 4)` unit quaternions of `(n, 3)` rotation vectors."""
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    return np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * turns], axis=1)


def _products(rotations: np.ndarray) -> np.ndarray:
    """Return the products of the first 1, 2, ... n of `(n, 4)` unit quaternions, by doubling."""
    step = 1
    while step < len(rotations):
        rotations = np.concatenate([rotations[:step], multiply(rotations[:-step], rotations[step:])])
        step *= 2
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
