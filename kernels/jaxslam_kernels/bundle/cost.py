"""The cost of many camera poses and points: every camera against every point, on a dense grid.

An observation is worth the same as in `pose_cost`: three whitened residuals, one robust loss on their squared norm.
Here they lie in planes `(k, n)`, one row a camera and one column a point, most of them empty. A local window is
dense enough (7000 observations in 12 x 1500 slots) that plain vector arithmetic on all slots beats gathering and
scattering the observations in every step, which XLA does one by one on a CPU.

A residual of gradient a along the point in the camera's frame has the row (-a, a × X) along the right tangent of the
pose and R a along the point in the world. So all derivatives follow from `M = Σ a w aᵀ` and `m = Σ a w r`, 3 x 3 and 3
numbers a slot. A lens of each camera's own adds three rows, see `bundle_lens`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.bundle.lens import Bend, Cameras, LensPart, bend
from jaxslam_kernels.camera import MIN_DEPTH, Intrinsics, normalize
from jaxslam_kernels.checks import checked
from jaxslam_kernels.pose.pose_cost import UNKNOWN_CHI2, positive
from jaxslam_kernels.pose_graph.cost import GraphProblem
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import Loss, loss_value, loss_weight
from jaxslam_kernels.types import Flag, Mask, Pixels, Points, Scalar, Weights

Poses = Float[Array, "k 7"]
"""`wxyz_xyz` of T_world_cam, one row a camera."""
Plane = Float[Array, "k n"]
"""One number for each camera and point."""


_OFF_PLANE = 1e-6
"""Least distance from the camera's plane of a point that counts on both sides of it."""


class Observations(NamedTuple):
    """Observations of points in cameras, `m` slots. A camera observes a point at most once.

    Attributes:
        camera: Row of the pose.
        point: Column of the point.
        xy: Measured directions, undistorted normalized coordinates; with lenses, pixels from the principal point.
        depth: Measured depths in meters; 0 or NaN where there is none.
        precision: Factors that whiten the three residuals: `fx / σ_px`, `fy / σ_px`, `1 / σ_depth`; with lenses,
            `1 / σ_px` twice.
        weights: Factor of each observation's cost, not negative.
        valid: False for unused slots, whatever they hold.
    """

    camera: Int[Array, " m"]
    point: Int[Array, " m"]
    xy: Float[Array, "2 m"]
    depth: Float[Array, " m"]
    precision: Float[Array, "3 m"]
    weights: Float[Array, " m"]
    valid: Bool[Array, " m"]


@checked
def observe(
    camera: Int[Array, " n"],
    point: Int[Array, " n"],
    uv: Pixels,
    intrinsics: Intrinsics,
    *,
    depth: Weights | None = None,
    sigma_px: Weights | Scalar | float = 1.0,
    sigma_depth: Weights | Scalar | float = 0.02,
    weights: Weights | None = None,
    valid: Mask | None = None,
) -> Observations:
    """Observations from pixels of the distorted images of one camera model, with standard deviations (pixels, meters).

    Anything that is not finite, or a deviation that is not positive, takes out the observation, or only its depth.
    """
    dtype, n = uv.dtype, uv.shape[1]
    sigma_px, sigma_depth = (jnp.broadcast_to(jnp.asarray(s, dtype), (n,)) for s in (sigma_px, sigma_depth))
    inverse_px, inverse_depth = (jnp.where(s > 0, 1.0 / jnp.where(s > 0, s, 1.0), 0.0) for s in (sigma_px, sigma_depth))
    depth = jnp.zeros(n, dtype) if depth is None else depth
    known = jnp.isfinite(uv).all(axis=0) & (sigma_px > 0)
    return Observations(
        camera=camera,
        point=point,
        xy=normalize(intrinsics, uv),
        depth=depth,
        precision=jnp.stack([intrinsics.fx * inverse_px, intrinsics.fy * inverse_px, inverse_depth]),
        weights=jnp.ones(n, dtype) if weights is None else weights,
        valid=known if valid is None else known & valid,
    )


class BundleProblem(NamedTuple):
    """Clean observations on the grid: everything finite, and weight 0 where something is missing.

    Attributes:
        xy, depth, precision: As in `Observations`, with precision 0 for a missing depth.
        weights: Factor of each slot's cost, those of the point and of the observation multiplied.
        known: True for slots that hold an observation.
        scale: Scale of the robust loss, in standard deviations.
        free_pose: True for poses that may move.
        free_point: True for points that may move.
        free_lens: True for lenses that may change; `None` without lenses.
        two_sided: Whether points behind a camera count; `None` if not.
        edges: Measured relative poses of the cameras; `None` without.
    """

    xy: Float[Array, "2 k n"]
    depth: Plane
    precision: Float[Array, "3 k n"]
    weights: Plane
    known: Bool[Array, "k n"]
    scale: Scalar
    free_pose: Bool[Array, " k"]
    free_point: Mask
    free_lens: Bool[Array, " k"] | None = None
    two_sided: Flag | None = None
    edges: GraphProblem | None = None


