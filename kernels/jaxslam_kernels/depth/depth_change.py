"""A depth image against one taken before from elsewhere: which surfaces were there then, and which were not.

A pixel is carried into the earlier image. If depth there agrees, the surface has been there since. If the earlier image
saw something farther away along that ray, the surface was not there: it would have hidden that. Nothing can be said
where depth is missing, out of the earlier view, or hidden in it. Source: free space between a depth camera and what it
sees, as in occupancy mapping; Palazzolo et al., "ReFusion", 2019, section III-D, uses it on a model of the scene.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Int

from jaxslam_kernels.camera import MIN_DEPTH, Intrinsics
from jaxslam_kernels.checks import checked
from jaxslam_kernels.se3 import to_world
from jaxslam_kernels.types import DepthImage, Scalar


class DepthChange(NamedTuple):
    """Comparison of each pixel of a depth image with an earlier depth image.

    Attributes:
        same: True if the surface at the pixel was there in the earlier image.
        new: True if it was not: the earlier image measured a depth beyond it.
        then: Its pixel in the earlier image, as `row * w + column`; always a valid index, even if it is neither.
    """

    same: Bool[Array, "h w"]
    new: Bool[Array, "h w"]
    then: Int[Array, "h w"]


@checked
def depth_change(
    depth: DepthImage,
    depth_then: DepthImage,
    T_then_now: SE3,
    intrinsics: Intrinsics,
    *,
    same_share: Scalar | float = 0.04,
    same_m: Scalar | float = 0.0,
    new_share: Scalar | float = 0.1,
    new_m: Scalar | float = 0.0,
) -> DepthChange:
    """Compare two depth images of one camera.

    Args:
        depth: Current depth image, meters; 0 or NaN where depth is missing.
        depth_then: Earlier depth image of the same size, meters.
        T_then_now: Transform from the current camera to the earlier one.
        intrinsics: Intrinsics of both images; their distortion is ignored.
        same_share: Differences of depth up to this share of the depth,
        same_m: and so many meters more, are none.
        new_share: The earlier depth must be greater by this share,
        new_m: and so many meters more, for the surface to be new.
    """
    height, width = depth.shape
    v, u = jnp.mgrid[:height, :width].astype(depth.dtype)
    ray = jnp.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, jnp.ones_like(u)])
    known = jnp.isfinite(depth) & (depth > MIN_DEPTH)
    X_now = (ray * jnp.where(known, depth, 1)[None]).reshape(3, -1)
    x, y, z = to_world(T_then_now, X_now).reshape(3, height, width)
    known &= jnp.isfinite(z) & (z > MIN_DEPTH)
    z = jnp.where(known, z, 1)
    column = jnp.round(intrinsics.fx * x / z + intrinsics.cx)
    row = jnp.round(intrinsics.fy * y / z + intrinsics.cy)
    known &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    then = jnp.where(known, row, 0).astype(jnp.int32) * width + jnp.where(known, column, 0).astype(jnp.int32)
    seen = depth_then.reshape(-1)[then]
    known &= jnp.isfinite(seen) & (seen > MIN_DEPTH)
    beyond = jnp.where(known, seen, z) - z
    same = known & (jnp.abs(beyond) < same_share * z + same_m)
    new = known & (beyond > new_share * z + new_m)
    return DepthChange(same, new, then)
