"""The reduced, cleaned depth images of the dense map, and the rays of their pixels."""

import math
from typing import NamedTuple

import cv2
import numpy as np
from jaxslam_kernels.camera import Intrinsics, normalize
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from jaxslam.runtime.compiled import compiled
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.downscale import Downscaler, ImageGrid

_EDGE_SHARE, _EDGE_REACH = 0.025, 1 / 150
"""Difference of depth around a pixel above which it is on an outline, where a sensor mixes near and far depth: a share
of the depth per pixel of the step, plus a share of the farthest valid depth."""
_THREE = np.ones((3, 3), np.uint8)

_rays = compiled(when="warm-up")(normalize)


class Looks(NamedTuple):
    """Depth images in the form that voxels are compared with.

    Attributes:
        depth: `(..., h, w)` depth, meters; 0 where it is missing.
        least: `(..., h, w)` smallest depth of each pixel and its eight neighbors, meters; 0 if one of them is missing.
    """

    depth: np.ndarray
    least: np.ndarray


class DepthView:
    """The reduced pixel grid of a camera that the dense map uses.

    Attributes:
        step: Number of image pixels per grid pixel, along each axis.
        shape: Number of rows and columns of the grid.
        intrinsics: Intrinsics of the camera in pixels of the grid.
        rays: `(2, h w)` normalized image coordinates of the grid's pixels: where their rays meet the plane z = 1.
        borders: `(2, 2)` left and top, then right and bottom border of the view in normalized image coordinates.
        nearest_m: Smallest valid depth, meters.
        farthest_m: Largest valid depth, meters.
    """

    def __init__(self, camera: Camera, step: int, farthest_m: float, nearest_m: float) -> None:
        """Use every `step`-th pixel, and depth within bounds."""
        reduced = Downscaler(ImageGrid.of(camera), max(8, camera.width // step))
        self._begin((reduced,), farthest_m, nearest_m)

    def _begin(self, reduced: tuple[Downscaler, ...], farthest_m: float, nearest_m: float) -> None:
        """Use the pixels that remain after a chain of downscalers."""
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
        """Return the view with every second pixel of this one."""
        half = DepthView.__new__(DepthView)
        last = Downscaler(self._reduced[-1].raster, max(8, self.shape[1] // 2))
        half._begin((*self._reduced, last), self.farthest_m, self.nearest_m)
        return half

    def every(self, image: Shaped[np.ndarray, "*colors h w"]) -> Shaped[np.ndarray, "*colors _h _w"]:
        """Return a view of the pixels of a whole image that the grid uses."""
        for once in self._reduced:
            image = once.every(image)
        return image

    def of_finer(self, image: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "_h _w"]:
        """Return a view of the pixels of an image on the grid from which this one was halved."""
        return self._reduced[-1].every(image)

    def colors(self, image: np.ndarray) -> UInt8[np.ndarray, "3 n"]:
        """Return the colors of the grid's pixels in a whole RGB or gray image."""
        small = self.every(np.moveaxis(image, -1, 0)) if image.ndim == 3 else self.every(image)[None]
        return np.broadcast_to(small, (3, *self.shape)).reshape(3, -1)

    def cloud(
        self, depth: Float32[np.ndarray, "_h _w"], image: np.ndarray
    ) -> tuple[Float32[np.ndarray, "3 n"], UInt8[np.ndarray, "3 n"]]:
        """Return the points with depth, in the camera frame in meters, and their colors.

        Args:
            depth: `(_h, _w)` depth on the grid, meters; 0 where it is missing.
            image: `(h, w, 3)` RGB or `(h, w)` gray image, at full size.
        """
        seen = np.flatnonzero(depth)
        return self.points(depth, seen), self.colors(image)[:, seen]

    def points(
        self, depth: Float32[np.ndarray, "_h _w"], which: Shaped[np.ndarray, " k"]
    ) -> Float32[np.ndarray, "3 n"]:
        """Back-project some pixels of the grid into the camera frame, meters.

        Args:
            depth: `(_h, _w)` depth on the grid, meters.
            which: Mask or indices of the pixels, in row-major order.
        """
        z = depth.ravel()[which]
        return np.concatenate([self.rays[:, which] * z, z[None]])

    def is_believed(
        self, small: Float[np.ndarray, "_h _w"], ignore: Bool[np.ndarray, "_h _w"]
    ) -> Bool[np.ndarray, "_h _w"]:
        """Return the mask of the grid's pixels whose depth is within bounds and not ignored."""
        return cv2.inRange(small, np.array([self.nearest_m]), np.array([self.farthest_m])).view(bool) & ~ignore

    def depth(self, depth: Float[np.ndarray, "h w"], ignore: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "_h _w"]:
        """Return the valid depth on the grid: within bounds, not ignored, not on an outline; 0 elsewhere.

        Depth is averaged over five by five pixels where no outline is near. Without that, noise far away is larger than
        a voxel, and the centroid of a voxel would not be a mean over the noise.
        """
        return self.cleaned(self.every(depth), self.every(ignore))

    def cleaned(
        self, small: Float[np.ndarray, "_h _w"], ignore: Bool[np.ndarray, "_h _w"]
    ) -> Float32[np.ndarray, "_h _w"]:
        """Clean a depth image that is already on the grid, as in `depth`."""
        small = np.ascontiguousarray(small, np.float32)
        good = self.is_believed(small, ignore)
        small = np.where(good, small, np.float32(0))
        least, most = np.where(good, small, np.float32(2 * self.farthest_m)), small
        limit = _EDGE_SHARE * self.step * small + np.float32(_EDGE_REACH * self.farthest_m)
        most, least = _dilated(most), _eroded(least)
        outline = most - least >= limit
        # On a plane the inverse depth is linear in the pixel coordinates, so its mean is the value at the center.
        inverse = np.where(good, 1 / np.maximum(small, np.float32(self.nearest_m)), np.float32(0))
        count, total = (
            cv2.boxFilter(array, -1, (5, 5), normalize=False) for array in (good.astype(np.float32), inverse)
        )
        smooth = (_dilated(most) - _eroded(least) < limit) & good  # dilated twice: five by five
        small = np.where(smooth, count / np.maximum(total, np.float32(1e-6)), small)
        return np.where(outline, np.float32(0), small)

    def looks(self, depth: Float32[np.ndarray, "_h _w"]) -> Looks:
        """Return a depth image on the grid with the smallest depth around each pixel."""
        return Looks(depth, _eroded(depth))

    def under(self, mask: Bool[np.ndarray, "h w"], X_cam: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, " n"]:
        """Return which points of the grid's pixels a mask of the whole image covers.

        Args:
            mask: `(h, w)` mask at full size.
            X_cam: `(3, n)` points in the camera frame, meters.
        """
        small = self.every(mask)
        x, y = X_cam[:2] / np.maximum(X_cam[2], 1e-3)
        column, row = self.intrinsics.fx * x + self.intrinsics.cx, self.intrinsics.fy * y + self.intrinsics.cy
        if self.intrinsics.distortion is not None and any(self.intrinsics.distortion.tolist()):
            column, row = _distorted(self.intrinsics, np.stack([x, y]))
        row = np.clip(np.rint(row), 0, self.shape[0] - 1).astype(np.intp)
        column = np.clip(np.rint(column), 0, self.shape[1] - 1).astype(np.intp)
        return small[row, column]


def _dilated(image: np.ndarray) -> np.ndarray:
    """Return the largest value of each pixel and its eight neighbors."""
    return cv2.dilate(image, _THREE)


def _eroded(image: np.ndarray) -> np.ndarray:
    """Return the smallest value of each pixel and its eight neighbors."""
    return cv2.erode(image, _THREE)


def _distorted(intrinsics: Intrinsics, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distorted columns and rows of `(2, n)` normalized image coordinates (OpenCV), pixels."""
    K = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], np.float64)
    rays = np.concatenate([xy, np.ones_like(xy[:1])]).T.astype(np.float64)
    if not len(rays):
        return np.zeros(0), np.zeros(0)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.asarray(intrinsics.distortion, np.float64))
    return pixels[:, 0, 0], pixels[:, 0, 1]
