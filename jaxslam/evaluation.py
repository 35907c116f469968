"""How far an estimated trajectory is from the true one: ATE, RPE, drift as KITTI measures it, and coverage.

Figures are computed in float64 whatever JAX is set to, and depend on nothing but the two trajectories and the
settings. Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012; for KITTI's figures
see `jaxslam_kernels.segments`.
"""

import math
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.alignment import (
    MAX_DISTANCE,
    AbsoluteErrors,
    AlignmentKind,
    AlignmentStatus,
    RelativeErrors,
    ate,
    rpe,
)
from jaxslam_kernels.segments import KITTI_LENGTHS_M, KITTI_STEP, SegmentErrors, segment_errors

from jaxslam.errors import TrajectoryError, nearest
from jaxslam.rotation import matrices
from jaxslam.trace_cache import traced_once
from jaxslam.trajectory import Trajectory, associate
from jaxslam.xla import SOON_COMPILED

_NAMES: dict[AlignmentKind, str] = {
    "none": "without alignment",
    "se3": "with SE(3) alignment",
    "sim3": "with Sim(3) alignment",
}
_LOST_AFTER_INTERVALS = 3.0
_SMALLEST_CAPACITY = 1024
_FEWEST_TO_ALIGN = 3
_SAME_FRAME_RAD = 0.05
"""RPE a second up to which nobody need wonder about the frames of the bodies."""
_SAME_ANGLES = 0.2
"""Share of the RPE by which angles of two rigidly connected bodies may differ; 0.03 on Bonn `crowd`."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures of one estimate against one reference. `str()` prints them, `summary()` is for JSON.

    All are over the matched poses. The RMSE of the distances is what papers call the ATE. A relative figure is the
    RMSE over pairs of matched poses; pairs bridge losses too, so that a wrong relocalisation counts.

    Attributes:
        align: What was aligned: `none`, `se3` or `sim3`.
        max_gap_s: Stamps further apart than this do not match.
        rpe_delta_s: Pairs of the RPE per second: each pose with the first pose at least this much later.
        num_estimate: Poses of the estimate.
        num_reference: Poses of the reference.
        num_matched: Pairs of poses at the same time, one to one.
        coverage_percent: Share of the reference's time span in which poses were estimated (see `lost_spans_ns`).
        ate_rmse_m: Root of the mean square distance after alignment.
        ate_mean_m: Mean distance.
        ate_median_m: Median distance.
        ate_max_m: Largest distance.
        ate_std_m: Standard deviation of the distances.
        ate_sim3_rmse_m: RMSE with a scale fitted too; `None` with fewer than three matches.
        sim3_scale: That scale, by which the estimate is multiplied.
        rpe_trans_m_per_s: Error of the motion over `rpe_delta_s`, divided by it; `None` without such pairs.
        rpe_rot_deg_per_s: The same for the angle.
        rpe_pairs: How many such pairs there are.
        rpe_trans_m_per_frame: Error of the motion from one matched pose to the next; `None` with a single match.
        rpe_rot_deg_per_frame: The same for the angle.
        kitti_trans_percent: KITTI's `t_rel`: the error of the motion over a segment of 100, 200, ... or 800 m of the
            true path, divided by that length; the mean of all. `None` if the path of the matched poses is too short for
            any. A segment begins at every 10th matched pose, as it does at every 10th frame in the benchmark: with gaps
            fewer begin there.
        kitti_rot_deg_per_100m: KITTI's `r_rel`, the same for the angle.
        kitti_segments: How many such segments there are.
        notes: Reservations about the figures, in words.
        timestamps_ns: `(m,)` stamps of the matched poses of the estimate.
        positions_m: `(m, 3)` their positions, aligned.
        reference_m: `(m, 3)` the positions they should have.
        errors_m: `(m,)` the distances.
        lost_spans_ns: `(k, 2)` begin and end of the parts of the reference's time span without estimated poses: gaps
            longer than three times the median interval of the estimate.
        T_reference_estimate: `(7,)` alignment, `wxyz_xyz`, applied after the scale.
        scale: Scale applied to the estimate; 1 unless `align` is `sim3`.
    """

    align: AlignmentKind
    max_gap_s: float
    rpe_delta_s: float
    num_estimate: int
    num_reference: int
    num_matched: int
    coverage_percent: float
    ate_rmse_m: float
    ate_mean_m: float
    ate_median_m: float
    ate_max_m: float
    ate_std_m: float
    ate_sim3_rmse_m: float | None
    sim3_scale: float | None
    rpe_trans_m_per_s: float | None
    rpe_rot_deg_per_s: float | None
    rpe_pairs: int
    rpe_trans_m_per_frame: float | None
    rpe_rot_deg_per_frame: float | None
    kitti_trans_percent: float | None
    kitti_rot_deg_per_100m: float | None
    kitti_segments: int
    notes: tuple[str, ...]
    timestamps_ns: np.ndarray
    positions_m: np.ndarray
    reference_m: np.ndarray
    errors_m: np.ndarray
    lost_spans_ns: np.ndarray
    T_reference_estimate: np.ndarray
    scale: float

    @property
    def title(self) -> str:
        """What was done, in one line."""
        return f"ATE w.r.t. translation ({_NAMES[self.align]}, gap {self.max_gap_s * 1e3:g} ms)"

    def summary(self) -> dict[str, Any]:
        """All figures and settings, without the arrays; ready for JSON."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()
            if not isinstance(value, np.ndarray)
        }

    def __str__(self) -> str:
        ate_figures = (
            f"rmse {self.ate_rmse_m:.6f} m  mean {self.ate_mean_m:.6f}  median {self.ate_median_m:.6f}"
            f"  max {self.ate_max_m:.6f}  std {self.ate_std_m:.6f}"
        )
        lines = [self.title, f"  ATE  {ate_figures}"]
        if self.ate_sim3_rmse_m is not None and self.align != "sim3":
            lines.append(f"  ATE  rmse {self.ate_sim3_rmse_m:.6f} m with Sim(3), scale {self.sim3_scale:.6f}")
        if self.rpe_trans_m_per_s is not None:
            lines.append(
                f"  RPE  rmse {self.rpe_trans_m_per_s:.6f} m/s  {self.rpe_rot_deg_per_s:.6f} deg/s"
                f"  ({self.rpe_pairs} pairs {self.rpe_delta_s:g} s apart)"
            )
        if self.rpe_trans_m_per_frame is not None:
            lines.append(
                f"  RPE  rmse {self.rpe_trans_m_per_frame:.6f} m/frame  {self.rpe_rot_deg_per_frame:.6f} deg/frame"
            )
        if self.kitti_trans_percent is not None:
            lines.append(
                f"  KITTI  {self.kitti_trans_percent:.6f} %  {self.kitti_rot_deg_per_100m:.6f} deg/100 m"
                f"  (mean of {self.kitti_segments} segments of {KITTI_LENGTHS_M[0]:g} to {KITTI_LENGTHS_M[-1]:g} m)"
            )
        lines.append(
            f"  matched {self.num_matched} of {self.num_estimate} estimated and {self.num_reference} true poses;"
            f" {self.coverage_percent:.1f} % of the time covered"
        )
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    align: AlignmentKind = "se3",
    max_gap_s: float = 0.02,
    rpe_delta_s: float = 1.0,
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

    Raises:
        TrajectoryError: If a setting is wrong, nothing matches, or too little matches to align.
    """
    _check_settings(align, max_gap_s, rpe_delta_s)
    index_est, index_ref = associate(estimate.timestamps_ns, reference.timestamps_ns, max_gap_s)
    _check_matches(estimate, reference, len(index_est), align, max_gap_s)
    matched, truth = estimate.select(index_est), reference.T_world_cam[index_ref]
    errors = _errors(matched, truth, align, rpe_delta_s)
    if (beyond := len(matched) - int(errors.absolute[align].num_poses)) > 0:
        raise TrajectoryError(f"{beyond} matched poses are more than {MAX_DISTANCE:g} m from the origin")
    coverage, lost = _coverage(estimate.timestamps_ns, reference.timestamps_ns)
    fitted = errors.absolute[align].alignment
    T, scale = np.asarray(fitted.T_reference_estimate.wxyz_xyz), float(fitted.scale)
    return Evaluation(
        align=align,
        max_gap_s=max_gap_s,
        rpe_delta_s=rpe_delta_s,
        num_estimate=len(estimate),
        num_reference=len(reference),
        num_matched=len(matched),
        coverage_percent=coverage,
        **_absolute_figures(errors, align),
        **_relative_figures(errors, rpe_delta_s),
        **_kitti_figures(errors.per_length),
        notes=_notes(errors) + _notes_on_frames(matched, truth, errors, rpe_delta_s),
        timestamps_ns=matched.timestamps_ns,
        positions_m=scale * matched.positions @ matrices(T[None, :4])[0].T + T[4:],
        reference_m=truth[:, 4:],
        errors_m=np.asarray(errors.absolute[align].distances[: len(matched)]),
        lost_spans_ns=lost,
        T_reference_estimate=T,
        scale=scale,
    )


