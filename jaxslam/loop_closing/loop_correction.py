"""A closed loop put into the map: two submaps become one, or keyframes get new poses and all else moves along."""

import numpy as np

from jaxslam.geometry.se3 import IDENTITY, compose, inverse, rotate
from jaxslam.loop_closing.loop_detector import LoopClosure
from jaxslam.map.edit import moved, transformed, with_loop
from jaxslam.map.types import NONE, Map, has, rows, standing


def with_loop_closed(map: Map, loop: LoopClosure) -> Map:
    """The map with a loop closed; both its ends must be in it.

    The map may have changed since the loop was found: keyframes that it does not name move as those do on which they
    hang, and points as the keyframes that made them.

    Raises:
        KeyError: If an end is not in the map.
    """
    first, second = map.submap[rows(map.ids, np.array([loop.source, loop.target]))]
    map = _bent(map, loop) if first == second else _merged(map, loop, int(first), int(second))
    return with_loop(map, loop.source, loop.target, loop.T_source_target, loop.information)


def _merged(map: Map, loop: LoopClosure, first: int, second: int) -> Map:
    """The later of two submaps carried into the frame of the other."""
    T_new_old = compose(compose(map.pose(loop.source), loop.T_source_target), inverse(map.pose(loop.target)))
    if second > first:
        return transformed(map, T_new_old, second, first, loop.source, loop.target)
    return transformed(map, inverse(T_new_old), first, second, loop.target, loop.source)


def _bent(map: Map, loop: LoopClosure) -> Map:
    """New poses for the keyframes; what came after them, and all points, move along."""
    known = np.flatnonzero(has(map.ids, loop.keyframes))
    if not len(known):
        return map
    row = rows(map.ids, loop.keyframes[known])
    first = known[0]  # the graph held it: the world is where it is now, even if all has been carried elsewhere since
    T_now_then = compose(map.T_world_cam[row[0]], inverse(loop.T_world_cam[first]))
    change = np.tile(IDENTITY, (len(map.ids), 1))
    change[row] = compose(compose(T_now_then, loop.T_world_cam[known]), inverse(map.T_world_cam[row]))
    settled = map.parent == NONE
    settled[row] = True
    for index in np.flatnonzero(~settled):
        line = [int(index)]
        while not settled[line[-1]]:
            line.append(map.row(map.parent[line[-1]]))
        change[line] = change[line[-1]]
        settled[line] = True
    of_point = change[rows(map.ids, standing(map, map.points.made_by))]
    X_world = (rotate(of_point, map.points.X_world.T) + of_point[:, 4:]).T
    return moved(map, map.ids, compose(change, map.T_world_cam), map.points.ids, X_world)
