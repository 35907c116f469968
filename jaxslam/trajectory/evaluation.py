"""Evaluate an estimated trajectory against ground truth: ATE, RPE, KITTI drift, and coverage.

Figures are computed in float64 whatever JAX is set to, and depend only on the two trajectories and the settings.
Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012; for KITTI's figures
see `jaxslam_kernels.trajectory.kitti_drift`.
"""

import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.trajectory.alignment import (
    MAX_DISTANCE,
    AbsoluteErrors,
    AlignmentKind,
    AlignmentStatus,
    RelativeErrors,
    ate,
    rpe,
)
from jaxslam_kernels.trajectory.kitti_drift import KITTI_LENGTHS_M, KITTI_STEP, SegmentErrors, segment_errors
from jaxtyping import Float, Int

from jaxslam.errors import TrajectoryError, nearest
from jaxslam.geometry.so3 import matrices
from jaxslam.geometry.types import Pose
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.trajectory.coverage import Coverage, coverage_of
from jaxslam.trajectory.evaluation_figures import ALIGNMENT_NAMES, Evaluation
from jaxslam.trajectory.evaluation_notes import (
    Matches,
    on_counts,
    on_doubtful_offset,
    on_frames,
    on_pairs,
    on_rotations,
    on_swapped_arguments,
    on_time_offset,
    why_nothing_matches,
)
from jaxslam.trajectory.pose_pairs import PosePairs
from jaxslam.trajectory.time_offset import estimate_time_offset
from jaxslam.trajectory.trajectory import Trajectory, associate

_SMALLEST_CAPACITY = 1024
_FEWEST_TO_ALIGN = 3


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    align: AlignmentKind = "se3",
    max_gap_s: float = 0.02,
    rpe_delta_s: float = 1.0,
    frames_ns: Int[np.ndarray, " f"] | None = None,
    time_offset_s: float | Literal["auto"] = 0.0,
) -> Evaluation:
    """Evaluate an estimated trajectory against ground truth.

    Poses are matched by time (`trajectory.associate`), never interpolated. A straight path or a camera at rest leaves
    the rotation of the alignment undetermined but not the errors: the figures are right, and a note reports it.
    With `align='sim3'` the RPE and KITTI's figures are computed for the scaled estimate.

    Args:
        estimate: Estimated poses, in any world frame.
        reference: True poses of the same camera.
        align: Alignment to fit before positions are compared: `none`, `se3` (metric sensors) or `sim3` (monocular).
        max_gap_s: Largest difference of timestamps that counts as the same time, seconds.
        rpe_delta_s: Time over which drift is measured, seconds.
        frames_ns: `(f,)` int64 timestamps of the frames of the recording, nanoseconds, from which the coverage is
            computed. They may be on the clock of the estimate with or without `time_offset_s` added. Without them the
            coverage is not known.
        time_offset_s: Time to add to the timestamps of the estimate, seconds, if its clock differs from the clock of
            the reference. `auto` estimates it (`estimate_time_offset`).

    Raises:
        TrajectoryError: If a setting is wrong, no poses match, too few poses match to align them, or the time offset
            cannot be estimated.
    """
    _check_settings(align, max_gap_s, rpe_delta_s, time_offset_s)
    _check_not_empty(estimate, reference)
    notes: tuple[str, ...] = ()
    if time_offset_s == "auto":
        offset = estimate_time_offset(estimate, reference, align)
        time_offset_s, notes = offset.seconds, on_doubtful_offset(offset)
    settings = _Settings(align, max_gap_s, rpe_delta_s, time_offset_s)
    estimate = estimate.shifted(time_offset_s)
    compared = _compare(estimate, reference, settings, frames_ns)
    matched, truth = compared.matches
    errors, later, successive = compared.errors, compared.later, compared.successive
    T, scale, distances_m = _alignment(errors.absolute[align])
    return Evaluation(
        **settings._asdict(),
        num_estimate=len(estimate),
        num_reference=len(reference),
        num_matched=len(matched),
        **compared.coverage._asdict(),
        **_absolute_figures(errors, align),
        **_relative_figures(errors, later, successive),
        **_kitti_figures(errors.per_length),
        notes=(*notes, *_notes(estimate, reference, compared, settings, frames_ns)),
        timestamps_ns=matched.timestamps_ns,
        positions_m=scale * matched.positions @ matrices(T[None, :4])[0].T + T[4:],
        reference_m=truth[:, 4:],
        errors_m=distances_m[: len(matched)],
        T_reference_estimate=T,
        scale=scale,
    )


class _Settings(NamedTuple):
    """The arguments of `evaluate` that its result repeats.

    Attributes:
        align: The alignment that is fitted before positions are compared.
        max_gap_s: Largest difference of timestamps that counts as the same time, seconds.
        rpe_delta_s: Time between the two poses of a pair of the RPE per second, seconds.
        time_offset_s: Time added to the timestamps of the estimate, seconds.
    """

    align: AlignmentKind
    max_gap_s: float
    rpe_delta_s: float
    time_offset_s: float


