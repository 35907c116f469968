"""Update tracked points with what a frame shows of them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.se3 import to_camera, to_world
from jaxslam_kernels.types import Mask, Pixels, Weights

from jaxslam.sensors.measurement import Measurements
from jaxslam.tracking.points import TrackedPoints
from jaxslam.tracking.state import TrackParams
from jaxslam.tracking.step_context import StepContext

_MAX_FUSED, _MAX_FUSED_OF_PAIR = 4, 16
"""Measurements of depth that a point counts as at most, so that an early error of the pose is forgotten. Those of a
pair are less sure: with 4, three rooms along a half sphere have 3.3, 6.4 and 4.0 mm of error, with 16 1.6, 1.9 and 1.3,
with 64 1.5, 1.5 and 1.2."""


class KeptPoints(NamedTuple):
    """The points of the state that stay after a frame.

    Attributes:
        points: The points, updated; those that were dropped are not valid.
        tracked: `(n,)` mask of the static points.
        monitored: `(n,)` mask of the points on moving objects, kept to see whether they go on moving.
    """

    points: TrackedPoints
    tracked: Mask
    monitored: Mask


def probation_weights(points: TrackedPoints, params: TrackParams) -> Weights:
    """Return the `(n,)` weights of the points, lower while one is on probation; 0 for one without a position."""
    served = (points.age + 1).astype(points.weight.dtype) / params.probation_frames
    return jnp.where(points.has_position(), points.weight * jnp.minimum(served, 1), 0)


def update_points(
    step: StepContext, uv: Pixels, seen: Measurements, inliers: Mask, monitored: Mask, T_world_cam: SE3
) -> KeptPoints:
    """Keep the inliers and the monitored points, and fuse the measured depth of the inliers into their positions.

    Args:
        step: Context of the step.
        uv: `(2, n)` positions of the points in the frame, pixels.
        seen: Measurements of the points at the refined pose.
        inliers: `(n,)` mask of the points that agree with the refined pose.
        monitored: `(n,)` mask of the points on moving objects to be kept; their positions are measured anew.
        T_world_cam: Refined pose.
    """
    points, params = step.state.points, step.params
    X_cam = to_camera(T_world_cam, points.X_world)
    agrees = inliers & (seen.depth > 0) & (jnp.abs(seen.depth - X_cam[2]) < 3 * seen.sigma)
    measured = 1 / jnp.square(seen.sigma)
    information = jnp.where(agrees, measured, 0)
    total = jnp.where(agrees, points.information + information, 1)
    fused = X_cam + (information / total)[None, :] * (seen.in_camera() - X_cam)
    monitored &= seen.depth > 0
    # One transform for both kinds of points: a monitored point is where it is measured now.
    moved = to_world(T_world_cam, jnp.where(monitored[None, :], seen.in_camera(), fused))
    X_world = jnp.where((agrees | monitored)[None, :], moved, points.X_world)
    cap = (_MAX_FUSED if step.view.right is None else _MAX_FUSED_OF_PAIR) * information
    information = jnp.where(agrees, jnp.minimum(points.information + information, cap), points.information)
    kept = inliers | monitored
    anchored = points.anchor_age.astype(X_world.dtype) < params.anchor_frames
    updated = TrackedPoints(
        uv=jnp.where(kept[None, :], uv, points.uv),
        xy=jnp.where(kept[None, :], seen.xy, points.xy),
        depth=jnp.where(kept, seen.depth, points.depth),
        X_world=X_world,
        X_anchor=jnp.where(anchored[None, :], points.X_anchor, X_world),
        information=jnp.where(monitored, measured, information),
        weight=points.weight,
        age=jnp.where(monitored, 0, points.age + inliers.astype(jnp.int32)),
        anchor_age=jnp.where(anchored, points.anchor_age + 1, 0),
        id=points.id,
        valid=points.valid & kept,
    )
    return KeptPoints(updated, points.valid & inliers, monitored)
