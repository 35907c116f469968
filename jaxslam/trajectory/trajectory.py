"""Trajectories: poses over time, matched by time, read from and written to the files of the field."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.se3 import between
from jaxslam.geometry.so3 import matrices, slerp
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
    """Camera poses in the world in the order of time. Arrays are copied and read-only.

    Attributes:
        timestamps_ns: `(n,)` int64 nanoseconds, never decreasing.
        T_world_cam: `(n, 7)` float64 `qw qx qy qz x y z` (jaxlie's order), meters; quaternions of unit length.
            Given quaternions may be up to 5 % off and are normalized.

    Raises:
        TrajectoryError: If a shape, a type, a number, a quaternion or the order of time is wrong.
    """

    timestamps_ns: np.ndarray
    T_world_cam: np.ndarray

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
    def positions(self) -> np.ndarray:
        """`(n, 3)` positions of the camera in the world, meters."""
        return self.T_world_cam[:, 4:]

    def select(self, index: np.ndarray) -> "Trajectory":
        """The poses at these indices, or where this mask is true."""
        return Trajectory(self.timestamps_ns[index], self.T_world_cam[index])

    def shifted(self, seconds: float) -> "Trajectory":
        """The same poses with this time added to their stamps, seconds; rounded to nanoseconds."""
        if not seconds:
            return self  # quaternions normalized once more would differ in the last digit
        return Trajectory(self.timestamps_ns + round(seconds * 1e9), self.T_world_cam)

    def at(self, timestamps_ns: np.ndarray) -> "Trajectory":
        """Poses at other times: linear in position, spherical in rotation, held before the first and after the last.

        Raises:
            TrajectoryError: If there is no pose at all.
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


def associate(first_ns: np.ndarray, second_ns: np.ndarray, max_gap_s: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Match stamps of two clocks that agree: nearest first, one to one, never interpolated.

    The pair with the smallest gap is matched, then the smallest among the rest, and so on, as in `associate.py` of
    the TUM benchmark. Of two equal gaps at one stamp, the one where the first list's stamp is the earlier wins; of
    equal stamps in one list only the first can be matched. A few passes of `O(n)` after sorting.

    Args:
        first_ns: `(n,)` int64 nanoseconds, in any order.
        second_ns: `(m,)` int64 nanoseconds, in any order.
        max_gap_s: Largest gap that counts as the same time, seconds.

    Returns:
        Indices into the first and into the second list, `(k,)` each, in the order of time.
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
    """Read a trajectory in the TUM format (8 columns), the KITTI format (12) or EuRoC's (commas), whichever it is.

    Raises:
        TrajectoryError: If the file is missing, unreadable, empty, or in none of these formats.
    """
    return of_rows(read_rows(path))


def read_tum(path: PathLike) -> Trajectory:
    """Read `timestamp tx ty tz qx qy qz qw` rows: seconds, meters, `T_world_cam`; `#` begins a comment.

    Stamps are read as exact decimals, not as floats, which would round epoch seconds to 0.2 microseconds.

    Raises:
        TrajectoryError: If the file is missing or unreadable, or a row is wrong; the message names file and line.
    """
    return of_rows(read_tum_rows(path))


def read_kitti(path: PathLike, times: PathLike | None = None) -> Trajectory:
    """Read rows of the upper 3 x 4 of `T_world_cam`, row-major, one a frame.

    Args:
        path: The file of poses. Matrices are replaced by the nearest rotations.
        times: A file of one stamp in seconds a row, as KITTI's `times.txt`; without it frames are 0.1 s apart.

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
    """Read the ground truth of EuRoC, `nanoseconds, x, y, z, qw, qx, qy, qz, ...`: poses of the body, the IMU.

    Raises:
        TrajectoryError: If the file is missing or unreadable, or a row is wrong; the message names file and line.
    """
    return of_rows(read_euroc_rows(path))


def of_rows(rows: PoseRows, timestamps_ns: Int[np.ndarray, " n"] | None = None) -> Trajectory:
    """The trajectory that the rows of a file hold, which must be in the order of time.

    Args:
        rows: What the file holds.
        timestamps_ns: The stamps of the rows, nanoseconds. By default those of the file, and for KITTI, which has none,
            0.1 s apart.

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
    poses = trajectory.T_world_cam[:, [4, 5, 6, 1, 2, 3, 0]]
    lines = (
        f"{decimal_seconds(stamp)} {_numbers(pose)}\n"
        for stamp, pose in zip(trajectory.timestamps_ns.tolist(), poses.tolist(), strict=True)
    )
    write_atomically(path, "".join(lines).encode(), TrajectoryError)


def write_kitti(path: PathLike, trajectory: Trajectory, frames_ns: np.ndarray | None = None) -> int:
    """Write rows of the upper 3 x 4 of `T_world_cam`, one a frame; the file appears whole or not at all.

    The format has no stamps, so a frame without a pose needs a row too: its pose is interpolated (`Trajectory.at`).

    Args:
        path: Where to write.
        trajectory: The poses, written as they are; KITTI's own begin with the identity.
        frames_ns: `(m,)` stamps of all frames; by default those of the trajectory.

    Returns:
        How many rows were filled in by interpolation.

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


def write_kitti_frames(path: PathLike, trajectory: Trajectory, frames_ns: np.ndarray) -> int:
    """Write what KITTI's development kit reads: a row for every frame, in the axes of the first.

    A frame without a pose of its own (lost, rejected, dropped) has the one before it, and those before the first pose
    have that: what a robot would have known then. Nothing is interpolated, which would make losses look smaller.

    Args:
        path: Where to write.
        trajectory: The poses.
        frames_ns: `(m,)` stamps of all frames, in the order of time.

    Returns:
        How many rows were filled in.

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
    """Index and description of the first pose that cannot be right."""
    off = np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1)
    checks = (
        (~np.isfinite(poses).all(axis=1), NOT_FINITE),
        (~(off <= 0.05), "the quaternion is not of unit length; expected wxyz in memory, xyzw in TUM files"),
        (np.diff(stamps, prepend=stamps[:1]) < 0, "time goes backwards"),
    )
    found = [(int(np.argmax(wrong)), text) for wrong, text in checks if wrong.any()]
    return min(found, key=lambda problem: problem[0]) if found else None


def _mutually_nearest(stamps: np.ndarray, second: np.ndarray, limit: int) -> np.ndarray:
    """Which neighbors in a sorted list are each other's nearest of the other kind; `(n - 1,)`.

    These pairs the greedy matching takes whatever becomes of the rest. The two gaps at one stamp never tie, because
    the key also holds which list's stamp is the earlier.
    """
    nodes, none = np.arange(len(stamps)), np.iinfo(np.int64).max
    previous = np.where(second, _last_true(~second), _last_true(second))
    following = len(stamps) - 1 - np.where(second, _last_true(~second[::-1])[::-1], _last_true(second[::-1])[::-1])
    to_previous = np.where(previous >= 0, 2 * (stamps - stamps[previous]) + second[previous], none)
    to_following = np.where(following < len(stamps), 2 * (stamps[following - len(stamps)] - stamps) + second, none)
    mutual = (following[:-1] == nodes[1:]) & (to_following <= to_previous)[:-1] & (to_previous <= to_following)[1:]
    return mutual & (np.diff(stamps) <= limit)


def _last_true(flags: np.ndarray) -> np.ndarray:
    """At each place, where the last true flag up to there is; -1 if there is none."""
    return np.maximum.accumulate(np.where(flags, np.arange(len(flags)), -1))


def _numbers(values: Sequence[float]) -> str:
    return " ".join([f"{value:.9f}" for value in values])
