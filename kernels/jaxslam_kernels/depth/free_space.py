"""Free-space check of points by a depth image: which it confirms, and which it sees through.

Source: free space between a depth camera and what it sees, as in occupancy mapping (Hornung et al., "OctoMap", 2013);
here points are carried into the image, not rays into the map, so that the work is one look a point.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3

from jaxslam_kernels.camera import Intrinsics, in_front, project
from jaxslam_kernels.checks import checked
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import DepthImage, Mask, Points, Scalar


class Visibility(NamedTuple):
    """Visibility of points in a depth image; both are false for a point out of view or occluded.

    Attributes:
        there: True if the image measures a surface at the point.
        past: True if the image measures a surface clearly behind the point.
    """

    there: Mask
    past: Mask


@checked
def classify_visibility(
    X_world: Points,
    T_world_cam: SE3,
    depth: DepthImage,
    least: DepthImage,
    intrinsics: Intrinsics,
    *,
    same_share: Scalar,
    same_m: Scalar,
) -> Visibility:
    """Compare points with a depth image.

    Args:
        X_world: `(3, n)` meters.
        T_world_cam: Pose of the camera.
        depth: `(h, w)` meters; 0 or not a number where missing.
        least: `(h, w)` the least depth around each pixel, 0 where some is missing: outlines see nothing past.
        intrinsics: Intrinsics of the image.
        same_share: A surface is where a point is if their depths differ by no more than this share,
        same_m: and so many meters; it is clearly behind if it is further than twice that.
    """
    height, width = depth.shape
    X_cam = to_camera(T_world_cam, X_world)
    column, row = jnp.round(project(intrinsics, X_cam))
    visible = in_front(X_cam) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = jnp.where(visible, row, 0).astype(jnp.int32) * width + jnp.where(visible, column, 0).astype(jnp.int32)
    z = jnp.where(visible, X_cam[2], 1)
    seen, nearest = depth.reshape(-1)[at], least.reshape(-1)[at]
    limit = same_share * z + same_m
    there = visible & (seen > 0) & (jnp.abs(seen - z) <= limit)
    return Visibility(there, visible & (nearest > 0) & (nearest - z > 2 * limit))
