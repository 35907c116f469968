"""Smaller images: a mask needs no outline to the pixel, and half the width is a quarter of the work."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxslam_kernels.camera import Intrinsics
from jaxtyping import Bool, Shaped, UInt8

from jaxslam.runtime.aligned_memory import aligned_array
from jaxslam.sensors.camera import Camera


class ImageGrid(NamedTuple):
    """Where the pixels of an image lie.

    Attributes:
        shape: Its height and width.
        intrinsics: Of the camera, in its pixels.
    """

    shape: tuple[int, int]
    intrinsics: Intrinsics

    @classmethod
    def of(cls, camera: Camera) -> "ImageGrid":
        """The pixels of a camera's images."""
        return cls((camera.height, camera.width), camera.intrinsics(np.float32))


class Downscaler:
    """Every few pixels of larger images: their middle ones, counted from the top left corner.

    Attributes:
        step: A pixel of it in larger ones.
        raster: Its own pixels. Rows and columns of the larger image that make no whole pixel are left out.
    """

    def __init__(self, fine: ImageGrid, width: int) -> None:
        """Of about so many columns; never of more pixels than the larger images have."""
        self.step = max(1, round(fine.shape[1] / width))
        self._fine, self._offset = fine.shape, self.step // 2
        height, width = (max(1, side // self.step) for side in fine.shape)
        whole, scale, first = fine.intrinsics, np.float32(1 / self.step), np.float32(self._offset)
        self.raster = ImageGrid(
            (height, width),
            Intrinsics(
                whole.fx * scale,
                whole.fy * scale,
                (whole.cx - first) * scale,
                (whole.cy - first) * scale,
                whole.distortion,
            ),
        )

    def every(self, images: Shaped[np.ndarray, "... h w"]) -> Shaped[np.ndarray, "... _h _w"]:
        """Of images of the larger size, the pixels that are in it; a view of them."""
        (height, width), first = self.raster.shape, self._offset
        return images[..., first :: self.step, first :: self.step][..., :height, :width]

    def mean(self, gray: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "_h _w"]:
        """A smaller picture, each pixel the mean of those it stands for; a copy, aligned."""
        small = aligned_array(self.raster.shape, np.uint8)
        height, width = (side * self.step for side in self.raster.shape)
        cv2.resize(gray[:height, :width], self.raster.shape[::-1], dst=small, interpolation=cv2.INTER_AREA)
        return small

    def whole(self, mask: Bool[np.ndarray, "_h _w"]) -> Bool[np.ndarray, "h w"]:
        """A mask at the larger size; a copy."""
        if self.step == 1:
            return mask.copy()
        return cv2.resize(mask.view(np.uint8), self._fine[::-1], interpolation=cv2.INTER_NEAREST).view(bool)
