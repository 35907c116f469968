"""Notes of an evaluation: reservations about its figures, and the likely causes of bad ones."""

from typing import NamedTuple

import numpy as np
from jaxslam_kernels.trajectory.alignment import AlignmentKind
from jaxtyping import Float, Int

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.so3 import multiply
from jaxslam.trajectory.pose_pairs import PosePairs
from jaxslam.trajectory.time_offset import TimeOffset, estimate_time_offset
from jaxslam.trajectory.trajectory import Trajectory

_SAME_FRAME_RAD = 0.05
"""RPE per second, radians, up to which the frames of the two bodies are taken as the same."""
_EXPLAINED = 0.2
"""Largest share of the RPE that may remain after correcting a cause for the note to name that cause."""
_SWAPPED_RATIO = 2.0
"""The estimate looks like ground truth if it has this many times as many poses at this many times the rate."""
_FEW_MATCHED = 0.75
"""Share of matched estimated poses below which a note gives their number."""
_FAR_FROM_DELTA = 0.1
"""Share of the requested time by which the time of a pair may be longer without a note."""
_BRIDGED_INTERVALS = 3.0
_CLEARLY_BETTER = 0.8
"""Largest share of the errors that may remain with a time offset for a note to name the offset."""
_SMALLEST_OFFSET_S = 0.01
_MIN_ATE = 1e-4
"""ATE, as a share of the size of the path, below which no cause is looked for."""

_Wxyz = Float[np.ndarray, "n 4"]


class Matches(NamedTuple):
    """Poses of the estimate and of the reference at the same times.

    Attributes:
        estimate: The matched poses of the estimate.
        true: `(n, 7)` matched poses of the reference, `wxyz_xyz`.
    """

    estimate: Trajectory
    true: Float[np.ndarray, "n 7"]


def on_counts(estimate: Trajectory, reference: Trajectory, matches: int, max_gap_s: float) -> tuple[str, ...]:
    """Note if few poses are matched, or if the estimate and the reference look swapped."""
    notes: list[str] = []
    if matches < _FEW_MATCHED * len(estimate):
        notes.append(
            f"only {matches} of {len(estimate)} estimated poses have a true pose within {max_gap_s * 1e3:g} ms; the"
            " figures say nothing of the others"
        )
    return (*notes, *on_swapped_arguments(estimate, reference))


def on_swapped_arguments(estimate: Trajectory, reference: Trajectory) -> tuple[str, ...]:
    """Note if there are so many more estimated than true poses that the two files look swapped."""
    intervals = [_median_interval_s(trajectory.timestamps_ns) for trajectory in (estimate, reference)]
    if len(estimate) < _SWAPPED_RATIO * len(reference) or not 0 < _SWAPPED_RATIO * intervals[0] < intervals[1]:
        return ()
    return (
        f"the estimate has {len(estimate)} poses, {1e3 * intervals[0]:.3g} ms apart, and the reference"
        f" {len(reference)}, {1e3 * intervals[1]:.3g} ms apart: were the estimate and the ground truth swapped?",
    )


def on_frames(num_frames: int | None, coverage_percent: float | None, max_gap_s: float) -> tuple[str, ...]:
    """Note if the frames seem to belong to another recording."""
    if coverage_percent != 0:
        return ()
    return (
        f"none of the {num_frames} frames has an estimated pose within {max_gap_s * 1e3:g} ms: are they those of this"
        " recording, on its clock?",
    )


def on_pairs(
    later: PosePairs, successive: PosePairs, delta_s: float, frames_ns: Int[np.ndarray, " f"] | None
) -> tuple[str, ...]:
    """Note if the pairs of an RPE are further apart in time than its name says.

    Args:
        later: Pairs of the RPE per second.
        successive: Pairs of the RPE per frame.
        delta_s: Requested time between the poses of a pair of the RPE per second, seconds.
        frames_ns: `(f,)` timestamps of the frames of the recording, nanoseconds; `None` if they are not known.
    """
    notes: list[str] = []
    usual_s, median_s = (pairs.times()["median"] or 0.0 for pairs in (successive, later))
    if median_s > (1 + _FAR_FROM_DELTA) * delta_s:
        notes.append(
            f"the poses are too sparse for an RPE over {delta_s:g} s: the pairs are {median_s:.2f} s apart at the"
            " median, and each error is divided by the time of its pair"
        )
    excess = max(_BRIDGED_INTERVALS * usual_s, _FAR_FROM_DELTA * delta_s)
    if bridging := _bridging(later, delta_s + excess, f"RPE over {delta_s:g} s"):
        notes.append(bridging)
    frame_s = 0.0 if frames_ns is None else _median_interval_s(frames_ns)
    if bridging := _bridging(successive, _BRIDGED_INTERVALS * (frame_s or usual_s), "RPE per frame"):
        usual = f"frames are {frame_s:.3f}" if frame_s else f"most poses are {usual_s:.3f}"
        notes.append(f"{bridging}, while {usual} s apart")
    return tuple(notes)


