"""Partial maps: extract a part of the map, edit it as a map of its own, and merge it back.

The cost of an edit then depends on the size of the part. A part has all keyframes, which are few, and the points and
observations around some of them. Every function of maps takes it, but only the keyframes around which it was extracted
have all their observations in it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxslam.geometry.types import Ids
from jaxslam.map.types import Map, MapPoints, Observations, observations_at, points_at


class PartialMap(NamedTuple):
    """A part of a map.

    Attributes:
        map: A map with all keyframes, the points that some of them observe, and every observation of those points.
        keyframes: Ascending ids of the keyframes around which it was extracted; all their observations are in `map`.
    """

    map: Map
    keyframes: Ids


def extract_around(slam_map: Map, keyframe_ids: Ids, point_ids: Ids | None = None) -> PartialMap:
    """Extract the part of a map around some keyframes.

    Args:
        slam_map: The map.
        keyframe_ids: Ids of the keyframes whose points the part has.
        point_ids: Ids of further points.

    Raises:
        IndexError: If an id was never assigned in this map.
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
    """Replace a part of a map by its edited version.

    Args:
        whole: The map from which the part was extracted, unchanged since.
        before: The part as it was extracted.
        after: The edited part. Keyframes may have been added; of the old ones, only those in `before.keyframes` may
            have been removed.
    """
    inside = _mask(whole.next_point, before.map.points.ids)
    points = points_at(whole.points, np.flatnonzero(~inside[whole.points.ids]))
    points = MapPoints(*_joined_columns(points, after.points, axes={"descriptor": 0}))
    order = np.argsort(points.ids, kind="stable")  # two sorted runs, which a stable sort merges in linear time
    seen = observations_at(whole.observations, np.flatnonzero(~inside[whole.observations.point]))
    return after._replace(
        points=points_at(points, order), observations=Observations(*_joined_columns(seen, after.observations))
    )


def most_shared(slam_map: Map, point_ids: Ids, at_most: int) -> Ids:
    """Return the at most `at_most` keyframes that observe the most of some points, most first; newer first if equal."""
    seen = _mask(slam_map.next_point, point_ids)[slam_map.observations.point]
    counts = np.bincount(slam_map.observations.keyframe[seen], minlength=slam_map.next_keyframe)
    ids = slam_map.ids[counts[slam_map.ids] > 0]
    return ids[np.lexsort((-ids, -counts[ids]))][:at_most]


def _joined_columns(
    first: MapPoints | Observations, second: MapPoints | Observations, axes: dict[str, int] | None = None
) -> list[np.ndarray]:
    """Concatenate the columns of two records, along the axis given in `axes` or else the last one."""
    return [
        np.concatenate([one, getattr(second, name)], axis=(axes or {}).get(name, -1))
        for name, one in first._asdict().items()
    ]


def _mask(size: int, ids: Ids) -> Bool[np.ndarray, " size"]:
    """Return a `(size,)` mask that is true at these ids; looking up an id takes one step instead of a search."""
    mask = np.zeros(size, bool)
    mask[ids] = True
    return mask
