"""The figures of an evaluation, printable and ready for JSON."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxslam_kernels.trajectory.alignment import AlignmentKind
from jaxslam_kernels.trajectory.kitti_drift import KITTI_LENGTHS_M
from jaxtyping import Float64, Int

from jaxslam.geometry.types import Pose, Positions, Timestamps
from jaxslam.trajectory.pose_pairs import spacing

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ALIGNMENT_NAMES: dict[AlignmentKind, str] = {
    "none": "without alignment",
    "se3": "with SE(3) alignment",
    "sim3": "with Sim(3) alignment",
}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures of one estimate against one reference: `str()` formats them, and `summary()` returns them for JSON.

    All figures are over the matched poses. The RMSE of the distances is what papers call the ATE. A relative figure
    is the RMSE over pairs of matched poses. Pairs also bridge the times when tracking was lost, so that a wrong
    relocalization counts.

    Attributes:
        align: The alignment that was fitted: `none`, `se3` or `sim3`.
        max_gap_s: Largest difference of timestamps at which poses match, seconds.
        rpe_delta_s: Shortest time between the two poses of a pair of the RPE per second, seconds. Each pose is paired
            with the first pose at least this much later.
        time_offset_s: Time added to the timestamps of the estimate before poses were matched, seconds.
        num_estimate: Number of poses of the estimate.
        num_reference: Number of poses of the reference.
        num_matched: Number of pairs of poses at the same time, matched one to one.
        num_frames: Number of frames of the recording; `None` if the frames are not known.
        coverage_percent: Share of the frames that have an estimated pose, percent; `None` if the frames are not known,
            because the poses alone do not tell how many frames there were.
        pose_interval_s: Median time between successive poses of the estimate, seconds; `None` with a single pose.
        longest_gap_s: Longest time between successive poses of the estimate, seconds; `None` with a single pose.
        span_percent: Share of the reference's time span that lies between the first and the last estimated pose,
            percent.
        ate_rmse_m: ATE: the root mean square distance after alignment, meters.
        ate_mean_m: Mean distance after alignment, meters.
        ate_median_m: Median distance after alignment, meters.
        ate_max_m: Largest distance after alignment, meters.
        ate_std_m: Standard deviation of the distances after alignment, meters.
        ate_sim3_rmse_m: Root mean square distance after a Sim(3) alignment, meters; `None` with fewer than three
            matches.
        sim3_scale: Scale of the Sim(3) alignment, by which the estimate is multiplied; `None` with fewer than three
            matches.
        rpe_trans_m_per_s: Translational RPE per second, m/s: the error of the motion between the poses of a pair,
            divided by the time between them. That time is longer than `rpe_delta_s` if poses are sparse or missing.
            `None` without pairs.
        rpe_trans_mean_m_per_s: Mean of the same errors per second, m/s; `None` without pairs.
        rpe_trans_median_m_per_s: Median of the same errors per second, m/s; `None` without pairs.
        rpe_trans_std_m_per_s: Standard deviation of the same errors per second, m/s; `None` without pairs.
        rpe_rot_deg_per_s: Rotational RPE per second, degrees/s; `None` without pairs.
        rpe_rot_mean_deg_per_s: Mean of the same errors per second, degrees/s; `None` without pairs.
        rpe_rot_median_deg_per_s: Median of the same errors per second, degrees/s; `None` without pairs.
        rpe_rot_std_deg_per_s: Standard deviation of the same errors per second, degrees/s; `None` without pairs.
        rpe_pairs: Number of pairs of the RPE per second.
        rpe_pair_s_median: Median time between the poses of a pair of the RPE per second, seconds; `None` without
            pairs.
        rpe_pair_s_min: Shortest time between the poses of a pair of the RPE per second, seconds; `None` without pairs.
        rpe_pair_s_max: Longest time between the poses of a pair of the RPE per second, seconds; `None` without pairs.
        rpe_trans_m_per_frame: Translational RPE per frame, meters: the error of the motion from one matched pose to
            the next, whatever the time between them. `None` with a single match.
        rpe_rot_deg_per_frame: Rotational RPE per frame, degrees; `None` with a single match.
        rpe_frame_pairs: Number of pairs of the RPE per frame.
        rpe_frame_s_median: Median time between the poses of a pair of the RPE per frame, seconds; `None` without
            pairs.
        rpe_frame_s_min: Shortest time between the poses of a pair of the RPE per frame, seconds; `None` without pairs.
        rpe_frame_s_max: Longest time between the poses of a pair of the RPE per frame, seconds; `None` without pairs.
        kitti_trans_percent: KITTI's `t_rel`, percent: the mean over all segments of the translational error of the
            motion, divided by the length of the segment. A segment is 100, 200, ... or 800 m of the true path. `None`
            if the path of the matched poses is too short for any segment. A segment starts at every 10th matched
            pose; the benchmark starts one at every 10th frame, so gaps leave fewer segments here.
        kitti_rot_deg_per_100m: KITTI's `r_rel`, degrees per 100 m: the same mean of the rotational error; `None`
            without segments.
        kitti_segments: Number of segments of KITTI's figures.
        notes: Reservations about the figures, in words.
        timestamps_ns: `(m,)` timestamps of the matched poses of the estimate with `time_offset_s` added, nanoseconds.
        positions_m: `(m, 3)` aligned positions of the matched poses of the estimate, in the frame of the reference,
            meters.
        reference_m: `(m, 3)` positions of the matched poses of the reference, meters.
        errors_m: `(m,)` distances between the two positions of each match, meters.
        lost_spans_ns: `(k, 2)` start and end of the time spans without estimated poses, nanoseconds, as in `Coverage`.
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
    rpe_trans_mean_m_per_s: float | None
    rpe_trans_median_m_per_s: float | None
    rpe_trans_std_m_per_s: float | None
    rpe_rot_deg_per_s: float | None
    rpe_rot_mean_deg_per_s: float | None
    rpe_rot_median_deg_per_s: float | None
    rpe_rot_std_deg_per_s: float | None
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
    timestamps_ns: Timestamps
    positions_m: Positions
    reference_m: Positions
    errors_m: Float64[np.ndarray, " m"]
    lost_spans_ns: Int[np.ndarray, "k 2"]
    T_reference_estimate: Pose
    scale: float

    @property
    def title(self) -> str:
        """One line that names the alignment and the settings."""
        shift = f", {self.time_offset_s:+.5g} s added to the stamps of the estimate" if self.time_offset_s else ""
        return f"ATE w.r.t. translation ({ALIGNMENT_NAMES[self.align]}, gap {self.max_gap_s * 1e3:g} ms{shift})"

    @property
    def rpe_spacing(self) -> str:
        """Number and time spacing of the pairs of the RPE per second, in words."""
        return spacing(self.rpe_pairs, self.rpe_pair_s_median, self.rpe_pair_s_min, self.rpe_pair_s_max)

    @property
    def rpe_frame_spacing(self) -> str:
        """Number and time spacing of the pairs of the RPE per frame, in words."""
        return spacing(self.rpe_frame_pairs, self.rpe_frame_s_median, self.rpe_frame_s_min, self.rpe_frame_s_max)

    def summary(self) -> dict[str, Any]:
        """All figures and settings, without the arrays; ready for JSON."""
        return without_arrays(self)

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
        """The coverage as far as it is known, in words."""
        if self.coverage_percent is not None:
            return f"{self.coverage_percent:.1f} % of {self.num_frames} frames covered"
        unknown = "coverage unknown without the frames of the recording"
        if self.pose_interval_s is None:
            return unknown
        return (
            f"{unknown}\n  estimated a pose each {self.pose_interval_s:.3f} s (median), none for up to"
            f" {self.longest_gap_s:.3f} s, over {self.span_percent:.1f} % of the reference's time"
        )


def without_arrays(figures: "DataclassInstance") -> dict[str, Any]:
    """Fields of a dataclass that are no arrays, ready for JSON."""
    values = {field.name: getattr(figures, field.name) for field in fields(figures)}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
        if not isinstance(value, np.ndarray)
    }
