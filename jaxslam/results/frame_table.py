"""CSV tables of a run with one row per frame: its tracking status and times, and the error of its pose."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from enum import IntEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxslam.errors import TrajectoryError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.timestamps import decimal_seconds, nanoseconds
from jaxslam.slam.frame_result import FrameRecord
from jaxslam.trajectory.evaluation import Evaluation

COLUMNS = ("timestamp_s", *(field.name for field in fields(FrameRecord) if field.name != "timestamp_ns"))
_ERROR_COLUMNS = ("timestamp_s", "x_m", "y_m", "z_m", "true_x_m", "true_y_m", "true_z_m", "error_m")
_EARLIER_NAMES = {"num_looked_up": "num_keyframe_matches", "is_keyframe": "keyframe"}
"""Columns that had another name when the file was written, each with its present name."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Poses that were compared with the ground truth.

    Attributes:
        timestamps_ns: `(m,)` timestamps in nanoseconds.
        positions_m: `(m, 3)` estimated camera positions in meters, aligned with the ground truth.
        reference_m: `(m, 3)` true camera positions in meters.
        errors_m: `(m,)` distances between estimated and true positions in meters.
    """

    timestamps_ns: Int[np.ndarray, " m"]
    positions_m: Float[np.ndarray, "m 3"]
    reference_m: Float[np.ndarray, "m 3"]
    errors_m: Float[np.ndarray, " m"]


def write_frames(path: Path, records: Iterable[FrameRecord]) -> None:
    """Write the record of every frame, under the names of the fields of `FrameRecord`; missing values are empty.

    Raises:
        TrajectoryError: If the file cannot be written.
    """
    _write(path, COLUMNS, map(frame_row, records))


def write_errors(path: Path, evaluation: Evaluation) -> None:
    """Write the estimated positions, aligned with the ground truth, beside the true ones.

    Raises:
        TrajectoryError: If the file cannot be written.
    """
    values = np.column_stack([evaluation.positions_m, evaluation.reference_m, evaluation.errors_m])
    stamps = map(decimal_seconds, evaluation.timestamps_ns.tolist())
    rows = ([stamp, *(f"{value:.9f}" for value in row)] for stamp, row in zip(stamps, values.tolist(), strict=True))
    _write(path, _ERROR_COLUMNS, rows)


def read_errors(path: Path) -> Errors:
    """Read a file of `write_errors`.

    Raises:
        TrajectoryError: If the file cannot be read or has other content.
    """
    rows = _read(path, _ERROR_COLUMNS)
    try:
        values = np.array([[float(cell) for cell in row[1:]] for row in rows]).reshape(-1, len(_ERROR_COLUMNS) - 1)
    except ValueError as problem:
        raise TrajectoryError(f"{path}: {problem}") from None
    stamps = [nanoseconds(row[0], str(path), TrajectoryError) for row in rows]
    return Errors(np.array(stamps, np.int64), values[:, :3], values[:, 3:6], values[:, 6])


def read_track_ms(path: Path) -> Float[np.ndarray, " frames"]:
    """Read the tracking times, in milliseconds, of all frames in a file of `write_frames` that have one.

    Raises:
        TrajectoryError: If the file cannot be read or has other content.
    """
    column = COLUMNS.index("track_ms")
    try:
        return np.array([float(row[column]) for row in _read(path, COLUMNS) if row[column]])
    except ValueError as problem:
        raise TrajectoryError(f"{path}: {problem}") from None


def frame_row(record: FrameRecord) -> list[object]:
    """Return the cells of a frame, in the order of `COLUMNS`."""
    values = asdict(record)
    stamp = decimal_seconds(values.pop("timestamp_ns"))
    return [stamp, *(_cell(value) for value in values.values())]


def _cell(value: object) -> object:
    if value is None:
        return ""
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, bool):
        return int(value)
    return f"{value:.6g}" if isinstance(value, float) else value


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_atomically(path, text.getvalue().encode(), TrajectoryError)


def _read(path: Path, columns: Sequence[str]) -> list[list[str]]:
    """Read the rows below the heading."""
    try:
        with path.open(newline="") as file:
            head, *rows = csv.reader(file)
    except (OSError, ValueError) as problem:
        raise TrajectoryError(f"{path}: cannot be read: {problem}") from None
    names = tuple(_EARLIER_NAMES.get(name, name) for name in head)
    if names != tuple(columns) or any(len(row) != len(columns) for row in rows):
        raise TrajectoryError(f"{path}: expected the columns {', '.join(columns)}, got {', '.join(head)}")
    return rows
