"""Keyframes of the map brought back to the tracker, so that it finds their points again by their picture.

The tracker keeps its latest keyframes. Where the camera comes back to a place, older ones that show it hold the pose
to where the map has it, as precisely as flow does.
"""

from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.geometry.se3 import to_local
from jaxslam.map.types import NONE, Map, rows, sightings_at
from jaxslam.mapping.local_mapping import recalled_id
from jaxslam.runtime.padding import padded


class Recalled(NamedTuple):
    """A keyframe as the tracker takes it back; `n` slots for points, weight 0 for those not used.

    Attributes:
        keyframe: Its id.
        image: `(h, w)` grey, uint8.
        seen_uv: `(2, n)` points in it, pixels as seen.
        X_cam: `(3, n)` where they are in its axes, metres.
        weight: `(n,)`.
        id: `(n,)` the tracker's numbers for them.
    """

    keyframe: int
    image: np.ndarray
    seen_uv: np.ndarray
    X_cam: np.ndarray
    weight: np.ndarray
    id: np.ndarray


def recall(map: Map, keyframe_id: int, num_points: int) -> Recalled:
    """A keyframe of the map for the tracker, with its points, those that were followed first.

    Raises:
        RuntimeError: If its image cannot be decoded.
    """
    keyframe = map.keyframe(keyframe_id)
    image = cv2.imdecode(np.frombuffer(keyframe.image_png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise RuntimeError(f"the image of keyframe {keyframe_id} cannot be decoded")
    seen = sightings_at(map.sightings, np.flatnonzero(map.sightings.keyframe == keyframe_id))
    order = np.lexsort((seen.point, seen.feature != NONE))[:num_points]
    seen = sightings_at(seen, order)
    X_world = map.points.X_world[:, rows(map.points.ids, seen.point)]
    weight = seen.weight * map.points.weight[rows(map.points.ids, seen.point)]
    fit = lambda array, dtype: padded(array, num_points, axis=-1).astype(dtype)
    return Recalled(
        keyframe_id,
        image,
        fit(seen.seen_uv, np.float32),
        fit(to_local(map.pose(keyframe_id), X_world), np.float32),
        fit(weight, np.float32),
        fit(recalled_id(seen.point), np.int32),
    )
