"""Key objects at full density: their points from a keyframe and from frames shortly before it.

Source: RTS-SLAM (Sensors 2026), Algorithm 2, lines 5 to 14. The paper finds "corresponding object regions" in the
neighbors and does not say how. Here the detector runs on the keyframe only. The depth inside its detections gives each
object a 3D box, and the points of the neighbors inside that box belong to the object. So a neighbor costs no inference,
and the foreground and background of an object are left out in all frames.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import between, transform
from jaxslam.masks.box_to_mask import add_box
from jaxslam.semantics import Detections

_BOUNDS = (2.0, 98.0)
"""Percentiles of an object's points along each axis that bound its 3D box."""
_BEYOND = 0.05
"""Margin of the 3D box beyond these percentiles, as a share of its size."""
_FEWEST = 50
"""Fewest points of an object from which its size is estimated."""


class Neighbor(NamedTuple):
    """A frame shortly before a keyframe.

    Attributes:
        image: `(h, w, 3)` RGB or `(h, w)` gray image.
        depth: `(h, w)` depth image, meters.
        ignore: `(h, w)` mask of the pixels that are dynamic or may be.
        pose: `(7,)` pose of the frame in the tracker's world, or relative to the keyframe once it is returned by
            `Neighbors.before`.
    """

    image: np.ndarray
    depth: np.ndarray
    ignore: np.ndarray
    pose: np.ndarray


class Neighbors:
    """Some of the latest frames, evenly spaced."""

    def __init__(self, window: int, count: int) -> None:
        """Keep `count` of the latest `window` frames."""
        self._kept: deque[tuple[int, Neighbor]] = deque(maxlen=max(count, 1))
        self._every, self._window, self._count = max(1, window // max(count, 1)), window, count

    def see(
        self,
        frame: int,
        image: np.ndarray,
        depth: Float[np.ndarray, "h w"],
        ignore: Bool[np.ndarray, "h w"],
        pose: np.ndarray,
    ) -> None:
        """Add a tracked frame; only a frame that is kept is copied.

        Args:
            frame: Number of the frame.
            image: `(h, w, 3)` RGB or `(h, w)` gray image.
            depth: `(h, w)` depth image, meters.
            ignore: `(h, w)` mask of the pixels that are dynamic or may be.
            pose: `(7,)` pose of the frame in the tracker's world.
        """
        if self._count and frame % self._every == 0:
            self._kept.append((frame, Neighbor(image.copy(), depth.copy(), ignore.copy(), pose)))

    def before(self, frame: int, pose: np.ndarray) -> tuple[Neighbor, ...]:
        """Return the kept frames in the window before a keyframe, with poses relative to the keyframe."""
        return tuple(
            kept._replace(pose=between(pose, kept.pose))
            for number, kept in self._kept
            if frame - self._window <= number < frame
        )


def object_boxes(
    found: Detections, depth: Float32[np.ndarray, "_h _w"], view: DepthView
) -> Float32[np.ndarray, "k 2 3"]:
    """Return the 3D boxes (lower and upper corner) of the objects found in a keyframe, in the camera frame, meters.

    Args:
        found: Detections in the whole image.
        depth: `(_h, _w)` depth on the grid of the view, meters; 0 where it is missing or may be dynamic.
        view: The pixel grid of `depth`.
    """
    boxes: list[np.ndarray] = []
    for number, box in enumerate(found.boxes):
        mask = np.zeros(depth.shape, bool)
        if found.masks is None:
            add_box(mask, depth, box / view.step, float(view.intrinsics.fx))
        else:
            mask |= view.every(found.masks[number])
        inside = (mask & (depth > 0)).ravel()
        if inside.sum() < _FEWEST:
            continue
        low, high = np.percentile(view.points(depth, inside), _BOUNDS, axis=1)
        boxes.append(np.stack([low, high]) + _BEYOND * (high - low) * [[-1], [1]])
    return np.array(boxes, np.float32).reshape(-1, 2, 3)


def points_inside(
    boxes: Float32[np.ndarray, "k 2 3"], frame: Neighbor, view: DepthView
) -> tuple[Float32[np.ndarray, "3 n"], UInt8[np.ndarray, "3 n"]]:
    """Return the points of a frame inside 3D boxes, in the frame of the keyframe in meters, and their colors.

    Args:
        boxes: `(k, 2, 3)` lower and upper corners in the frame of the keyframe, meters.
        frame: The frame, with its pose relative to the keyframe.
        view: The pixel grid of the frame at full size.
    """
    X, colors = view.cloud(view.depth(frame.depth, frame.ignore), frame.image)
    X = transform(frame.pose, X).astype(np.float32)
    inside = np.zeros(X.shape[1], bool)
    for low, high in boxes:
        inside |= (np.abs(X - 0.5 * (low + high)[:, None]) < 0.5 * (high - low)[:, None]).all(axis=0)
    return X[:, inside], colors[:, inside]
