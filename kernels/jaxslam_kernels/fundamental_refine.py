"""A fundamental matrix refined on the Sampson distances of matched points, seven unknowns, differentiable.

Matrices of rank two and unit norm form a surface of seven dimensions. With the epipoles `F v3 = 0`, `u3ᵀ F = 0`
completed to orthonormal bases U and V, `F = U diag(S, 0) Vᵀ` with S of 2 x 2, and every change keeps the rank to first
order if it has no part in the last corner; the corner that keeps it exactly is `a S⁻¹ b`, a Schur complement.
No singular value decomposition takes part.

Source: Bartoli and Sturm, "Nonlinear estimation of the fundamental matrix with minimal parameters", PAMI 2004, for
the idea; Absil, Mahony and Sepulchre, "Optimization Algorithms on Matrix Manifolds", 2008, for matrices of fixed rank.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from jaxslam_kernels.epipolar import LEAST_SLOPE, adjugate, sampson_squared
from jaxslam_kernels.levenberg_marquardt import ManifoldLevenbergMarquardt, NormalEquations
from jaxslam_kernels.robust import Loss, loss_value, loss_weight
from jaxslam_kernels.types import Flag, Pixels, Scalar, Weights

Matrix = Float[Array, "3 3"]


class TwoViews(NamedTuple):
    """Matched points, clean: everything finite, weight 0 for what does not count.

    Attributes:
        before: In the first view, in any unit that makes their spread about one.
        after: In the second view, in the same unit.
        weights: Factor of each one's cost.
        threshold: Largest Sampson distance of an inlier, in that unit.
    """

    before: Pixels
    after: Pixels
    weights: Weights
    threshold: Scalar


def refine_matrix(F: Matrix, views: TwoViews, loss: Loss, scale: float, max_steps: int) -> tuple[Matrix, Flag, Flag]:
    """The optimum near F with its derivative by the points, whether it converged, and whether it is determined."""
    optimum, hessian, converged = solve_matrix(F, views, loss, scale, max_steps)
    refined = optimum + jnp.tensordot(_basis(optimum), _optimum_shift(optimum, views, loss, scale), 1)
    return refined, converged, _is_determined(hessian)


def solve_matrix(
    F: Matrix, views: TwoViews, loss: Loss, scale: float, max_steps: int
) -> tuple[Matrix, Float[Array, "7 7"], Flag]:
    """The optimum, the Hessian there up to scale and whether it converged; constant for differentiation.

    Args:
        F: Where to start: rank two, unit norm, finite.
        views: The points.
        loss: Of the squared Sampson distances in squared thresholds, static.
        scale: Its scale in thresholds, static.
        max_steps: Bound on the evaluations of the cost, static.
    """
    F, views = lax.stop_gradient((F, views))
    epsilon = float(jnp.finfo(F.dtype).eps)
    solution = optx.minimise(
        lambda F, views: _equations(F, views, loss, scale),
        ManifoldLevenbergMarquardt(retract=_retract, atol=3.0 * epsilon**0.5, rtol=8.0 * epsilon),
        F,
        views,
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    return solution.value, solution.state.model.hessian.as_matrix(), solution.result == optx.RESULTS.successful


def score_matrices(F: Float[Array, "3 3 *batch"], views: TwoViews) -> Float[Array, "*batch"]:
    """`Σ w (1 - min(e², 1))` of each matrix, e in thresholds: one fused pass over matrices x points."""
    inverse = 1.0 / jnp.square(views.threshold)
    return (1.0 - jnp.minimum(sampson_squared(F, views.before, views.after) * inverse, 1.0)) @ views.weights


def _equations(F: Matrix, views: TwoViews, loss: Loss, scale: float) -> tuple[Scalar, NormalEquations]:
    """The cost at F and its normal equations in the tangent of `_retract`."""
    u1, v1 = views.before
    u2, v2 = views.after
    one = jnp.ones_like(u1)
    p1, p2 = jnp.stack([u1, v1, one]), jnp.stack([u2, v2, one])
    line, back = F @ p1, F.T @ p2
    error = (p2 * line).sum(axis=0)
    inverse = lax.rsqrt(jnp.maximum(jnp.square(line[:2]).sum(axis=0) + jnp.square(back[:2]).sum(axis=0), LEAST_SLOPE))
    residual = error * inverse / views.threshold
    # d residual / d F, row by column: of the error, and of the length it is divided by
    pull = residual * inverse
    after = (p2 * (inverse / views.threshold)[None]).at[:2].add(-(pull * inverse)[None] * line[:2])
    before = ((pull * inverse)[None] * back).at[2].set(0.0)
    by_F = after[:, None] * p1[None] - p2[:, None] * before[None]
    jacobian = _basis(F).reshape(9, 7).T @ by_F.reshape(9, -1)
    squared = jnp.square(residual)
    weight = views.weights * loss_weight(squared, scale, loss)
    cost = 0.5 * jnp.sum(views.weights * loss_value(squared, scale, loss))
    return cost, NormalEquations(jacobian @ (weight * residual), (jacobian * weight[None]) @ jacobian.T)


def _basis(F: Matrix) -> Float[Array, "3 3 7"]:
    """Seven orthonormal directions in which F may change: rank and norm stay to first order."""
    U, V, S = _frames(F)
    (a, b), (c, d) = S
    zero = jnp.zeros_like(a)
    inner = [(-b, a, -d, c), (-c, d, a, -b), (-d, -c, b, a)]  # orthogonal to (a, b, c, d) and to each other
    changes = [
        jnp.stack([jnp.stack([x, y, zero]), jnp.stack([z, w, zero]), jnp.stack([zero] * 3)]) for x, y, z, w in inner
    ]
    unit = jnp.eye(9, dtype=F.dtype).reshape(9, 3, 3)
    changes = jnp.concatenate([jnp.stack(changes), unit[jnp.array([2, 5, 6, 7])]])
    return jnp.einsum("ij,kjl,ml->imk", U, changes, V)


def _retract(F: Matrix, tangent: Float[Array, "7"]) -> Matrix:
    """The matrix of rank two and unit norm at a step along `_basis`."""
    U, V, _ = _frames(F)
    moved = F + jnp.tensordot(_basis(F), tangent, 1)
    (a, b, e), (c, d, f), (g, h, _) = U.T @ moved @ V
    determinant = a * d - b * c
    regular = jnp.abs(determinant) > 1e-12
    inverse = jnp.where(regular, 1.0 / jnp.where(regular, determinant, 1.0), 0.0)
    corner = inverse * (g * (d * e - b * f) + h * (a * f - c * e))
    moved = moved + corner * jnp.outer(U[:, 2], V[:, 2])
    return moved * lax.rsqrt(jnp.maximum(jnp.square(moved).sum(), 1e-24))


def _frames(F: Matrix) -> tuple[Matrix, Matrix, Float[Array, "2 2"]]:
    """Orthonormal U and V, the epipoles in their last columns, and S of unit norm, `F ~ U diag(S, 0) Vᵀ`."""
    cofactors = adjugate(F)  # v3 u3ᵀ up to scale
    u3 = cofactors[jnp.argmax(jnp.square(cofactors).sum(axis=1))]
    v3 = cofactors[:, jnp.argmax(jnp.square(cofactors).sum(axis=0))]
    U, V = _completed(u3), _completed(v3)
    S = U[:, :2].T @ F @ V[:, :2]
    return U, V, S * lax.rsqrt(jnp.maximum(jnp.square(S).sum(), 1e-24))


def _completed(axis: Float[Array, "3"]) -> Matrix:
    """An orthonormal basis whose last column is along `axis`; the identity if that is zero."""
    squared = jnp.square(axis).sum()
    usable = squared > 1e-30
    x, y, z = jnp.where(usable, axis * lax.rsqrt(jnp.where(usable, squared, 1.0)), jnp.array([0, 0, 1], axis.dtype))
    # Duff et al., "Building an Orthonormal Basis, Revisited", 2017
    sign = jnp.where(z < 0, -1.0, 1.0).astype(axis.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = ((1.0 + sign * x * x * a, b, x), (sign * b, sign + y * y * a, y), (-sign * x, -y, z))
    return jnp.stack([jnp.stack(row) for row in rows])


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _optimum_shift(optimum: Matrix, views: TwoViews, loss: Loss, scale: float) -> Float[Array, "7"]:
    """Zero, with the derivative of the optimum by the points, in the tangent of `_retract`.

    At the optimum the gradient g of the cost vanishes whatever the points θ, so dξ = -H⁻¹ (∂g/∂θ) dθ with H the
    exact Hessian.
    """
    del views, loss, scale
    return jnp.zeros(7, optimum.dtype)


@_optimum_shift.defjvp
def _optimum_shift_jvp(loss: Loss, scale: float, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    optimum, views = lax.stop_gradient(primals[0]), primals[1]
    zero = jnp.zeros(7, optimum.dtype)

    def gradient(tangent: Array, views: TwoViews) -> Array:
        return jax.grad(lambda t: _cost(_retract(optimum, t), views, loss, scale))(tangent)

    _, change = jax.jvp(partial(gradient, zero), (views,), (tangents[1],))
    exact = jax.jacfwd(gradient)(zero, views)
    exact = 0.5 * (exact + exact.T)
    reweighted = _equations(optimum, views, loss, scale)[1].hessian
    # Where the solver stopped short of a minimum the reweighted Hessian stands in; undetermined, nothing moves.
    hessian = jnp.where(_is_determined(exact), exact, reweighted)
    determined = _is_determined(hessian)
    scaled, unit = _scaled(jnp.where(determined, hessian, jnp.eye(7, dtype=hessian.dtype)))
    return zero, -unit * cho_solve(cho_factor(scaled), unit * jnp.where(determined, change, 0.0))


def _cost(F: Matrix, views: TwoViews, loss: Loss, scale: float) -> Scalar:
    squared = sampson_squared(F, views.before, views.after) / jnp.square(views.threshold)
    return 0.5 * jnp.sum(views.weights * loss_value(squared, scale, loss))


def _is_determined(hessian: Float[Array, "7 7"]) -> Flag:
    """Whether no direction is free: the pivots of the Hessian scaled to unit diagonal stand clear of rounding."""
    factor, _ = cho_factor(_scaled(lax.stop_gradient(hessian))[0])
    pivots = jnp.square(jnp.diagonal(factor))
    return jnp.isfinite(factor).all() & (pivots.min() > float(jnp.finfo(hessian.dtype).eps) ** 0.75)


def _scaled(hessian: Float[Array, "7 7"]) -> tuple[Array, Array]:
    diagonal = jnp.diagonal(hessian)
    unit = lax.rsqrt(jnp.where(diagonal > 1e-12, diagonal, 1.0))
    return hessian * unit[:, None] * unit[None, :], unit
