"""Points made of what a keyframe sees."""

import numpy as np

from jaxslam.dynamics.occlusion import PointState
from jaxslam.features.orb import DESCRIPTOR_BYTES, FeaturePlan, Features
from jaxslam.geometry.se3 import between, transform
from jaxslam.map.edit import with_observations, with_points
from jaxslam.map.types import NONE, Map, MapPoints
from jaxslam.mapping.map_point_matching import feature_observations
from jaxslam.mapping.triangulation import at_baseline, triangulate

_TRIANGULATE_KEYFRAMES = 8
"""Keyframes whose features without depth are matched with those of a new one."""


def new_points(slam_map: Map, keyframe_id: int, X_world: np.ndarray, descriptor: np.ndarray | None = None) -> MapPoints:
    """Points `(3, n)` made by a keyframe, with the map's next ids; recognizable if they have a descriptor `(n, 32)`."""
    num = X_world.shape[1]
    recognizable = np.full(num, descriptor is not None)
    return MapPoints(
        ids=slam_map.next_point + np.arange(num),
        X_world=X_world,
        weight=np.ones(num, np.float32),
        descriptor=np.zeros((num, DESCRIPTOR_BYTES), np.uint8) if descriptor is None else descriptor,
        has_descriptor=recognizable,
        reference_keyframe=np.full(num, keyframe_id, np.int64),
        state=np.full(num, PointState.STATIC, np.int8),
    )


def with_triangulated(slam_map: Map, keyframe_id: int, neighbors: np.ndarray, plan: FeaturePlan) -> Map:
    """Points for features without depth that a neighbor sees too.

    Args:
        slam_map: The map, or a part with all that these keyframes saw.
        keyframe_id: The keyframe.
        neighbors: Ids of others, the most alike first.
        plan: How features are found.
    """
    features, pose = slam_map.keyframe(keyframe_id).features, slam_map.pose(keyframe_id)
    free = _free(slam_map, keyframe_id)
    for neighbor in neighbors[:_TRIANGULATE_KEYFRAMES].tolist():
        if not at_baseline(pose, slam_map.pose(neighbor), features.depth):
            continue
        theirs, free_there = slam_map.keyframe(neighbor).features, _free(slam_map, neighbor)
        relative = between(pose, slam_map.pose(neighbor))
        found = triangulate(slam_map.camera, _at(features, free), _at(theirs, free_there), relative, plan)
        mine, other = free[found.first], free_there[found.second]
        points = new_points(slam_map, keyframe_id, transform(pose, found.X_first), features.descriptor[mine])
        slam_map = with_points(slam_map, points)
        for number, which, index in ((keyframe_id, features, mine), (neighbor, theirs, other)):
            slam_map = with_observations(slam_map, feature_observations(number, which, points.ids, index, plan))
        free = np.setdiff1d(free, mine)
    return slam_map


def _free(slam_map: Map, keyframe_id: int) -> np.ndarray:
    """Indices of the features of a keyframe that have no depth and are no point."""
    taken = slam_map.observations.feature[slam_map.observations.keyframe == keyframe_id]
    return np.setdiff1d(np.flatnonzero(slam_map.keyframe(keyframe_id).features.depth <= 0), taken[taken != NONE])


def _at(features: Features, index: np.ndarray) -> Features:
    return Features(
        *(array[index] if name == "descriptor" else array[..., index] for name, array in features._asdict().items())
    )