class _Errors(NamedTuple):
    """What the kernels compute, padded; in NumPy once it is back."""

    absolute: dict[str, AbsoluteErrors]
    per_second: RelativeErrors
    per_frame: RelativeErrors
    per_length: SegmentErrors


def _errors(estimate: Trajectory, truth: np.ndarray, align: AlignmentKind, delta_s: float) -> _Errors:
    """Errors of matched poses, padded to a capacity from a short ladder, so that few lengths compile anew."""
    count, capacity = len(estimate), _SMALLEST_CAPACITY
    while capacity < count:
        capacity *= 4
    later = _later(estimate.timestamps_ns, delta_s)
    pad = lambda values, fill: np.concatenate([values, np.repeat(fill, capacity - count, axis=0)])
    nowhere = np.array([[1.0, 0, 0, 0, 0, 0, 0]])
    with jax.enable_x64(True):
        errors = _padded_errors(
            pad(estimate.T_world_cam, nowhere),
            pad(truth, nowhere),
            np.arange(capacity) < count,
            pad(later.astype(np.int32), np.array([capacity], np.int32)),
            np.array(align == "sim3"),
        )
        return jax.tree.map(np.asarray, errors)


@partial(jax.jit, compiler_options=SOON_COMPILED)
@traced_once
def _padded_errors(P: jax.Array, Q: jax.Array, mask: jax.Array, later: jax.Array, scaled: jax.Array) -> _Errors:
    """All alignments at once: one compilation serves them all."""
    x, y, weights = P[:, 4:].T, Q[:, 4:].T, mask.astype(P.dtype)
    absolute = {kind: ate(x, y, weights, alignment=kind) for kind in _NAMES}
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


