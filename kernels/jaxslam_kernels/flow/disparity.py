"""Disparities of points of a rectified pair of images: where a point of the left image lies in the right one.

Optical flow from left to right that stays in its row, and back again. The right camera stands to the right of the left
one, so that a point lies further left in its image: `u_left - u_right = disparity >= 0`, and depth is
`focal length * baseline / disparity`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxslam_kernels.checks import checked
from jaxslam_kernels.flow.lk_flow import lk_flow_forward_backward
from jaxslam_kernels.flow.lk_search import FlowPlan, LevelPlan
from jaxslam_kernels.image.pyramid import Pyramid
from jaxslam_kernels.types import Mask, Pixels, Scalar, Weights

ROW_PLAN = FlowPlan(
    coarsest=LevelPlan(11, 6, 0.1), middle=LevelPlan(11, 4, 0.1), finest=LevelPlan(13, 8, 0.02), along_rows=True
)
"""For pyramids of two levels or so, with a guess that is good to a few pixels."""


class Disparities(NamedTuple):
    """Disparities of points of the left image.

    Attributes:
        disparity: `(n,)` disparity in pixels; 0 where it was not found.
        found: `(n,)` true where it was found and the search back ended at the point.
        residual: `(n,)` mean absolute difference of intensity over the window, from the mean difference.
    """

    disparity: Weights
    found: Mask
    residual: Weights


@checked
def row_disparities(
    left: Pyramid,
    right: Pyramid,
    points: Pixels,
    guess: Weights,
    mask: Mask | None = None,
    *,
    max_return_px: Scalar | float = 0.5,
    expected_px: Scalar | float = 0.0,
    least: Scalar | float = 0.1,
    plan: FlowPlan = ROW_PLAN,
    min_texture: Scalar | float = 4.0,
) -> Disparities:
    """Match points of the left image along their rows of the right one, to a fraction of a pixel.

    Differentiable in both images and in `points` as `lk_flow` is, by the implicit function theorem. A difference in
    brightness between the images, constant over a window, has no influence.

    Args:
        left: Pyramid of the left image.
        right: Pyramid of the right image, of the same sizes.
        points: `(2, n)` pixels in the left image.
        guess: `(n,)` about what the disparity is, to twice as many pixels as the coarsest level is smaller.
        mask: `(n,)` which points to match; all if not given.
        max_return_px: Maximum distance from the point at which the search back may end: the left-right check of stereo.
        expected_px: A match within so many pixels of its guess is taken without a way back, for guesses that come from
            elsewhere than these images.
        least: Smallest disparity that is one, pixels: smaller ones are those of points too far to tell.
        plan: Windows and iterations, static; `along_rows` has to be set.
        min_texture: Smallest accepted mean of the squared gradient along the row, in squared intensity a squared pixel.

    Returns:
        Disparities, finite whatever the images hold.
    """
    shift = jnp.where(jnp.isfinite(guess), guess, 0)
    start = points - jnp.stack([shift, jnp.zeros_like(shift)])
    flow = lk_flow_forward_backward(
        left,
        right,
        points,
        lax.stop_gradient(start),
        mask,
        max_return_px=max_return_px,
        expected_px=expected_px,
        plan=plan,
        min_texture=min_texture,
    )
    disparity = points[0] - flow.points[0]
    found = flow.ok & (disparity > least)
    return Disparities(jnp.where(found, disparity, 0), found, flow.residual)