class _Compared(NamedTuple):
    """The matched poses of two trajectories with their errors.

    Attributes:
        matches: Poses of both trajectories at the same times.
        later: Pairs of the RPE per second.
        successive: Pairs of the RPE per frame.
        errors: Absolute and relative errors of the matched poses.
        coverage: The part of the recording that has estimated poses.
    """

    matches: Matches
    later: PosePairs
    successive: PosePairs
    errors: "_Errors"
    coverage: Coverage


def _compare(
    estimate: Trajectory, reference: Trajectory, settings: _Settings, frames_ns: Int[np.ndarray, " f"] | None
) -> _Compared:
    """Match the poses of two trajectories by time and compute their errors, as in `evaluate`."""
    align, max_gap_s, rpe_delta_s, added_s = settings
    index_est, index_ref = associate(estimate.timestamps_ns, reference.timestamps_ns, max_gap_s)
    if not len(index_est):
        raise TrajectoryError(_no_match(estimate, reference, max_gap_s, added_s))
    _check_alignable(estimate, reference, len(index_est), align, max_gap_s)
    matches = Matches(estimate.select(index_est), reference.T_world_cam[index_ref])
    later = PosePairs.later_by(matches.estimate.timestamps_ns, rpe_delta_s)
    successive = PosePairs.successive(matches.estimate.timestamps_ns)
    errors = _errors(matches, later, align)
    if (beyond := len(index_est) - int(errors.absolute[align].num_poses)) > 0:
        raise TrajectoryError(f"{beyond} matched poses are more than {MAX_DISTANCE:g} m from the origin")
    coverage = coverage_of(estimate.timestamps_ns, reference.timestamps_ns, frames_ns, max_gap_s, added_s)
    return _Compared(matches, later, successive, errors, coverage)


def _notes(
    estimate: Trajectory,
    reference: Trajectory,
    compared: _Compared,
    settings: _Settings,
    frames_ns: Int[np.ndarray, " f"] | None,
) -> tuple[str, ...]:
    """Return the reservations about the figures of an evaluation."""
    matches, later, successive, errors, coverage = compared
    if len(matches.estimate) < _FEWEST_TO_ALIGN:
        return (f"fewer than {_FEWEST_TO_ALIGN} matches: no alignment",)
    return (
        *_notes_on_alignment(errors),
        *on_counts(estimate, reference, len(matches.estimate), settings.max_gap_s),
        *on_rotations(matches, later, np.asarray(errors.per_second.rotations)[later.first]),
        *on_pairs(later, successive, settings.rpe_delta_s, frames_ns),
        *on_frames(coverage.num_frames, coverage.coverage_percent, settings.max_gap_s),
        *on_time_offset(estimate, reference, settings.align, settings.time_offset_s),
    )


def _alignment(absolute: AbsoluteErrors) -> tuple[Pose, float, Float[np.ndarray, " capacity"]]:
    """Return the fitted `T_reference_estimate`, the scale, and the padded distances after alignment, meters."""
    fitted = absolute.alignment
    return np.asarray(fitted.T_reference_estimate.wxyz_xyz), float(fitted.scale), np.asarray(absolute.distances)


class _Errors(NamedTuple):
    """The errors that the kernels compute, padded; NumPy arrays once they are back on the host.

    Attributes:
        absolute: Distances between matched positions and their statistics, by the name of the alignment.
        per_second: Errors of the pairs of the RPE per second.
        per_frame: Errors of the pairs of the RPE per frame.
        per_length: Errors of KITTI's segments.
    """

    absolute: dict[str, AbsoluteErrors]
    per_second: RelativeErrors
    per_frame: RelativeErrors
    per_length: SegmentErrors


def _errors(matches: Matches, later: PosePairs, align: AlignmentKind) -> _Errors:
    """Compute the errors of matched poses, padded to one of a few capacities so that few lengths compile anew."""
    count, capacity = len(matches.estimate), _SMALLEST_CAPACITY
    while capacity < count:
        capacity *= 4
    second = np.full(capacity, capacity, np.int32)
    second[later.first] = later.second
    nowhere = np.repeat(np.array([[1.0, 0, 0, 0, 0, 0, 0]]), capacity - count, axis=0)
    with jax.enable_x64(True):
        errors = _padded_errors(
            np.concatenate([matches.estimate.T_world_cam, nowhere]),
            np.concatenate([matches.true, nowhere]),
            np.arange(capacity) < count,
            second,
            np.array(align == "sim3"),
        )
        return jax.tree.map(np.asarray, errors)


@compiled(when="first use", options=FAST_COMPILE)
def _padded_errors(P: jax.Array, Q: jax.Array, mask: jax.Array, later: jax.Array, scaled: jax.Array) -> _Errors:
    """Compute the errors with every alignment at once, so that one compilation serves them all."""
    x, y, weights = P[:, 4:].T, Q[:, 4:].T, mask.astype(P.dtype)
    absolute = {kind: ate(x, y, weights, alignment=kind) for kind in ALIGNMENT_NAMES}
    P = P.at[:, 4:].multiply(jnp.where(scaled, absolute["sim3"].alignment.scale, 1.0))
    index, end = jnp.arange(len(mask), dtype=jnp.int32), jnp.sum(mask, dtype=jnp.int32)
    drift = lambda other: rpe(SE3(P), SE3(Q), index, other, mask & (other < end))
    per_length = segment_errors(SE3(P), SE3(Q), mask, jnp.array(KITTI_LENGTHS_M, P.dtype), step=KITTI_STEP)
    return _Errors(absolute, drift(later), drift(index + 1), per_length)


