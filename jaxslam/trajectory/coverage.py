"""Coverage of a recording by a trajectory: the share of frames with a pose, and the time spans without poses."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.trajectory import associate

_LOST_AFTER_INTERVALS = 3.0


class Coverage(NamedTuple):
    """The part of a recording that has estimated poses.

    Attributes:
        num_frames: Number of frames of the recording; `None` if the frames are not known.
        coverage_percent: Share of the frames that have a pose, percent; `None` if the frames are not known.
        lost_spans_ns: `(k, 2)` start and end of the time spans without poses, nanoseconds. If the frames are known, a
            span is a run of frames without a pose: it reaches from the last frame that has a pose to the next frame
            that has one, or to the first or last frame of the recording. If the frames are not known or none has a
            pose, the spans are the gaps between poses longer than three times their median interval, within the time
            span of the reference.
        pose_interval_s: Median time between successive poses of the estimate, seconds; `None` with a single pose.
        longest_gap_s: Longest time between successive poses of the estimate, seconds; `None` with a single pose.
        span_percent: Share of the reference's time span that lies between the first and the last estimated pose,
            percent.
    """

    num_frames: int | None
    coverage_percent: float | None
    lost_spans_ns: Int[np.ndarray, "k 2"]
    pose_interval_s: float | None
    longest_gap_s: float | None
    span_percent: float


def coverage_of(
    estimate_ns: Int[np.ndarray, " n"],
    reference_ns: Int[np.ndarray, " m"],
    frames_ns: Int[np.ndarray, " f"] | None,
    max_gap_s: float,
    frames_offset_s: float = 0.0,
) -> Coverage:
    """Compute the part of a recording that an estimate covers.

    Args:
        estimate_ns: `(n,)` timestamps of the estimated poses in increasing order, at least one, nanoseconds.
        reference_ns: `(m,)` timestamps of the true poses in increasing order, at least one, nanoseconds.
        frames_ns: `(f,)` timestamps of the recording's frames, nanoseconds; `None` if they are not known.
        max_gap_s: Largest difference of timestamps at which a pose belongs to a frame, seconds.
        frames_offset_s: Time by which the clock of the estimate may be ahead of the clock of the frames, seconds.
            Frames are matched with and without this offset, because they may be on either clock, and the better match
            counts.

    Raises:
        TrajectoryError: If `frames_ns` is not a list of timestamps.
    """
    intervals = np.diff(np.unique(estimate_ns)) * 1e-9
    known = (float(np.median(intervals)), float(intervals.max())) if len(intervals) else (None, None)
    span = _span_percent(estimate_ns, reference_ns)
    if frames_ns is None:
        return Coverage(None, None, _gaps(estimate_ns, reference_ns), *known, span)
    frames_ns = _checked(frames_ns)
    clocks = dict.fromkeys((0, round(frames_offset_s * 1e9)))
    matches = [associate(frames_ns, estimate_ns - offset, max_gap_s)[0] for offset in clocks]
    matched = max(matches, key=len)
    lost = _runs_without(frames_ns, matched) if len(matched) else _gaps(estimate_ns, reference_ns)
    return Coverage(len(frames_ns), 100 * len(matched) / len(frames_ns), lost, *known, span)


def _checked(frames_ns: np.ndarray) -> Int[np.ndarray, " f"]:
    """Validate the timestamps of frames, and return them sorted without duplicates."""
    frames_ns = np.asarray(frames_ns)
    if frames_ns.ndim != 1 or not frames_ns.size or frames_ns.dtype.kind not in "iu":
        raise TrajectoryError(
            f"frames_ns: expected (n,) integers in nanoseconds, at least one, got {frames_ns.dtype} {frames_ns.shape}"
        )
    return np.unique(frames_ns).astype(np.int64)


def _runs_without(frames_ns: Int[np.ndarray, " f"], matched: Int[np.ndarray, " k"]) -> Int[np.ndarray, "r 2"]:
    """Return the start and end of each run of frames without a match, as in `Coverage`."""
    without = np.pad(~np.isin(np.arange(len(frames_ns)), matched), 1)
    steps = np.diff(without.astype(np.int8))
    first, after = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    return np.column_stack([frames_ns[np.maximum(first - 1, 0)], frames_ns[np.minimum(after, len(frames_ns) - 1)]])


def _gaps(estimate_ns: Int[np.ndarray, " n"], reference_ns: Int[np.ndarray, " m"]) -> Int[np.ndarray, "k 2"]:
    """Return the start and end of the long gaps between poses within the time span of the reference."""
    begin, end = reference_ns[[0, -1]]
    inside = estimate_ns[(estimate_ns >= begin) & (estimate_ns <= end)]
    stamps = np.concatenate([[begin], inside, [end]])
    intervals = np.diff(np.unique(estimate_ns))
    usual = np.median(intervals) if len(intervals) else 0
    lost = np.diff(stamps) > _LOST_AFTER_INTERVALS * usual
    return np.column_stack([stamps[:-1], stamps[1:]])[lost]


def _span_percent(estimate_ns: Int[np.ndarray, " n"], reference_ns: Int[np.ndarray, " m"]) -> float:
    begin, end = reference_ns[[0, -1]]
    shared = min(end, estimate_ns[-1]) - max(begin, estimate_ns[0])
    return 100 * max(float(shared) / float(end - begin), 0.0) if end > begin else 100.0
