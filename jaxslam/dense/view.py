"""What the dense map sees of a keyframe: depth at a smaller size, cleaned, and the rays of its pixels."""

from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxslam_kernels.camera import Intrinsics, normalise
from jaxtyping import Bool, Float, Float32, Shaped

from jaxslam.camera import Camera
from jaxslam.masks.reduced import Raster, Reduced

_EDGE_SHARE, _EDGE_M = 0.025, 0.04
"""Depth that differs by more around a pixel, a share for each pixel of the step and metres, is that of an outline:
there a sensor mixes near and far."""


class Looks(NamedTuple):
    """Depth images as voxels are compared with them.

    Attributes:
        depth: `(..., h, w)` metres, 0 where missing.
        least: `(..., h, w)` the least around each pixel; 0 where some is missing.
    """

    depth: np.ndarray
    least: np.ndarray


class View:
    """The pixels of a camera that the dense map uses.

    Attributes:
        step: One in so many.
        shape: Rows and columns of them.
        intrinsics: Of the camera in these pixels.
        rays: `(2, h w)` where the ray of each meets the plane one metre ahead.
    """

    def __init__(self, camera: Camera, step: int, farthest_m: float, nearest_m: float) -> None:
        """Use one pixel in so many, and depth within bounds."""
        self._reduced = Reduced(Raster.of(camera), max(8, camera.width // step))
        self.step, self._bounds_m = self._reduced.step, (nearest_m, farthest_m)
        self.shape = self._reduced.raster.shape
        self.intrinsics: Intrinsics = self._reduced.raster.intrinsics
        v, u = np.mgrid[: self.shape[0], : self.shape[1]].astype(np.float32)
        self.rays: Float32[np.ndarray, "2 n"] = np.array(
            jax.jit(normalise)(self.intrinsics, np.stack([u.ravel(), v.ravel()]))
        )

    def every(self, image: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "_h _w"]:
        """The pixels of a larger image that are used; a view of them."""
        return self._reduced.every(image)

    def colours(self, image: np.ndarray) -> Float32[np.ndarray, "3 n"]:
        """Colours of the pixels used, of an RGB or a grey image."""
        small = self.every(np.moveaxis(image, -1, 0)) if image.ndim == 3 else self.every(image)[None]
        return np.broadcast_to(small, (3, *self.shape)).reshape(3, -1).astype(np.float32)

    def depth(self, depth: Float[np.ndarray, "h w"], ignore: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "_h _w"]:
        """Depth to be believed at the pixels used: within bounds, not ignored, not at an outline; else 0.

        It is smoothed over five by five of them where no outline is near: far away, noise is larger than voxels, and
        no centroid would be a mean.
        """
        return self.cleaned(self.every(depth), self.every(ignore))

    def cleaned(
        self, small: Float[np.ndarray, "_h _w"], ignore: Bool[np.ndarray, "_h _w"]
    ) -> Float32[np.ndarray, "_h _w"]:
        """The same of an image that has the pixels used only."""
        nearest_m, farthest_m = self._bounds_m
        with np.errstate(invalid="ignore"):
            good = (small >= nearest_m) & (small <= farthest_m) & ~ignore
        small = np.where(good, small, np.float32(0)).astype(np.float32, copy=False)
        least, most = np.where(good, small, np.float32(2 * farthest_m)), small
        limit = _EDGE_SHARE * self.step * small + _EDGE_M
        outline = _dilated(most, 3) - _eroded(least, 3) >= limit
        # On a plane the inverse of depth is even: its mean is that of the plane.
        inverse = np.where(good, 1 / np.maximum(small, np.float32(nearest_m)), np.float32(0))
        count, total = (
            cv2.boxFilter(array, -1, (5, 5), normalize=False) for array in (good.astype(np.float32), inverse)
        )
        smooth = (_dilated(most, 5) - _eroded(least, 5) < limit) & good
        small = np.where(smooth, count / np.maximum(total, np.float32(1e-6)), small)
        return np.where(outline, np.float32(0), small)

    def looks(self, depth: Float32[np.ndarray, "_h _w"]) -> Looks:
        """A depth image of the size used, with what is least around each pixel."""
        return Looks(depth, _eroded(depth, 3))

    def under(self, mask: Bool[np.ndarray, "h w"], X_cam: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, " n"]:
        """Which points, of pixels used and in the axes of the camera, a mask of the whole image covers."""
        small = self.every(mask)
        x, y = X_cam[:2] / np.maximum(X_cam[2], 1e-3)
        column, row = self.intrinsics.fx * x + self.intrinsics.cx, self.intrinsics.fy * y + self.intrinsics.cy
        if any(self.intrinsics.distortion.tolist()):
            column, row = _distorted(self.intrinsics, np.stack([x, y]))
        row = np.clip(np.rint(row), 0, self.shape[0] - 1).astype(np.intp)
        column = np.clip(np.rint(column), 0, self.shape[1] - 1).astype(np.intp)
        return small[row, column]


def _dilated(image: np.ndarray, side: int) -> np.ndarray:
    return cv2.dilate(image, np.ones((side, side), np.uint8))


def _eroded(image: np.ndarray, side: int) -> np.ndarray:
    return cv2.erode(image, np.ones((side, side), np.uint8))


def _distorted(intrinsics: Intrinsics, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of normalised coordinates, by OpenCV."""
    K = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], np.float64)
    rays = np.concatenate([xy, np.ones_like(xy[:1])]).T.astype(np.float64)
    if not len(rays):
        return np.zeros(0), np.zeros(0)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.asarray(intrinsics.distortion, np.float64))
    return pixels[:, 0, 0], pixels[:, 0, 1]
