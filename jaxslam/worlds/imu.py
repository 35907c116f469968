"""The IMU of a world: samples synthesized along the way of the camera, or those of a real flight."""

from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxslam.datasets.synthetic.virtual_camera import START_NS
from jaxslam.errors import ConfigError
from jaxslam.geometry.se3 import between, compose, inverse
from jaxslam.geometry.so3 import matrices
from jaxslam.sensors.imu import ImuSamples, ImuSheet, ImuStates
from jaxslam.sensors.imu_files import read_imu_samples, read_imu_sheet
from jaxslam.sensors.imu_preintegration import GRAVITY_M_PER_S2
from jaxslam.worlds.camera_way import CameraWay, FileWay
from jaxslam.worlds.data_paths import data_path
from jaxslam.worlds.description import World, WorldImu

ADIS16448 = ImuSheet(
    rate_hz=200.0,
    gyroscope_noise_density=1.6968e-4,
    gyroscope_random_walk=1.9393e-5,
    accelerometer_noise_density=2.0e-3,
    accelerometer_random_walk=3.0e-3,
    T_imu_cam=(
        0.7123014606689463,
        -0.007707179755532145,
        0.010499323370595164,
        0.7017528002921407,
        -0.0216401454975,
        -0.064676986768,
        0.00981073058949,
    ),
)
"""Data sheet of the IMU of EuRoC MAV with its left camera (Burri et al., IJRR 2016)."""

_STEP_S = 3e-4
"""Step of the differences of poses: a longer one blurs the motion, a shorter one magnifies rounding."""


class ImuRecord(NamedTuple):
    """The IMU of a recording; each field is `None` if there is none.

    Attributes:
        sheet: Its data sheet, with the place of the camera in the scale of the world.
        samples: Its samples, from the first frame or before to the last or after.
        states: What is true of it at the times of the frames.
    """

    sheet: ImuSheet | None = None
    samples: ImuSamples | None = None
    states: ImuStates | None = None


class _Motion(NamedTuple):
    """Motion of the IMU at `n` times: poses `(n, 7)`, and `(n, 3)` velocities, accelerations, and rates in its axes."""

    T_world_imu: np.ndarray
    velocity_m_per_s: np.ndarray
    accel_m_per_s2: np.ndarray
    gyro_rad_per_s: np.ndarray


class _Biases(NamedTuple):
    """Biases of rates and forces, `(n, 3)` each, at the `(n,)` times of the samples since the start."""

    time_s: np.ndarray
    gyro_rad_per_s: np.ndarray
    accel_m_per_s2: np.ndarray


def record_imu(world: World, way: CameraWay, frames_ns: np.ndarray) -> ImuRecord:
    """Return the IMU of a recording.

    Samples are synthesized from the second differences of positions, the differences of rotations, and a gravity of
    9.81 m/s^2 downward, whatever the scale. Biases begin at 0 with the first sample. Sample `k` does not depend on the
    length of the recording.

    Args:
        world: The world.
        way: The way of its camera.
        frames_ns: `(n,)` times of the frames, nanoseconds.

    Raises:
        ConfigError: The data sheet cannot be read, or real samples do not reach from the first frame to the last.
        DatasetError: The file of real samples cannot be read.
    """
    if world.imu is None:
        return ImuRecord()
    sheet = _sheet(world.imu, world.scale)
    T_cam_imu, frames_s = inverse(np.array(sheet.T_imu_cam)), 1e-9 * (frames_ns - START_NS)
    truth = _motion(way, T_cam_imu, frames_s)
    states = ImuStates(frames_ns, truth.T_world_imu, truth.velocity_m_per_s)
    if world.imu.file is not None and isinstance(way, FileWay):
        return ImuRecord(
            sheet, _real_samples(str(data_path(world.imu.file, Path())), way, frames_ns, world.camera.fps), states
        )
    count = int(np.ceil(frames_s[-1] * sheet.rate_hz - 1e-6)) + 1
    since_ns = np.round(np.arange(count) * (1e9 / sheet.rate_hz)).astype(np.int64)
    noise_sheet = _without_noise(sheet) if world.imu.noise_free else sheet
    samples, biases = _synthesized(_motion(way, T_cam_imu, 1e-9 * since_ns), since_ns, noise_sheet, world.seed)
    gyro, accel = (_at(frames_s, biases.time_s, each) for each in biases[1:])
    return ImuRecord(sheet, samples, replace(states, gyro_bias_rad_per_s=gyro, accel_bias_m_per_s2=accel))


