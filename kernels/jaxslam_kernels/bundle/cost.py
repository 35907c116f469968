"""The cost of many camera poses and points: every camera against every point, on a dense grid.

An observation is worth the same as in `pose_cost`: three whitened residuals, one robust loss on their squared norm.
Here they lie in planes `(k, n)`, one row a camera and one column a point, most of them empty. A local window is
dense enough (7000 observations in 12 x 1500 slots) that plain vector arithmetic on all slots beats gathering and
scattering the observations in every step, which XLA does one by one on a CPU.

A residual of gradient a along the point in the camera's frame has the row (-a, a × X) along the right tangent of the
pose and R a along the point in the world. So all derivatives follow from `M = Σ a w aᵀ` and `m = Σ a w r`, 3 x 3 and 3
numbers a slot. A lens of each camera's own adds three rows, see `bundle_lens`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.bundle.lens import (
    Bend,
    Cameras,
    LensPart,
    bend,
    lens_gradient,
    lens_hessian,
    shift_cameras,
)
from jaxslam_kernels.camera import MIN_DEPTH, Intrinsics, normalize
from jaxslam_kernels.checks import checked
from jaxslam_kernels.pose.pose_cost import UNKNOWN_CHI2, positive
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
    R = jax.vmap(lambda pose: SE3(pose).rotation().as_matrix())(poses)
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
    return 0.5 * jnp.sum(problem.weights * jnp.where(problem.known, loss_value(views.chi2, problem.scale, loss), 0.0))


class BundleEquations(NamedTuple):
    """A quadratic model of the cost: gradients, and the blocks of a Hessian that no two points share.

    Attributes:
        camera_gradient: Gradient along the right tangents of the poses, then by the lenses.
        camera_hessian: Hessian block of each camera.
        point_gradient: Gradient by the points.
        point_hessian: Hessian block of each point.
        cross: Second derivatives by camera and point.
    """

    camera_gradient: Float[Array, "k c"]
    camera_hessian: Float[Array, "k c c"]
    point_gradient: Points
    point_hessian: Float[Array, "3 3 n"]
    cross: Float[Array, "k c 3 n"]


def normal_equations(views: Views) -> BundleEquations:
    """The exact gradient, and the Hessian of iteratively reweighted least squares."""
    R, (X, Y, Z), (x, y), (mu, mv, md), pull = views.R, views.X_cam, views.slope, views.information, views.pull
    k, n = x.shape
    column = lambda i, j: R[:, j, i, None]  # Rᵀ, spread over the points
    first = [mu * (column(0, j) - x * column(2, j)) for j in range(3)]  # rows of M Rᵀ
    second = [mv * (column(1, j) - y * column(2, j)) for j in range(3)]
    if views.skew is not None:
        first, second = (
            [a + views.skew * (column(1, j) - y * column(2, j)) for j, a in enumerate(first)],
            [a + views.skew * (column(0, j) - x * column(2, j)) for j, a in enumerate(second)],
        )
    third = [md * column(2, j) - x * first[j] - y * second[j] for j in range(3)]
    turn = zip(first, second, third, strict=True)
    turned = [(Z * b - Y * c, X * c - Z * a, Y * a - X * b) for a, b, c in turn]  # (M Rᵀ) × X, by columns
    rows = [[-v for v in row] for row in (first, second, third)] + [list(row) for row in zip(*turned, strict=True)]
    if views.lens is not None:
        rows = rows + _lens_rows(views, views.lens)
    cross = jnp.stack([v for row in rows for v in row], axis=1)
    moments = jnp.einsum("kan,kbn->kab", cross, jnp.stack([X, Y, Z, jnp.ones_like(X)], axis=1))
    to_point = lambda a, b, c: [
        jnp.sum(column(0, j) * a + column(1, j) * b + column(2, j) * c, axis=0) for j in range(3)
    ]
    by_column = [to_point(a, b, c) for a, b, c in zip(first, second, third, strict=True)]
    along_pose = [-sum_ for sum_ in map(partial(jnp.sum, axis=1), pull)]
    turning = (pull[1] * Z - pull[2] * Y, pull[2] * X - pull[0] * Z, pull[0] * Y - pull[1] * X)
    gradient = jnp.stack([*along_pose, *(jnp.sum(t, axis=1) for t in turning)], axis=1)
    columns = _pose_columns(moments.reshape(k, len(rows), 3, 4), R)
    hessian = 0.5 * (columns[:, :6] + jnp.swapaxes(columns[:, :6], 1, 2))
    if views.lens is not None:
        gradient = jnp.concatenate([gradient, lens_gradient(views.lens)], axis=1)
        mixed = columns[:, 6:]
        hessian = jnp.concatenate(
            [
                jnp.concatenate([hessian, jnp.swapaxes(mixed, 1, 2)], axis=2),
                jnp.concatenate([mixed, lens_hessian(views.lens)], axis=2),
            ],
            axis=1,
        )
    return BundleEquations(
        camera_gradient=gradient,
        camera_hessian=hessian,
        point_gradient=jnp.stack(to_point(*pull)),
        point_hessian=jnp.stack([jnp.stack(row) for row in by_column]),
        cross=cross.reshape(k, len(rows), 3, n),
    )


def _lens_rows(views: Views, lens: LensPart) -> list[list[Plane]]:
    """Second derivatives by lens and point."""
    R, (x, y), (by_x, by_y) = views.R, views.slope, lens.cross
    column = lambda i, j: R[:, j, i, None]
    base = [by_x * (column(0, j) - x * column(2, j)) + by_y * (column(1, j) - y * column(2, j)) for j in range(3)]
    return [[d * b for b in base] for d in lens.by_lens]


class ExactBlocks(NamedTuple):
    """Blocks of the Hessian that every slot adds to, the curvature of projection and loss included.

    Attributes:
        camera: Block of the slot's camera.
        cross: Block that couples its camera and its point.
        point: Block of its point.
    """

    camera: Float[Array, "k c c n"]
    cross: Float[Array, "k c 3 n"]
    point: Float[Array, "3 3 k n"]


def exact_blocks(cameras: Cameras, X_world: Points, problem: BundleProblem, loss: Loss) -> ExactBlocks:
    """The exact Hessian, at an optimum: elsewhere the turning of the tangents would add to it.

    A slot depends on one camera and one point, so moving all of them at once along one axis gives a column of each.
    """
    k, c = cameras.poses.shape[0], 6 if cameras.lenses is None else 9

    def gradient(tangent: Float[Array, " d"]) -> Float[Array, "d k n"]:
        shifted = shift_cameras(cameras, jnp.broadcast_to(tangent[None, :c], (k, c)))
        views = bundle_views(shifted, X_world + tangent[c:, None], problem, loss)
        (X, Y, Z), (a, b, d), R, lens = views.X_cam, views.pull, views.R, views.lens
        world = [R[:, j, 0, None] * a + R[:, j, 1, None] * b + R[:, j, 2, None] * d for j in range(3)]
        by_lens = [] if lens is None else [plane * lens.pull for plane in lens.by_lens]
        return jnp.stack([-a, -b, -d, b * Z - d * Y, d * X - a * Z, a * Y - b * X, *by_lens, *world])

    hessian = jax.jacfwd(gradient)(jnp.zeros(c + 3, X_world.dtype))  # (c + 3, k, n, c + 3)
    camera = jnp.transpose(hessian[:c, :, :, :c], (1, 0, 3, 2))
    return ExactBlocks(
        camera=0.5 * (camera + jnp.swapaxes(camera, 1, 2)),
        cross=jnp.transpose(hessian[:c, :, :, c:], (1, 0, 3, 2)),
        point=jnp.transpose(hessian[c:, :, :, c:], (0, 3, 1, 2)),
    )


def _pose_columns(moments: Float[Array, "k c 3 4"], R: Float[Array, "k 3 3"]) -> Float[Array, "k c 6"]:
    """`Σ A M D` with `D = (-I, [X]×)`, from the sums of `A M Rᵀ` times (X, Y, Z, 1) over the points."""
    by_axis = jnp.einsum("kajb,kji->kaib", moments, R)  # A M: the Rᵀ taken off again
    across = lambda i, j: by_axis[:, :, i, j] - by_axis[:, :, j, i]
    columns = [
        -by_axis[:, :, 0, 3],
        -by_axis[:, :, 1, 3],
        -by_axis[:, :, 2, 3],
        across(1, 2),
        across(2, 0),
        across(0, 1),
    ]
    return jnp.stack(columns, axis=2)


def _known(observations: Observations, k: int, n: int) -> Bool[Array, " m"]:
    inside = (
        (observations.camera >= 0) & (observations.camera < k) & (observations.point >= 0) & (observations.point < n)
    )
    pixel = jnp.isfinite(observations.xy).all(axis=0) & positive(observations.precision[:2]).all(axis=0)
    return observations.valid & inside & pixel


def clean_weights(weights: Array) -> Array:
    """Replace invalid weights by 0; a weight of 0 keeps its derivative, the effect of letting it back in."""
    return jnp.where(jnp.isfinite(weights) & (weights >= 0), weights, 0.0)
