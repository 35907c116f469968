"""What may move leaves a keyframe and the map, once it is known where it was seen.

Source: Ji, Wang and Xie, "Towards Real-time Semantic RGB-D SLAM in Dynamic Environments" (TRS-SLAM), 2021, section
III-A: keyframes and map keep static features and points only.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, Num

from jaxslam.features.orb import Features
from jaxslam.map.edit import without_points
from jaxslam.map.types import NONE, Keyframe, Map, has


class DynamicObservations(NamedTuple):
    """What may move in a keyframe.

    Attributes:
        keyframe: Its id; `NONE` if it does not go into the map.
        mask: True where it is, in pixels of the image.
        tracks: The tracker's numbers of the points that it saw there.
    """

    keyframe: int
    mask: Bool[np.ndarray, "h w"]
    tracks: Int64[np.ndarray, " n"]


def under(mask: Bool[np.ndarray, "h w"], uv_raw: Num[np.ndarray, "2 n"]) -> Bool[np.ndarray, " n"]:
    """Which pixels of the image, as seen, are under a mask; those beyond its border count as on it."""
    limits = np.array(mask.shape[::-1])[:, None] - 1
    column, row = np.clip(np.round(uv_raw), 0, limits).astype(np.int64)
    return mask[row, column]


def without_dynamic(slam_map: Map, keyframe_id: int, mask: Bool[np.ndarray, "h w"]) -> Map:
    """The map without what a keyframe shows under a mask.

    The features there leave the keyframe, and the points that it saw there leave the map, with all that was seen of
    them from elsewhere.

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


def without_dynamic_points(slam_map: Map, point_ids: np.ndarray) -> Map:
    """Remove those of some points that are in the map."""
    known = np.unique(point_ids)
    return without_points(slam_map, known[has(slam_map.points.ids, known)])


def _with_features(slam_map: Map, keyframe: Keyframe, stays: Bool[np.ndarray, " n"]) -> Map:
    """The map with only some features of a keyframe; no point may be seen by the others."""
    row, features, seen = slam_map.row(keyframe.id), keyframe.features, slam_map.observations
    kept = {name: array[..., stays] for name, array in features._asdict().items() if name != "descriptor"}
    left = Features(descriptor=features.descriptor[stays], **kept)
    number = np.cumsum(stays, dtype=np.int32) - 1
    feature, renumbered = seen.feature.copy(), (seen.keyframe == keyframe.id) & (seen.feature != NONE)
    feature[renumbered] = number[feature[renumbered]]
    keyframes = (*slam_map.keyframes[:row], keyframe._replace(features=left), *slam_map.keyframes[row + 1 :])
    return slam_map._replace(keyframes=keyframes, observations=seen._replace(feature=feature))
