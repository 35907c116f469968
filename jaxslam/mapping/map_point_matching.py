"""Match map points with the features of a keyframe, and fuse points that are in the map twice."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int32, Int64, UInt8

from jaxslam.features.matching import NEAR, match_by_projection
from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.geometry.se3 import to_local
from jaxslam.geometry.types import Ids, Pose, Transforms
from jaxslam.map.edit import with_observations
from jaxslam.map.point_fusion import with_fused_points
from jaxslam.map.point_records import NONE, Observations, has, observations_at, rows
from jaxslam.map.types import Map
from jaxslam.sensors.camera import Camera

_MARGIN_PX = 1.0
_SAME_PX = 2.0
"""Largest distance of a tracked point from the feature that shows it."""
_MAX_DEPTH_ERROR = 0.1
"""Largest difference between the depth of a point and the depth measured at a feature, as a share of the former."""


class DescribedPoints(NamedTuple):
    """Map points with a descriptor, and how they appeared; `(r,)`, ascending by id.

    Attributes:
        ids: Ids of the points.
        X_world: `(3, r)` positions in meters.
        descriptor: `(r, 32)` descriptors.
        size: Feature size times distance; divided by another distance it gives the size seen from there, relative to
            octave 0.
    """

    ids: Int64[np.ndarray, " r"]
    X_world: Float64[np.ndarray, "3 r"]
    descriptor: UInt8[np.ndarray, "r 32"]
    size: Float64[np.ndarray, " r"]

    def without(self, point_ids: Ids) -> "DescribedPoints":
        """Return the points but for those with these ids."""
        stays = ~has(np.sort(point_ids), self.ids)
        return DescribedPoints(self.ids[stays], self.X_world[:, stays], self.descriptor[stays], self.size[stays])


def described_points_in(slam_map: Map, keyframe_ids: Ids, plan: FeaturePlan) -> DescribedPoints:
    """Return the points with a descriptor that these keyframes observe at a feature."""
    slam_map = slam_map.around(keyframe_ids)
    of_keyframes = has(np.sort(keyframe_ids), slam_map.observations.keyframe)
    seen = np.flatnonzero(of_keyframes & (slam_map.observations.feature != NONE))
    ids, first = np.unique(slam_map.observations.point[seen], return_index=True)
    seen = seen[first]
    row = rows(slam_map.points.ids, ids)
    X_world = slam_map.points.X_world[:, row]
    distance = np.linalg.norm(
        X_world - slam_map.T_world_cam[rows(slam_map.ids, slam_map.observations.keyframe[seen]), 4:].T, axis=0
    )
    with_descriptor = slam_map.points.has_descriptor[row]
    return DescribedPoints(
        ids[with_descriptor],
        X_world[:, with_descriptor],
        slam_map.points.descriptor[row[with_descriptor]],
        (plan.scale(_octaves(slam_map, seen)) * distance)[with_descriptor],
    )


def _octaves(slam_map: Map, rows_of: Int[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Return the octave of the feature of each of some observations."""
    owner, feature = slam_map.observations.keyframe[rows_of], slam_map.observations.feature[rows_of]
    octave = np.zeros(len(rows_of), np.uint8)
    for keyframe_id in np.unique(owner).tolist():
        mine = owner == keyframe_id
        octave[mine] = slam_map.keyframe(keyframe_id).features.octave[feature[mine]]
    return octave


