"""The fundamental matrix of two views beside OpenCV."""

import math
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.two_view.fundamental import ransac_fundamental

from jaxslam.benchmark.kernels.case import Case, Problem
from jaxslam.benchmark.kernels.scenes.two_views import TwoViewScene, make_two_views

OPENCV_PX, CONFIDENCE = 1.0, 0.99
SAME_BAND_PX = OPENCV_PX * math.sqrt(0.5)
"""A Sampson distance so large is a distance of one pixel to both epipolar lines, by which OpenCV decides."""


def fundamental_arguments(seed: int, scene: TwoViewScene, threshold_px: float) -> tuple[Any, ...]:
    """Key, pixels before and after, and threshold, for `ransac_fundamental` in single precision."""
    pixels = (jnp.asarray(x, jnp.float32) for x in (scene.uv_before, scene.uv_after))
    return jax.random.key(seed), *pixels, jnp.asarray(threshold_px, jnp.float32)


def opencv_fundamental(before: np.ndarray, after: np.ndarray, method: int = cv2.FM_RANSAC) -> tuple[Any, Any]:
    """Matrix and mask of `(n, 2)` pixels; no matrix and no mask if there is no consensus."""
    return cv2.findFundamentalMat(before, after, method, OPENCV_PX, CONFIDENCE)


def _fundamental(num_matches: int) -> Problem:
    scene = make_two_views(0, num_matches)
    before, after = scene.uv_before.T.copy(), scene.uv_after.T.copy()

    def ours(key: Any, before: Any, after: Any, threshold_px: Any) -> Any:
        return ransac_fundamental(key, before, after, threshold_px=threshold_px).F

    def difference(ours: Any, theirs: Any) -> float:
        return math.inf if theirs[0] is None else _found(theirs[0], scene) - _found(ours, scene)

    return Problem(
        ours,
        fundamental_arguments(0, scene, SAME_BAND_PX),
        lambda: opencv_fundamental(before, after),
        difference,
    )


def _found(F: Any, scene: TwoViewScene) -> float:
    """Share of the right matches within `OPENCV_PX` of the epipolar lines of a matrix, in both views."""
    before, after = (
        np.concatenate([uv, np.ones_like(uv[:1])])[:, ~scene.outlier] for uv in (scene.uv_before, scene.uv_after)
    )
    lines_after, lines_before = np.asarray(F, float) @ before, np.asarray(F, float).T @ after
    error = np.abs((after * lines_after).sum(axis=0))
    slope = np.minimum(np.linalg.norm(lines_after[:2], axis=0), np.linalg.norm(lines_before[:2], axis=0))
    return float(np.mean(error < OPENCV_PX * slope))


TWO_VIEW_CASES = (
    Case(
        name="ransac_fundamental",
        axis="matches",
        sizes=(60, 250, 500, 1000, 4000),
        reference="cv2.findFundamentalMat",
        compared="matches of two views with half a pixel of noise in each, half of them wrong; ours 640 samples, each"
        " scored, and refinement, OpenCV's RANSAC up to 1000 and early stopping at 99 %; both count what is within"
        f" {OPENCV_PX:g} px of its epipolar lines",
        difference="share of the right matches that are so near to the lines of the matrix found, OpenCV's minus ours:"
        " negative where ours has more of them",
        limit=0.05,
        problem=_fundamental,
    ),
)
