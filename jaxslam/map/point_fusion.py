"""Fuse map points that are the same point of the world."""

import numpy as np
from jaxtyping import Int

from jaxslam.geometry.types import Ids
from jaxslam.map.edit import first_of_rivals
from jaxslam.map.point_records import MapPoints, has, observations_at, points_at, rows
from jaxslam.map.types import Map, point_submaps


def with_fused_points(slam_map: Map, keep: Int[np.ndarray, " f"], drop: Int[np.ndarray, " f"]) -> Map:
    """Fuse pairs of points: the observations of `drop[i]` become observations of `keep[i]`, and `drop[i]` is removed.

    Points linked by several pairs become one point, the one with the lowest id among those not dropped. It takes the
    position and weight of the most observed of them, a descriptor if it has none, and the highest state, because an
    object that passed in front of one of them passed in front of all. Of two observations in one keyframe the first
    stays.

    Args:
        slam_map: The map.
        keep: `(f,)` ids of the points to keep.
        drop: `(f,)` ids of the points to remove.

    Raises:
        ValueError: If the points of a pair are in different submaps.
        KeyError: If a point is not in the map.
    """
    if not len(keep):
        return slam_map
    members, into = _representatives(slam_map, keep, drop)
    submaps = point_submaps(slam_map)
    if (submaps != submaps[into]).any():
        raise ValueError("points of different submaps cannot be one")
    changed = has(slam_map.points.ids[members], slam_map.observations.point)
    at = rows(slam_map.points.ids, slam_map.observations.point[changed])
    point = slam_map.observations.point.copy()
    point[changed] = slam_map.points.ids[into[at]]
    seen = slam_map.observations._replace(point=point)
    stays = ~changed
    stays[changed] = first_of_rivals(observations_at(seen, changed))
    points = _with_best_known(_with_descriptors(slam_map.points, into), members, into, at)
    points = _with_highest_state(points, into)
    return slam_map.with_arrays(points_at(points, into == np.arange(len(into))), observations_at(seen, stays))


def _representatives(slam_map: Map, keep: Ids, drop: Ids) -> tuple[Ids, Ids]:
    """Return the ascending rows of the points of the pairs, and the `(p,)` row of the point that each point becomes.

    For most points, that is their own row.
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 - see `runtime.preload`
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    ids, which = np.unique(np.stack([keep, drop]), return_inverse=True)
    members, (first, second) = rows(slam_map.points.ids, ids), which.reshape(2, -1)
    links = coo_array((np.ones(len(keep), np.int8), (first, second)), shape=(len(ids), len(ids)))
    group = connected_components(links, directed=False)[1]
    dropped = np.zeros(len(ids), bool)
    dropped[second[first != second]] = True
    order = np.lexsort((dropped, group))  # stable: lowest id first
    into = np.arange(len(slam_map.points.ids))
    into[members] = members[order[np.unique(group[order], return_index=True)[1]][group]]
    return members, into


def _with_descriptors(points: MapPoints, into: Ids) -> MapPoints:
    """Give points without a descriptor the descriptor of the first point that is fused into them."""
    givers = np.flatnonzero(points.has_descriptor & ~points.has_descriptor[into])
    takers, first = np.unique(into[givers], return_index=True)
    descriptor, recognizable = points.descriptor.copy(), points.has_descriptor.copy()
    descriptor[takers], recognizable[takers] = descriptor[givers[first]], True
    return points._replace(descriptor=descriptor, has_descriptor=recognizable)


def _with_best_known(points: MapPoints, members: Ids, into: Ids, seen: Ids) -> MapPoints:
    """Give points the position and weight of the most observed point among those that are fused.

    Of several equally often observed ones, the kept point itself wins, then the one with the lowest id.

    Args:
        points: The points.
        members: Ascending rows of the points that are fused, and of those that they become.
        into: `(p,)` row of the point that each point becomes.
        seen: Row of the point of each observation of theirs.
    """
    counts = np.bincount(seen, minlength=len(points.ids))[members]
    order = members[np.lexsort((members, members != into[members], -counts, into[members]))]
    takers, first = np.unique(into[order], return_index=True)
    X_world, weight = points.X_world.copy(), points.weight.copy()
    X_world[:, takers], weight[takers] = points.X_world[:, order[first]], points.weight[order[first]]
    return points._replace(X_world=X_world, weight=weight)


def _with_highest_state(points: MapPoints, into: Ids) -> MapPoints:
    """Give points the highest state among those that are fused."""
    givers = np.flatnonzero(points.state[into] < points.state)
    if not len(givers):
        return points
    state = points.state.copy()
    np.maximum.at(state, into[givers], points.state[givers])
    return points._replace(state=state)
