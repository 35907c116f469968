"""Read the rows of trajectory files: TUM, KITTI, the ground truth of EuRoC, and the trajectories of VSLAM-LAB."""

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from jaxslam.errors import TrajectoryError, one_line
from jaxslam.geometry.so3 import quaternions
from jaxslam.io.text_rows import PathLike, read_text, text_rows
from jaxslam.io.timestamps import nanoseconds

NOT_FINITE = "holds a number that is not finite"

_Rows: TypeAlias = Sequence[tuple[int, list[str]]]
"""The line number and the words of every line with data."""

_LONGEST_YEARS = 30
_TUM_COLUMNS, _KITTI_COLUMNS, _EUROC_COLUMNS = 8, 12, 8
_VSLAMLAB_HEADINGS = ("ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw")
_VSLAMLAB_TIMES = ("ts (ns)", "timestamp")
"""Headings of the first column: of its datasets and C++ baselines, and of some baselines in Python."""


@dataclass(frozen=True, eq=False)
class PoseRows:
    """The poses of a file in the order of its rows, which need not be the order of time.

    Attributes:
        path: Path of the file.
        kind: Format of the file.
        lines: `(n,)` line number of each pose, from 1.
        timestamps_ns: `(n,)` int64 timestamps, nanoseconds; `None` for KITTI, whose rows have no timestamps.
        T_world_cam: `(n, 7)` `qw qx qy qz x y z`, meters; quaternions are not checked or normalized.
    """

    path: Path
    kind: Literal["TUM", "KITTI", "EuRoC", "VSLAM-LAB"]
    lines: Int[np.ndarray, " n"]
    timestamps_ns: Int[np.ndarray, " n"] | None
    T_world_cam: Float[np.ndarray, "n 7"]

    def __len__(self) -> int:
        return len(self.lines)


def read_rows(path: PathLike) -> PoseRows:
    """Read a file in the TUM format (8 columns), the KITTI format (12), EuRoC's or VSLAM-LAB's (commas).

    A file is VSLAM-LAB's if its first line begins with the heading `ts (ns)`. It is EuRoC's if it is separated
    by commas and either begins with a `#` line that is, too, or is named `.csv`.

    Raises:
        TrajectoryError: If the file is missing, unreadable, empty, or in none of these formats.
    """
    if _is_vslamlab(path):
        return read_vslamlab_rows(path)
    if _is_euroc(path):
        return read_euroc_rows(path)
    rows = _pose_rows(path)
    number, words = rows[0]
    match len(words):
        case 8:
            return _tum(path, rows)
        case 12:
            return _kitti(path, rows)
        case found:
            raise TrajectoryError(f"{path}:{number}: expected 8 (TUM) or 12 (KITTI) columns, found {found}")


def read_tum_rows(path: PathLike) -> PoseRows:
    """Read rows of `timestamp tx ty tz qx qy qz qw`: seconds, meters.

    Raises:
        TrajectoryError: If the file is missing, unreadable or empty, or a row is malformed.
    """
    return _tum(path, _pose_rows(path))


def read_kitti_rows(path: PathLike) -> PoseRows:
    """Read rows of the upper 3 x 4 of `T_world_cam`; matrices are replaced by the nearest rotations.

    Raises:
        TrajectoryError: If the file is missing, unreadable or empty, or a row is malformed.
    """
    return _kitti(path, _pose_rows(path))


def read_euroc_rows(path: PathLike) -> PoseRows:
    """Read rows of `nanoseconds, x, y, z, qw, qx, qy, qz`, whatever follows; `#` begins a comment.

    Raises:
        TrajectoryError: If the file is missing, unreadable or empty, or a row is malformed.
    """
    rows = _pose_rows(path, commas=True)
    stamps: list[int] = []
    poses: list[list[float]] = []
    for number, words in rows:
        if len(words) < _EUROC_COLUMNS:
            raise TrajectoryError(
                f"{path}:{number}: expected at least {_EUROC_COLUMNS} columns (nanoseconds, x y z, qw qx qy qz),"
                f" got {len(words)}"
            )
        try:
            stamps.append(int(np.int64(int(words[0]))))
            x, y, z, *wxyz = (float(word) for word in words[1:_EUROC_COLUMNS])
        except (ValueError, OverflowError):
            raise TrajectoryError(f"{path}:{number}: expected nanoseconds, x y z and qw qx qy qz") from None
        poses.append([*wxyz, x, y, z])
    return PoseRows(Path(path), "EuRoC", _lines(rows), np.array(stamps, np.int64), np.array(poses))


