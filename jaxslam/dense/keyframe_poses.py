"""Where keyframes are in the map, and how far they have moved."""

import numpy as np

from jaxslam.geometry.se3 import IDENTITY, angle, compose, inverse
from jaxslam.map.types import Map, has, rows

_AT_M = 2.0


def distance(now: np.ndarray | None, wanted: np.ndarray | None) -> float:
    """How far a point two meters away goes from one pose to the other; infinite into or out of the map."""
    if now is None or wanted is None:
        return 0.0 if now is wanted else float("inf")
    change = compose(inverse(now), wanted)
    return float(np.linalg.norm(change[4:]) + _AT_M * angle(change))


def poses_of(slam_map: Map, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`(n, 7)` poses and `(n,)` submaps of keyframes, also of those that were culled; as `Map.pose` of each."""
    order, at = np.argsort(slam_map.culled.ids), ids.copy()
    T_at_keyframe = np.tile(IDENTITY, (len(ids), 1))
    while (gone := ~has(slam_map.ids, at)).any():
        row = order[rows(slam_map.culled.ids[order], at[gone])]
        T_at_keyframe[gone] = compose(slam_map.culled.T_anchor_keyframe[row], T_at_keyframe[gone])
        at[gone] = slam_map.culled.anchor[row]
    row = rows(slam_map.ids, at)
    return compose(slam_map.T_world_cam[row], T_at_keyframe), slam_map.submap[row]
