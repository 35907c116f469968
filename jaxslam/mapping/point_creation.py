"""Points made of what a keyframe sees."""

import numpy as np

from jaxslam.dynamics.occlusion import PointState
from jaxslam.features.orb import DESCRIPTOR_BYTES, FeaturePlan, Features
from jaxslam.geometry.se3 import between, transform
from jaxslam.map.edit import with_points, with_sightings
from jaxslam.map.types import NONE, Map, MapPoints
from jaxslam.mapping.map_point_matching import feature_sightings
from jaxslam.mapping.triangulation import at_baseline, triangulate

_TRIANGULATE_KEYFRAMES = 8
"""Keyframes whose features without depth are matched with those of a new one."""


def new_points(map: Map, keyframe_id: int, X_world: np.ndarray, descriptor: np.ndarray | None = None) -> MapPoints:
    """Points `(3, n)` made by a keyframe, with the map's next ids; recognisable if they have a descriptor `(n, 32)`."""
    num = X_world.shape[1]
    recognisable = np.full(num, descriptor is not None)
    return MapPoints(
        ids=map.next_point + np.arange(num),
        X_world=X_world,
        weight=np.ones(num, np.float32),
        descriptor=np.zeros((num, DESCRIPTOR_BYTES), np.uint8) if descriptor is None else descriptor,
        recognisable=recognisable,
        made_by=np.full(num, keyframe_id, np.int64),
        state=np.full(num, PointState.STATIC, np.int8),
    )


def with_triangulated(map: Map, keyframe_id: int, neighbours: np.ndarray, plan: FeaturePlan) -> Map:
    """Points for features without depth that a neighbour sees too.

    Args:
        map: The map, or a part with all that these keyframes saw.
        keyframe_id: The keyframe.
        neighbours: Ids of others, the most alike first.
        plan: How features are found.
    """
    features, pose = map.keyframe(keyframe_id).features, map.pose(keyframe_id)
    free = _free(map, keyframe_id)
    for neighbour in neighbours[:_TRIANGULATE_KEYFRAMES].tolist():
        if not at_baseline(pose, map.pose(neighbour), features.depth):
            continue
        theirs, free_there = map.keyframe(neighbour).features, _free(map, neighbour)
        relative = between(pose, map.pose(neighbour))
        found = triangulate(map.camera, _at(features, free), _at(theirs, free_there), relative, plan)
        mine, other = free[found.first], free_there[found.second]
        points = new_points(map, keyframe_id, transform(pose, found.X_first), features.descriptor[mine])
        map = with_points(map, points)
        for number, which, index in ((keyframe_id, features, mine), (neighbour, theirs, other)):
            map = with_sightings(map, feature_sightings(number, which, points.ids, index, plan))
        free = np.setdiff1d(free, mine)
    return map


def _free(map: Map, keyframe_id: int) -> np.ndarray:
    """Indices of the features of a keyframe that have no depth and are no point."""
    taken = map.sightings.feature[map.sightings.keyframe == keyframe_id]
    return np.setdiff1d(np.flatnonzero(map.keyframe(keyframe_id).features.depth <= 0), taken[taken != NONE])


def _at(features: Features, index: np.ndarray) -> Features:
    return Features(
        *(array[index] if name == "descriptor" else array[..., index] for name, array in features._asdict().items())
    )
