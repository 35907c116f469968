"""How far an estimated trajectory is from the true one: ATE, RPE, drift as KITTI measures it, and coverage.

Figures are computed in float64 whatever JAX is set to, and depend on nothing but the two trajectories and the
settings. Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012; for KITTI's figures
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

from jaxslam.errors import TrajectoryError, nearest
from jaxslam.geometry.so3 import matrices
from jaxslam.runtime.compile_cache import FAST_COMPILE
from jaxslam.runtime.compiled import compiled
from jaxslam.trajectory.coverage import coverage_of
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
    frames_ns: np.ndarray | None = None,
    time_offset_s: float | Literal["auto"] = 0.0,
) -> Evaluation:
    """Compare an estimated trajectory with the true one.

    Poses are matched by time (`trajectory.associate`), never interpolated. A straight line or a camera that stands
    still leaves the rotation of the alignment open but not the errors: the figures are right and a note says so.
    With `align='sim3'` RPE and KITTI's figures are those of the scaled estimate.

    Args:
        estimate: Estimated poses, in any world frame.
        reference: True poses of the same camera.
        align: What to fit before positions are compared: `none`, `se3` (metric sensors) or `sim3` (monocular).
        max_gap_s: Largest difference of stamps that counts as the same time, seconds.
        rpe_delta_s: Time over which drift is measured, seconds.
        frames_ns: `(f,)` int64 stamps of the frames of the recording, nanoseconds, for the coverage. They may be on the
            clock of the estimate, with `time_offset_s` added or not. Without them the coverage is not known.
        time_offset_s: What to add to the stamps of the estimate, seconds, where its clock differs from that of the
            reference; `auto` estimates it by `estimate_time_offset`.

    Raises:
        TrajectoryError: If a setting is wrong, nothing matches, too little matches to align, or the time offset cannot
            be estimated.
    """
    _check_settings(align, max_gap_s, rpe_delta_s, time_offset_s)
    _check_not_empty(estimate, reference)
    notes: tuple[str, ...] = ()
    if time_offset_s == "auto":
        offset = estimate_time_offset(estimate, reference, align)
        time_offset_s, notes = offset.seconds, on_doubtful_offset(offset)
    estimate = estimate.shifted(time_offset_s)
    index_est, index_ref = associate(estimate.timestamps_ns, reference.timestamps_ns, max_gap_s)
    if not len(index_est):
        raise TrajectoryError(_no_match(estimate, reference, max_gap_s, time_offset_s))
    _check_alignable(estimate, reference, len(index_est), align, max_gap_s)
    matches = Matches(estimate.select(index_est), reference.T_world_cam[index_ref])
    matched, truth = matches
    later = PosePairs.later_by(matched.timestamps_ns, rpe_delta_s)
    successive = PosePairs.successive(matched.timestamps_ns)
    errors = _errors(matches, later, align)
    if (beyond := len(matched) - int(errors.absolute[align].num_poses)) > 0:
        raise TrajectoryError(f"{beyond} matched poses are more than {MAX_DISTANCE:g} m from the origin")
    coverage = coverage_of(estimate.timestamps_ns, reference.timestamps_ns, frames_ns, max_gap_s, time_offset_s)
    if len(matched) < _FEWEST_TO_ALIGN:
        notes += (f"fewer than {_FEWEST_TO_ALIGN} matches: no alignment",)
    else:
        notes += (
            *_notes_on_alignment(errors),
            *on_counts(estimate, reference, len(matched), max_gap_s),
            *on_rotations(matches, later, np.asarray(errors.per_second.rotations)[later.first]),
            *on_pairs(later, successive, rpe_delta_s, frames_ns),
            *on_frames(coverage.num_frames, coverage.coverage_percent, max_gap_s),
            *on_time_offset(estimate, reference, align, time_offset_s),
        )
    fitted = errors.absolute[align].alignment
    T, scale = np.asarray(fitted.T_reference_estimate.wxyz_xyz), float(fitted.scale)
    return Evaluation(
        align=align,
        max_gap_s=max_gap_s,
        rpe_delta_s=rpe_delta_s,
        time_offset_s=time_offset_s,
        num_estimate=len(estimate),
        num_reference=len(reference),
        num_matched=len(matched),
        **coverage._asdict(),
        **_absolute_figures(errors, align),
        **_relative_figures(errors, later, successive),
        **_kitti_figures(errors.per_length),
        notes=notes,
        timestamps_ns=matched.timestamps_ns,
        positions_m=scale * matched.positions @ matrices(T[None, :4])[0].T + T[4:],
        reference_m=truth[:, 4:],
        errors_m=np.asarray(errors.absolute[align].distances[: len(matched)]),
        T_reference_estimate=T,
        scale=scale,
    )


class _Errors(NamedTuple):
    """What the kernels compute, padded; in NumPy once it is back."""

    absolute: dict[str, AbsoluteErrors]
    per_second: RelativeErrors
    per_frame: RelativeErrors
    per_length: SegmentErrors


def _errors(matches: Matches, later: PosePairs, align: AlignmentKind) -> _Errors:
    """Errors of matched poses, padded to a capacity from a short ladder, so that few lengths compile anew."""
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
    """All alignments at once: one compilation serves them all."""
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
    per_frame = errors.per_frame
    return {
        "rpe_trans_m_per_s": later.rmse_per_second(translations[later.first]),
        "rpe_rot_deg_per_s": later.rmse_per_second(np.degrees(rotations[later.first])),
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
    """What to say when no pose is matched."""
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
