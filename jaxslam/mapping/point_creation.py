"""Create map points from the features of a keyframe."""

import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.dynamics.occlusion import PointState
from jaxslam.features.orb import DESCRIPTOR_BYTES, FeaturePlan, Features
from jaxslam.geometry.se3 import between, transform
from jaxslam.geometry.types import Ids
from jaxslam.map.edit import with_observations, with_points
from jaxslam.map.point_records import NONE, MapPoints, joined
from jaxslam.map.types import Map
from jaxslam.mapping.map_point_matching import feature_observations
from jaxslam.mapping.triangulation import at_baseline, triangulate

_TRIANGULATE_KEYFRAMES = 8
"""Number of neighbors with which the features of a new keyframe are triangulated."""


def new_points(
    slam_map: Map,
    keyframe_id: int,
    X_world: Float[np.ndarray, "3 n"],
    descriptor: UInt8[np.ndarray, "n 32"] | None = None,
) -> MapPoints:
    """Create points with the map's next ids.

    Args:
        slam_map: The map.
        keyframe_id: Id of their reference keyframe.
        X_world: `(3, n)` positions in the world, meters.
        descriptor: `(n, 32)` ORB descriptors; `None` for points without descriptors.
    """
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


def with_triangulated(slam_map: Map, keyframe_id: int, neighbors: Ids, plan: FeaturePlan) -> Map:
    """Triangulate the features of a keyframe without depth with its neighbors, and add the points.

    Args:
        slam_map: The map, or a part with all observations of these keyframes.
        keyframe_id: Id of the keyframe.
        neighbors: Ids of its neighbors, the most shared points first.
        plan: Settings of feature extraction.
    """
    features, pose = slam_map.keyframe(keyframe_id).features, slam_map.pose(keyframe_id)
    free, seen = _free(slam_map, keyframe_id), []
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
            seen.append(feature_observations(number, which, points.ids, index, plan))
        free = np.setdiff1d(free, mine)
    return with_observations(slam_map, joined(seen)) if seen else slam_map


def _free(slam_map: Map, keyframe_id: int) -> Ids:
    """Return the indices of the features of a keyframe that have neither depth nor a map point."""
    taken = slam_map.observations.feature[slam_map.observations.keyframe == keyframe_id]
    return np.setdiff1d(np.flatnonzero(slam_map.keyframe(keyframe_id).features.depth <= 0), taken[taken != NONE])


def _at(features: Features, index: Ids) -> Features:
    return Features(
        *(array[index] if name == "descriptor" else array[..., index] for name, array in features._asdict().items())
    )
