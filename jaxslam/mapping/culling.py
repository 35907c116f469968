"""What leaves the map: points that nobody confirmed, and keyframes that others make redundant.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, and "ORB-SLAM", 2015, sections VI-B and VI-E, for the rules.
"""

import numpy as np

from jaxslam.map.edit import without_keyframe, without_points
from jaxslam.map.types import NONE, Map, covisible, has, rows

CONFIRM_WITHIN = 3
"""Keyframes after which a point must have been seen by others."""
_MIN_VIEWS, _MIN_VIEWS_WITHOUT_DEPTH = 2, 3
"""Keyframes that must see a point; one more if none measured its depth: two rays meet somewhere even if wrongly
matched."""
_REDUNDANT_SHARE, _REDUNDANT_VIEWS = 0.9, 3
"""A keyframe goes if this share of its points is seen by so many others, as exactly as it sees them."""
_AS_EXACT = 1.25
"""Factor of the standard deviation up to which a observation is as exact as another: a level of the pyramid."""
KEEP_LATEST = 12
"""Keyframes the tracker may still be looking into."""


def without_unconfirmed(slam_map: Map, keyframe_id: int) -> Map:
    """Drop the points that too few keyframes have seen, some keyframes after they were made.

    Args:
        slam_map: The map, or a part of it.
        keyframe_id: The latest keyframe.
    """
    row = rows(slam_map.points.ids, slam_map.observations.point)
    seen = np.bincount(row, minlength=len(slam_map.points.ids))
    measured = np.bincount(row[slam_map.observations.depth > 0], minlength=len(slam_map.points.ids)) > 0
    enough = seen >= np.where(measured, _MIN_VIEWS, _MIN_VIEWS_WITHOUT_DEPTH)
    old = slam_map.points.reference_keyframe <= keyframe_id - CONFIRM_WITHIN
    return without_points(slam_map, slam_map.points.ids[(old & ~enough) | (seen < 1)])


def without_redundant(slam_map: Map, keyframe_id: int, among: np.ndarray) -> Map:
    """Drop the neighbors of a keyframe whose points others see well enough.

    Args:
        slam_map: The map, or a part of it.
        keyframe_id: The latest keyframe.
        among: Ids, ascending, of the keyframes that may go: those whose points are all here. The first of a submap
            stays, and so do the latest.
    """
    near, _ = covisible(slam_map, keyframe_id)
    first = slam_map.parent[rows(slam_map.ids, near)] == NONE
    for candidate in near[has(among, near) & ~first & (near <= keyframe_id - KEEP_LATEST)].tolist():
        if _redundant(slam_map, candidate):
            slam_map = without_keyframe(slam_map, candidate)
    return slam_map


def _redundant(slam_map: Map, keyframe_id: int) -> bool:
    mine = slam_map.observations.keyframe == keyframe_id
    sigma = np.zeros(len(slam_map.points.ids), np.float32)
    seen = rows(slam_map.points.ids, slam_map.observations.point)
    sigma[seen[mine]] = slam_map.observations.sigma_px[mine]
    as_exact = ~mine & (slam_map.observations.sigma_px <= _AS_EXACT * sigma[seen])
    views = np.bincount(seen[as_exact], minlength=len(slam_map.points.ids))[seen[mine]]
    return bool(len(views) and np.mean(views >= _REDUNDANT_VIEWS) > _REDUNDANT_SHARE)
