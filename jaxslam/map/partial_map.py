"""A part of the map cut out, changed as a map of its own, and put back: so that a change costs what it touches.

A part has all keyframes, which are few, and the points and observations around some of them. All functions of maps take
it. What is true only of the whole must not be asked of it: a keyframe shows all that it saw only if it is one of those
around which the part was cut.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.map.types import Map, MapPoints, Observations, observations_at, points_at


class PartialMap(NamedTuple):
    """A part of a map.

    Attributes:
        map: All keyframes, the points that some of them saw, and every observation of those points.
        keyframes: Ids, ascending, of the keyframes around which it was cut: all that they saw is in it.
    """

    map: Map
    keyframes: np.ndarray


def extract_around(slam_map: Map, keyframe_ids: np.ndarray, point_ids: np.ndarray | None = None) -> PartialMap:
    """The part of a map around some of its keyframes, and some points besides.

    Raises:
        IndexError: If an id was never given in this map.
    """
    inside = _mask(
        slam_map.next_point,
        slam_map.observations.point[_mask(slam_map.next_keyframe, keyframe_ids)[slam_map.observations.keyframe]],
    )
    if point_ids is not None:
        inside[point_ids] = True
    part = slam_map._replace(
        points=points_at(slam_map.points, np.flatnonzero(inside[slam_map.points.ids])),
        observations=observations_at(slam_map.observations, np.flatnonzero(inside[slam_map.observations.point])),
    )
    return PartialMap(part, np.unique(keyframe_ids))


def merge_back(whole: Map, before: PartialMap, after: Map) -> Map:
    """The whole map with a part as it is after changes, of `before`, in place of what was there.

    Args:
        whole: The map from which the part was cut, unchanged since.
        before: The part as it was cut.
        after: What it has become; keyframes may have been added and removed, but no keyframe that is not one of
            `before.keyframes` may have been removed.
    """
    inside = _mask(whole.next_point, before.map.points.ids)
    points = points_at(whole.points, np.flatnonzero(~inside[whole.points.ids]))
    points = MapPoints(*_joined_columns(points, after.points, axes={"descriptor": 0}))
    order = np.argsort(points.ids, kind="stable")  # two runs in order: a merge
    seen = observations_at(whole.observations, np.flatnonzero(~inside[whole.observations.point]))
    return after._replace(
        points=points_at(points, order), observations=Observations(*_joined_columns(seen, after.observations))
    )


def most_shared(slam_map: Map, point_ids: np.ndarray, at_most: int) -> np.ndarray:
    """The keyframes that saw most of some points, those with most first, at most so many; later ones if equal."""
    seen = _mask(slam_map.next_point, point_ids)[slam_map.observations.point]
    counts = np.bincount(slam_map.observations.keyframe[seen], minlength=slam_map.next_keyframe)
    ids = slam_map.ids[counts[slam_map.ids] > 0]
    return ids[np.lexsort((-ids, -counts[ids]))][:at_most]


def _joined_columns(
    first: MapPoints | Observations, second: MapPoints | Observations, axes: dict[str, int] | None = None
) -> list[np.ndarray]:
    """The columns of two records of one kind, one after the other, along the last axis but where `axes` says so."""
    return [
        np.concatenate([one, getattr(second, name)], axis=(axes or {}).get(name, -1))
        for name, one in first._asdict().items()
    ]


def _mask(size: int, ids: np.ndarray) -> np.ndarray:
    """`(size,)` true at these ids: looked up in one step each, where a search would take many."""
    mask = np.zeros(size, bool)
    mask[ids] = True
    return mask