def _sheet(imu: WorldImu, scale: float) -> ImuSheet:
    """Return the data sheet with the figures that the description gives, and the camera's place in scale."""
    sheet = ADIS16448 if imu.sheet is None else read_imu_sheet(data_path(imu.sheet, Path()))
    given = {field.name: getattr(imu, field.name) for field in fields(ImuSheet)}
    sheet = replace(sheet, **{name: value for name, value in given.items() if value is not None})
    qw, qx, qy, qz, x, y, z = sheet.T_imu_cam
    return replace(sheet, T_imu_cam=(qw, qx, qy, qz, scale * x, scale * y, scale * z))


def _without_noise(sheet: ImuSheet) -> ImuSheet:
    return ImuSheet(sheet.rate_hz, 0.0, 0.0, 0.0, 0.0, sheet.T_imu_cam)


def _motion(way: CameraWay, T_cam_imu: np.ndarray, time_s: np.ndarray) -> _Motion:
    """Return the motion of the IMU at `(n,)` seconds since the start, by central differences."""
    before, now, after = (compose(way.poses(time_s + step), T_cam_imu[None]) for step in (-_STEP_S, 0.0, _STEP_S))
    turn = between(before, after)
    return _Motion(
        now,
        (after - before)[:, 4:] / (2.0 * _STEP_S),
        (after - 2.0 * now + before)[:, 4:] / _STEP_S**2,
        Rotation.from_quat(turn[:, [1, 2, 3, 0]]).as_rotvec() / (2.0 * _STEP_S),
    )


def _synthesized(motion: _Motion, since_ns: np.ndarray, sheet: ImuSheet, seed: int) -> tuple[ImuSamples, _Biases]:
    """Return the samples of a motion with noise, at `(n,)` nanoseconds since the start, and their biases."""
    draws = np.random.default_rng([seed, 602]).standard_normal((len(since_ns), 4, 3))
    white = np.array([sheet.gyroscope_noise_density, sheet.accelerometer_noise_density]) * np.sqrt(sheet.rate_hz)
    walk = np.array([sheet.gyroscope_random_walk, sheet.accelerometer_random_walk]) / np.sqrt(sheet.rate_hz)
    steps = walk[:, None] * draws[:-1, 2:]
    bias = np.concatenate([np.zeros((1, 2, 3)), np.cumsum(steps, axis=0)])
    added = bias + white[:, None] * draws[:, :2]
    upward = motion.accel_m_per_s2 - GRAVITY_M_PER_S2
    force = np.einsum("nji,nj->ni", matrices(motion.T_world_imu[:, :4]), upward)
    samples = ImuSamples(START_NS + since_ns, motion.gyro_rad_per_s + added[:, 0], force + added[:, 1])
    return samples, _Biases(1e-9 * since_ns, bias[:, 0], bias[:, 1])


def _real_samples(file: str, way: FileWay, frames_ns: np.ndarray, fps: float) -> ImuSamples:
    """Return the samples of a file on the clock of the recording, from a frame time before the first frame."""
    given = read_imu_samples(file)
    stamps = given.timestamps_ns + (START_NS - way.start_ns)
    if stamps[0] > frames_ns[0] or stamps[-1] < frames_ns[-1]:
        need, got = (_seconds(span) for span in (frames_ns, stamps))
        raise ConfigError(f"{file}: expected samples of the whole recording, {need} after its start, got {got}")
    begin = max(int(np.searchsorted(stamps, frames_ns[0] - round(1e9 / fps), side="right")) - 1, 0)
    kept = slice(begin, int(np.searchsorted(stamps, frames_ns[-1])) + 1)
    return ImuSamples(stamps[kept], given.gyro_rad_per_s[kept], given.accel_m_per_s2[kept])


def _seconds(stamps: np.ndarray) -> str:
    first, last = 1e-9 * (stamps[[0, -1]] - START_NS)
    return f"{first:.3f} to {last:.3f} s"


def _at(at_s: np.ndarray, time_s: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Interpolate `(n, 3)` vectors at `(n,)` times linearly at `(m,)` others."""
    return np.stack([np.interp(at_s, time_s, column) for column in vectors.T], axis=1)