def read_vslamlab_rows(path: PathLike) -> PoseRows:
    """Read rows of `ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw`, below a line of headings or not.

    Source: what the baselines and `create_groundtruth_csv` of the datasets of github.com/VSLAM-LAB/VSLAM-LAB write. Its
    evaluation sorts rows that are not in the order of time, and writes them with spaces and without headings
    (`Evaluate/evo_functions.py`).

    Raises:
        TrajectoryError: If the file is missing, unreadable or empty, or a row is malformed.
    """
    rows = _pose_rows(path, commas="," in _first_line(path))
    rows = rows[1:] if rows[0][1][0] in _VSLAMLAB_TIMES else rows
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses")
    numbers = _table(path, rows, _TUM_COLUMNS, " ".join(_VSLAMLAB_HEADINGS))
    stamps = np.array([_integer_ns(words[0], f"{path}:{number}") for number, words in rows], np.int64)
    return PoseRows(Path(path), "VSLAM-LAB", _lines(rows), stamps, numbers[:, [7, 4, 5, 6, 1, 2, 3]])


def read_times(path: PathLike) -> Int[np.ndarray, " n"]:
    """Read a file of one timestamp in seconds per line, such as KITTI's `times.txt`; return `(n,)` int64 nanoseconds.

    Raises:
        TrajectoryError: If the file is missing, unreadable or empty, or a line is not one number.
    """
    rows = _pose_rows(path)
    _table(path, rows, 1, "timestamp")
    return _stamps(path, rows)


def _is_vslamlab(path: PathLike) -> bool:
    return _first_line(path).partition(",")[0].strip() == _VSLAMLAB_HEADINGS[0]


def _first_line(path: PathLike) -> str:
    return read_text(path, TrajectoryError).partition("\n")[0]


def _integer_ns(text: str, place: str) -> int:
    """Convert a number of nanoseconds, with decimals or an exponent or not, to an integer that int64 holds."""
    number = int(Decimal(text))
    if abs(number) > np.iinfo(np.int64).max:
        raise TrajectoryError(f"{place}: expected a timestamp in nanoseconds, got '{text:.80}'")
    return number


def _is_euroc(path: PathLike) -> bool:
    lines = [line for line in read_text(path, TrajectoryError).split("\n") if line.strip()]
    first = next((line for line in lines if not line.lstrip().startswith("#")), "")
    headed = bool(lines) and lines[0].lstrip().startswith("#") and "," in lines[0]
    return "," in first and (headed or Path(path).suffix.lower() == ".csv")


def _pose_rows(path: PathLike, *, commas: bool = False) -> _Rows:
    """Read the lines with data, at least one."""
    rows = text_rows(path, TrajectoryError, commas=commas)
    if not rows:
        raise TrajectoryError(f"{path}: holds no poses")
    return rows


def _tum(path: PathLike, rows: _Rows) -> PoseRows:
    numbers = _table(path, rows, _TUM_COLUMNS, "timestamp tx ty tz qx qy qz qw")
    return PoseRows(Path(path), "TUM", _lines(rows), _stamps(path, rows), numbers[:, [7, 4, 5, 6, 1, 2, 3]])


def _kitti(path: PathLike, rows: _Rows) -> PoseRows:
    top = _table(path, rows, _KITTI_COLUMNS, "the 3 x 4 matrix of a pose, row by row").reshape(-1, 3, 4)
    R = top[:, :, :3]
    error = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = ~((error < 0.05) & (np.linalg.det(R) > 0))
    if wrong.any():
        raise TrajectoryError(f"{path}:{rows[int(np.argmax(wrong))][0]}: the 3 x 3 matrix is not a rotation")
    return PoseRows(Path(path), "KITTI", _lines(rows), None, np.hstack([quaternions(R), top[:, :, 3]]))


def _lines(rows: _Rows) -> Int[np.ndarray, " n"]:
    return np.array([number for number, _ in rows])


def _table(path: PathLike, rows: _Rows, columns: int, meaning: str) -> Float[np.ndarray, "n columns"]:
    """Convert all words to floats, `(n, columns)`."""
    values: list[list[float]] = []
    for number, words in rows:
        if len(words) != columns:
            found = f"{len(words)}: {' '.join(words)[:80]}"
            raise TrajectoryError(f"{path}:{number}: expected {columns} columns ({meaning}), found {found}")
        try:
            values.append([float(word) for word in words])
        except ValueError as error:
            raise TrajectoryError(
                f"{path}:{number}: expected {columns} numbers ({meaning}): {one_line(error, 80)}"
            ) from None
    table = np.array(values)
    wrong = ~np.isfinite(table).all(axis=1)
    if wrong.any():
        raise TrajectoryError(f"{path}:{rows[int(np.argmax(wrong))][0]}: {NOT_FINITE}")
    return table


def _stamps(path: PathLike, rows: _Rows) -> Int[np.ndarray, " n"]:
    """Convert the first word of each row, in seconds, to `(n,)` int64 nanoseconds."""
    stamps = np.array([nanoseconds(words[0], f"{path}:{number}", TrajectoryError) for number, words in rows])
    years = np.ptp(stamps / 1e9) / 31_557_600
    if years > _LONGEST_YEARS:
        raise TrajectoryError(f"{path}: the timestamps span {years:.0f} years; are they all in seconds?")
    return stamps
