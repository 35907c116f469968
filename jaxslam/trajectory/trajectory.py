"""Trajectories: timestamped poses, their association by time, and reading and writing TUM, KITTI and EuRoC files."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.se3 import between
from jaxslam.geometry.so3 import matrices, slerp
from jaxslam.geometry.types import Pose, Poses, Positions, Timestamps
from jaxslam.io.atomic_files import write_atomically
from jaxslam.io.timestamps import decimal_seconds
from jaxslam.trajectory.formats import (
    NOT_FINITE,
    PathLike,
    PoseRows,
    read_euroc_rows,
    read_kitti_rows,
    read_rows,
    read_times,
    read_tum_rows,
)

_KITTI_RATE_HZ = 10.0


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses in the world in the order of time; its arrays are read-only copies.

    Attributes:
        timestamps_ns: `(n,)` int64 timestamps, never decreasing, nanoseconds.
        T_world_cam: `(n, 7)` float64 `qw qx qy qz x y z` (jaxlie's order), meters; quaternions of unit length.
            Quaternions are normalized; the length of a given one may differ from 1 by up to 5 %.

    Raises:
        TrajectoryError: If a shape, a type, a number, a quaternion or the order of time is wrong.
    """

    timestamps_ns: Timestamps
    T_world_cam: Poses

    def __post_init__(self) -> None:
        stamps, poses = np.array(self.timestamps_ns), np.array(self.T_world_cam, np.float64)
        if stamps.ndim != 1 or (stamps.size and stamps.dtype.kind not in "iu"):
            raise TrajectoryError(
                f"timestamps_ns: expected (n,) integers in nanoseconds, got {stamps.dtype} {stamps.shape}"
            )
        if poses.shape != (len(stamps), 7) and stamps.size + poses.size:
            raise TrajectoryError(f"T_world_cam: expected shape ({len(stamps)}, 7), got {poses.shape}")
        stamps, poses = stamps.astype(np.int64), poses.reshape(-1, 7)
        if problem := _first_problem(stamps, poses):
            raise TrajectoryError(f"pose {problem[0]}: {problem[1]}")
        poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
        for name, array in (("timestamps_ns", stamps), ("T_world_cam", poses)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def positions(self) -> Positions:
        """`(n, 3)` positions of the camera in the world, meters."""
        return self.T_world_cam[:, 4:]

    def select(self, index: Int[np.ndarray, " k"] | Bool[np.ndarray, " n"]) -> "Trajectory":
        """Select the poses at some indices, or where a mask is true."""
        return Trajectory(self.timestamps_ns[index], self.T_world_cam[index])

    def shifted(self, seconds: float) -> "Trajectory":
        """Add a time in seconds, rounded to nanoseconds, to all timestamps."""
        if not seconds:
            return self  # quaternions normalized once more would differ in the last digit
        return Trajectory(self.timestamps_ns + round(seconds * 1e9), self.T_world_cam)

    def at(self, timestamps_ns: Int[np.ndarray, " m"]) -> "Trajectory":
        """Interpolate the poses at other times: positions linearly, rotations by slerp.

        Times before the first pose get the first pose, and times after the last pose get the last one.

        Args:
            timestamps_ns: `(m,)` times in increasing order, nanoseconds.

        Raises:
            TrajectoryError: If the trajectory is empty.
        """
        if not len(self):
            raise TrajectoryError("no pose to interpolate: the trajectory is empty")
        wanted = np.clip(timestamps_ns, self.timestamps_ns[0], self.timestamps_ns[-1])
        after = np.minimum(np.searchsorted(self.timestamps_ns, wanted), len(self) - 1)
        before = np.maximum(after - 1, 0)
        start = self.timestamps_ns[before]
        span = np.maximum(self.timestamps_ns[after] - start, 1)
        share = np.where(after > before, (wanted - start) / span, 1.0)
        first, second = self.T_world_cam[before], self.T_world_cam[after]
        positions = (1 - share[:, None]) * first[:, 4:] + share[:, None] * second[:, 4:]
        return Trajectory(timestamps_ns, np.hstack([slerp(first[:, :4], second[:, :4], share), positions]))


def associate(
    first_ns: Int[np.ndarray, " n"], second_ns: Int[np.ndarray, " m"], max_gap_s: float = 0.02
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Match the timestamps of two synchronized clocks one to one, nearest first.

    The pair with the smallest gap is matched, then the smallest among the rest, and so on, as in `associate.py` of
    the TUM benchmark. Of two equal gaps at one timestamp, the one wins whose timestamp from the first list is earlier.
    Of equal timestamps in one list only the first can be matched. Takes a few `O(n)` passes after sorting.

    Args:
        first_ns: `(n,)` timestamps in any order, nanoseconds.
        second_ns: `(m,)` timestamps in any order, nanoseconds.
        max_gap_s: Largest gap that counts as the same time, seconds.

    Returns:
        `(k,)` indices into the first list and `(k,)` indices into the second list, in the order of time.
    """
    (stamps_1, index_1), (stamps_2, index_2) = (np.unique(s, return_index=True) for s in (first_ns, second_ns))
    stamps = np.concatenate([stamps_1, stamps_2]).astype(np.int64)
    second = np.repeat([False, True], [len(stamps_1), len(stamps_2)])
    index = np.concatenate([index_1, index_2])
    limit = min(round(max_gap_s * 1e9), 2**61)
    matched: list[np.ndarray] = [np.zeros((0, 2), np.int64)]
    order = np.lexsort((second, stamps))
    while True:
        stamps, second, index = stamps[order], second[order], index[order]
        taken = _mutually_nearest(stamps, second, limit)
        if not taken.any():
            break
        pairs = np.column_stack([index[:-1][taken], index[1:][taken]])
        swapped = second[:-1][taken]
        pairs[swapped] = pairs[swapped, ::-1]
        matched.append(pairs)
        order = np.flatnonzero(~(np.append(taken, False) | np.append(False, taken)))
    pairs = np.concatenate(matched)
    pairs = pairs[np.argsort(np.asarray(first_ns)[pairs[:, 0]])]
    return pairs[:, 0], pairs[:, 1]


def read(path: PathLike) -> Trajectory:
    """Read a trajectory in the format of TUM (8 columns), KITTI (12), EuRoC or VSLAM-LAB (commas), whichever it is.

    Raises:
        TrajectoryError: If the file is missing, unreadable, empty, or in none of these formats.
    """
    return of_rows(read_rows(path))


def read_tum(path: PathLike) -> Trajectory:
    """Read `timestamp tx ty tz qx qy qz qw` rows: seconds, meters, `T_world_cam`; `#` begins a comment.

    Timestamps are read as exact decimals, not as floats, which would round epoch seconds to 0.2 microseconds.

    Raises:
        TrajectoryError: If the file is missing or unreadable, or a row is wrong; the message names file and line.
    """
    return of_rows(read_tum_rows(path))


def read_kitti(path: PathLike, times: PathLike | None = None) -> Trajectory:
    """Read rows of the upper 3 x 4 matrix of `T_world_cam`, row-major, one row per frame.

    Args:
        path: The file of poses. Matrices are replaced by the nearest rotations.
        times: A file of one timestamp in seconds per row, such as KITTI's `times.txt`. Without it frames are 0.1 s
            apart.

    Raises:
        TrajectoryError: If a file is missing or unreadable, a row is wrong, or the files differ in length.
    """
    rows = read_kitti_rows(path)
    if times is None:
        return of_rows(rows)
    stamps = read_times(times)
    if len(stamps) != len(rows):
        raise TrajectoryError(f"{times}: expected one stamp a pose, {len(rows)}, got {len(stamps)}")
    return of_rows(rows, stamps)


def read_euroc(path: PathLike) -> Trajectory:
    """Read the ground truth of EuRoC, `nanoseconds, x, y, z, qw, qx, qy, qz, ...`: poses of the IMU, not of a camera.

    Raises:
        TrajectoryError: If the file is missing or unreadable, or a row is wrong; the message names file and line.
    """
    return of_rows(read_euroc_rows(path))


def of_rows(rows: PoseRows, timestamps_ns: Int[np.ndarray, " n"] | None = None) -> Trajectory:
    """Convert the rows of a file, which must be in the order of time, to a trajectory.

    Args:
        rows: Rows of the file.
        timestamps_ns: `(n,)` timestamps of the rows, nanoseconds. By default they are the timestamps of the file; for
            KITTI, which has none, they are 0.1 s apart.

    Raises:
        TrajectoryError: If a row cannot be right; the message names file and line.
    """
    stamps = rows.timestamps_ns if timestamps_ns is None else timestamps_ns
    if stamps is None:
        stamps = np.round(np.arange(len(rows)) * (1e9 / _KITTI_RATE_HZ)).astype(np.int64)
    if problem := _first_problem(stamps, rows.T_world_cam):
        raise TrajectoryError(f"{rows.path}:{rows.lines[problem[0]]}: {problem[1]}")
    return Trajectory(stamps, rows.T_world_cam)


def write_tum(path: PathLike, trajectory: Trajectory) -> None:
    """Write `timestamp tx ty tz qx qy qz qw` rows with 9 decimals; the file appears whole or not at all.

    Raises:
        TrajectoryError: If the file cannot be written.
    """
    lines = map(tum_line, trajectory.timestamps_ns.tolist(), trajectory.T_world_cam)
    write_atomically(path, "".join(lines).encode(), TrajectoryError)


def tum_line(timestamp_ns: int, T_world_cam: Pose) -> str:
    """Return the row of a pose in a TUM file: `timestamp tx ty tz qx qy qz qw`."""
    return f"{decimal_seconds(timestamp_ns)} {_numbers(T_world_cam[[4, 5, 6, 1, 2, 3, 0]].tolist())}\n"


def write_kitti(path: PathLike, trajectory: Trajectory, frames_ns: Int[np.ndarray, " m"] | None = None) -> int:
    """Write rows of the upper 3 x 4 matrix of `T_world_cam`, one per frame; the file appears whole or not at all.

    The format has no timestamps, so a frame without a pose needs a row too: its pose is interpolated (`Trajectory.at`).

    Args:
        path: Path of the file to write.
        trajectory: The poses, written as they are. KITTI's own files start with the identity.
        frames_ns: `(m,)` timestamps of all frames, nanoseconds; by default the timestamps of the trajectory.

    Returns:
        Number of interpolated rows.

    Raises:
        TrajectoryError: If the file cannot be written, or frames are given and there is no pose.
    """
    filled = 0
    if frames_ns is not None:
        filled = int((~np.isin(frames_ns, trajectory.timestamps_ns)).sum())
        trajectory = trajectory.at(np.asarray(frames_ns))
    top = np.concatenate([matrices(trajectory.T_world_cam[:, :4]), trajectory.positions[:, :, None]], axis=2)
    lines = (f"{_numbers(row)}\n" for row in top.reshape(-1, 12).tolist())
    write_atomically(path, "".join(lines).encode(), TrajectoryError)
    return filled


def write_kitti_frames(path: PathLike, trajectory: Trajectory, frames_ns: Int[np.ndarray, " m"]) -> int:
    """Write the file that KITTI's development kit reads: a row for every frame, relative to the first frame.

    A frame without a pose of its own (lost, rejected, dropped) gets the pose before it, which is what a robot would
    have known then. Frames before the first pose get the first pose. No pose is interpolated, because that would make
    tracking losses look smaller.

    Args:
        path: Path of the file to write.
        trajectory: The poses.
        frames_ns: `(m,)` timestamps of all frames in increasing order, nanoseconds.

    Returns:
        Number of rows that repeat another frame's pose.

    Raises:
        TrajectoryError: If the file cannot be written, or there is no pose.
    """
    if not len(trajectory):
        raise TrajectoryError("no pose to write: the trajectory is empty")
    stamps = np.asarray(frames_ns)
    held = np.maximum(np.searchsorted(trajectory.timestamps_ns, stamps, side="right") - 1, 0)
    poses = trajectory.T_world_cam[held]
    write_kitti(path, Trajectory(stamps, between(poses[:1], poses)))
    return int((trajectory.timestamps_ns[held] != stamps).sum())


def _first_problem(stamps: np.ndarray, poses: np.ndarray) -> tuple[int, str] | None:
    """Return the index and a description of the first invalid pose; `None` if all are valid."""
    off = np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1)
    checks = (
        (~np.isfinite(poses).all(axis=1), NOT_FINITE),
        (~(off <= 0.05), "the quaternion is not of unit length; expected wxyz in memory, xyzw in TUM files"),
        (np.diff(stamps, prepend=stamps[:1]) < 0, "time goes backwards"),
    )
    found = [(int(np.argmax(wrong)), text) for wrong, text in checks if wrong.any()]
    return min(found, key=lambda problem: problem[0]) if found else None


def _mutually_nearest(stamps: np.ndarray, second: np.ndarray, limit: int) -> np.ndarray:
    """Return the `(n - 1,)` mask of neighbors in a sorted list that are each other's nearest from the other list.

    The greedy matching takes these pairs whatever becomes of the rest. The two gaps at one timestamp never tie, because
    the key also holds which list's timestamp is earlier.
    """
    nodes, none = np.arange(len(stamps)), np.iinfo(np.int64).max
    previous = np.where(second, _last_true(~second), _last_true(second))
    following = len(stamps) - 1 - np.where(second, _last_true(~second[::-1])[::-1], _last_true(second[::-1])[::-1])
    to_previous = np.where(previous >= 0, 2 * (stamps - stamps[previous]) + second[previous], none)
    to_following = np.where(following < len(stamps), 2 * (stamps[following - len(stamps)] - stamps) + second, none)
    mutual = (following[:-1] == nodes[1:]) & (to_following <= to_previous)[:-1] & (to_previous <= to_following)[1:]
    return mutual & (np.diff(stamps) <= limit)


def _last_true(flags: np.ndarray) -> np.ndarray:
    """Return, for each index, the index of the last true flag up to it; -1 if there is none."""
    return np.maximum.accumulate(np.where(flags, np.arange(len(flags)), -1))


def _numbers(values: Sequence[float]) -> str:
    return " ".join([f"{value:.9f}" for value in values])