def on_rotations(matches: Matches, pairs: PosePairs, error_rad: Float[np.ndarray, " m"]) -> tuple[str, ...]:
    """Note the cause of large rotational errors: a swapped order of quaternions, or another body on the camera.

    Bonn RGB-D Dynamic has the ground truth of markers on the camera: they rotate by the same angles as the camera, but
    about axes that differ from the camera's by a constant rotation. The figures are still computed from the poses as
    given, as in the literature.

    Args:
        matches: The matched poses.
        pairs: Pairs of the RPE per second.
        error_rad: `(m,)` rotational errors of these pairs, radians.
    """
    rms = _rms(error_rad)
    if rms < _SAME_FRAME_RAD:
        return ()
    given = matches.estimate.T_world_cam[:, :4], matches.true[:, :4]
    reordered = {"estimate": (_reordered(given[0]), given[1]), "reference": (given[0], _reordered(given[1]))}
    for name, (estimate, true) in reordered.items():
        remaining = _turns(estimate, pairs) - _turns(true, pairs)
        if _rms(remaining) <= _EXPLAINED * rms:
            return (_swapped_order(name, remaining, error_rad, pairs),)
    if _differ_about_axes(*given, pairs) <= _EXPLAINED * rms:
        return (
            "estimate and reference turn by the same angles about different axes: the reference is another body on the"
            " camera (a marker?), so the RPE says nothing and the ATE includes the lever arm",
        )
    for name, (estimate, true) in reordered.items():
        if _differ_about_axes(estimate, true, pairs) <= _EXPLAINED * rms:
            return (
                f"the rotations of the {name} fit, but for another body on the camera, if its quaternions are read as"
                " qw qx qy qz: they seem to be in that order instead of qx qy qz qw, so the RPE says nothing",
            )
    return ()


def on_time_offset(
    estimate: Trajectory, reference: Trajectory, align: AlignmentKind, added_s: float
) -> tuple[str, ...]:
    """Note if a constant offset between the clocks explains much of the errors.

    Args:
        estimate: The estimated poses, with `added_s` added to their timestamps.
        reference: The true poses.
        align: Alignment that is fitted before positions are compared.
        added_s: Time that was added to the timestamps of the estimate, seconds.
    """
    offset = _time_offset(estimate, reference, align)
    if offset is None or abs(offset.seconds) < _SMALLEST_OFFSET_S or not _explains(offset, reference):
        return ()
    seconds = added_s + offset.seconds
    return (
        f"with {seconds:+.3f} s added to the stamps of the estimate, the ATE is {offset.with_it.ate_m:.4f} m instead of"
        f" {offset.without_it.ate_m:.4f} m: do the clocks differ? (jaxslam eval --time-offset {seconds:.3f})",
    )


def on_doubtful_offset(offset: TimeOffset) -> tuple[str, ...]:
    """Note if the rotations contradict an offset that was estimated from the positions."""
    if offset.with_it.turn_rad * _CLEARLY_BETTER <= offset.without_it.turn_rad:
        return ()
    return (
        f"the time offset of {offset.seconds:+.4f} s was estimated from the positions; the rotations do not agree much"
        " better with it",
    )


