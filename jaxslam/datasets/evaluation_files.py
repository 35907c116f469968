"""Files of an estimated and a reference trajectory, with the timestamps and frames that they do not contain."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxslam.datasets.image_lists import read_file_list
from jaxslam.errors import DatasetError, TrajectoryError
from jaxslam.io.text_rows import text_rows
from jaxslam.trajectory.formats import PoseRows, read_rows, read_times
from jaxslam.trajectory.trajectory import Trajectory, of_rows

_FRAME_LISTS = ("rgb.txt", "times.txt")
"""Files next to the ground truth that list the frames of a recording, in the layouts of TUM and KITTI."""
_HOW = "--times FILE gives stamps, one a row, to rows of KITTI"


class TrajectoryPair(NamedTuple):
    """An estimated and a reference trajectory read from files.

    Attributes:
        estimate: The estimated poses.
        reference: The true poses.
        frames_ns: `(f,)` int64 timestamps of the recording's frames in nanoseconds; `None` if unknown.
        notes: Assumptions made while reading, as sentences.
    """

    estimate: Trajectory
    reference: Trajectory
    frames_ns: Int[np.ndarray, " f"] | None
    notes: tuple[str, ...]


def read_pair(
    estimate: Path, reference: Path, times: Sequence[Path] = (), frames: Path | None = None
) -> TrajectoryPair:
    """Read an estimate and a reference; rows that are not in the order of time are sorted.

    Rows of KITTI have no timestamps. They get those of `times` or, without it, of a list of frames of the same length.
    Two files of KITTI of equal length are matched by row without any timestamps.

    Args:
        estimate: File of the estimated poses.
        reference: File of the true poses.
        times: Files of one timestamp per line for rows of KITTI: one file for either or both sides, or one for the
            estimate and one for the reference.
        frames: File with the timestamps of the recording's frames, as `read_frames` reads it. The default is `rgb.txt`
            or `times.txt` next to the reference, if it exists.

    Raises:
        TrajectoryError: If a file is missing, unreadable or malformed, or timestamps are missing or do not fit.
        DatasetError: If a list of images given as `frames` is malformed.
    """
    rows = [read_rows(estimate), read_rows(reference)]
    listed, notes = _listed_frames(reference, frames)
    if times:
        rows = _with_times(rows, times)
    elif any(side.timestamps_ns is None for side in rows):
        rows, listed, more = _with_frames(rows, listed)
        notes += more
    estimated, on_estimate = in_order("estimate", rows[0])
    true, on_reference = in_order("reference", rows[1])
    frames_ns = None if listed is None else listed.timestamps_ns
    return TrajectoryPair(estimated, true, frames_ns, notes + on_estimate + on_reference)


def read_frames(path: Path) -> Int[np.ndarray, " f"]:
    """Read the timestamps of frames from a list of images (`rgb.txt`) or of one time per line (KITTI's `times.txt`).

    Raises:
        TrajectoryError: If the file is missing, unreadable or empty, or a line is not one number.
        DatasetError: If it is a malformed list of images.
    """
    rows = text_rows(path, TrajectoryError)
    return read_file_list(path).timestamps_ns if rows and len(rows[0][1]) > 1 else read_times(path)


def in_order(name: str, side: PoseRows) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the trajectory of the rows of a file, sorted by time, and a note if that changed their order.

    Args:
        name: What the file holds, for the note.
        side: Rows of the file.

    Raises:
        TrajectoryError: If a row cannot be right; the message names file and line.
    """
    if side.timestamps_ns is None:
        return of_rows(side), ()
    back = int((np.diff(side.timestamps_ns) < 0).sum())
    order = np.argsort(side.timestamps_ns, kind="stable")
    ordered = replace(
        side, lines=side.lines[order], timestamps_ns=side.timestamps_ns[order], T_world_cam=side.T_world_cam[order]
    )
    note = f"the rows of the {name} were not in the order of time ({back} steps back) and have been sorted"
    return of_rows(ordered), (note,) if back else ()


class _Frames(NamedTuple):
    """A list of frames.

    Attributes:
        path: The file it was read from.
        timestamps_ns: `(f,)` timestamps of the frames in nanoseconds.
        asked_for: Whether the caller named the file.
    """

    path: Path
    timestamps_ns: Int[np.ndarray, " f"]
    asked_for: bool


def _listed_frames(reference: Path, frames: Path | None) -> tuple[_Frames | None, tuple[str, ...]]:
    """Read the list of frames that the caller named, or else the one next to the reference."""
    if frames is not None:
        return _Frames(frames, read_frames(frames), asked_for=True), ()
    found = next((path for name in _FRAME_LISTS if (path := reference.parent / name).is_file()), None)
    if found is None:
        return None, ()
    try:
        stamps = read_frames(found)
    except (TrajectoryError, DatasetError) as problem:
        return None, (f"frames beside the ground truth are not used: {problem}",)
    return _Frames(found, stamps, asked_for=False), (f"frames are those of {found}, beside the ground truth",)


def _with_times(rows: Sequence[PoseRows], times: Sequence[Path]) -> list[PoseRows]:
    """Return the rows of both sides, those of KITTI with the timestamps of these files."""
    bare = [side for side in rows if side.timestamps_ns is None]
    if not 0 < len(times) <= len(bare):
        have = " and ".join(f"{side.path} ({side.kind})" for side in rows)
        raise TrajectoryError(
            f"--times: expected a file for rows of KITTI, {len(bare)} at most, got {len(times)}: {have}"
        )
    files = iter(times if len(times) == len(bare) else [times[0]] * len(bare))
    return [side if side.timestamps_ns is not None else _stamped(side, next(files)) for side in rows]


def _stamped(side: PoseRows, times: Path) -> PoseRows:
    stamps = read_times(times)
    if len(stamps) != len(side):
        raise TrajectoryError(
            f"--times {times}: expected one stamp a row of {side.path}, {len(side)}, got {len(stamps)}; two files are"
            " those of the estimate and of the reference"
        )
    return replace(side, timestamps_ns=stamps)


def _with_frames(
    rows: Sequence[PoseRows], frames: _Frames | None
) -> tuple[list[PoseRows], _Frames | None, tuple[str, ...]]:
    """Return the rows of both sides, those of KITTI with the timestamps of as many frames, or matched by row.

    Returns:
        The rows, the frames if their timestamps fit those of the rows, and notes.
    """
    bare = [side for side in rows if side.timestamps_ns is None]
    if frames is not None and all(len(side) == len(frames.timestamps_ns) for side in bare):
        stamped = [replace(side, timestamps_ns=frames.timestamps_ns) if side in bare else side for side in rows]
        return stamped, frames, (f"rows of KITTI have the stamps of {frames.path}",)
    counts = " and ".join(f"{side.path} {len(side)} ({side.kind})" for side in rows)
    if len(bare) == 1:
        raise TrajectoryError(f"rows of KITTI have no stamps to match with those of the other file: {counts}; {_HOW}")
    if len(bare[0]) != len(bare[1]):
        raise TrajectoryError(f"rows of KITTI have no stamps, and files of different length: {counts}; {_HOW}")
    if frames is not None and frames.asked_for:
        raise TrajectoryError(
            f"--frames {frames.path}: expected as many stamps as there are rows of KITTI, {len(bare[0])},"
            f" got {len(frames.timestamps_ns)}; {_HOW}"
        )
    unused = f"; {frames.path} lists {len(frames.timestamps_ns)} frames and is not used" if frames is not None else ""
    return list(rows), None, (f"rows of KITTI have no stamps: matched by row, as if 0.1 s apart{unused}; {_HOW}",)
