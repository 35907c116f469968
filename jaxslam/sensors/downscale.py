"""Smaller images for masks: a mask need not be exact to the pixel, and half the width is a quarter of the work."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxslam_kernels.camera import Intrinsics
from jaxtyping import Bool, Shaped, UInt8

from jaxslam.runtime.aligned_memory import aligned_array
from jaxslam.sensors.camera import Camera


class ImageGrid(NamedTuple):
    """The pixel grid of an image.

    Attributes:
        shape: Height and width in pixels.
        intrinsics: Intrinsics of the camera in pixels of this grid.
    """

    shape: tuple[int, int]
    intrinsics: Intrinsics

    @classmethod
    def of(cls, camera: Camera) -> "ImageGrid":
        """Return the pixel grid of a camera's images."""
        return cls((camera.height, camera.width), camera.intrinsics(np.float32))


class Downscaler:
    """Subsampling of images by an integer step: each small pixel is the middle one of its block.

    Attributes:
        step: Side of a block, in pixels of the large image.
        raster: The pixel grid of the small image. Rows and columns of the large image that fill no block are left out.
    """

    def __init__(self, fine: ImageGrid, width: int) -> None:
        """Choose the step for a small image of about `width` columns; a small image is never the larger one.

        Args:
            fine: The pixel grid of the large images.
            width: Desired width of the small image in pixels.
        """
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
        """Return a view of the pixels of large images that are in the small one."""
        (height, width), first = self.raster.shape, self._offset
        return images[..., first :: self.step, first :: self.step][..., :height, :width]

    def mean(self, gray: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "_h _w"]:
        """Return a smaller image, each pixel the mean of its block; an aligned copy."""
        small = aligned_array(self.raster.shape, np.uint8)
        height, width = (side * self.step for side in self.raster.shape)
        cv2.resize(gray[:height, :width], self.raster.shape[::-1], dst=small, interpolation=cv2.INTER_AREA)
        return small

    def whole(self, mask: Bool[np.ndarray, "_h _w"]) -> Bool[np.ndarray, "h w"]:
        """Return a small mask enlarged to the size of the large image; a copy."""
        if self.step == 1:
            return mask.copy()
        return cv2.resize(mask.view(np.uint8), self._fine[::-1], interpolation=cv2.INTER_NEAREST).view(bool)