def _absolute_figures(errors: _Errors, align: AlignmentKind) -> dict[str, float | None]:
    statistics, similar = errors.absolute[align].statistics, errors.absolute["sim3"]
    alignable = similar.num_poses >= _FEWEST_TO_ALIGN
    return {
        "ate_rmse_m": float(statistics.rmse),
        "ate_mean_m": float(statistics.mean),
        "ate_median_m": float(statistics.median),
        "ate_max_m": float(statistics.maximum),
        "ate_std_m": float(statistics.std),
        "ate_sim3_rmse_m": float(similar.statistics.rmse) if alignable else None,
        "sim3_scale": float(similar.alignment.scale) if alignable else None,
    }


def _relative_figures(errors: _Errors, later: PosePairs, successive: PosePairs) -> dict[str, Any]:
    translations, rotations = np.asarray(errors.per_second.translations), np.asarray(errors.per_second.rotations)
    translations, rotations, per_frame = translations[later.first], np.degrees(rotations[later.first]), errors.per_frame
    return {
        "rpe_trans_m_per_s": later.rmse_per_second(translations),
        **{f"rpe_trans_{name}_m_per_s": value for name, value in later.statistics_per_second(translations).items()},
        "rpe_rot_deg_per_s": later.rmse_per_second(rotations),
        **{f"rpe_rot_{name}_deg_per_s": value for name, value in later.statistics_per_second(rotations).items()},
        "rpe_trans_m_per_frame": float(per_frame.translation.rmse) if len(successive) else None,
        "rpe_rot_deg_per_frame": float(np.degrees(per_frame.rotation.rmse)) if len(successive) else None,
        "rpe_pairs": len(later),
        "rpe_frame_pairs": len(successive),
        **{f"rpe_pair_s_{name}": value for name, value in later.times().items()},
        **{f"rpe_frame_s_{name}": value for name, value in successive.times().items()},
    }


def _kitti_figures(errors: SegmentErrors) -> dict[str, Any]:
    found = int(errors.num_segments)
    return {
        "kitti_trans_percent": 100 * float(errors.translation) if found else None,
        "kitti_rot_deg_per_100m": 100 * math.degrees(float(errors.rotation)) if found else None,
        "kitti_segments": found,
    }


def _notes_on_alignment(errors: _Errors) -> tuple[str, ...]:
    if errors.absolute["sim3"].alignment.status != AlignmentStatus.ROTATION_UNDETERMINED:
        return ()
    return ("positions on a straight line or in one point: the aligned rotation is arbitrary about it",)


def _check_settings(align: str, max_gap_s: float, rpe_delta_s: float, time_offset_s: float | str) -> None:
    if align not in ALIGNMENT_NAMES:
        raise TrajectoryError(f"align: unknown alignment '{align}'{nearest(align, ALIGNMENT_NAMES)}")
    for name, value in (("max_gap_s", max_gap_s), ("rpe_delta_s", rpe_delta_s)):
        if not (math.isfinite(value) and value > 0):
            raise TrajectoryError(f"{name}: expected a positive number of seconds, got {value}")
    if time_offset_s != "auto" and (isinstance(time_offset_s, str) or not math.isfinite(time_offset_s)):
        raise TrajectoryError(f"time_offset_s: expected seconds or 'auto', got {time_offset_s}")


def _check_not_empty(estimate: Trajectory, reference: Trajectory) -> None:
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        if not len(trajectory):
            raise TrajectoryError(f"the {name} holds no poses")


def _no_match(estimate: Trajectory, reference: Trajectory, max_gap_s: float, added_s: float) -> str:
    """Return the error message if no poses match."""
    spans = f"the estimate's ({_span(estimate)}) and the reference's ({_span(reference)})"
    reasons = [why_nothing_matches(estimate, reference, added_s), *on_swapped_arguments(estimate, reference)]
    return f"no stamps within {max_gap_s * 1e3:g} ms of each other among {spans}: {'; '.join(reasons)}"


def _check_alignable(
    estimate: Trajectory, reference: Trajectory, matches: int, align: AlignmentKind, max_gap_s: float
) -> None:
    if align != "none" and matches < _FEWEST_TO_ALIGN:
        rest = "the ATE" if matches == 1 else "the ATE and the RPE"
        raise TrajectoryError(
            f"alignment needs {_FEWEST_TO_ALIGN} matches, got {matches} within {max_gap_s * 1e3:g} ms from"
            f" {len(estimate)} estimated and {len(reference)} true poses; align='none' still gives {rest}"
        )


def _span(trajectory: Trajectory) -> str:
    first, last = trajectory.timestamps_ns[[0, -1]] / 1e9
    return f"{len(trajectory)} poses, {first:.3f} to {last:.3f} s"
