"""Finding the points of the map in a keyframe, and points that are in the map twice."""

from typing import NamedTuple

import numpy as np

from jaxslam.features.matching import NEAR, match_by_projection
from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.geometry.se3 import to_local
from jaxslam.map.edit import fused, with_sightings
from jaxslam.map.types import NONE, Map, Sightings, empty_sightings, rows, sightings_at

_MARGIN_PX = 1.0
_NEAREST_M = 0.1
_MAX_DEPTH_ERROR = 0.1
"""Largest difference between the depth of a point and that measured at a feature, as a share of it."""


class Recognisable(NamedTuple):
    """Points of the map that have a descriptor, with how they looked; `(r,)`, ascending by id.

    Attributes:
        ids: Of the points.
        X_world: `(3, r)` metres.
        descriptor: `(r, 32)`.
        size: Size of the feature times its distance: over another distance, its size from there in octave 0's.
    """

    ids: np.ndarray
    X_world: np.ndarray
    descriptor: np.ndarray
    size: np.ndarray


def recognisable_in(map: Map, keyframe_ids: np.ndarray) -> Recognisable:
    """The points with a descriptor that some keyframes see."""
    seen = np.flatnonzero(np.isin(map.sightings.keyframe, keyframe_ids) & (map.sightings.feature != NONE))
    ids, first = np.unique(map.sightings.point[seen], return_index=True)
    seen = seen[first]
    row = rows(map.points.ids, ids)
    X_world = map.points.X_world[:, row]
    distance = np.linalg.norm(X_world - map.T_world_cam[rows(map.ids, map.sightings.keyframe[seen]), 4:].T, axis=0)
    with_descriptor = map.points.recognisable[row]
    return Recognisable(
        ids[with_descriptor],
        X_world[:, with_descriptor],
        map.points.descriptor[row[with_descriptor]],
        (map.sightings.sigma_px[seen] * distance)[with_descriptor],
    )


def find_points(
    map: Map,
    points: Recognisable,
    features: Features,
    T_world_cam: np.ndarray,
    plan: FeaturePlan,
    *,
    radius_px: float,
    max_distance: int = NEAR,
) -> np.ndarray:
    """Find points of the map among the features of a picture taken from about `T_world_cam`.

    Args:
        map: The map; for its camera.
        points: What to look for.
        features: Of the picture.
        T_world_cam: `(7,)` where it was taken from.
        plan: How features are found.
        radius_px: How far from where the pose puts a point to look, at octave 0.
        max_distance: Most bits of the descriptor that differ.

    Returns:
        `(2, m)` index in `points` and in `features` of each match.
    """
    camera = map.camera
    X = to_local(T_world_cam, points.X_world)
    front = X[2] > _NEAREST_M
    z = np.where(front, X[2], 1.0)
    uv = np.stack([camera.fx * X[0] / z + camera.cx, camera.fy * X[1] / z + camera.cy])
    inside = front & (uv > -_MARGIN_PX).all(axis=0) & (uv < [[camera.width], [camera.height]]).all(axis=0)
    octave = np.log(points.size / np.linalg.norm(X, axis=0).clip(_NEAREST_M)) / np.log(plan.scale_factor)
    octave = np.clip(np.round(octave), 0, plan.num_levels - 1).astype(np.int64)
    where = np.flatnonzero(inside)
    match = match_by_projection(
        uv[:, where],
        octave[where],
        points.descriptor[where],
        features,
        radius_px=radius_px,
        max_distance=max_distance,
        plan=plan,
    )
    index, feature = where[match[0]], match[1]
    measured = features.depth[feature]
    agrees = (measured <= 0) | (np.abs(measured - X[2, index]) < _MAX_DEPTH_ERROR * X[2, index])
    return np.stack([index, feature])[:, agrees]


def feature_sightings(
    keyframe_id: int, features: Features, point_ids: np.ndarray, feature: np.ndarray, plan: FeaturePlan
) -> Sightings:
    """Sightings of points at features of a keyframe."""
    return Sightings(
        keyframe=np.full(len(feature), keyframe_id, np.int64),
        point=point_ids.astype(np.int64),
        feature=feature.astype(np.int32),
        seen_uv=features.seen_uv[:, feature],
        uv=features.uv[:, feature],
        depth=features.depth[feature],
        sigma_px=plan.scale(features.octave[feature]).astype(np.float32),
        weight=np.ones(len(feature), np.float32),
    )


def fuse_duplicates(
    map: Map, keyframe_id: int, neighbours: np.ndarray, plan: FeaturePlan, *, radius_px: float
) -> tuple[Map, np.ndarray, np.ndarray]:
    """Look for the points of a keyframe in its neighbours: what is there a point already becomes one with it.

    Args:
        map: The map, or a part with all that these keyframes saw.
        keyframe_id: The keyframe.
        neighbours: Ids of others of its submap.
        plan: How features are found.
        radius_px: As for `find_points`.

    Returns:
        The map, and the points that others became one with: ids kept and ids dropped.
    """
    points = recognisable_in(map, np.array([keyframe_id]))
    kept, dropped, new = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [empty_sightings()]
    for neighbour in neighbours.tolist():
        features = map.keyframe(neighbour).features
        seen = sightings_at(map.sightings, np.flatnonzero(map.sightings.keyframe == neighbour))
        unseen = ~np.isin(points.ids, seen.point)
        wanted = Recognisable(
            points.ids[unseen], points.X_world[:, unseen], points.descriptor[unseen], points.size[unseen]
        )
        index, feature = find_points(map, wanted, features, map.pose(neighbour), plan, radius_px=radius_px)
        point_at = np.full(len(features.octave), NONE, np.int64)
        by_feature = seen.feature != NONE
        point_at[seen.feature[by_feature]] = seen.point[by_feature]
        there, mine = point_at[feature], wanted.ids[index]
        free = there == NONE
        new.append(feature_sightings(neighbour, features, mine[free], feature[free], plan))
        kept.append(np.minimum(there, mine)[~free])
        dropped.append(np.maximum(there, mine)[~free])
    map = with_sightings(map, Sightings(*(np.concatenate(columns, axis=-1) for columns in zip(*new, strict=True))))
    drop, first = np.unique(np.concatenate(dropped), return_index=True)
    keep = np.concatenate(kept)[first]
    return fused(map, keep, drop), keep, drop
