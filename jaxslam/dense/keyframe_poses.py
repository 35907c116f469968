"""Poses of keyframes in the map, and the size of their corrections."""

import numpy as np

from jaxslam.geometry.se3 import IDENTITY, angle, compose, inverse
from jaxslam.map.point_records import has, rows
from jaxslam.map.types import Map

_AT_M = 2.0


def distance(now: np.ndarray | None, wanted: np.ndarray | None) -> float:
    """Bound the displacement of a point two meters ahead between two poses, meters.

    A pose is `None` outside the map: the displacement is infinite if only one is, and 0 if both are.
    """
    if now is None or wanted is None:
        return 0.0 if now is wanted else float("inf")
    change = compose(inverse(now), wanted)
    return float(np.linalg.norm(change[4:]) + _AT_M * angle(change))


def poses_of(slam_map: Map, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the `(n, 7)` poses and `(n,)` submaps of keyframes, including culled ones; as `Map.pose` for each."""
    order, at = np.argsort(slam_map.culled.ids), ids.copy()
    T_at_keyframe = np.tile(IDENTITY, (len(ids), 1))
    while (gone := ~has(slam_map.ids, at)).any():
        row = order[rows(slam_map.culled.ids[order], at[gone])]
        T_at_keyframe[gone] = compose(slam_map.culled.T_anchor_keyframe[row], T_at_keyframe[gone])
        at[gone] = slam_map.culled.anchor[row]
    row = rows(slam_map.ids, at)
    return compose(slam_map.T_world_cam[row], T_at_keyframe), slam_map.submap[row]
