"""Whether two keyframes can have been where they are said to be, by what is around what they have in common."""

import numpy as np

from jaxslam.features.orb import Features
from jaxslam.geometry.se3 import to_local
from jaxslam.sensors.camera import Camera

_NEAR_PX = 8.0
_SAME_SHARE, _SAME_M = 0.1, 0.02
"""Difference of depth up to which two are the same, as a share of it and besides."""
_MIN_COMPARED = 50


def see_through_ratio(camera: Camera, source: Features, target: Features, T_source_target: np.ndarray) -> float:
    """Share of the surfaces of one keyframe that another would have to see through, of those it could see.

    What is nearer there than expected may hide a surface, or have come there. What is farther contradicts: a thing
    that is there twice looks the same, but what is around it does not fit. Surfaces are compared at the features of
    both, within 8 pixels.

    Args:
        camera: Of both.
        source: Features of the first.
        target: Features of the second.
        T_source_target: `(7,)` pose of the second in the axes of the first.

    Returns:
        0 to 1; 0 where too few can be compared to tell.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - see `late_imports`

    focal, center = np.array([[camera.fx], [camera.fy]]), np.array([[camera.cx], [camera.cy]])
    known, measured = source.depth > 0, target.depth > 0
    if not known.any() or not measured.any():
        return 0.0
    rays = np.concatenate([(source.uv[:, known] - center) / focal, np.ones((1, np.count_nonzero(known)))])
    X = to_local(T_source_target, rays * source.depth[known])
    X = X[:, X[2] > _SAME_M]
    uv = X[:2] / X[2] * focal + center
    apart, nearest = (
        np.asarray(a) for a in KDTree(target.uv[:, measured].T).query(uv.T, distance_upper_bound=_NEAR_PX)
    )
    close = np.isfinite(apart)
    expected = X[2, close]
    farther = target.depth[measured][nearest[close]] - expected
    bound = _SAME_SHARE * expected + _SAME_M
    through, same = np.count_nonzero(farther > bound), np.count_nonzero(np.abs(farther) <= bound)
    return through / (through + same) if through + same >= _MIN_COMPARED else 0.0