def free_cameras(problem: BundleProblem) -> Bool[Array, "k c"]:
    """Tell which parameters of the cameras may change; a single column stands for all of them without lenses."""
    if problem.free_lens is None:
        return problem.free_pose[:, None]
    return jnp.repeat(jnp.stack([problem.free_pose, problem.free_lens], axis=1), np.array([6, 3]), axis=1)


def bundle_problem(
    observations: Observations,
    point_weights: Weights,
    scale: Scalar,
    free_pose: Bool[Array, " k"],
    free_point: Mask,
) -> tuple[BundleProblem, Int[Array, " m"]]:
    """Spread the observations over the grid; also the slot of each, `k n` for those without one.

    Of several observations of a point by a camera the last one of positive weight has the slot.
    """
    k, n, m = free_pose.shape[0], free_point.shape[0], observations.weights.shape[0]
    weights = clean_weights(observations.weights)
    usable_scale = jnp.isfinite(scale) & (scale > 0)
    slot = jnp.where(_known(observations, k, n) & usable_scale, observations.camera * n + observations.point, k * n)
    order = jnp.arange(m, dtype=jnp.int32)
    rank = jnp.where(weights > 0, order + m, order)
    owner = jnp.full(k * n + 1, -1, jnp.int32).at[slot].max(rank).at[k * n].set(-1)
    slot = jnp.where(owner[slot] == rank, slot, k * n)
    known, source = (owner[:-1] >= 0).reshape(k, n), (jnp.maximum(owner[:-1], 0) % m).reshape(k, n)
    gather = lambda values: jnp.where(known, values[source], 0.0)
    has_depth = positive(observations.depth) & positive(observations.precision[2])
    precision = [*observations.precision[:2], jnp.where(has_depth, observations.precision[2], 0.0)]
    problem = BundleProblem(
        xy=jnp.stack([gather(observations.xy[0]), gather(observations.xy[1])]),
        depth=gather(jnp.where(has_depth, observations.depth, 0.0)),
        precision=jnp.stack([gather(row) for row in precision]),
        weights=gather(weights) * clean_weights(point_weights)[None, :],
        known=known,
        scale=jnp.where(usable_scale, scale, 1.0),
        free_pose=free_pose,
        free_point=free_point,
    )
    return problem, slot


class Views(NamedTuple):
    """Every point seen from every camera, and how that differs from what was measured. Planes `(k, n)`.

    Attributes:
        R: Rotations of T_world_cam.
        X_cam: The points in the cameras' frames; (0, 0, 1) where there is nothing to see.
        slope: x / z and y / z.
        information: The part of M due to the pixel's u, its v and the depth: `w (fu / z)²`, `w (fv / z)²`, `w fd²`.
        pull: m, the derivative of the cost along the point in the camera's frame.
        chi2: Squared whitened residual s, `UNKNOWN_CHI2` without observation or behind the camera.
        robust_weights: `ρ'(s)`, 0 likewise.
        skew: The part of M due to the pixel's u and v together, and
        lens: the part of the lenses; `None` without lenses.
    """

    R: Float[Array, "k 3 3"]
    X_cam: tuple[Plane, Plane, Plane]
    slope: tuple[Plane, Plane]
    information: tuple[Plane, Plane, Plane]
    pull: tuple[Plane, Plane, Plane]
    chi2: Plane
    robust_weights: Plane
    skew: Plane | None = None
    lens: LensPart | None = None


