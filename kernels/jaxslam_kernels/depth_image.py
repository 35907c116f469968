"""Reading depth at points, without being fooled by edges and holes."""

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam_kernels.types import DepthImage, Pixels, Scalar, Weights


def believable(depth: DepthImage, nearest: Scalar | float, farthest: Scalar | float) -> DepthImage:
    """Depth where it is a number within the range of the sensor, 0 elsewhere."""
    inside = (depth > nearest) & (depth < farthest)
    return jnp.where(inside, depth, 0)


def sample_depth(depth: DepthImage, uv: Pixels, *, reach: int = 1, max_step: float = 0.05) -> Weights:
    """Depth at the nearest pixel, or 0 where its surroundings do not agree.

    Args:
        depth: Depth image, 0 where missing.
        uv: `(2, n)` pixel coordinates; outside the image gives 0.
        reach: The `2 * reach + 1` pixels around must all have depth, static.
        max_step: Largest difference of depth among them, as a share of the depth.
    """
    height, width = depth.shape
    side = 2 * reach + 1
    finite = jnp.all(jnp.isfinite(uv), axis=0)
    nearest = jnp.round(lax.stop_gradient(jnp.where(finite[None, :], uv, -1))).astype(jnp.int32)
    u, v = nearest
    inside = finite & (u >= reach) & (v >= reach) & (u < width - reach) & (v < height - reach)
    cut = jax.vmap(lambda u, v: lax.dynamic_slice(depth, (v - reach, u - reach), (side, side)))(u, v)
    around = cut.reshape(-1, side * side)
    low, high = jnp.min(around, axis=1), jnp.max(around, axis=1)
    centre = around[:, side * side // 2]
    smooth = (low > 0) & (high - low <= max_step * centre + 0.02)
    return jnp.where(inside & smooth, centre, 0)
