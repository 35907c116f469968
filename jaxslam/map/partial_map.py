"""Partial maps: extract a part of the map, edit it as a map of its own, and merge it back.

The cost of an edit then depends on the size of the part, and so does that of merging it back. A part has all keyframes,
which are few, and the points and observations around some of them. Every function of maps takes it, but only the
keyframes around which it was extracted have all their observations in it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxslam.geometry.types import Ids
from jaxslam.map.point_records import distinct, observations_at, points_at
from jaxslam.map.types import Map


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
    slam_map = slam_map.around(keyframe_ids, point_ids)
    inside = _mask(
        slam_map.next_point,
        slam_map.observations.point[_mask(slam_map.next_keyframe, keyframe_ids)[slam_map.observations.keyframe]],
    )
    if point_ids is not None:
        inside[point_ids] = True
    part = slam_map.with_arrays(
        points_at(slam_map.points, np.flatnonzero(inside[slam_map.points.ids])),
        observations_at(slam_map.observations, np.flatnonzero(inside[slam_map.observations.point])),
    )
    return PartialMap(part, distinct(keyframe_ids)[0])


def merge_back(whole: Map, before: PartialMap, after: Map) -> Map:
    """Replace a part of a map by its edited version.

    Args:
        whole: The map from which the part was extracted, unchanged since.
        before: The part as it was extracted.
        after: The edited part. Keyframes may have been added; of the old ones, only those in `before.keyframes` may
            have been removed.
    """
    return after._replace(contents=whole.contents.replaced(before.map.points.ids, after.contents))


def _mask(size: int, ids: Ids) -> Bool[np.ndarray, " size"]:
    """Return a `(size,)` mask that is true at these ids; looking up an id takes one step instead of a search."""
    mask = np.zeros(size, bool)
    mask[ids] = True
    return mask