def why_nothing_matches(estimate: Trajectory, reference: Trajectory, added_s: float) -> str:
    """Return the likeliest reason why no poses match: another unit, another time, or interleaved timestamps.

    Args:
        estimate: The estimated poses, with `added_s` added to their timestamps.
        reference: The true poses.
        added_s: Time that was added to the timestamps of the estimate, seconds.
    """
    estimate_ns, reference_ns = estimate.timestamps_ns, reference.timestamps_ns
    ratio = abs(float(estimate_ns[-1])) / max(abs(float(reference_ns[-1])), 1.0)
    for factor, times in ((1e3, "a thousand"), (1e6, "a million"), (1e9, "a billion")):
        if 0.5 < ratio / factor < 2 or 0.5 < ratio * factor < 2:
            return f"the {'first' if ratio > 1 else 'second'} are {times} times larger; are the units the same?"
    if estimate_ns[-1] < reference_ns[0] or reference_ns[-1] < estimate_ns[0]:
        begin_s = added_s + (reference_ns[0] - estimate_ns[0]) * 1e-9
        return (
            "they do not overlap in time; if their clocks differ, jaxslam eval --time-offset SECONDS adds to the stamps"
            f" of the estimate ({begin_s:.3f} would make both begin together)"
        )
    after = np.clip(np.searchsorted(reference_ns, estimate_ns), 1, max(len(reference_ns) - 1, 1))
    around = reference_ns[np.stack([after - 1, np.minimum(after, len(reference_ns) - 1)])]
    nearest = f"the nearest are {np.abs(around - estimate_ns).min() / 1e6:.3f} ms apart"
    offset = _time_offset(estimate, reference, "se3")
    if offset is None or offset.with_it.turn_rad > offset.without_it.turn_rad:
        return nearest
    return f"{nearest}; do the clocks differ? The positions fit best with --time-offset {added_s + offset.seconds:.3f}"


def _bridging(pairs: PosePairs, limit_s: float, error: str) -> str:
    """Describe the pairs whose poses are further apart in time than a limit; empty if there are none."""
    longer = pairs.seconds[pairs.seconds > limit_s]
    if not len(longer):
        return ""
    return f"{len(longer)} of {len(pairs)} pairs of the {error} bridge gaps and are up to {longer.max():.2f} s apart"


def _swapped_order(name: str, remaining: np.ndarray, error_rad: np.ndarray, pairs: PosePairs) -> str:
    angles = np.linalg.norm(remaining, axis=1)
    reordered, given = (np.degrees(pairs.rmse_per_second(error) or 0.0) for error in (angles, error_rad))
    return (
        f"the quaternions of the {name} seem to be in the order qw qx qy qz instead of qx qy qz qw: read that way, the"
        f" RPE would be {reordered:.3f} deg/s instead of {given:.3f}"
    )


def _time_offset(estimate: Trajectory, reference: Trajectory, align: AlignmentKind) -> TimeOffset | None:
    """Estimate the offset between the clocks; `None` if it cannot be estimated."""
    try:
        return estimate_time_offset(estimate, reference, align)
    except TrajectoryError:
        return None


def _explains(offset: TimeOffset, reference: Trajectory) -> bool:
    """Return whether an offset clearly reduces the errors of positions and rotations, and the ATE is not negligible."""
    (ate, turn), (ate_without, turn_without) = offset.with_it, offset.without_it
    size = np.sqrt(np.var(reference.positions, axis=0).sum())
    better = ate < _CLEARLY_BETTER * ate_without and turn < _CLEARLY_BETTER * turn_without
    return bool(better and ate_without > _MIN_ATE * size)


def _reordered(wxyz: _Wxyz) -> _Wxyz:
    """Reorder quaternions that were read as qx qy qz qw although the file has qw qx qy qz."""
    return wxyz[:, [1, 2, 3, 0]]


def _turns(wxyz: _Wxyz, pairs: PosePairs) -> Float[np.ndarray, "m 3"]:
    """Return the rotation vector from the first to the second pose of each pair, in the frame of the first, radians."""
    inverse = wxyz[pairs.first] * np.array([1.0, -1, -1, -1])
    turned = multiply(inverse, wxyz[pairs.second])
    turned = np.where(turned[:, :1] < 0, -turned, turned)
    sine = np.linalg.norm(turned[:, 1:], axis=1, keepdims=True)
    return 2 * np.arctan2(sine, turned[:, :1]) * turned[:, 1:] / np.where(sine > 0, sine, 1.0)


def _differ_about_axes(estimate: _Wxyz, true: _Wxyz, pairs: PosePairs) -> float:
    """Return the RMS difference of the rotation vectors of two bodies after fitting a constant rotation, radians."""
    a, b = _turns(estimate, pairs), _turns(true, pairs)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (Vt.T * np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])) @ U.T
    return _rms(a @ R.T - b)


def _rms(values: np.ndarray) -> float:
    """Return the root mean square of numbers or of the lengths of vectors; 0 if there are none."""
    return float(np.sqrt(np.sum(np.square(values)) / max(len(values), 1)))


def _median_interval_s(timestamps_ns: Int[np.ndarray, " n"]) -> float:
    """Return the median time between distinct timestamps, seconds; 0 with a single one."""
    intervals = np.diff(np.unique(timestamps_ns))
    return float(np.median(intervals)) * 1e-9 if len(intervals) else 0.0
