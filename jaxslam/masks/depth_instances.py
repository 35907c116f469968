"""Divide a mask into objects: connected components without depth steps."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxslam.sensors.camera import Camera
from jaxslam.sensors.downscale import Downscaler, ImageGrid

_WIDTH_PX = 320
_STEP = 0.055
"""Difference of depth between neighboring pixels that separates objects, as a share of the depth."""
_MIN = 0.002
"""Smallest share of the image that an object covers; a smaller one has too few points for a motion estimate."""
_REACH_PX = 4
"""Distance up to which mask pixels without depth or in small components belong to the nearest object, pixels."""


class Instances(NamedTuple):
    """A mask divided into objects.

    Attributes:
        labels: `(h, w)` number of the object at each pixel, from 1, the largest first; 0 where there is none.
        rest: `(h, w)` mask of the pixels of the mask that are in no object.
    """

    labels: UInt8[np.ndarray, "h w"]
    rest: Bool[np.ndarray, "h w"]


class InstanceFinder:
    """Divides masks of one camera's images into objects."""

    def __init__(self, camera: Camera, most: int) -> None:
        """Find at most `most` objects in an image of a camera, up to 255."""
        self._reduced, self._most = Downscaler(ImageGrid.of(camera), _WIDTH_PX), most

    def divided(self, mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"]) -> Instances:
        """Divide a mask into objects.

        Args:
            mask: `(h, w)` mask of the movable objects.
            depth: `(h, w)` depth image, meters; 0 where depth is missing.
        """
        if not mask.any():
            return Instances(np.zeros(mask.shape, np.uint8), np.zeros(mask.shape, bool))
        small = object_labels(self._reduced.every(mask), self._reduced.every(depth), self._most)
        # Rows and columns beyond the last whole pixel of the reduced image are in no object.
        whole = np.zeros(mask.shape, np.uint8)
        step = self._reduced.step
        large = np.repeat(np.repeat(small, step, axis=0), step, axis=1)
        whole[: large.shape[0], : large.shape[1]] = large
        whole[~mask] = 0
        return Instances(whole, mask & (whole == 0))


def object_labels(
    mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], most: int
) -> UInt8[np.ndarray, "h w"]:
    """Number the object at each pixel of a mask, from 1, the largest first; 0 for none.

    Args:
        mask: `(h, w)` mask of the movable objects.
        depth: `(h, w)` depth image, meters; 0 where depth is missing.
        most: Largest number of objects; the smallest are left out.
    """
    inside = mask & (depth > 0) & ~_steps(depth)
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(inside.view(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    by_size = np.argsort(-area)[:most]
    large = by_size[area[by_size] >= _MIN * mask.size]
    number = np.zeros(len(area), np.uint8)
    number[large] = np.arange(1, len(large) + 1)
    labels = number[np.asarray(pieces, np.int32)]
    around = cv2.dilate(labels, np.ones((2 * _REACH_PX + 1,) * 2, np.uint8))
    return np.where(labels > 0, labels, np.where(mask, around, 0)).astype(np.uint8)


def _steps(depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels whose right or lower neighbor is across a depth step."""
    steps = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        before = depth[:-1] if axis == 0 else depth[:, :-1]
        apart = np.abs(np.diff(depth, axis=axis)) > _STEP * before
        (steps[:-1] if axis == 0 else steps[:, :-1])[...] |= apart
    return steps