def bundle_views(cameras: Cameras, X_world: Points, problem: BundleProblem, loss: Loss) -> Views:
    """Evaluates all slots."""
    poses = cameras.poses
    R = apart(lambda: jax.vmap(lambda pose: SE3(pose).rotation().as_matrix())(poses))
    offset = [X_world[j][None, :] - poses[:, 4 + j, None] for j in range(3)]
    X, Y, Z = (sum((R[:, j, i, None] * offset[j] for j in (1, 2)), R[:, 0, i, None] * offset[0]) for i in range(3))
    seen = problem.known & _in_view(Z, problem)
    X, Y, Z = jnp.where(seen, X, 0.0), jnp.where(seen, Y, 0.0), jnp.where(seen, Z, 1.0)
    inverse_z = 1.0 / Z
    x, y = X * inverse_z, Y * inverse_z
    fu, fv, fd = problem.precision
    bent = None if cameras.lenses is None else bend(cameras.lenses, x, y)
    u, v = (x, y) if bent is None else bent.seen
    ru, rv, rd = (u - problem.xy[0]) * fu, (v - problem.xy[1]) * fv, (Z - problem.depth) * fd
    chi2 = jnp.where(seen, ru * ru + rv * rv + rd * rd, UNKNOWN_CHI2)
    robust_weights = jnp.where(seen, loss_weight(chi2, problem.scale, loss), 0.0)
    weights = problem.weights * robust_weights
    to_slope = _through(bent, weights, inverse_z, (fu, fv), (ru, rv))
    pull_x, pull_y = to_slope.pull
    return Views(
        R=R,
        X_cam=(X, Y, Z),
        slope=(x, y),
        information=(*to_slope.information, weights * fd * fd),
        pull=(pull_x, pull_y, weights * fd * rd - x * pull_x - y * pull_y),
        chi2=chi2,
        robust_weights=robust_weights,
        skew=to_slope.skew,
        lens=None if bent is None else _lens_part(bent, weights, inverse_z, (x, y), (fu, fv), (ru, rv)),
    )


def _in_view(Z: Plane, problem: BundleProblem) -> Bool[Array, "k n"]:
    """Whether a point can be seen: before the camera, or if both sides count, off its plane."""
    before = Z > MIN_DEPTH
    return before if problem.two_sided is None else before | (problem.two_sided & (jnp.abs(Z) > _OFF_PLANE))


class _Slopes(NamedTuple):
    """The two pixel residuals' information and pull in the slopes' plane, over the depth."""

    information: tuple[Plane, Plane]
    pull: tuple[Plane, Plane]
    skew: Plane | None


def _through(
    bent: Bend | None, weights: Plane, inverse_z: Plane, f: tuple[Plane, Plane], r: tuple[Plane, Plane]
) -> _Slopes:
    au, av = f[0] * inverse_z, f[1] * inverse_z
    if bent is None:
        return _Slopes((weights * au * au, weights * av * av), (weights * au * r[0], weights * av * r[1]), None)
    xx, xy, yy = bent.across
    ux, uy, vx, vy = au * xx, au * xy, av * xy, av * yy
    information = (weights * (ux * ux + vx * vx), weights * (uy * uy + vy * vy))
    pull = (weights * (ux * r[0] + vx * r[1]), weights * (uy * r[0] + vy * r[1]))
    return _Slopes(information, pull, weights * (ux * uy + vx * vy))


def _lens_part(
    bent: Bend,
    weights: Plane,
    inverse_z: Plane,
    slope: tuple[Plane, Plane],
    f: tuple[Plane, Plane],
    r: tuple[Plane, Plane],
) -> LensPart:
    along_u, along_v = slope[0] * f[0], slope[1] * f[1]
    by_u, by_v = weights * inverse_z * along_u * f[0], weights * inverse_z * along_v * f[1]
    xx, xy, yy = bent.across
    return LensPart(
        by_lens=bent.by_lens,
        pull=weights * (along_u * r[0] + along_v * r[1]),
        information=weights * (along_u * along_u + along_v * along_v),
        cross=(by_u * xx + by_v * xy, by_u * xy + by_v * yy),
    )


def bundle_cost(views: Views, problem: BundleProblem, loss: Loss) -> Scalar:
    """`½ Σ w ρ(s)` over all observations, those behind the camera too."""
    value = lambda: problem.weights * jnp.where(problem.known, loss_value(views.chi2, problem.scale, loss), 0.0)
    return 0.5 * jnp.sum(apart(value))  # a sum of what is computed on the way takes 0.4 instead of 0.1 ms


def _known(observations: Observations, k: int, n: int) -> Bool[Array, " m"]:
    inside = (
        (observations.camera >= 0) & (observations.camera < k) & (observations.point >= 0) & (observations.point < n)
    )
    pixel = jnp.isfinite(observations.xy).all(axis=0) & positive(observations.precision[:2]).all(axis=0)
    return observations.valid & inside & pixel


def clean_weights(weights: Array) -> Array:
    """Replace invalid weights by 0; a weight of 0 keeps its derivative, the effect of letting it back in."""
    return jnp.where(jnp.isfinite(weights) & (weights >= 0), weights, 0.0)