def _relative_figures(errors: _Errors, delta_s: float) -> dict[str, Any]:
    def rate(value: Any, pairs: Any, seconds: float = 1.0) -> float | None:
        return float(value) / seconds if pairs else None

    second, frame = errors.per_second, errors.per_frame
    return {
        "rpe_trans_m_per_s": rate(second.translation.rmse, second.num_pairs, delta_s),
        "rpe_rot_deg_per_s": rate(np.degrees(second.rotation.rmse), second.num_pairs, delta_s),
        "rpe_pairs": int(second.num_pairs),
        "rpe_trans_m_per_frame": rate(frame.translation.rmse, frame.num_pairs),
        "rpe_rot_deg_per_frame": rate(np.degrees(frame.rotation.rmse), frame.num_pairs),
    }


def _kitti_figures(errors: SegmentErrors) -> dict[str, Any]:
    found = int(errors.num_segments)
    return {
        "kitti_trans_percent": 100 * float(errors.translation) if found else None,
        "kitti_rot_deg_per_100m": 100 * math.degrees(float(errors.rotation)) if found else None,
        "kitti_segments": found,
    }


def _notes(errors: _Errors) -> tuple[str, ...]:
    status = errors.absolute["sim3"].alignment.status
    if status == AlignmentStatus.ROTATION_UNDETERMINED:
        return ("positions on a straight line or in one point: the aligned rotation is arbitrary about it",)
    if status == AlignmentStatus.TOO_FEW:
        return (f"fewer than {_FEWEST_TO_ALIGN} matches: no alignment",)
    return ()


def _notes_on_frames(estimate: Trajectory, truth: np.ndarray, errors: _Errors, delta_s: float) -> tuple[str, ...]:
    """Whether the reference moves like another body fixed to the camera: equal angles about other axes.

    Bonn RGB-D Dynamic is such a reference. Figures stay those of the poses as given, as in the literature.
    """
    error_rad = float(errors.per_second.rotation.rmse)
    if not errors.per_second.num_pairs or error_rad < _SAME_FRAME_RAD:
        return ()
    later = _later(estimate.timestamps_ns, delta_s)
    first = np.flatnonzero(later < len(estimate))
    turned, true = (_angles(wxyz[first], wxyz[later[first]]) for wxyz in (estimate.T_world_cam[:, :4], truth[:, :4]))
    if np.sqrt(np.mean(np.square(turned - true))) > _SAME_ANGLES * error_rad:
        return ()
    return (
        "estimate and reference turn by the same angles about different axes: the reference is another body on the"
        " camera (a marker?), so the RPE says nothing and the ATE includes the lever arm",
    )


