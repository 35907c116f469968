"""Estimate the constant offset between the clocks of two trajectories from the motion of the camera."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxslam_kernels.trajectory.alignment import AlignmentKind
from jaxtyping import Bool, Float

from jaxslam.errors import TrajectoryError
from jaxslam.geometry.se3 import angle, between
from jaxslam.trajectory.trajectory import Trajectory

OFFSET_RANGE_S = 1.0
"""Default largest offset that is tried, in either direction, seconds."""

_FIRST_STEP_S, _LAST_STEP_S = 0.02, 2e-5
"""Steps between the offsets of the first and the last search, seconds; each search is ten times finer."""
_TURN_S = 0.2
"""Shortest time over which rotation angles are compared, seconds: long enough that they exceed the noise of motion
capture."""
_MAX_SAMPLES, _FEWEST_SAMPLES = 1000, 10
_LARGEST_SHARE_OF_TIME = 0.25
_BRIDGED_INTERVALS = 3.0
"""Poses more than this many median intervals apart are not interpolated."""


class Disagreement(NamedTuple):
    """Errors between two trajectories with one time offset.

    Attributes:
        ate_m: RMSE of the aligned positions, meters. Positions are interpolated.
        turn_rad: RMS difference of the angles by which the two trajectories rotate within 0.2 s, or within one
            interval of the sparser trajectory if that is longer, radians.
    """

    ate_m: float
    turn_rad: float


class _Disagreements(NamedTuple):
    """Errors between two trajectories with each of `k` time offsets; infinite if too few samples have a partner.

    Attributes:
        ate_m: `(k,)` RMSE of the aligned positions, meters.
        turn_rad: `(k,)` RMS difference of the rotation angles, radians.
    """

    ate_m: Float[np.ndarray, " k"]
    turn_rad: Float[np.ndarray, " k"]


class TimeOffset(NamedTuple):
    """An offset between two clocks, and the errors with and without it.

    Attributes:
        seconds: Time to add to the timestamps of the estimate, seconds.
        with_it: Errors between the trajectories with the offset.
        without_it: Errors between the trajectories without the offset.
    """

    seconds: float
    with_it: Disagreement
    without_it: Disagreement


def estimate_time_offset(
    estimate: Trajectory, reference: Trajectory, align: AlignmentKind = "se3", range_s: float = OFFSET_RANGE_S
) -> TimeOffset:
    """Find the time offset with which the aligned positions of two trajectories agree best.

    Up to 1000 poses of the trajectory with the longer intervals are compared with the other one, which is interpolated,
    but never across its gaps. Offsets 20 ms apart are tried first, then finer ones around the best, down to 0.02 ms.
    Rotation angles are compared too, as a check: they depend neither on the alignment nor on the tracked body on the
    camera, and drift, which an offset can seem to explain, hardly changes them.

    Args:
        estimate: Estimated poses.
        reference: True poses.
        align: Alignment to fit at each offset before positions are compared: `none`, `se3` or `sim3`.
        range_s: Largest offset to try, seconds. The range is limited to a quarter of the time that both trajectories
            share, so that most poses still have a partner.

    Raises:
        TrajectoryError: If the trajectories share too few poses, or if the best offset is at the end of the range, as
            it is if the positions do not depend on the offset.
    """
    comparison = _Comparison.of(estimate, reference, align)
    limit_s = min(range_s, _LARGEST_SHARE_OF_TIME * _shared_s(estimate, reference))
    without = comparison.at(np.zeros(1))
    if limit_s < _FIRST_STEP_S or not np.isfinite(without.ate_m).all():
        raise TrajectoryError("the time offset cannot be estimated: the trajectories share too few poses")
    step = _FIRST_STEP_S
    offsets = step * np.arange(-int(limit_s / step), int(limit_s / step) + 1)
    best = int(np.argmin((found := comparison.at(offsets)).ate_m))
    if best in (0, len(offsets) - 1):
        raise TrajectoryError(
            f"the time offset cannot be estimated: no offset up to {limit_s:g} s fits better than those around it"
        )
    while step > _LAST_STEP_S:
        step /= 10
        offsets = offsets[best] + step * np.arange(-10, 11)
        best = int(np.argmin((found := comparison.at(offsets)).ate_m))
    at_best, at_zero = (Disagreement(float(d.ate_m[k]), float(d.turn_rad[k])) for d, k in ((found, best), (without, 0)))
    return TimeOffset(round(float(offsets[best]), 5), at_best, at_zero)


@dataclass(frozen=True)
class _Course:
    """Positions and rotation angles of one trajectory over time.

    Attributes:
        seconds: `(n,)` times, strictly increasing, seconds.
        values: `(n, 4)` positions (meters) and, in the last column, the angle by which the camera rotates within a
            fixed time from then on (radians). The angle is NaN if there is no pose at its end.
        bridged: `(n - 1,)` mask of the intervals that are gaps.
    """

    seconds: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n 4"]
    bridged: Bool[np.ndarray, " n-1"]

    @classmethod
    def of(cls, trajectory: Trajectory, base_ns: int, turn_ns: int) -> "_Course":
        """Compute the course of a trajectory of at least two poses without duplicate timestamps.

        Args:
            trajectory: The trajectory.
            base_ns: Time from which `seconds` count, nanoseconds.
            turn_ns: Time within which the rotation angle is measured, nanoseconds.
        """
        stamps, later_ns = trajectory.timestamps_ns, trajectory.timestamps_ns + turn_ns
        turned = angle(between(trajectory.T_world_cam, trajectory.at(later_ns).T_world_cam))
        steps = np.diff(stamps)
        bridged = steps > _BRIDGED_INTERVALS * np.median(steps)
        gaps_before = np.append(0, np.cumsum(bridged))
        after = np.searchsorted(stamps, later_ns)
        beyond = after == len(stamps)
        turned[beyond | (gaps_before[after - beyond] > gaps_before)] = np.nan
        return cls((stamps - base_ns) * 1e-9, np.column_stack([trajectory.positions, turned]), bridged)

    def at(self, seconds: Float[np.ndarray, "k m"]) -> Float[np.ndarray, "k m 4"]:
        """Interpolate the values linearly at other times; NaN before the first pose, after the last, and in gaps."""
        after = np.clip(np.searchsorted(self.seconds, seconds), 1, len(self.seconds) - 1)
        start, end = self.seconds[after - 1], self.seconds[after]
        share = ((seconds - start) / (end - start))[..., None]
        values = (1 - share) * self.values[after - 1] + share * self.values[after]
        known = (seconds >= start) & (seconds <= end) & ~self.bridged[after - 1]
        return np.where(known[..., None], values, np.nan)


@dataclass(frozen=True)
class _Comparison:
    """Samples of the sparser of two trajectories, and the course of the other one, which is interpolated.

    Attributes:
        seconds: `(n,)` times of the samples, seconds.
        values: `(n, 4)` positions and rotation angles of the samples, as in `_Course`.
        other: Course of the trajectory that is interpolated.
        samples_are_true: Whether the samples are from the reference and the estimate is interpolated.
        align: Alignment to fit at each offset.
    """

    seconds: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n 4"]
    other: _Course
    samples_are_true: bool
    align: AlignmentKind

    @classmethod
    def of(cls, estimate: Trajectory, reference: Trajectory, align: AlignmentKind) -> "_Comparison":
        """Choose the samples from the sparser trajectory.

        Raises:
            TrajectoryError: If a trajectory has a single pose.
        """
        pair = [t.select(np.unique(t.timestamps_ns, return_index=True)[1]) for t in (estimate, reference)]
        if min(len(trajectory) for trajectory in pair) < 2:
            raise TrajectoryError("the time offset cannot be estimated: a single pose does not move")
        intervals_ns = [float(np.median(np.diff(trajectory.timestamps_ns))) for trajectory in pair]
        turn_ns = round(max(_TURN_S * 1e9, *intervals_ns))
        samples, other = (_Course.of(trajectory, int(reference.timestamps_ns[0]), turn_ns) for trajectory in pair)
        if samples_are_true := intervals_ns[1] > intervals_ns[0]:
            samples, other = other, samples
        chosen = np.unique(np.linspace(0, len(samples.seconds) - 1, _MAX_SAMPLES).round().astype(int))
        return cls(samples.seconds[chosen], samples.values[chosen], other, samples_are_true, align)

    def at(self, offsets_s: Float[np.ndarray, " k"]) -> _Disagreements:
        """Compute both errors with each of `(k,)` offsets, seconds."""
        sign = -1.0 if self.samples_are_true else 1.0
        other = self.other.at(self.seconds[None] + sign * offsets_s[:, None])
        known = np.isfinite(other[..., 0])
        other[~known, :3] = 0.0
        samples = np.broadcast_to(self.values, other.shape)
        estimate, reference = (other, samples) if self.samples_are_true else (samples, other)
        ate = _aligned_rmse(estimate[..., :3], reference[..., :3], known, self.align)
        turn = _rms(estimate[..., 3] - reference[..., 3])
        enough = known.sum(axis=1) >= max(_FEWEST_SAMPLES, 0.5 * len(self.seconds))
        return _Disagreements(np.where(enough, ate, np.inf), np.where(enough, turn, np.inf))


def _rms(values: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " k"]:
    """Return the root mean square of the finite values of each row; 0 for a row without finite values."""
    finite = np.isfinite(values)
    return np.sqrt(np.sum(np.where(finite, values, 0.0) ** 2, axis=1) / np.maximum(finite.sum(axis=1), 1))


def _shared_s(estimate: Trajectory, reference: Trajectory) -> float:
    begin = max(estimate.timestamps_ns[0], reference.timestamps_ns[0])
    return float(min(estimate.timestamps_ns[-1], reference.timestamps_ns[-1]) - begin) * 1e-9


def _aligned_rmse(
    estimate: Float[np.ndarray, "k n 3"],
    reference: Float[np.ndarray, "k n 3"],
    known: Bool[np.ndarray, "k n"],
    align: AlignmentKind,
) -> Float[np.ndarray, " k"]:
    """Compute the RMSE after the best alignment without computing the alignment (Umeyama, PAMI 1991, eq. 33)."""
    weights = known / np.maximum(known.sum(axis=1, keepdims=True), 1)
    if align == "none":
        return np.sqrt(np.sum(weights * np.sum((estimate - reference) ** 2, axis=2), axis=1))
    x, y = (xyz - np.einsum("kn,knc->kc", weights, xyz)[:, None] for xyz in (estimate, reference))
    covariance = (weights[..., None] * y).swapaxes(1, 2) @ x
    singular = np.linalg.svd(covariance, compute_uv=False)
    trace = singular[:, 0] + singular[:, 1] + np.sign(np.linalg.det(covariance)) * singular[:, 2]
    x_variance, y_variance = (np.einsum("kn,knc->k", weights, xyz**2) for xyz in (x, y))
    if align == "sim3":
        squared = y_variance - trace**2 / np.where(x_variance > 0, x_variance, 1.0)
    else:
        squared = x_variance + y_variance - 2 * trace
    return np.sqrt(np.maximum(squared, 0.0))
