"""The figures of an evaluation, as text and for JSON."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxslam_kernels.trajectory.alignment import AlignmentKind
from jaxslam_kernels.trajectory.kitti_drift import KITTI_LENGTHS_M

from jaxslam.trajectory.pose_pairs import spacing

ALIGNMENT_NAMES: dict[AlignmentKind, str] = {
    "none": "without alignment",
    "se3": "with SE(3) alignment",
    "sim3": "with Sim(3) alignment",
}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures of one estimate against one reference. `str()` prints them, `summary()` is for JSON.

    All are over the matched poses. The RMSE of the distances is what papers call the ATE. A relative figure is the
    RMSE over pairs of matched poses; pairs bridge losses too, so that a wrong relocalization counts.

    Attributes:
        align: What was aligned: `none`, `se3` or `sim3`.
        max_gap_s: Stamps further apart than this do not match.
        rpe_delta_s: Pairs of the RPE per second: each pose with the first pose at least this much later.
        time_offset_s: What was added to the stamps of the estimate before poses were matched, seconds.
        num_estimate: Poses of the estimate.
        num_reference: Poses of the reference.
        num_matched: Pairs of poses at the same time, one to one.
        num_frames: Frames of the recording; `None` if they are not known.
        coverage_percent: Share of these frames that have an estimated pose; `None` if they are not known. The poses
            alone do not tell how many frames there were.
        pose_interval_s: Median time between successive poses of the estimate, seconds; `None` with a single pose.
        longest_gap_s: The longest such time, seconds; `None` with a single pose.
        span_percent: Share of the reference's time span that lies between the first and the last estimated pose.
        ate_rmse_m: Root of the mean square distance after alignment.
        ate_mean_m: Mean distance.
        ate_median_m: Median distance.
        ate_max_m: Largest distance.
        ate_std_m: Standard deviation of the distances.
        ate_sim3_rmse_m: RMSE with a scale fitted too; `None` with fewer than three matches.
        sim3_scale: That scale, by which the estimate is multiplied.
        rpe_trans_m_per_s: RPE per second: the error of the motion between the poses of a pair, divided by the time
            between them, which is longer than `rpe_delta_s` where poses are sparse or missing; `None` without pairs.
        rpe_rot_deg_per_s: The same for the angle.
        rpe_pairs: How many such pairs there are.
        rpe_pair_s_median: Median time between the poses of such a pair, seconds; `None` without pairs.
        rpe_pair_s_min: The shortest such time, seconds.
        rpe_pair_s_max: The longest such time, seconds.
        rpe_trans_m_per_frame: RPE per frame: the error of the motion from one matched pose to the next, whatever the
            time between them; `None` with a single match.
        rpe_rot_deg_per_frame: The same for the angle.
        rpe_frame_pairs: How many such pairs there are.
        rpe_frame_s_median: Median time between the poses of such a pair, seconds; `None` without pairs.
        rpe_frame_s_min: The shortest such time, seconds.
        rpe_frame_s_max: The longest such time, seconds.
        kitti_trans_percent: KITTI's `t_rel`: the error of the motion over a segment of 100, 200, ... or 800 m of the
            true path, divided by that length; the mean of all. `None` if the path of the matched poses is too short for
            any. A segment begins at every 10th matched pose, as it does at every 10th frame in the benchmark: with gaps
            fewer begin there.
        kitti_rot_deg_per_100m: KITTI's `r_rel`, the same for the angle.
        kitti_segments: How many such segments there are.
        notes: Reservations about the figures, in words.
        timestamps_ns: `(m,)` stamps of the matched poses of the estimate, `time_offset_s` included.
        positions_m: `(m, 3)` their positions, aligned.
        reference_m: `(m, 3)` the positions they should have.
        errors_m: `(m,)` the distances.
        lost_spans_ns: `(k, 2)` begin and end of the times without estimated poses. Where frames are known, each run of
            frames without a pose, from the last frame that has one to the next that has one, or to the first or last
            frame of all. Where they are not known, or none has a pose, gaps longer than three times the median interval
            of the estimate, within the time span of the reference.
        T_reference_estimate: `(7,)` alignment, `wxyz_xyz`, applied after the scale.
        scale: Scale applied to the estimate; 1 unless `align` is `sim3`.
    """

    align: AlignmentKind
    max_gap_s: float
    rpe_delta_s: float
    time_offset_s: float
    num_estimate: int
    num_reference: int
    num_matched: int
    num_frames: int | None
    coverage_percent: float | None
    pose_interval_s: float | None
    longest_gap_s: float | None
    span_percent: float
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
    rpe_pair_s_median: float | None
    rpe_pair_s_min: float | None
    rpe_pair_s_max: float | None
    rpe_trans_m_per_frame: float | None
    rpe_rot_deg_per_frame: float | None
    rpe_frame_pairs: int
    rpe_frame_s_median: float | None
    rpe_frame_s_min: float | None
    rpe_frame_s_max: float | None
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
        shift = f", {self.time_offset_s:+.5g} s added to the stamps of the estimate" if self.time_offset_s else ""
        return f"ATE w.r.t. translation ({ALIGNMENT_NAMES[self.align]}, gap {self.max_gap_s * 1e3:g} ms{shift})"

    @property
    def rpe_spacing(self) -> str:
        """How many pairs the RPE per second has and how far they are apart, in words."""
        return spacing(self.rpe_pairs, self.rpe_pair_s_median, self.rpe_pair_s_min, self.rpe_pair_s_max)

    @property
    def rpe_frame_spacing(self) -> str:
        """How many pairs the RPE per frame has and how far they are apart, in words."""
        return spacing(self.rpe_frame_pairs, self.rpe_frame_s_median, self.rpe_frame_s_min, self.rpe_frame_s_max)

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
                f"  ({self.rpe_spacing})"
            )
        if self.rpe_trans_m_per_frame is not None:
            lines.append(
                f"  RPE  rmse {self.rpe_trans_m_per_frame:.6f} m/frame  {self.rpe_rot_deg_per_frame:.6f} deg/frame"
                f"  ({self.rpe_frame_spacing})"
            )
        if self.kitti_trans_percent is not None:
            lines.append(
                f"  KITTI  {self.kitti_trans_percent:.6f} %  {self.kitti_rot_deg_per_100m:.6f} deg/100 m"
                f"  (mean of {self.kitti_segments} segments of {KITTI_LENGTHS_M[0]:g} to {KITTI_LENGTHS_M[-1]:g} m)"
            )
        lines += [
            f"  matched {self.num_matched} of {self.num_estimate} estimated and {self.num_reference} true poses;"
            f" {self._coverage}"
        ]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

    @property
    def _coverage(self) -> str:
        """What is known of the coverage, in words."""
        if self.coverage_percent is not None:
            return f"{self.coverage_percent:.1f} % of {self.num_frames} frames covered"
        unknown = "coverage unknown without the frames of the recording"
        if self.pose_interval_s is None:
            return unknown
        return (
            f"{unknown}\n  estimated a pose each {self.pose_interval_s:.3f} s (median), none for up to"
            f" {self.longest_gap_s:.3f} s, over {self.span_percent:.1f} % of the reference's time"
        )
