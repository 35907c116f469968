"""Points of unknown depth: followed without a vote until their depth is measured or known from parallax.

A frame without depth (a dropout, a sensor at half the rate, a covered lens of a pair) still shows corners, and so does
what is out of the sensor's reach: in a room with walls 6 m away, people may cover all that has depth. Each corner is
followed with the other points, from an assumed depth. It counts as soon as its depth is measured, or as the camera has
moved aside far enough for its rays to tell the depth.
"""

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.robust import masked_median
from jaxslam_kernels.se3 import to_camera, to_world
from jaxslam_kernels.types import Mask, Pixels, Scalar

from jaxslam.sensors.measurement import Measurements
from jaxslam.tracking.point_update import KeptPoints
from jaxslam.tracking.points import TrackedPoints
from jaxslam.tracking.pose_estimation import reprojects
from jaxslam.tracking.step_context import StepContext

_DEPTH_ERROR = 0.1
"""Standard deviation of a depth from parallax, as a share of the depth, at which the point begins to count. With 0.05,
three rendered ways on which depth fails for four to five seconds, two seeds, have 20.0 mm in the geometric mean instead
of 17.2, and half of the points."""
_FAR = 100.0
"""Multiple of the assumed depth beyond which a point is as good as at infinity."""
_PARALLEL = 0.1
"""Angle between two rays below which they are parallel, in standard deviations of their directions."""


def assumed_depth(points: TrackedPoints, T_world_cam: SE3, nearest_m: Scalar) -> Scalar:
    """Return the depth to assume where none is measured: the median depth of the points that have a position, meters.

    Args:
        points: Points of the tracker.
        T_world_cam: Pose of the camera.
        nearest_m: Smallest depth to assume, meters.
    """
    depth = to_camera(T_world_cam, points.X_world)[2]
    known = points.has_position() & (depth > nearest_m)
    return jnp.maximum(masked_median(depth, known), nearest_m)


def with_located(
    kept: KeptPoints, step: StepContext, uv: Pixels, seen: Measurements, waiting: Mask, T_world_cam: SE3
) -> KeptPoints:
    """Add the points of unknown depth that are still followed, with their positions where these are known by now.

    The rays along which a point was detected and is seen now are triangulated. A point that the first ray cannot
    explain has moved, or flow has lost it: it is dropped.

    Args:
        kept: The other points that stay after the frame.
        step: Context of the step.
        uv: `(2, n)` positions of the points in the frame, pixels.
        seen: Measurements of the points at the refined pose.
        waiting: `(n,)` mask of the points of unknown depth that were followed and lie on nothing that moves.
        T_world_cam: Refined pose.
    """
    before, params = step.state.points, step.params
    # In the axes of the camera, whose center is 0: the first ray is `origin + share * along`, the present one `ray`.
    # Points that do not wait have rays that are apart, for the sake of derivatives.
    origin = to_camera(T_world_cam, before.X_anchor)
    along = jnp.where(waiting[None, :], to_camera(T_world_cam, before.X_world) - origin, 1)
    ray = jnp.concatenate([seen.xy, jnp.ones_like(seen.xy[:1])])
    across = jnp.cross(along, ray, axis=0)
    apart = jnp.sum(jnp.square(across), axis=0)
    sine_squared = apart / (jnp.sum(jnp.square(along), axis=0) * jnp.sum(jnp.square(ray), axis=0))
    sigma = params.pixel_sigma / params.sensor.intrinsics.fx
    parallel = sine_squared < jnp.square(_PARALLEL * sigma)
    share = -jnp.sum(jnp.cross(origin, ray, axis=0) * across, axis=0) / jnp.where(parallel, 1, apart)
    ahead = ~parallel & (share > 0) & (share < _FAR)
    X_cam = origin + jnp.where(ahead, share, _FAR)[None, :] * along
    follows = reprojects(T_world_cam, to_world(T_world_cam, X_cam), seen.xy, params)
    measured = waiting & (seen.depth > 0)
    triangulated = waiting & ~measured & ahead & follows & (sine_squared > jnp.square(sigma / _DEPTH_ERROR))
    located, stays = measured | triangulated, measured | (waiting & follows)
    X_world = to_world(T_world_cam, jnp.where(measured[None, :], seen.in_camera(), X_cam))
    by_parallax = sine_squared / jnp.square(jnp.where(triangulated, X_cam[2], 1) * sigma)
    information = jnp.where(measured, 1 / jnp.square(seen.sigma), by_parallax)
    points = kept.points
    updated = points._replace(
        uv=jnp.where(stays[None, :], uv, points.uv),
        xy=jnp.where(stays[None, :], seen.xy, points.xy),
        depth=jnp.where(stays, seen.depth, points.depth),
        X_world=jnp.where(located[None, :], X_world, points.X_world),
        X_anchor=jnp.where(located[None, :], X_world, jnp.where(waiting[None, :], before.X_anchor, points.X_anchor)),
        information=jnp.where(located, information, points.information),
        age=jnp.where(stays, 0, points.age),
        anchor_age=jnp.where(stays, 0, points.anchor_age),
        valid=points.valid | (before.valid & stays),
    )
    return kept._replace(points=updated)
