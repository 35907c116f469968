"""Free-space check of a loop candidate: compare the surroundings that two keyframes see."""

import numpy as np

from jaxslam.features.orb import Features
from jaxslam.geometry.se3 import to_local
from jaxslam.geometry.types import Pose
from jaxslam.sensors.camera import Camera

_NEAR_PX = 8.0
_SAME_SHARE = 0.11
"""Largest depth difference within one surface, as a share of the depth."""
_MIN_COMPARED = 50


def see_through_ratio(camera: Camera, source: Features, target: Features, T_source_target: Pose) -> float:
    """Return the share of one keyframe's surfaces that another would have to see through, of those it could see.

    A nearer depth there than expected may occlude a surface, or may have appeared since. A farther depth contradicts:
    an object that exists twice looks the same, but its surroundings do not fit. Surfaces are compared at the features
    of both, within 8 pixels.

    Args:
        camera: Camera of both keyframes.
        source: Features of the first keyframe.
        target: Features of the second keyframe.
        T_source_target: `(7,)` pose of the second keyframe in the axes of the first.

    Returns:
        The share, 0 to 1; 0 where too few surfaces can be compared.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - see `runtime.preload`

    focal, center = np.array([[camera.fx], [camera.fy]]), np.array([[camera.cx], [camera.cy]])
    known, measured = source.depth > 0, target.depth > 0
    if not known.any() or not measured.any():
        return 0.0
    X_source = camera.back_project(source.uv[:, known].astype(np.float64), source.depth[known])
    X = to_local(T_source_target, X_source)
    X = X[:, X[2] > 0]
    uv = X[:2] / X[2] * focal + center
    apart, nearest = (
        np.asarray(a) for a in KDTree(target.uv[:, measured].T).query(uv.T, distance_upper_bound=_NEAR_PX)
    )
    close = np.isfinite(apart)
    expected = X[2, close]
    farther = target.depth[measured][nearest[close]] - expected
    bound = _SAME_SHARE * expected
    through, same = np.count_nonzero(farther > bound), np.count_nonzero(np.abs(farther) <= bound)
    return through / (through + same) if through + same >= _MIN_COMPARED else 0.0