def _later(timestamps_ns: np.ndarray, delta_s: float) -> np.ndarray:
    """`(n,)` index of the first pose at least so much later than each; `n` where there is none."""
    return np.searchsorted(timestamps_ns, timestamps_ns + round(delta_s * 1e9))


def _angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """`(n,)` radians between `(n, 4)` unit quaternions."""
    return 2 * np.arccos(np.clip(np.abs(np.sum(first * second, axis=1)), 0, 1))


def _coverage(estimate_ns: np.ndarray, reference_ns: np.ndarray) -> tuple[float, np.ndarray]:
    """Percent of the reference's time span covered by the estimate, and the spans that are not."""
    begin, end = reference_ns[[0, -1]]
    inside = estimate_ns[(estimate_ns >= begin) & (estimate_ns <= end)]
    stamps = np.concatenate([[begin], inside, [end]])
    gaps = np.diff(stamps)
    intervals = np.diff(np.unique(estimate_ns))
    usual = np.median(intervals) if len(intervals) else 0
    lost = gaps > _LOST_AFTER_INTERVALS * usual
    spans = np.column_stack([stamps[:-1], stamps[1:]])[lost]
    share = float(gaps[lost].sum() / (end - begin)) if end > begin else 0.0
    return 100.0 * (1.0 - share), spans


def _check_settings(align: str, max_gap_s: float, rpe_delta_s: float) -> None:
    if align not in _NAMES:
        raise TrajectoryError(f"align: unknown alignment '{align}'{nearest(align, _NAMES)}")
    for name, value in (("max_gap_s", max_gap_s), ("rpe_delta_s", rpe_delta_s)):
        if not (math.isfinite(value) and value > 0):
            raise TrajectoryError(f"{name}: expected a positive number of seconds, got {value}")


def _check_matches(
    estimate: Trajectory, reference: Trajectory, matches: int, align: AlignmentKind, max_gap_s: float
) -> None:
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        if not len(trajectory):
            raise TrajectoryError(f"the {name} holds no poses")
    gap = f"{max_gap_s * 1e3:g} ms"
    if not matches:
        spans = f"the estimate's ({_span(estimate)}) and the reference's ({_span(reference)})"
        reason = _why_nothing_matches(estimate.timestamps_ns, reference.timestamps_ns)
        raise TrajectoryError(f"no stamps within {gap} of each other among {spans}: {reason}")
    if align != "none" and matches < _FEWEST_TO_ALIGN:
        rest = "the ATE" if matches == 1 else "the ATE and the RPE"
        raise TrajectoryError(
            f"alignment needs {_FEWEST_TO_ALIGN} matches, got {matches} within {gap} from {len(estimate)} estimated"
            f" and {len(reference)} true poses; align='none' still gives {rest}"
        )


def _span(trajectory: Trajectory) -> str:
    first, last = trajectory.timestamps_ns[[0, -1]] / 1e9
    return f"{len(trajectory)} poses, {first:.3f} to {last:.3f} s"


def _why_nothing_matches(estimate_ns: np.ndarray, reference_ns: np.ndarray) -> str:
    """The likeliest reason: another unit, another time, or stamps that fall between each other."""
    ratio = abs(float(estimate_ns[-1])) / max(abs(float(reference_ns[-1])), 1.0)
    for factor, times in ((1e3, "a thousand"), (1e6, "a million"), (1e9, "a billion")):
        if 0.5 < ratio / factor < 2 or 0.5 < ratio * factor < 2:
            return f"the {'first' if ratio > 1 else 'second'} are {times} times larger; are the units the same?"
    if estimate_ns[-1] < reference_ns[0] or reference_ns[-1] < estimate_ns[0]:
        return "they do not overlap in time"
    after = np.clip(np.searchsorted(reference_ns, estimate_ns), 1, max(len(reference_ns) - 1, 1))
    around = reference_ns[np.stack([after - 1, np.minimum(after, len(reference_ns) - 1)])]
    return f"the nearest are {np.abs(around - estimate_ns).min() / 1e6:.3f} ms apart"
