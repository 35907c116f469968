"""Reading depth at points, without being fooled by edges and holes."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import DepthImage, Pixels, Scalar, Weights

_NOISE_M = 0.02
"""A difference that noise alone makes, at any depth."""


@checked
def valid_depth(
    depth: Float[Array, "*shape"], nearest: Scalar | float, farthest: Scalar | float
) -> Float[Array, "*shape"]:
    """Depth in meters where it is a number between `nearest` and `farthest`, 0 elsewhere."""
    inside = (depth > nearest) & (depth < farthest)
    return jnp.where(inside, depth, 0)


@checked
def sample_depth(depth: DepthImage, uv: Pixels, *, reach: int = 1, max_step: float = 0.05) -> Weights:
    """Depth at the nearest pixel, or 0 where its surroundings do not agree.

    Differentiable in the depth image; in `uv` the derivative is zero, because the nearest pixel stays the same.

    Args:
        depth: Depth image in meters, at least as large as the surroundings; 0 or NaN where missing.
        uv: `(2, n)` pixel coordinates. Where one is not a number, or the surroundings leave the image, the result is 0.
        reach: The surroundings are `2 * reach + 1` pixels a side, and all must have depth; static.
        max_step: Largest difference of depth in them, as a share of the depth in the middle; 2 cm are always allowed.
    """
    height, width = depth.shape
    side = 2 * reach + 1
    center = jnp.round(lax.stop_gradient(uv))
    u, v = center
    inside = (u >= reach) & (v >= reach) & (u < width - reach) & (v < height - reach)
    column, row = jnp.where(inside[None, :], center, reach).astype(jnp.int32) - reach
    cut = jax.vmap(lambda row, column: lax.dynamic_slice(depth, (row, column), (side, side)))(row, column)
    around = cut.reshape(-1, side * side)
    low, high = jnp.min(around, axis=1), jnp.max(around, axis=1)
    middle = around[:, side * side // 2]
    smooth = (low > 0) & jnp.isfinite(high) & (high - low <= max_step * middle + _NOISE_M)
    return jnp.where(inside & smooth, middle, 0)
