"""Divide a mask into objects: connected components without depth steps."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8

from jaxslam.dynamics.object_motion import INERT
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
        labels: `(h, w)` number of the object at each pixel, from 1, the largest first, plus `INERT` for an object that
            does not move by itself; 0 where there is none.
        rest: `(h, w)` mask of the pixels of the mask that are in no object, without those of inert objects.
    """

    labels: UInt8[np.ndarray, "h w"]
    rest: Bool[np.ndarray, "h w"]


class InstanceFinder:
    """Divides masks of one camera's images into objects, and recalls which of them are inert.

    In a frame that the detector looked at, the objects are those that it found; otherwise, depth divides the mask. An
    object is inert if most of it is where the detector found objects that do not move by themselves or, in a frame
    without a detection, where such objects were in the frame before.
    """

    def __init__(self, camera: Camera, most: int) -> None:
        """Find at most `most` objects in an image of a camera, up to 127."""
        self._reduced, self._most = Downscaler(ImageGrid.of(camera), _WIDTH_PX), most
        self._inert = np.zeros(self._reduced.raster.shape, bool)

    def divided(
        self,
        mask: Bool[np.ndarray, "h w"],
        depth: Float[np.ndarray, "h w"],
        detected: UInt8[np.ndarray, "_h _w"] | None = None,
        age: int = 0,
    ) -> Instances:
        """Divide a mask into objects.

        Args:
            mask: `(h, w)` mask of the movable objects.
            depth: `(h, w)` depth image, meters; 0 where depth is missing.
            detected: `(h', w')` number of the detected object at each pixel, as in `instance_labels`, at the size of
                masks; `None` if nothing was detected since the last call.
            age: Number of frames since the one that `detected` is of.
        """
        if detected is not None:
            self._inert = detected >= INERT
        if not mask.any():
            self._inert = np.zeros_like(self._inert)
            return Instances(np.zeros(mask.shape, np.uint8), np.zeros(mask.shape, bool))
        mask_px = self._reduced.every(mask)
        if detected is not None and age == 0 and detected.any():
            small = _numbered(detected % INERT, mask_px, self._most)
        else:
            small = object_labels(mask_px, self._reduced.every(depth), self._most)
        if self._inert.any():
            small = self._with_inert(small, mask_px)
        # Rows and columns beyond the last whole pixel of the reduced image are in no object.
        whole = np.zeros(mask.shape, np.uint8)
        step = self._reduced.step
        large = np.repeat(np.repeat(small, step, axis=0), step, axis=1)
        whole[: large.shape[0], : large.shape[1]] = large
        whole[~mask] = 0
        rest = mask & (whole == 0)
        return Instances(whole, rest & ~self._reduced.whole(self._inert) if self._inert.any() else rest)

    def _with_inert(
        self, labels: UInt8[np.ndarray, "_h _w"], mask: Bool[np.ndarray, "_h _w"]
    ) -> UInt8[np.ndarray, "_h _w"]:
        """Add `INERT` to the numbers of inert objects, and recall where they are."""
        area, inert = (np.bincount(pixels, minlength=INERT) for pixels in (labels.ravel(), labels[self._inert]))
        is_inert = 2 * inert > area
        is_inert[0] = False
        self._inert = np.where(labels > 0, is_inert[labels], self._inert & mask)
        return labels + np.uint8(INERT) * is_inert[labels]


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
    _, pieces = cv2.connectedComponents(inside.view(np.uint8), connectivity=4)
    return _numbered(np.asarray(pieces, np.int32), mask, most)


def _numbered(pieces: Integer[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], most: int) -> UInt8[np.ndarray, "h w"]:
    """Number parts of a mask from 1, the largest first, without small ones; the mask around a part belongs to it."""
    area = np.bincount(pieces.ravel(), minlength=2)
    area[0] = 0
    by_size = np.argsort(-area)[:most]
    large = by_size[area[by_size] >= _MIN * mask.size]
    number = np.zeros(len(area), np.uint8)
    number[large] = np.arange(1, len(large) + 1)
    labels = number[pieces]
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
