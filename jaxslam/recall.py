"""Keyframes of the map brought back to the tracker, so that it finds their points again by their picture.

The tracker keeps its latest keyframes. Where the camera comes back to a place, older ones that show it hold the pose
to where the map has it, as precisely as flow does.
"""

from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.local_mapping import recalled_id
from jaxslam.map import NONE, Map, rows, sightings_at
from jaxslam.padding import padded
from jaxslam.pose import to_local

_LEAST_POINTS = 60
"""Fewest points in view for which a keyframe is worth recalling."""
_MOST_TURN = 0.7
"""Cosine of the largest angle between the directions from which a point is seen, then and now."""
_SCALES = (0.5, 2.0)
"""Bounds on how much nearer or farther a point was."""
_MARGIN_PX = 8


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


def worth_recalling(map: Map, T_world_cam: np.ndarray, submap: int, exclude: set[int], at_most: int) -> list[int]:
    """The keyframes that show most of what is in view, those with most points first.

    Args:
        map: The map.
        T_world_cam: `(7,)` pose of the camera.
        submap: Number of the submap it is in.
        exclude: Keyframes the tracker has.
        at_most: How many.
    """
    camera = map.camera
    X = to_local(T_world_cam, map.points.X_world)
    z = np.where(X[2] > 0.1, X[2], np.inf)
    uv = np.stack([camera.fx * X[0] / z + camera.cx, camera.fy * X[1] / z + camera.cy])
    size = np.array([[camera.width], [camera.height]])
    inside = (X[2] > 0.1) & ((uv > _MARGIN_PX) & (uv < size - _MARGIN_PX)).all(axis=0)
    row, at = rows(map.points.ids, map.sightings.point), rows(map.ids, map.sightings.keyframe)
    shown = np.flatnonzero(inside[row] & (map.submap[at] == submap))
    now = map.points.X_world[:, row[shown]] - T_world_cam[4:, None]
    then = map.points.X_world[:, row[shown]] - map.T_world_cam[at[shown], 4:].T
    near, far = np.linalg.norm(now, axis=0), np.linalg.norm(then, axis=0)
    alike = (now * then).sum(axis=0) > _MOST_TURN * near * far
    alike &= (far > _SCALES[0] * near) & (far < _SCALES[1] * near)
    counts = np.bincount(at[shown[alike]], minlength=len(map.ids))
    counts[np.isin(map.ids, list(exclude))] = 0
    order = np.lexsort((map.ids, -counts))[:at_most]
    return [int(map.ids[index]) for index in order if counts[index] >= _LEAST_POINTS]


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