def features_at(features: Features, uv_raw: Float32[np.ndarray, "2 n"]) -> Int32[np.ndarray, " n"]:
    """Return the feature that shows each tracked point: the nearest one, at most once; `NONE` where none is near.

    Args:
        features: Features of the keyframe.
        uv_raw: Positions of the points in its distorted image, pixels.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - see `runtime.preload`

    nothing = np.full(uv_raw.shape[1], NONE, np.int32)
    if not (uv_raw.shape[1] and len(features.octave)):
        return nothing
    found = KDTree(features.uv_raw.T).query(uv_raw.T, distance_upper_bound=_SAME_PX)
    apart, nearest = map(np.asarray, found)
    order = np.lexsort((apart, nearest))
    _, first = np.unique(nearest[order], return_index=True)
    chosen = order[first]
    chosen = chosen[np.isfinite(apart[chosen])]  # beyond the bound it is infinite
    nothing[chosen] = nearest[chosen]
    return nothing


def points_of_features(slam_map: Map, keyframe_id: int, num_features: int) -> Int64[np.ndarray, " f"]:
    """Return the id of the point that each feature of a keyframe shows; `NONE` for a feature that shows none."""
    slam_map = slam_map.around(np.array([keyframe_id]))
    seen = observations_at(
        slam_map.observations,
        np.flatnonzero((slam_map.observations.keyframe == keyframe_id) & (slam_map.observations.feature != NONE)),
    )
    points = np.full(num_features, NONE, np.int64)
    points[seen.feature] = seen.point
    return points


def find_points(
    slam_map: Map,
    points: DescribedPoints,
    features: Features,
    T_world_cam: Pose,
    plan: FeaturePlan,
    *,
    radius_px: float,
    max_distance: int = NEAR,
) -> Int[np.ndarray, "2 m"]:
    """Match map points with the features of an image by projection from an approximate pose.

    Args:
        slam_map: The map, for its camera.
        points: Points to match.
        features: Features of the image.
        T_world_cam: `(7,)` approximate pose of the camera.
        plan: Settings of feature extraction.
        radius_px: Search radius around the predicted pixel at octave 0.
        max_distance: Maximum Hamming distance of a match, in bits.

    Returns:
        `(2, m)` index in `points` and in `features` of each match.
    """
    everywhere = np.ones((1, len(points.ids)), bool)
    _, index, feature = _find_in_images(
        slam_map.camera,
        points,
        everywhere,
        _together([features]),
        T_world_cam[None],
        plan,
        radius_px=radius_px,
        max_distance=max_distance,
    )
    return np.stack([index, feature])


class _Images(NamedTuple):
    """Features of `v` images.

    Attributes:
        features: The `n` features of the images, one image after the other.
        image: `(n,)` number of the image of each feature.
        first: `(v,)` index of the first feature of each image.
    """

    features: Features
    image: Int64[np.ndarray, " n"]
    first: Int64[np.ndarray, " v"]


def _together(features: Sequence[Features]) -> _Images:
    """Put the features of images into one array each."""
    size = np.array([len(each.octave) for each in features])
    uv_raw, uv, *columns = zip(*features, strict=True)
    positions = np.concatenate(uv_raw, axis=1), np.concatenate(uv, axis=1)
    return _Images(
        Features(*positions, *map(np.concatenate, columns)),
        np.repeat(np.arange(len(features)), size),
        np.cumsum(size) - size,
    )


def _find_in_images(
    camera: Camera,
    points: DescribedPoints,
    wanted: Bool[np.ndarray, "v r"],
    images: _Images,
    T_world_cam: Transforms,
    plan: FeaturePlan,
    *,
    radius_px: float,
    max_distance: int = NEAR,
) -> Int[np.ndarray, "3 m"]:
    """Match map points with the features of several images by projection from approximate poses.

    Args:
        camera: Camera of the images.
        points: Points to match.
        wanted: Which points to match with each image.
        images: Features of the images.
        T_world_cam: `(v, 7)` approximate poses of the images.
        plan: Settings of feature extraction.
        radius_px: Search radius around the predicted pixel at octave 0.
        max_distance: Maximum Hamming distance of a match, in bits.

    Returns:
        `(3, m)` image, index in `points`, and index in the features of that image of each match.
    """
    image, index = np.nonzero(wanted)
    X = np.concatenate(
        [to_local(T, points.X_world[:, mine]) for T, mine in zip(T_world_cam, wanted, strict=True)], axis=1
    )
    front = X[2] > 0
    X = np.where(front, X, 1.0)
    uv = camera.project(X)
    inside = front & (uv > -_MARGIN_PX).all(axis=0) & (uv < [[camera.width], [camera.height]]).all(axis=0)
    image, index, X, uv = image[inside], index[inside], X[:, inside], uv[:, inside]
    octave = np.log(points.size[index] / np.linalg.norm(X, axis=0)) / np.log(plan.scale_factor)
    octave = np.clip(np.round(octave), 0, plan.num_levels - 1).astype(np.int64)
    row, feature = match_by_projection(
        uv,
        octave,
        points.descriptor[index],
        images.features,
        radius_px=radius_px,
        max_distance=max_distance,
        plan=plan,
        images=(image, images.image),
    )
    measured, expected = images.features.depth[feature], X[2, row]
    agrees = (measured <= 0) | (np.abs(measured - expected) < _MAX_DEPTH_ERROR * expected)
    row, feature = row[agrees], feature[agrees]
    return np.stack([image[row], index[row], feature - images.first[image[row]]])


def feature_observations(
    keyframe_id: int | Ids,
    features: Features,
    point_ids: Int[np.ndarray, " m"],
    feature: Int[np.ndarray, " m"],
    plan: FeaturePlan,
) -> Observations:
    """Make observations of points at features of a keyframe, or of one keyframe each."""
    return Observations(
        keyframe=np.full(len(feature), keyframe_id, np.int64),
        point=point_ids.astype(np.int64),
        feature=feature.astype(np.int32),
        uv_raw=features.uv_raw[:, feature],
        uv=features.uv[:, feature],
        depth=features.depth[feature],
        sigma_px=plan.scale(features.octave[feature]).astype(np.float32),
        weight=np.ones(len(feature), np.float32),
    )


def fuse_duplicates(
    slam_map: Map, keyframe_id: int, neighbors: Ids, plan: FeaturePlan, *, radius_px: float
) -> tuple[Map, Int[np.ndarray, " f"], Int[np.ndarray, " f"]]:
    """Match the points of a keyframe with the features of its neighbors, and fuse those that are the same point.

    Args:
        slam_map: The map, or a part with all observations of these keyframes.
        keyframe_id: Id of the keyframe.
        neighbors: Ids of other keyframes of its submap.
        plan: Settings of feature extraction.
        radius_px: Search radius, as for `find_points`.

    Returns:
        The map, and the fused points: the ids kept, and for each the id dropped.
    """
    if not len(neighbors):
        nothing = np.zeros(0, np.int64)
        return slam_map, nothing, nothing
    points = described_points_in(slam_map, np.array([keyframe_id]), plan)
    images = _together([slam_map.keyframe(neighbor).features for neighbor in neighbors.tolist()])
    order = np.argsort(neighbors)
    seen = observations_at(slam_map.observations, has(neighbors[order], slam_map.observations.keyframe))
    seen_in = order[np.searchsorted(neighbors, seen.keyframe, sorter=order)]
    # 1. Match the points with the features of the neighbors that do not observe them.
    wanted = np.ones((len(neighbors), len(points.ids)), bool)
    shared = has(points.ids, seen.point)
    wanted[seen_in[shared], rows(points.ids, seen.point[shared])] = False
    poses = slam_map.T_world_cam[rows(slam_map.ids, neighbors)]
    image, index, feature = _find_in_images(slam_map.camera, points, wanted, images, poses, plan, radius_px=radius_px)
    # 2. A feature that shows no point shows the one matched; one that shows another point shows that it is the same.
    shown = np.full(len(images.image), NONE, np.int64)
    at_feature = seen.feature != NONE
    shown[images.first[seen_in[at_feature]] + seen.feature[at_feature]] = seen.point[at_feature]
    at, mine = images.first[image] + feature, points.ids[index]
    there = shown[at]
    free = there == NONE
    new = feature_observations(neighbors[image[free]], images.features, mine[free], at[free], plan)
    slam_map = with_observations(slam_map, new._replace(feature=feature[free].astype(np.int32)))
    drop, first = np.unique(np.maximum(there, mine)[~free], return_index=True)
    keep = np.minimum(there, mine)[~free][first]
    return with_fused_points(slam_map, keep, drop), keep, drop
