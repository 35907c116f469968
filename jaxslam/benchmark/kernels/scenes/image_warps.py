"""Pairs of images with known motion: a real picture, warped by homographies, with noise."""

from typing import Any, NamedTuple

import cv2
import numpy as np
from skimage.data import camera, stereo_motorcycle


class Warp(NamedTuple):
    """Two gray images and the homography from pixels of the first to pixels of the second."""

    previous: np.ndarray
    current: np.ndarray
    homography: np.ndarray

    def move(self, points: np.ndarray) -> np.ndarray:
        """Map `(2, n)` points of the first image to the second."""
        moved = self.homography @ np.vstack([points, np.ones_like(points[:1])])
        return moved[:2] / moved[2]

    def visible(self, points: np.ndarray) -> np.ndarray:
        """Tell which points stay inside the image."""
        height, width = self.current.shape
        u, v = self.move(points)
        return (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)


def picture(width: int, height: int) -> np.ndarray:
    """The middle of a real picture that comes with scikit-image; nothing is downloaded. At most 741x500."""
    if width > 256:
        source = cv2.cvtColor(stereo_motorcycle()[0], cv2.COLOR_RGB2GRAY)
    else:
        source = cv2.resize(camera(), (256, 256), interpolation=cv2.INTER_AREA)
    top, left = (source.shape[0] - height) // 2, (source.shape[1] - width) // 2
    return np.ascontiguousarray(source[top : top + height, left : left + width])


def homography(rng: np.random.Generator, width: int, height: int, shift_px: float) -> np.ndarray:
    """A rotation of up to 2.5 degrees, a scale of up to 3 %, some perspective, and a shift of `shift_px`."""
    angle, scale = rng.uniform(-0.045, 0.045), rng.uniform(0.97, 1.03)
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    direction = rng.uniform(0, 2 * np.pi)
    shift = shift_px * np.array([np.cos(direction), np.sin(direction)])
    about_center = np.array([[cos, -sin, shift[0]], [sin, cos, shift[1]], [*rng.uniform(-3e-5, 3e-5, 2), 1]])
    to_center = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1]])
    return np.linalg.inv(to_center) @ about_center @ to_center


def warp(image: np.ndarray, shift_px: float, seed: int, noise: float = 2.0) -> Warp:
    """`image` moved by a random homography, both 8 bit."""
    rng = np.random.default_rng(seed)
    height, width = image.shape
    H = homography(rng, width, height, shift_px)
    moved = cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    noisy = np.clip(moved + rng.normal(0, noise, moved.shape), 0, 255)
    return Warp(image, noisy.round().astype(np.uint8), H)


def corners(image: np.ndarray, n: int, distance: float = 7) -> np.ndarray:
    """The `n` best corners as `(2, n)`; the weaker ones are textured just enough."""
    found: Any = cv2.goodFeaturesToTrack(image, n, 0.001, distance)
    points = found[:, 0].T
    assert points.shape == (2, n)
    return np.ascontiguousarray(points)
