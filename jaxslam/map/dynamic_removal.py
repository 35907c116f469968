"""Remove the features and points on dynamic objects from a keyframe and the map, once their mask is known.

Source: Ji, Wang and Xie, "Towards Real-time Semantic RGB-D SLAM in Dynamic Environments" (TRS-SLAM), 2021, section
III-A: keyframes and map keep static features and points only.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, Num

from jaxslam.features.orb import Features
from jaxslam.geometry.types import Ids
from jaxslam.map.edit import without_points
from jaxslam.map.point_records import NONE, has
from jaxslam.map.types import Keyframe, Map


class DynamicObservations(NamedTuple):
    """The dynamic part of a keyframe.

    Attributes:
        keyframe: Id of the keyframe; `NONE` if it is not added to the map.
        mask: `(h, w)` mask of the dynamic objects, in pixels of the distorted image.
        tracks: `(n,)` tracker ids of the points observed under the mask.
    """

    keyframe: int
    mask: Bool[np.ndarray, "h w"]
    tracks: Int64[np.ndarray, " n"]


def under(mask: Bool[np.ndarray, "h w"], uv_raw: Num[np.ndarray, "2 n"]) -> Bool[np.ndarray, " n"]:
    """Return which pixels of the distorted image are under a mask; pixels outside are clamped to its border."""
    limits = np.array(mask.shape[::-1])[:, None] - 1
    column, row = np.clip(np.round(uv_raw), 0, limits).astype(np.int64)
    return mask[row, column]


def without_dynamic(slam_map: Map, keyframe_id: int, mask: Bool[np.ndarray, "h w"]) -> Map:
    """Remove what a keyframe observes under a mask.

    The features under the mask are removed from the keyframe. The points that it observes there are removed from the
    map with all their observations.

    Args:
        slam_map: The map.
        keyframe_id: Id of the keyframe.
        mask: `(h, w)` mask in pixels of the distorted image.

    Raises:
        KeyError: If the keyframe is not in the map.
    """
    keyframe, seen = slam_map.keyframe(keyframe_id), slam_map.observations
    stays = ~under(mask, keyframe.features.uv_raw)
    mine = np.flatnonzero(seen.keyframe == keyframe_id)
    hidden = under(mask, seen.uv_raw[:, mine])
    by_feature = seen.feature[mine] != NONE
    hidden[by_feature] |= ~stays[seen.feature[mine][by_feature]]
    slam_map = without_points(slam_map, np.unique(seen.point[mine[hidden]]))
    return _with_features(slam_map, keyframe, stays)


def without_dynamic_points(slam_map: Map, point_ids: Ids) -> Map:
    """Remove some points; ids that are not in the map are skipped."""
    known = np.unique(point_ids)
    return without_points(slam_map, known[has(slam_map.points.ids, known)])


def _with_features(slam_map: Map, keyframe: Keyframe, stays: Bool[np.ndarray, " n"]) -> Map:
    """Keep only the features of a keyframe where `stays` is true; the others must have no observation."""
    row, features, seen = slam_map.row(keyframe.id), keyframe.features, slam_map.observations
    kept = {name: array[..., stays] for name, array in features._asdict().items() if name != "descriptor"}
    left = Features(descriptor=features.descriptor[stays], **kept)
    number = np.cumsum(stays, dtype=np.int32) - 1
    feature, renumbered = seen.feature.copy(), (seen.keyframe == keyframe.id) & (seen.feature != NONE)
    feature[renumbered] = number[feature[renumbered]]
    keyframes = (*slam_map.keyframes[:row], keyframe._replace(features=left), *slam_map.keyframes[row + 1 :])
    return slam_map.with_arrays(observations=seen._replace(feature=feature))._replace(keyframes=keyframes)
