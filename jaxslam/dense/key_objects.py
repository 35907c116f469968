"""Key objects at full density: points inside them from a keyframe and from frames shortly before it.

Source: RTS-SLAM (Sensors 2026), Algorithm 2, lines 5 to 14. The paper finds "corresponding object regions" in the
neighbors and does not say how. Here the network looks at the keyframe alone; depth in its boxes gives each object a
box in space, and what neighbors see in that is of the object. So a neighbor costs no look of the network, and what
stands before or behind an object stays out in all frames.
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
"""Percentiles of an object's points, along each axis, between which its box is,"""
_BEYOND_M = 0.03
"""and how far it reaches beyond."""
_FEWEST = 50
"""Points of an object with fewer say nothing of its size."""


class Neighbor(NamedTuple):
    """A frame before a keyframe.

    Attributes:
        image: `(h, w, 3)` or `(h, w)`.
        depth: `(h, w)` meters.
        ignore: `(h, w)` where something moves or may.
        pose: `(7,)` where the tracker had it; seen from the keyframe once it goes with one.
    """

    image: np.ndarray
    depth: np.ndarray
    ignore: np.ndarray
    pose: np.ndarray


class Neighbors:
    """Some of the latest frames, evenly spread."""

    def __init__(self, window: int, count: int) -> None:
        """Keep so many out of the latest `window` frames."""
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
        """Take in a frame that was tracked; it is copied if it is one of those kept."""
        if self._count and frame % self._every == 0:
            self._kept.append((frame, Neighbor(image.copy(), depth.copy(), ignore.copy(), pose)))

    def before(self, frame: int, pose: np.ndarray) -> tuple[Neighbor, ...]:
        """Those in the window before a keyframe, as seen from it."""
        return tuple(
            kept._replace(pose=between(pose, kept.pose))
            for number, kept in self._kept
            if frame - self._window <= number < frame
        )


def object_boxes(
    found: Detections, depth: Float32[np.ndarray, "_h _w"], view: DepthView
) -> Float32[np.ndarray, "k 2 3"]:
    """Boxes in space, in the axes of the camera, of what was found in a keyframe.

    Args:
        found: In the whole image.
        depth: Of the pixels that the view uses, 0 where something may move.
        view: Those pixels.
    """
    boxes: list[np.ndarray] = []
    for number, box in enumerate(found.boxes):
        mask = np.zeros(depth.shape, bool)
        if found.masks is None:
            add_box(mask, depth, box / view.step)
        else:
            mask |= view.every(found.masks[number])
        inside = (mask & (depth > 0)).ravel()
        if inside.sum() < _FEWEST:
            continue
        low, high = np.percentile(view.points(depth, inside), _BOUNDS, axis=1)
        boxes.append(np.stack([low - _BEYOND_M, high + _BEYOND_M]))
    return np.array(boxes, np.float32).reshape(-1, 2, 3)


def points_inside(
    boxes: Float32[np.ndarray, "k 2 3"], frame: Neighbor, view: DepthView
) -> tuple[Float32[np.ndarray, "3 n"], UInt8[np.ndarray, "3 n"]]:
    """Points of a frame inside boxes, in the axes of the keyframe, with their colors.

    Args:
        boxes: In the axes of the keyframe.
        frame: Seen from there.
        view: All pixels of its image.
    """
    X, colors = view.cloud(view.depth(frame.depth, frame.ignore), frame.image)
    X = transform(frame.pose, X).astype(np.float32)
    inside = np.zeros(X.shape[1], bool)
    for low, high in boxes:
        inside |= (np.abs(X - 0.5 * (low + high)[:, None]) < 0.5 * (high - low)[:, None]).all(axis=0)
    return X[:, inside], colors[:, inside]
