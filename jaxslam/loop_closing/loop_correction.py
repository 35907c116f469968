"""Apply a loop closure to the map: merge two submaps, or correct keyframe poses and move everything else along."""

import numpy as np

from jaxslam.geometry.se3 import IDENTITY, compose, inverse, rotate
from jaxslam.geometry.types import Ids, Poses
from jaxslam.loop_closing.loop_detector import LoopClosure
from jaxslam.map.edit import transformed, with_loop, with_positions
from jaxslam.map.point_records import NONE, has, rows
from jaxslam.map.types import Map, surviving_keyframes


def with_loop_closed(slam_map: Map, loop: LoopClosure) -> Map:
    """Return the map with a loop closed; both of its keyframes must be in the map.

    The map may have changed since the loop was detected: keyframes the closure does not name move with their parent in
    the spanning tree, and points move with their reference keyframe.

    Raises:
        KeyError: If one of the two keyframes is not in the map.
    """
    first, second = slam_map.submap[rows(slam_map.ids, np.array([loop.source, loop.target]))]
    slam_map = _bent(slam_map, loop) if first == second else _merged(slam_map, loop, int(first), int(second))
    return with_loop(slam_map, loop.source, loop.target, loop.T_source_target, loop.information)


def _merged(slam_map: Map, loop: LoopClosure, first: int, second: int) -> Map:
    """Merge two submaps by transforming the later one into the frame of the earlier one."""
    T_new_old = compose(compose(slam_map.pose(loop.source), loop.T_source_target), inverse(slam_map.pose(loop.target)))
    if second > first:
        return transformed(slam_map, T_new_old, second, first, loop.source, loop.target)
    return transformed(slam_map, inverse(T_new_old), first, second, loop.target, loop.source)


def _bent(slam_map: Map, loop: LoopClosure) -> Map:
    """Set the corrected keyframe poses; later keyframes and all points move along."""
    known = np.flatnonzero(has(slam_map.ids, loop.keyframes))
    if not len(known):
        return slam_map
    # The first is fixed in the pose graph: the world stays where it is now, even if it was transformed since.
    now = slam_map.pose(int(loop.keyframes[known[0]]))
    T_now_then = compose(now, inverse(loop.T_world_cam[known[0]]))
    return with_corrected_keyframes(slam_map, loop.keyframes[known], compose(T_now_then, loop.T_world_cam[known]))


def with_corrected_keyframes(slam_map: Map, keyframe_ids: Ids, T_world_cam: Poses) -> Map:
    """Set the poses of some keyframes, and move everything else along.

    Other keyframes move with their parent in the spanning tree, and points with their reference keyframe.

    Args:
        slam_map: The map.
        keyframe_ids: `(m,)` ids of the keyframes.
        T_world_cam: `(m, 7)` new poses of the keyframes.

    Raises:
        KeyError: If a keyframe is not in the map.
    """
    row = rows(slam_map.ids, keyframe_ids)
    change = np.tile(IDENTITY, (len(slam_map.ids), 1))
    change[row] = compose(T_world_cam, inverse(slam_map.T_world_cam[row]))
    settled = slam_map.parent == NONE
    settled[row] = True
    for index in np.flatnonzero(~settled):
        line = [int(index)]
        while not settled[line[-1]]:
            line.append(slam_map.row(slam_map.parent[line[-1]]))
        change[line] = change[line[-1]]
        settled[line] = True
    of_point = change[rows(slam_map.ids, surviving_keyframes(slam_map, slam_map.points.reference_keyframe))]
    X_world = (rotate(of_point, slam_map.points.X_world.T) + of_point[:, 4:]).T
    moved = (change != IDENTITY).any(axis=1)
    poses = compose(change[moved], slam_map.T_world_cam[moved])
    return with_positions(slam_map, slam_map.ids[moved], poses, slam_map.points.ids, X_world)
