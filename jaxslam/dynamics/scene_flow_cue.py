"""Trajectory consistency: whether a point's way from frame to frame is that of something at rest.

Source: RTS-SLAM (Sensors 2026), trajectory consistency, up to formula 14: the displacement of the point in camera axes
against that of the camera, with a tolerance that grows with depth.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxslam_kernels.camera import Intrinsics, back_project
from jaxslam_kernels.se3 import between, to_camera, to_world
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights

from jaxslam.dynamics.cue import CueInput, CueResult, threshold_evidence


class TrajectoryParams(NamedTuple):
    """Of `trajectory_cue`; scalars.

    Attributes:
        tolerance_m: Difference of ways that says nothing, close to the camera: the paper's alpha.
        tolerance_per_m: Its growth with the smaller of both depths: the paper's beta.
        as_published: 1 compares the lengths of the ways, as in the paper; 0 the ways themselves. A choice without a
            derivative; a number, not a flag, so that `jax.grad` takes it. One program serves both.
        temperature: See `cue.judge`.
    """

    tolerance_m: Scalar
    tolerance_per_m: Scalar
    as_published: Scalar
    temperature: Scalar


def trajectory_cue(scene: CueInput, params: TrajectoryParams) -> CueResult:
    """How far each point is from where it would be at rest, in tolerances.

    The paper compares the lengths of two ways: that of the point in the axes of the camera, and that of the camera.
    A point far from the axis about which the camera turns is then taken to move, and one that moves along with the
    camera is not. Corrected, the point is carried to the second frame by the motion of the camera, and the distance to
    where it is found is what counts: `|P_t - T P_{t-1}|`.

    Args:
        scene: What is known of the points; those without depth in one frame are not judged.
        params: Tolerances.
    """
    seen = jnp.isfinite(scene.uv_before).all(axis=0) & jnp.isfinite(scene.uv).all(axis=0)
    known = scene.followed & seen & (scene.depth_before > 0) & (scene.depth > 0)
    before, now = (
        _in_camera(uv, depth, known, scene.intrinsics)
        for uv, depth in ((scene.uv_before, scene.depth_before), (scene.uv, scene.depth))
    )
    carried = to_camera(scene.T_world_cam, to_world(scene.T_world_before, before))
    camera_m = _length(between(scene.T_world_before, scene.T_world_cam).translation()[:, None])
    published = jnp.abs(_length(now - before) - camera_m)
    apart_m = jnp.where(params.as_published > 0.5, published, _length(now - carried))
    tolerance_m = params.tolerance_m + params.tolerance_per_m * jnp.minimum(scene.depth_before, scene.depth)
    return threshold_evidence(apart_m / jnp.where(known, tolerance_m, 1), known, params.temperature)


def _in_camera(uv: Pixels, depth: Weights, known: Mask, intrinsics: Intrinsics) -> Points:
    """Points in camera axes; those that are not known on the optical axis, a meter away."""
    center = jnp.stack([intrinsics.cx, intrinsics.cy])[:, None]
    return back_project(intrinsics, jnp.where(known, uv, center), jnp.where(known, depth, 1))


def _length(way: Points) -> Weights:
    """With derivative 0 where there is no way."""
    squared = jnp.sum(jnp.square(way), axis=0)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1)), 0)
