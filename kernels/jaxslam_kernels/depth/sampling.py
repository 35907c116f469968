"""Reading depth at points, without being fooled by edges and holes."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.types import DepthImage, Mask, Pixels, Scalar, Weights

_OUTSIDE_PX = 2**20
"""Farther from the first pixel than the sides of any image."""


@checked
def valid_depth(
    depth: Float[Array, "*shape"], nearest: Scalar | float, farthest: Scalar | float
) -> Float[Array, "*shape"]:
    """Depth in meters where it is a number between `nearest` and `farthest`, 0 elsewhere."""
    inside = (depth > nearest) & (depth < farthest)
    return jnp.where(inside, depth, 0)


@checked
def sample_depth(
    depth: DepthImage,
    uv: Pixels,
    *,
    reach: int = 1,
    max_step: float = 0.05,
    noise: Scalar | float = 0.0,
    nearest: Scalar | float = 0.0,
    farthest: Scalar | float = float("inf"),
) -> Weights:
    """Depth at the nearest pixel, or 0 where its surroundings do not agree.

    Differentiable in the depth image; in `uv` the derivative is zero, because the nearest pixel stays the same.

    Args:
        depth: Depth image in meters, at least as large as the surroundings; 0 or NaN where missing.
        uv: `(2, n)` pixel coordinates. Where one is not a number, or the surroundings leave the image, the result is 0.
        reach: The surroundings are `2 * reach + 1` pixels a side, and all must have depth; static.
        max_step: Largest difference of depth in them, as a share of the depth in the middle,
        noise: and so much more, in the unit of the depth, which noise alone makes at any depth.
        nearest: Depth at or below which there is none to believe, meters, 0 or more, and
        farthest: depth from which on there is none. The result is that of `valid_depth` on the whole image first,
            which takes 0.2 ms for 640x480 pixels.
    """
    around = _surroundings(depth, uv, reach)
    low, high = jnp.min(around, axis=1), jnp.max(around, axis=1)
    middle = around[:, around.shape[1] // 2]
    smooth = (low > nearest) & (high < farthest) & (high - low <= max_step * middle + noise)
    return jnp.where(smooth, middle, 0)


@checked
def lacks_depth(
    depth: DepthImage,
    uv: Pixels,
    *,
    reach: int,
    nearest: Scalar | float = 0.0,
    farthest: Scalar | float = float("inf"),
) -> Mask:
    """Tell around which pixels no depth is measured at all.

    What is out of the reach of a sensor has a wide hole, while that along a silhouette is narrow.

    Args:
        depth: Depth image in meters, at least as large as the surroundings; 0 or NaN where missing.
        uv: `(2, n)` pixel coordinates. Where one is not a number, or the surroundings leave the image, nothing is
            measured.
        reach: The surroundings are `2 * reach + 1` pixels a side; static.
        nearest: Depth at or below which there is none to believe, meters, 0 or more, and
        farthest: depth from which on there is none.
    """
    around = _surroundings(depth, uv, reach)
    return ~jnp.any((around > nearest) & (around < farthest), axis=1)


def _surroundings(depth: DepthImage, uv: Pixels, reach: int) -> Float[Array, "n m"]:
    """Depths in the square windows around pixels; 0 where a window leaves the image or a pixel is not a number."""
    side = 2 * reach + 1
    # Far outside where it is not a number, and never so far that the conversion to integers overflows.
    center = lax.stop_gradient(jnp.where(jnp.abs(uv) < _OUTSIDE_PX, jnp.round(uv), -_OUTSIDE_PX)).astype(jnp.int32)
    return apart(lambda: _windows(depth, center[::-1].T - reach, side)).reshape(-1, side * side)


def _windows(depth: DepthImage, corner: Int[Array, "n 2"], side: int) -> Float[Array, "n s s"]:
    """Square windows from their top-left corners, row and column; 0 where one leaves the image."""
    numbers = lax.GatherDimensionNumbers(offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1))
    return lax.gather(depth, corner, numbers, (side, side), mode=lax.GatherScatterMode.FILL_OR_DROP, fill_value=0)
