"""Trajectory cue: compare a point's displacement between frames with that of a static point.

Source: RTS-SLAM (Sensors 2026), trajectory consistency, up to equation 14: the displacement of the point in camera axes
against that of the camera, with a tolerance that grows with depth.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxslam_kernels.camera import Intrinsics, back_project
from jaxslam_kernels.se3 import between, to_camera, to_world
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights

from jaxslam.dynamics.cue import CueInput, CueResult, SettingsCue, threshold_evidence


class TrajectoryParams(NamedTuple):
    """Parameters of `trajectory_cue`; all scalars.

    Attributes:
        tolerance_m: Tolerated difference of displacement close to the camera, in meters: the paper's alpha.
        tolerance_per_m: Growth of the tolerance per meter of the smaller of both depths: the paper's beta.
        as_published: 1 compares the lengths of the displacements, as in the paper; 0 the displacements themselves. The
            choice has no derivative; it is a number and not a flag so that `jax.grad` accepts it. One compiled program
            serves both.
        temperature: Softness of the comparison, as in `cue.threshold_evidence`.
    """

    tolerance_m: Scalar
    tolerance_per_m: Scalar
    as_published: Scalar
    temperature: Scalar


def trajectory_cue(scene: CueInput, params: TrajectoryParams) -> CueResult:
    """Return the distance of each point from where a static point would be, in units of the tolerance.

    The paper compares two lengths: the displacement of the point in camera axes and that of the camera. A point far
    from the camera's axis of rotation is then taken to move, and one that moves along with the camera is not. The
    corrected form transforms the point to the second frame by the camera motion and measures the distance to where it
    is found: `|P_t - T P_{t-1}|`.

    Args:
        scene: Measurements of the points; those without depth in either frame are not classified.
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
    """Back-project points into camera axes; unknown ones are put on the optical axis, a meter away."""
    center = jnp.stack([intrinsics.cx, intrinsics.cy])[:, None]
    return back_project(intrinsics, jnp.where(known, uv, center), jnp.where(known, depth, 1))


def _length(way: Points) -> Weights:
    """Compute lengths with derivative 0 where the displacement is 0."""
    squared = jnp.sum(jnp.square(way), axis=0)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1)), 0)


CUE = SettingsCue("trajectory", lambda _: trajectory_cue, TrajectoryParams)
