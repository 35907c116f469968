"""Keyframes of the map brought back to the tracker, so that it finds their points again by their picture.

The tracker keeps its latest keyframes. Where the camera comes back to a place, older ones that show it hold the pose
to where the map has it, as precisely as flow does.
"""

from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.geometry.se3 import to_local
from jaxslam.map.point_records import observations_at, rows
from jaxslam.map.types import Map
from jaxslam.mapping.track_table import TrackId
from jaxslam.runtime.padding import padded


class MapKeyframe(NamedTuple):
    """A keyframe as the tracker takes it back; `n` slots for points, weight 0 for those not used.

    Attributes:
        keyframe: Its id.
        image: `(h, w)` gray, uint8.
        uv_raw: `(2, n)` points in it, pixels as seen.
        X_cam: `(3, n)` where they are in its axes, meters.
        weight: `(n,)`.
        id: `(n,)` the tracker's ids for them, see `TrackId`.
    """

    keyframe: int
    image: np.ndarray
    uv_raw: np.ndarray
    X_cam: np.ndarray
    weight: np.ndarray
    id: np.ndarray


def reload_keyframe(slam_map: Map, keyframe_id: int, num_points: int) -> MapKeyframe:
    """A keyframe of the map for the tracker, with its points, the most exact ones first.

    Raises:
        RuntimeError: If its image cannot be decoded.
    """
    keyframe = slam_map.keyframe(keyframe_id)
    image = cv2.imdecode(np.frombuffer(keyframe.image_file, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise RuntimeError(f"the image of keyframe {keyframe_id} cannot be decoded")
    slam_map = slam_map.around(np.array([keyframe_id]))
    seen = observations_at(slam_map.observations, np.flatnonzero(slam_map.observations.keyframe == keyframe_id))
    order = np.lexsort((seen.point, seen.sigma_px))[:num_points]
    seen = observations_at(seen, order)
    X_world = slam_map.points.X_world[:, rows(slam_map.points.ids, seen.point)]
    weight = seen.weight * slam_map.points.weight[rows(slam_map.points.ids, seen.point)]
    fit = lambda array, dtype: padded(array, num_points, axis=-1).astype(dtype)
    return MapKeyframe(
        keyframe_id,
        image,
        fit(seen.uv_raw, np.float32),
        fit(to_local(slam_map.pose(keyframe_id), X_world), np.float32),
        fit(weight, np.float32),
        fit(TrackId.of_map_points(seen.point), np.int32),
    )
