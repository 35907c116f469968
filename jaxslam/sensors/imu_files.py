"""Files of an IMU in the layout of EuRoC MAV: samples (`data.csv`) and data sheets (`sensor.yaml`).

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.config.validation import from_mapping
from jaxslam.errors import CameraError, ConfigError, DatasetError
from jaxslam.geometry.se3 import between
from jaxslam.geometry.so3 import matrices
from jaxslam.geometry.types import Pose
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.text_rows import text_rows
from jaxslam.io.yaml_files import read_mapping
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.sensors.stereo_rig_formats import transform_of

_HEADING = "#timestamp [ns]," + ",".join(
    [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
)
_COLUMNS = 7
_T_IMU_CAMERA, _T_BODY_SENSOR = "T_imu_cam0", "T_BS"


def read_imu_samples(path: str | Path) -> ImuSamples:
    """Read rows of `nanoseconds, w_x, w_y, w_z, a_x, a_y, a_z`: rad/s and m/s^2 in IMU axes.

    Args:
        path: The file, `#` begins a comment; one whose name ends in `.gz` is decompressed.

    Raises:
        DatasetError: If the file is missing, unreadable or empty, or a row is malformed or not later than the row
            before; the message names file and line.
    """
    rows = text_rows(path, DatasetError, commas=True)
    if not rows:
        raise DatasetError(f"{path}: expected at least one line `nanoseconds,rates,forces`, got none")
    parsed = [_row(f"{path}:{number}", words) for number, words in rows]
    stamps, numbers = np.array([stamp for stamp, _ in parsed], np.int64), np.array([values for _, values in parsed])
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if late.size:
        after, before = rows[late[0] + 1], rows[late[0]]
        raise DatasetError(f"{path}:{after[0]}: expected a time after {before[1][0]}, got {after[1][0]}")
    return ImuSamples(stamps, numbers[:, :3], numbers[:, 3:])


def write_imu_samples(path: str | Path, samples: ImuSamples) -> None:
    """Write rows that `read_imu_samples` reads, with 12 decimals; the file appears whole or not at all.

    Raises:
        DatasetError: If the file cannot be written.
    """
    numbers = np.concatenate([samples.gyro_rad_per_s, samples.accel_m_per_s2], axis=1)
    rows = zip(samples.timestamps_ns.tolist(), numbers.tolist(), strict=True)
    lines = [_HEADING, *(",".join([str(stamp), *(f"{number:.12f}" for number in row)]) for stamp, row in rows)]
    write_atomically(path, ("\n".join(lines) + "\n").encode(), DatasetError)


def read_imu_sheet(path: str | Path, T_body_cam: Pose | None = None) -> ImuSheet:
    """Read the data sheet of an IMU; keys that it does not need are ignored.

    Args:
        path: A YAML file with `rate_hz` and the four noise figures. The place of the camera is `T_imu_cam0`; in a file
            of EuRoC, which has `T_BS` instead, it follows from the place of the camera on the body.
        T_body_cam: `(7,)` wxyz_xyz pose of the camera in the axes of the body, for files of EuRoC.

    Raises:
        ConfigError: If the file is unreadable, or a key is missing or impossible.
    """
    path = Path(path)
    raw = read_mapping(path, ConfigError)
    names = {field.name for field in dataclasses.fields(ImuSheet)} - {"T_imu_cam"}
    figures: dict[str, Any] = {key: value for key, value in raw.items() if key in names}
    try:
        return from_mapping(ImuSheet, figures | {"T_imu_cam": _place(raw, str(path), T_body_cam)}, str(path))
    except CameraError as problem:
        raise ConfigError(str(problem)) from None


def write_imu_sheet(path: str | Path, sheet: ImuSheet) -> None:
    """Write a sensor file of EuRoC, in which the IMU is the body; the camera's file says where the camera is.

    Raises:
        DatasetError: If the file cannot be written.
    """
    figures = {name: value for name, value in dataclasses.asdict(sheet).items() if name != "T_imu_cam"}
    identity = np.array([1.0, 0, 0, 0, 0, 0, 0])
    lines = [
        "sensor_type: imu",
        *sensor_pose_lines(identity),
        *(f"{name}: {value!r}" for name, value in figures.items()),
    ]
    write_atomically(path, ("\n".join(lines) + "\n").encode(), DatasetError)


def sensor_pose_lines(T_body_sensor: Pose) -> list[str]:
    """Return the lines of `T_BS` in a sensor file of EuRoC, for a `(7,)` wxyz_xyz pose of the sensor on the body."""
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = matrices(T_body_sensor[:4]), T_body_sensor[4:]
    return [f"{_T_BODY_SENSOR}:", "  cols: 4", "  rows: 4", f"  data: {M.ravel().tolist()}"]


def _row(place: str, words: list[str]) -> tuple[int, list[float]]:
    expected = f"{place}: expected nanoseconds, three angular rates and three specific forces"
    if len(words) != _COLUMNS:
        raise DatasetError(f"{expected}, got {len(words)} columns")
    try:
        stamp, numbers = int(np.int64(int(words[0]))), [float(word) for word in words[1:]]
    except (ValueError, OverflowError):
        raise DatasetError(f"{expected}, got '{','.join(words)[:80]}'") from None
    if not np.isfinite(numbers).all():
        raise DatasetError(f"{place}: expected finite numbers, got '{','.join(words)[:80]}'")
    return stamp, numbers


def _place(raw: dict[str, Any], path: str, T_body_cam: Pose | None) -> tuple[float, ...]:
    """Return the place of the camera on the IMU."""
    if _T_IMU_CAMERA in raw:
        return tuple(transform_of(raw[_T_IMU_CAMERA], f"{path}: {_T_IMU_CAMERA}").tolist())
    if T_body_cam is None:
        raise ConfigError(f"{path}: missing '{_T_IMU_CAMERA}'")
    T_body_imu = transform_of(raw.get(_T_BODY_SENSOR), f"{path}: {_T_BODY_SENSOR}")
    return tuple(between(T_body_imu, T_body_cam).tolist())
