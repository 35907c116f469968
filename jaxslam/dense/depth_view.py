"""What the dense map sees of a keyframe: depth at a smaller size, cleaned, and the rays of its pixels."""

import math
from typing import NamedTuple

import cv2
import numpy as np
from jaxslam_kernels.camera import Intrinsics, normalize
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from jaxslam.runtime.compiled import compiled
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.downscale import Downscaler, ImageGrid

_EDGE_SHARE, _EDGE_M = 0.025, 0.04
"""Depth that differs by more around a pixel, a share for each pixel of the step and meters, is that of an outline:
there a sensor mixes near and far."""
_THREE = np.ones((3, 3), np.uint8)

_rays = compiled(when="warm-up")(normalize)


class Looks(NamedTuple):
    """Depth images as voxels are compared with them.

    Attributes:
        depth: `(..., h, w)` meters, 0 where missing.
        least: `(..., h, w)` the least around each pixel; 0 where some is missing.
    """

    depth: np.ndarray
    least: np.ndarray


class DepthView:
    """The pixels of a camera that the dense map uses.

    Attributes:
        step: One in so many.
        shape: Rows and columns of them.
        intrinsics: Of the camera in these pixels.
        rays: `(2, h w)` where the ray of each meets the plane one meter ahead.
        borders: `(2, 2)` left and top, right and bottom of all that any pixel may see, in that plane.
        nearest_m: Nearest depth believed.
        farthest_m: Farthest.
    """

    def __init__(self, camera: Camera, step: int, farthest_m: float, nearest_m: float) -> None:
        """Use one pixel in so many, and depth within bounds."""
        reduced = Downscaler(ImageGrid.of(camera), max(8, camera.width // step))
        self._begin((reduced,), farthest_m, nearest_m)

    def _begin(self, reduced: tuple[Downscaler, ...], farthest_m: float, nearest_m: float) -> None:
        """Use the pixels that are left when images are made smaller, one time after the other."""
        self._reduced = reduced
        self.step = math.prod(once.step for once in reduced)
        self.shape, intrinsics = reduced[-1].raster
        self.intrinsics: Intrinsics = intrinsics
        v, u = np.mgrid[: self.shape[0], : self.shape[1]].astype(np.float32)
        self.rays: Float32[np.ndarray, "2 n"] = np.array(_rays(self.intrinsics, np.stack([u.ravel(), v.ravel()])))
        pixel = 1 / np.array([self.intrinsics.fx, self.intrinsics.fy], np.float32)
        self.borders = np.stack([self.rays.min(axis=1) - pixel, self.rays.max(axis=1) + pixel])
        self.nearest_m, self.farthest_m = nearest_m, farthest_m

    def halved(self) -> "DepthView":
        """The view of every second of these pixels."""
        half = DepthView.__new__(DepthView)
        last = Downscaler(self._reduced[-1].raster, max(8, self.shape[1] // 2))
        half._begin((*self._reduced, last), self.farthest_m, self.nearest_m)
        return half

    def every(self, image: Shaped[np.ndarray, "*colors h w"]) -> Shaped[np.ndarray, "*colors _h _w"]:
        """The pixels of a larger image that are used; a view of them."""
        for once in self._reduced:
            image = once.every(image)
        return image

    def of_finer(self, image: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "_h _w"]:
        """The pixels used of an image of the view that this one was halved from."""
        return self._reduced[-1].every(image)

    def colors(self, image: np.ndarray) -> UInt8[np.ndarray, "3 n"]:
        """Colors of the pixels used, of an RGB or a gray image."""
        small = self.every(np.moveaxis(image, -1, 0)) if image.ndim == 3 else self.every(image)[None]
        return np.broadcast_to(small, (3, *self.shape)).reshape(3, -1)

    def cloud(
        self, depth: Float32[np.ndarray, "_h _w"], image: np.ndarray
    ) -> tuple[Float32[np.ndarray, "3 n"], UInt8[np.ndarray, "3 n"]]:
        """Points where there is depth, in the axes of the camera, with their colors."""
        seen = np.flatnonzero(depth)
        return self.points(depth, seen), self.colors(image)[:, seen]

    def points(
        self, depth: Float32[np.ndarray, "_h _w"], which: Shaped[np.ndarray, " k"]
    ) -> Float32[np.ndarray, "3 n"]:
        """Points of some of the pixels, a mask of all in a row or their numbers, in the axes of the camera."""
        z = depth.ravel()[which]
        return np.concatenate([self.rays[:, which] * z, z[None]])

    def is_believed(
        self, small: Float[np.ndarray, "_h _w"], ignore: Bool[np.ndarray, "_h _w"]
    ) -> Bool[np.ndarray, "_h _w"]:
        """Where depth of the pixels used is within bounds, and not ignored."""
        return cv2.inRange(small, np.array([self.nearest_m]), np.array([self.farthest_m])).view(bool) & ~ignore

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
        small = np.ascontiguousarray(small, np.float32)
        good = self.is_believed(small, ignore)
        small = np.where(good, small, np.float32(0))
        least, most = np.where(good, small, np.float32(2 * self.farthest_m)), small
        limit = _EDGE_SHARE * self.step * small + _EDGE_M
        most, least = _dilated(most), _eroded(least)
        outline = most - least >= limit
        # On a plane the inverse of depth is even: its mean is that of the plane.
        inverse = np.where(good, 1 / np.maximum(small, np.float32(self.nearest_m)), np.float32(0))
        count, total = (
            cv2.boxFilter(array, -1, (5, 5), normalize=False) for array in (good.astype(np.float32), inverse)
        )
        smooth = (_dilated(most) - _eroded(least) < limit) & good  # once more: five by five
        small = np.where(smooth, count / np.maximum(total, np.float32(1e-6)), small)
        return np.where(outline, np.float32(0), small)

    def looks(self, depth: Float32[np.ndarray, "_h _w"]) -> Looks:
        """A depth image of the size used, with what is least around each pixel."""
        return Looks(depth, _eroded(depth))

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


def _dilated(image: np.ndarray) -> np.ndarray:
    """The most of each pixel and the eight around it."""
    return cv2.dilate(image, _THREE)


def _eroded(image: np.ndarray) -> np.ndarray:
    """The least."""
    return cv2.erode(image, _THREE)


def _distorted(intrinsics: Intrinsics, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of normalized coordinates, by OpenCV."""
    K = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], np.float64)
    rays = np.concatenate([xy, np.ones_like(xy[:1])]).T.astype(np.float64)
    if not len(rays):
        return np.zeros(0), np.zeros(0)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.asarray(intrinsics.distortion, np.float64))
    return pixels[:, 0, 0], pixels[:, 0, 1]
