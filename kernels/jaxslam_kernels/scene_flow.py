"""Motion of points in space beyond that of the camera, and whether groups of them are at rest.

Source: USD-SLAM (Wang et al., RA-L 2024), section III-B, equations 2 to 9. Its formula 5 leaves out the motion of the
camera, which its text takes away: `V = P_n - T P_(n-1)`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.robust import robust_scale, weighted_median
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Mask, Points, Scalar, Weights


class GroupMotion(NamedTuple):
    """Motion of groups of points; 0 for a group without points.

    Attributes:
        share: `(k,)` weight of the moving points, as a share of the weight of the group.
        mean: `(k,)` length of the mean flow of the group, in the unit of the flow.
        number: `(k,)` total weight of the points of the group.
    """

    share: Float[Array, " k"]
    mean: Float[Array, " k"]
    number: Float[Array, " k"]


@checked
def scene_flow(X_world: Points, X_cam: Points, T_world_cam: SE3) -> Points:
    """Compute the motion of points beyond that of the camera, in camera axes (equations 4 and 5).

    Args:
        X_world: `(3, n)` earlier positions in the world, meters.
        X_cam: `(3, n)` current positions in camera axes, meters.
        T_world_cam: Current pose of the camera.
    """
    return X_cam - to_camera(T_world_cam, X_world)


@checked
def flow_length(flow: Points) -> Weights:
    """Compute the length of each vector of `(3, n)` (equation 6); the derivative at length 0 is 0."""
    squared = jnp.sum(jnp.square(flow), axis=0)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1)), 0)


@checked
def upper_limit(intensity: Weights, weights: Weights, sigmas: Scalar | float, *, robust: bool = True) -> Scalar:
    """Compute the limit for points at rest: the mean of their motion plus standard deviations (equations 7 and 8).

    Args:
        intensity: `(n,)` motion of each point, not negative; what is not finite does not count.
        weights: `(n,)` weight of each point, not negative; 0 for points on movable objects.
        sigmas: Standard deviations above the mean; 3 in the paper.
        robust: Whether to use the median and 1.4826 times the median absolute deviation instead, static. One wrong
            match in fifty doubles the standard deviation.

    Returns:
        The limit; 0 where nothing counts.
    """
    weights = jnp.where(jnp.isfinite(intensity), weights, 0)
    if robust:
        return weighted_median(intensity, weights) + sigmas * robust_scale(intensity, weights)
    counted = jnp.where(jnp.isfinite(intensity) & (weights >= 0), intensity, 0)
    total = jnp.sum(weights)
    mean = jnp.sum(weights * counted) / jnp.where(total > 0, total, 1)
    # The count less one, as in equation 8; a single point says nothing about the spread.
    spread = jnp.sum(weights * jnp.square(counted - mean)) / jnp.where(total > 1, total - 1, 1)
    some = spread > 0
    return mean + sigmas * jnp.where(some, jnp.sqrt(jnp.where(some, spread, 1)), 0)


@checked
def group_motion(flow: Points, moves: Weights, counts: Mask, group: Int[Array, " n"], num_groups: int) -> GroupMotion:
    """Compute the moving share of each group of points, and the length of its mean motion.

    Args:
        flow: `(3, n)` motion of each point, in any unit.
        moves: `(n,)` 1 for a point that moves, 0 for one at rest, or in between.
        counts: `(n,)` true for points that count.
        group: `(n,)` group of each point, from 0; a number outside `0 .. num_groups - 1` means no group.
        num_groups: Number of groups, static.
    """
    there = counts & (group >= 0) & (group < num_groups) & jnp.isfinite(flow).all(axis=0) & jnp.isfinite(moves)
    to = jnp.where(there, group, num_groups)
    rows = jnp.concatenate([flow, moves[None, :], jnp.ones_like(moves)[None, :]])
    sums = jnp.zeros((5, num_groups), flow.dtype).at[:, to].add(jnp.where(there[None, :], rows, 0), mode="drop")
    mean = sums[:4] / jnp.maximum(sums[4:], 1)
    return GroupMotion(share=mean[3], mean=flow_length(mean[:3]), number=sums[4])
