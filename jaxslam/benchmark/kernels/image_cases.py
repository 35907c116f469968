"""Kernels on images beside OpenCV: pyramid, corners, optical flow."""

import math
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.flow.lk_flow import lk_flow
from jaxslam_kernels.image.corners import Corners, corner_score, grid_corners
from jaxslam_kernels.image.pyramid import build_pyramid

from jaxslam.benchmark.kernels.case import Case, Problem
from jaxslam.benchmark.kernels.scenes.image_warps import corners, picture, warp
from jaxslam.benchmark.reference_flow import LEVELS, WINDOW_PX, opencv_flow

_BORDER, _CELLS_A_ROW = 16, 32
_BATCH_POINTS, _SHIFT_PX = 256, 10.0


def _sides(num_pixels: int) -> tuple[int, int]:
    """Width and height of a 4:3 image."""
    width = round(math.sqrt(num_pixels * 4 / 3))
    return width, width * 3 // 4


def _resolution(num_pixels: int) -> str:
    return "{}x{}".format(*_sides(num_pixels))


def _picture(num_pixels: int) -> np.ndarray:
    """The same picture at any size."""
    return cv2.resize(picture(640, 480), _sides(num_pixels), interpolation=cv2.INTER_AREA)


def _pyramid(num_pixels: int) -> Problem:
    image = _picture(num_pixels)

    def difference(ours: Any, theirs: Any) -> float:
        inside = [np.asarray(level)[_BORDER:-_BORDER, _BORDER:-_BORDER] for level in ours]
        return max(float(np.abs(a - b).max()) for a, b in zip(inside, theirs[1], strict=True))

    return Problem(
        lambda image: build_pyramid(image, num_levels=LEVELS, border=_BORDER).levels,
        (image,),
        lambda: cv2.buildOpticalFlowPyramid(image, (WINDOW_PX, WINDOW_PX), LEVELS - 1, withDerivatives=False),
        difference,
    )


def _corners(num_pixels: int) -> Problem:
    image = _picture(num_pixels)
    (width, height), cell = _sides(num_pixels), _sides(num_pixels)[0] // _CELLS_A_ROW
    count = (width // cell) * (height // cell)

    def ours(image: Any, allowed: Any) -> Corners:
        return grid_corners(corner_score(image.astype(jnp.float32)), allowed, cell=cell)

    def difference(ours: Any, theirs: Any) -> float:
        """Between the best of both in every cell that has one of theirs: they come best first."""
        found = theirs[:, 0].T
        u, v = (found // cell).astype(int)
        cells, first = np.unique(v * (width // cell) + u, return_index=True)
        return float(np.median(np.linalg.norm(found[:, first] - np.asarray(ours.points)[:, cells], axis=0)))

    return Problem(
        ours,
        (image, np.ones(image.shape, bool)),
        lambda: cv2.goodFeaturesToTrack(image, count, qualityLevel=0.01, minDistance=cell / 2, blockSize=5),
        difference,
    )


def _flow_of(previous: Any, current: Any, points: Any) -> Any:
    """Positions, from the images on: both pyramids are part of it, as they are of OpenCV's."""
    return lk_flow(build_pyramid(previous), build_pyramid(current), points).points


def moving_corners(num_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two pictures of 640x480, and corners `(2, num_points)` of the first, which move 10 px to the second."""
    previous, current, _ = warp(picture(640, 480), _SHIFT_PX, 2)
    return previous, current, corners(previous, num_points)


def _median_distance(ours: Any, theirs: Any) -> float:
    """Between `(2, n)` of ours and `(n, 2)` of theirs."""
    return float(np.median(np.linalg.norm(np.asarray(ours).T - theirs, axis=1)))


def _flow(num_points: int) -> Problem:
    previous, current, points = moving_corners(num_points)
    rows = np.ascontiguousarray(points.T)
    return Problem(
        _flow_of, (previous, current, points), lambda: opencv_flow(previous, current, rows), _median_distance
    )


def _flow_batch(num_pairs: int) -> Problem:
    previous = picture(320, 240)
    current = np.stack([warp(previous, _SHIFT_PX, seed).current for seed in range(num_pairs)])
    points = corners(previous, _BATCH_POINTS)
    rows = np.ascontiguousarray(points.T)
    repeated = np.repeat(previous[None], num_pairs, axis=0), current, np.repeat(points[None], num_pairs, axis=0)
    return Problem(
        jax.vmap(_flow_of),
        repeated,
        lambda: [opencv_flow(previous, image, rows) for image in current],
        lambda ours, theirs: float(np.median([_median_distance(a, b) for a, b in zip(ours, theirs, strict=True)])),
    )


_PIXELS = (320 * 240, 640 * 480, 1280 * 960, 2560 * 1920)
_LK = "21x21 windows, 4 levels, both pyramids included; OpenCV stops after 10 iterations or a step of 0.03 px"

IMAGE_CASES = (
    Case(
        name="image_pyramid",
        axis="pixels",
        sizes=_PIXELS,
        reference="cv2.buildOpticalFlowPyramid",
        compared="4 levels of a gray image, without derivatives; ours are floating point, OpenCV's are bytes",
        difference="largest difference of a pixel, gray levels",
        limit=2.0,
        problem=_pyramid,
        label=_resolution,
    ),
    Case(
        name="corners",
        axis="pixels",
        sizes=_PIXELS,
        reference="cv2.goodFeaturesToTrack",
        compared="corners of Shi and Tomasi, 5x5 windows: the best of each cell of a grid 32 wide, OpenCV's best as"
        " many that are half a cell apart",
        difference="median distance of the best in a cell, px",
        limit=1.5,
        problem=_corners,
        label=_resolution,
    ),
    Case(
        name="lk_flow",
        axis="points",
        sizes=(64, 200, 640, 2000),
        reference="cv2.calcOpticalFlowPyrLK",
        compared=f"optical flow of corners of 640x480 that move 10 px, {_LK}",
        difference="median distance, px",
        limit=0.1,
        problem=_flow,
    ),
    Case(
        name="lk_flow_batch",
        axis="pairs of images",
        sizes=(1, 4, 16, 64),
        reference="cv2.calcOpticalFlowPyrLK in a loop",
        compared=f"vmap of the optical flow of {_BATCH_POINTS} corners of 320x240 that move 10 px, {_LK}",
        difference="median distance, px",
        limit=0.1,
        problem=_flow_batch,
    ),
)
