"""The cost of one camera pose: reprojection and depth residuals, robust, with an optional prior.

Shared by `pose_refine` and `pnp`. A point gives three residuals, each divided by its standard deviation,

    (fx (x/z - x̂) / σ_px,  fy (y/z - ŷ) / σ_px,  (z - ẑ) / σ_depth),

with `(x̂, ŷ)` the measured pixel undistorted and normalized, so pixels are those of an ideal camera. A missing depth
drops the third one. The robust loss acts on the squared norm of all three: a point lies on the static scene or it
does not, and one that moves along the ray agrees with the pixel and not with the depth. Cost and derivatives are for
the perturbation `T_world_cam @ exp(tangent)`, tangent = (translation, rotation).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Float

from jaxslam_kernels.camera import MIN_DEPTH, Intrinsics, normalize
from jaxslam_kernels.levenberg_marquardt import NormalEquations
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import LARGEST_SQUARED, Loss, loss_value, loss_weight
from jaxslam_kernels.se3 import rotation_matrix, to_camera
from jaxslam_kernels.types import Flag, Mask, Pixels, Points, Scalar, Weights

UNKNOWN_CHI2 = 1e4
"""Squared residual of a point behind the camera or without a value: 100 standard deviations, and no derivative."""

FARTHEST_M = 1e9
"""Meters. For derivatives by weights of 0, a point farther away than this is no point: products would overflow."""


class PosePrior(NamedTuple):
    """Prior knowledge of a pose, for example from a constant velocity.

    The cost is `½ eᵀ Λ e` with `e = (R_pᵀ (t - t_p), 2 sgn(q_w) q_xyz)`, where q is the rotation from the predicted
    to the sought pose: the right tangent, with `2 sin(θ/2)` in place of the angle θ, smooth everywhere below π.

    Attributes:
        T_world_cam: The predicted pose.
        information: Inverse covariance Λ in its right tangent (translation in meters, rotation in radians), of which
            the symmetric part counts.
    """

    T_world_cam: SE3
    information: Float[Array, "6 6"]


class PoseProblem(NamedTuple):
    """Clean observations of one camera: everything finite, and weight 0 where something is missing.

    Attributes:
        X_world: Points in meters.
        xy: Measured directions, undistorted normalized coordinates.
        depth: Measured depths in meters; anything where there is none.
        precision: Factors that whiten the three residuals: `fx / σ_px`, `fy / σ_px`, `1 / σ_depth` or 0.
        weights: Factor of each point's cost.
        scale: Scale of the robust loss, in standard deviations.
        prior: Prior knowledge of the pose.
    """

    X_world: Points
    xy: Pixels
    depth: Weights
    precision: Float[Array, "3 n"]
    weights: Weights
    scale: Scalar
    prior: PosePrior | None


def pose_problem(
    X_world: Points,
    uv: Pixels,
    intrinsics: Intrinsics,
    weights: Weights | None,
    depth: Weights | None,
    sigma_px: Weights | Scalar | float,
    sigma_depth: Weights | Scalar | float,
    scale: Scalar | float,
    prior: PosePrior | None,
) -> tuple[PoseProblem, PoseProblem]:
    """The problem without what is unusable, and the idle points: those of weight exactly 0 that are usable otherwise.

    Any value that is not finite takes its point (or only its depth) out of both; a camera or a scale that means nothing
    takes all of them out.

    Idle points have no influence on the optimum, but the derivative by their weight is not zero. The second problem
    holds them alone, in their columns; its weights are all 0 and carry the derivative. See `with_idle`.
    """
    dtype, n = X_world.dtype, X_world.shape[1]
    weights = jnp.ones(n, dtype) if weights is None else weights
    depth = jnp.zeros(n, dtype) if depth is None else depth
    sigma_px, sigma_depth = (jnp.broadcast_to(jnp.asarray(sigma, dtype), (n,)) for sigma in (sigma_px, sigma_depth))
    loss_scale = jnp.asarray(scale, dtype)
    usable = apart(lambda: _usable(intrinsics) & positive(loss_scale))
    intrinsics, loss_scale = jax.tree.map(lambda x: jnp.where(usable, x, 1.0), (intrinsics, loss_scale))
    has_depth = apart(lambda: positive(depth) & positive(sigma_depth))
    finite = lambda array: jnp.isfinite(array).all(axis=0)
    known = apart(lambda: finite(X_world) & finite(uv) & positive(sigma_px) & usable)
    focal = jnp.stack([intrinsics.fx, intrinsics.fy])
    inverse_depth_sigma = jnp.where(has_depth, 1.0 / jnp.where(has_depth, sigma_depth, 1.0), 0.0)
    xy, clean_prior = normalize(intrinsics, uv), _usable_prior(prior)

    def problem_of(counts: Mask) -> PoseProblem:
        safe_sigma = jnp.where(counts, sigma_px, 1.0)
        return PoseProblem(
            X_world=jnp.where(counts[None, :], X_world, 0.0),
            xy=jnp.where(counts[None, :], xy, 0.0),
            depth=jnp.where(has_depth, depth, 0.0),
            precision=jnp.concatenate([focal[:, None] / safe_sigma[None, :], inverse_depth_sigma[None, :]]),
            weights=jnp.where(counts, weights, 0.0),
            scale=loss_scale,
            prior=clean_prior,
        )

    return problem_of(known & positive(weights)), problem_of(known & (weights == 0))


def with_idle(problem: PoseProblem, idle: PoseProblem, T_world_cam: SE3, loss: Loss) -> PoseProblem:
    """The problem with its idle points back in their columns, for derivatives: the values of all sums are the same.

    An idle point whose residual at the pose is beyond what the loss can tell apart, or that is farther away than
    `FARTHEST_M`, stays out, so that a weight of 0 never multiplies an overflow.
    """
    chi2 = lax.stop_gradient(pose_cost(T_world_cam, idle._replace(prior=None), loss).chi2)
    near = (jnp.abs(idle.X_world) < FARTHEST_M).all(axis=0)
    back = (problem.weights == 0) & near & (chi2 < LARGEST_SQUARED)  # false for NaN
    pick = lambda of_idle, of_problem: jnp.where(back.reshape((1,) * (of_idle.ndim - 1) + (-1,)), of_idle, of_problem)
    return problem._replace(
        X_world=pick(idle.X_world, problem.X_world),
        xy=pick(idle.xy, problem.xy),
        precision=pick(idle.precision, problem.precision),
        weights=pick(idle.weights, problem.weights),
    )


def tangent_basis(T_world_cam: SE3) -> Float[Array, "7 6"]:
    """The derivative of the parameters `wxyz_xyz` of `T_world_cam @ exp(tangent)` at tangent zero."""
    R, Q = rotation_matrix(T_world_cam), _quaternion_basis(T_world_cam)
    return jnp.block([[jnp.zeros_like(Q), 0.5 * Q], [R, jnp.zeros_like(R)]])


def retract(T_world_cam: SE3, tangent: Float[Array, "6"]) -> SE3:
    """A step along the right tangent: `T_world_cam @ exp(tangent)` to first order, with a unit quaternion."""
    parameters = T_world_cam.wxyz_xyz + tangent_basis(T_world_cam) @ tangent
    q = parameters[:4]
    return SE3(jnp.concatenate([q * jax.lax.rsqrt(jnp.sum(q * q)), parameters[4:]]))


def shifted(T_world_cam: SE3, tangent: Float[Array, "6"]) -> SE3:
    """`retract` for steps that are zero but for their derivatives: the pose stays as it is, to the last bit.

    To second order and beyond, quaternions keep their length: a pose on the tangent plane is none.
    """
    change = tangent_basis(T_world_cam) @ tangent
    q, lift = T_world_cam.wxyz_xyz[:4], change[:4]
    q = q * jnp.sqrt(1.0 - jnp.sum(jnp.square(lift))) + lift
    return SE3(jnp.concatenate([q, T_world_cam.wxyz_xyz[4:] + change[4:]]))


class PoseCost(NamedTuple):
    """The cost at one pose.

    Attributes:
        cost: `½ Σ w ρ(s)` and the prior's share.
        equations: Its exact gradient, and the Hessian of iteratively reweighted least squares. That leaves out the
            curvature of the loss. Triggs' correction puts it back, and was tried: with 20 % outliers it takes 16 to 20
            steps where this takes 6 to 8, as its indefinite part must be damped away.
        chi2: Squared whitened residual s of each point, `UNKNOWN_CHI2` behind the camera.
        robust_weights: `ρ'(s)` of each point, 0 behind the camera.
    """

    cost: Scalar
    equations: NormalEquations
    chi2: Weights
    robust_weights: Weights


def pose_cost(T_world_cam: SE3, problem: PoseProblem, loss: Loss) -> PoseCost:
    """Evaluates the cost and its derivatives along `T_world_cam @ exp(tangent)`."""
    rows, front = _linearize(T_world_cam, problem)
    chi2 = jnp.where(front, jnp.sum(jnp.square(rows[6]), axis=0), UNKNOWN_CHI2)
    robust_weights = jnp.where(front, loss_weight(chi2, problem.scale, loss), 0.0)
    weights = apart(lambda: problem.weights * robust_weights)
    cost = 0.5 * jnp.sum(problem.weights * loss_value(chi2, problem.scale, loss))
    # With the residuals as a seventh column, JᵀWJ and JᵀWr in one. Row by row: XLA's CPU backend takes two thirds of
    # the time of one product of matrices.
    weighted = (rows * weights[None, None, :]).reshape(7, -1)
    gram = jnp.stack([rows.reshape(7, -1) @ row for row in weighted])
    gradient, hessian = gram[:6, 6], gram[:6, :6]
    if problem.prior is not None:
        error, jacobian = _prior_error(T_world_cam, problem.prior)
        pull = jacobian.T @ problem.prior.information
        cost = cost + 0.5 * error @ problem.prior.information @ error
        gradient, hessian = gradient + pull @ error, hessian + pull @ jacobian
    return PoseCost(cost, NormalEquations(gradient, hessian), chi2, robust_weights)


def pose_residuals(T_world_cam: SE3, problem: PoseProblem, loss: Loss) -> tuple[Float[Array, "3 n"], Float[Array, "6"]]:
    """Residuals of which half the sum of squares is the cost of `pose_cost`, for solvers of least squares.

    Those of a point are its whitened residuals times `sqrt(w ρ(s) / s)`; without a value, `UNKNOWN_CHI2` counts. The
    root of the prior's information is symmetric, and exists where that leaves directions free.

    Returns:
        `(3, n)` residuals of the points, and `(6,)` those of the prior, zeros without one.
    """
    rows, front = _linearize(T_world_cam, problem)
    whitened = jnp.where(front[None, :], rows[6], 0.0)
    chi2 = jnp.sum(jnp.square(whitened), axis=0)
    there = chi2 > 0
    safe = jnp.where(there, chi2, 1.0)
    stretch = jnp.where(there, loss_value(safe, problem.scale, loss) / safe, 1.0)
    unknown = loss_value(jnp.full_like(chi2, UNKNOWN_CHI2), problem.scale, loss)
    weights = jnp.where(problem.weights > 0, problem.weights, 1.0)
    scaled = whitened * jnp.sqrt(stretch * weights)[None, :]
    behind = jnp.zeros_like(whitened).at[0].set(jnp.sqrt(unknown * weights))
    residuals = jnp.where((problem.weights > 0)[None, :], jnp.where(front[None, :], scaled, behind), 0.0)
    if problem.prior is None:
        return residuals, jnp.zeros(6, chi2.dtype)
    values, vectors = jnp.linalg.eigh(problem.prior.information)
    root = (vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]) @ vectors.T
    return residuals, root @ _prior_error(T_world_cam, problem.prior)[0]


def _linearize(T_world_cam: SE3, problem: PoseProblem) -> tuple[Float[Array, "7 3 n"], Mask]:
    """Derivatives of the three whitened residuals along the tangent, then the residuals, and which points are in front.

    With X' = X - v - ω × X in the camera's frame, a residual of gradient a along X has the row (-a, a × X).
    """
    X, Y, Z = to_camera(T_world_cam, problem.X_world)
    front = Z > MIN_DEPTH
    inverse_z = 1.0 / jnp.where(front, Z, 1.0)
    x, y = apart(lambda: (X * inverse_z, Y * inverse_z))

    fu, fv, fd = problem.precision
    rows = lambda: _planes(
        (-fu * inverse_z, None, None),
        (None, -fv * inverse_z, None),
        (fu * inverse_z * x, fv * inverse_z * y, -fd),
        (fu * x * y, fv * (1.0 + y * y), -fd * Y),
        (-fu * (1.0 + x * x), -fv * x * y, fd * X),
        (fu * y, -fv * x, None),
        ((x - problem.xy[0]) * fu, (y - problem.xy[1]) * fv, (Z - problem.depth) * fd),
    )
    return apart(rows), front


def _planes(*columns: Sequence[Float[Array, " n"] | None]) -> Float[Array, "k l n"]:
    """Stack `k` times `l` planes, `None` for zeros, one after the other into the result.

    Of all at once, XLA's CPU backend asks for every number which plane it is of: 39 us for 832 points instead of 5.
    """
    some = next(plane for column in columns for plane in column if plane is not None)
    planes = jnp.zeros((len(columns) * len(columns[0]), *some.shape), some.dtype)
    for row, plane in enumerate(plane for column in columns for plane in column):
        if plane is not None:
            planes = lax.dynamic_update_slice(planes, plane[None], (row, 0))
    return planes.reshape(len(columns), len(columns[0]), *some.shape)


def _prior_error(T_world_cam: SE3, prior: PosePrior) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """The deviation from the prior and its derivative along the right tangent, both exact."""
    R, Q, q = rotation_matrix(T_world_cam), _quaternion_basis(T_world_cam), T_world_cam.wxyz_xyz[:4]
    predicted = prior.T_world_cam
    R_prior, Q_prior, q_prior = rotation_matrix(predicted), _quaternion_basis(predicted), predicted.wxyz_xyz[:4]
    sign = jnp.where(jnp.dot(q_prior, q) < 0, -1.0, 1.0)  # q and -q are the same rotation
    offset = R_prior.T @ (T_world_cam.translation() - predicted.translation())
    error = jnp.concatenate([offset, 2.0 * sign * (Q_prior.T @ q)])
    zeros = jnp.zeros_like(R)
    return error, jnp.block([[R_prior.T @ R, zeros], [zeros, sign * (Q_prior.T @ Q)]])


def _quaternion_basis(T: SE3) -> Float[Array, "4 3"]:
    """The quaternion q of a pose times i, j and k. Against another quaternion p it gives the vector part of `q⁻¹ p`."""
    w, x, y, z = T.wxyz_xyz[:4]
    return apart(lambda: jnp.stack([-x, -y, -z, w, -z, y, z, w, -x, -y, x, w])).reshape(4, 3)


def positive(values: Array) -> Array:
    """True for values that are finite and above zero."""
    return jnp.isfinite(values) & (values > 0)


def _usable(intrinsics: Intrinsics) -> Flag:
    pinhole = jnp.stack([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    usable = jnp.isfinite(pinhole).all() & (pinhole[:2] > 0).all()
    return usable if intrinsics.distortion is None else usable & jnp.isfinite(intrinsics.distortion).all()


def _usable_prior(prior: PosePrior | None) -> PosePrior | None:
    """The prior, or one that says nothing where it is not finite."""
    if prior is None:
        return None
    parameters = prior.T_world_cam.wxyz_xyz
    known = jnp.isfinite(parameters).all() & jnp.isfinite(prior.information).all()
    identity = jnp.zeros_like(parameters).at[0].set(1.0)
    information = jnp.where(known, 0.5 * (prior.information + prior.information.T), 0.0)
    return PosePrior(SE3(jnp.where(known, parameters, identity)).normalize(), information)
