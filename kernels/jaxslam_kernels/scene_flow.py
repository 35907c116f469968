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
    """How groups of points move; `(k,)` each, 0 for a group without points.

    Attributes:
        share: Weight of the points that move, as a share of the group's.
        mean: Length of the mean flow of the group, in the unit of the flow.
        number: Weight of its points.
    """

    share: Float[Array, " k"]
    mean: Float[Array, " k"]
    number: Float[Array, " k"]


@checked
def scene_flow(X_world: Points, X_cam: Points, T_world_cam: SE3) -> Points:
    """How far points have come from where they would be at rest, in the axes of the camera (equations 4 and 5).

    Args:
        X_world: `(3, n)` where they were in the world, meters.
        X_cam: `(3, n)` where they are in the axes of the camera, meters.
        T_world_cam: Pose of the camera now.
    """
    return X_cam - to_camera(T_world_cam, X_world)


@checked
def flow_length(flow: Points) -> Weights:
    """`(n,)` length of each vector of `(3, n)` (equation 6); with derivative 0 where there is none."""
    squared = jnp.sum(jnp.square(flow), axis=0)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1)), 0)


@checked
def upper_limit(intensity: Weights, weights: Weights, sigmas: Scalar | float, *, robust: bool = True) -> Scalar:
    """What points at rest stay below: mean and so many standard deviations of their motion (equations 7 and 8).

    Args:
        intensity: `(n,)` motion of each point, not negative; what is not finite does not count.
        weights: `(n,)` how much each counts, not negative, 0 for what may move.
        sigmas: Standard deviations above the mean; 3 in the paper.
        robust: Median and 1.4826 times the median absolute deviation instead: one wrong match in fifty doubles the
            standard deviation. Static.

    Returns:
        The limit; 0 where nothing counts.
    """
    weights = jnp.where(jnp.isfinite(intensity), weights, 0)
    if robust:
        return weighted_median(intensity, weights) + sigmas * robust_scale(intensity, weights)
    counted = jnp.where(jnp.isfinite(intensity) & (weights >= 0), intensity, 0)
    total = jnp.sum(weights)
    mean = jnp.sum(weights * counted) / jnp.where(total > 0, total, 1)
    # One less than there are, as in equation 8; of a single point nothing is known of how they spread.
    spread = jnp.sum(weights * jnp.square(counted - mean)) / jnp.where(total > 1, total - 1, 1)
    some = spread > 0
    return mean + sigmas * jnp.where(some, jnp.sqrt(jnp.where(some, spread, 1)), 0)


@checked
def group_motion(flow: Points, moves: Weights, counts: Mask, group: Int[Array, " n"], num_groups: int) -> GroupMotion:
    """How much of each group of points moves, and how far the whole of it has come on average.

    Args:
        flow: `(3, n)` motion of each point, in any unit.
        moves: `(n,)` 1 for a point that moves, 0 for one at rest, or in between.
        counts: `(n,)` which points are known.
        group: `(n,)` number of each point's group, from 0; what is outside `0 .. num_groups - 1` is in none.
        num_groups: How many groups there are, static.
    """
    there = counts & (group >= 0) & (group < num_groups) & jnp.isfinite(flow).all(axis=0) & jnp.isfinite(moves)
    to = jnp.where(there, group, num_groups)
    rows = jnp.concatenate([flow, moves[None, :], jnp.ones_like(moves)[None, :]])
    sums = jnp.zeros((5, num_groups), flow.dtype).at[:, to].add(jnp.where(there[None, :], rows, 0), mode="drop")
    mean = sums[:4] / jnp.maximum(sums[4:], 1)
    return GroupMotion(share=mean[3], mean=flow_length(mean[:3]), number=sums[4])
