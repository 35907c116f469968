"""The scale of all lengths of a recording, which only something outside of it tells: a true path, or a known length."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxslam.errors import DatasetError
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory

_PARTS, _FEWEST_POSES = 6, 10
"""Parts of a path whose scales are compared, and poses that each must have."""


class Scale(NamedTuple):
    """Factor between lengths as tracked and true ones.

    Attributes:
        factor: True lengths in those that were tracked.
        sigma: Its standard deviation; NaN if nothing tells it.
    """

    factor: float
    sigma: float


def scale_of(trajectory: Trajectory, known: float | Trajectory) -> Scale:
    """Return the scale of a path as tracked.

    Args:
        trajectory: Path of the camera as tracked.
        known: The true path, or the distance in meters between its first and its last place.

    Raises:
        DatasetError: If the two places are one, or the true path is too short.
    """
    if isinstance(known, Trajectory):
        return _of_truth(trajectory, known)
    ends = trajectory.T_world_cam[[0, -1], 4:]
    length_m = float(np.linalg.norm(ends[1] - ends[0]))
    if length_m < 0.05 * known:
        raise DatasetError(
            f"known_length: expected the distance between the first and the last place of the camera, {length_m:.3f} m"
            f" as tracked, got {known:g} m"
        )
    return Scale(known / length_m, float("nan"))


def _of_truth(trajectory: Trajectory, truth: Trajectory) -> Scale:
    whole = evaluate(trajectory, truth).sim3_scale
    bounds = np.linspace(0, len(trajectory), _PARTS + 1).astype(int)
    if whole is None or np.diff(bounds).min() < _FEWEST_POSES:
        raise DatasetError(f"groundtruth: expected {_PARTS * _FEWEST_POSES} poses to compare, got {len(trajectory)}")
    # The scale without each part in turn (the jackknife): parts alone may be too short to have one.
    rest = [np.r_[0:first, last : len(trajectory)] for first, last in pairwise(bounds)]
    without = np.array([evaluate(trajectory.select(index), truth).sim3_scale for index in rest], float)
    spread = np.sqrt((_PARTS - 1) / _PARTS * np.square(without - without.mean()).sum())
    return Scale(float(whole), float(spread))
