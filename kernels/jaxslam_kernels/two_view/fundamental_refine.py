"""A fundamental matrix refined on the Sampson distances of matched points, seven unknowns, differentiable.

Matrices of rank two and unit norm form a surface of seven dimensions. With the epipoles `F v3 = 0`, `u3ᵀ F = 0`
completed to orthonormal bases U and V, `F = U diag(S, 0) Vᵀ` with S of 2 x 2: a step turns each basis so that its
epipole moves (two numbers each) and changes S (three). Bartoli and Sturm have singular values and turns about both
epipoles instead of S; where the singular values are equal those two turns are one. No decomposition takes part.

Source: Bartoli and Sturm, "Nonlinear estimation of the fundamental matrix with minimal parameters", PAMI 2004, for
the idea; Absil, Mahony and Sepulchre, "Optimization Algorithms on Matrix Manifolds", 2008, for matrices of fixed rank.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float

from jaxslam_kernels.derivative_rules import implicit_shift
from jaxslam_kernels.levenberg_marquardt import ManifoldLevenbergMarquardt, NormalEquations
from jaxslam_kernels.positive_definite import is_determined, solve_exact
from jaxslam_kernels.robust import Loss, loss_value, loss_weight
from jaxslam_kernels.two_view.epipolar import MIN_SLOPE, adjugate, sampson_squared
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


class FramedMatrix(NamedTuple):
    """A matrix of rank two and unit norm, `U diag(S, 0) Vᵀ`.

    Attributes:
        U: Orthonormal; the epipole of the second view in its last column.
        V: Orthonormal; the epipole of the first view in its last column.
        S: Matrix of unit norm.
    """

    U: Matrix
    V: Matrix
    S: Float[Array, "2 2"]

    def matrix(self) -> Matrix:
        """The matrix itself."""
        return self.U[:, :2] @ self.S @ self.V[:, :2].T


def refine_matrix(
    F: Matrix, views: TwoViews, idle: TwoViews, loss: Loss, scale: float, max_steps: int
) -> tuple[Matrix, Flag, Flag]:
    """The optimum near F with its derivative by the points, whether it converged, and whether it is determined.

    The idle points, all of weight 0, matter to the derivative by their weights only.
    """
    optimum, hessian, converged = solve_matrix(F, views, loss, scale, max_steps)
    rules = partial(_slope, loss, scale), partial(_solve, loss, scale)
    step = implicit_shift(*rules, jnp.zeros(7, F.dtype), optimum, (views, idle))
    return _retract(optimum, step).matrix(), converged, is_determined(hessian)


def solve_matrix(
    F: Matrix, views: TwoViews, loss: Loss, scale: float, max_steps: int
) -> tuple[FramedMatrix, Float[Array, "7 7"], Flag]:
    """The optimum, the Hessian there up to scale and whether it converged; constant for differentiation.

    Args:
        F: Initial matrix: rank two, unit norm, finite.
        views: The points.
        loss: Loss on the squared Sampson distances in squared thresholds, static.
        scale: Its scale in thresholds, static.
        max_steps: Bound on the evaluations of the cost, static.
    """
    F, views = lax.stop_gradient((F, views))
    epsilon = float(jnp.finfo(F.dtype).eps)
    solution = optx.minimise(
        lambda F, views: _equations(F, views, loss, scale),
        ManifoldLevenbergMarquardt(retract=_retract, atol=3.0 * epsilon**0.5, rtol=64.0 * epsilon),
        _framed(F),
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


def _equations(F: FramedMatrix, views: TwoViews, loss: Loss, scale: float) -> tuple[Scalar, NormalEquations]:
    """The cost at F and its normal equations in the tangent of `_retract`."""
    one = jnp.ones_like(views.weights)[None]
    p1, p2 = F.V.T @ jnp.concatenate([views.before, one]), F.U.T @ jnp.concatenate([views.after, one])
    line, back = F.S @ p1[:2], F.S.T @ p2[:2]  # in the axes of U and V; their last entries are 0
    error = (p2[:2] * line).sum(axis=0)
    slope, slope_back = F.U[:2, :2] @ line, F.V[:2, :2] @ back
    inverse = lax.rsqrt(jnp.maximum((jnp.square(slope) + jnp.square(slope_back)).sum(axis=0), MIN_SLOPE))
    unit = inverse / views.threshold
    residual = error * unit
    # d residual / d entry (i, j) in those axes: of the error, and of the length that it is divided by
    pull = residual * jnp.square(inverse)
    after, before = unit[None] * p2 - pull[None] * (F.U[:2].T @ slope), pull[None] * (F.V[:2].T @ slope_back)
    by_entry = after[:, None] * p1[None] - p2[:, None] * before[None]
    inner = jnp.tensordot(_turns_of(F.S), by_entry[:2, :2], 2)
    jacobian = jnp.concatenate([inner, by_entry[:2, 2], by_entry[2, :2]])
    squared = jnp.square(residual)
    weight = views.weights * loss_weight(squared, scale, loss)
    cost = 0.5 * jnp.sum(views.weights * loss_value(squared, scale, loss))
    return cost, NormalEquations(jacobian @ (weight * residual), (jacobian * weight[None]) @ jacobian.T)


def _retract(F: FramedMatrix, tangent: Float[Array, "7"]) -> FramedMatrix:
    """A step: three entries along `_turns_of(S)`, the last column of `Uᵀ F V`, its last row; orthonormal directions.

    An entry in the last column moves the epipole of the first view, one in the last row that of the second.
    """
    (a, b), (c, d) = F.S
    determinant = a * d - b * c
    regular = jnp.abs(determinant) > 1e-12
    inverse = jnp.where(regular, 1.0 / jnp.where(regular, determinant, 1.0), 0.0)
    x, y, z, w = tangent[3:] * inverse
    moved = F.S + jnp.tensordot(tangent[:3], _turns_of(F.S), 1)
    return FramedMatrix(
        U=F.U @ _completed(jnp.stack([c * w - d * z, b * z - a * w, jnp.ones_like(z)])),
        V=F.V @ _completed(jnp.stack([b * y - d * x, c * x - a * y, jnp.ones_like(x)])),
        S=moved * lax.rsqrt(jnp.square(moved).sum()),  # not shorter than S
    )


def _turns_of(S: Float[Array, "2 2"]) -> Float[Array, "3 2 2"]:
    """Three directions orthonormal to S and to each other."""
    (a, b), (c, d) = S
    return jnp.stack([-b, a, -d, c, -c, d, a, -b, -d, -c, b, a]).reshape(3, 2, 2)


def _framed(F: Matrix) -> FramedMatrix:
    """F, of rank two, of unit norm."""
    cofactors = adjugate(F)  # v3 u3ᵀ up to scale
    u3 = cofactors[jnp.argmax(jnp.square(cofactors).sum(axis=1))]
    v3 = cofactors[:, jnp.argmax(jnp.square(cofactors).sum(axis=0))]
    U, V = _completed(u3), _completed(v3)
    S = U[:, :2].T @ F @ V[:, :2]
    return FramedMatrix(U, V, S * lax.rsqrt(jnp.maximum(jnp.square(S).sum(), 1e-24)))


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


def _gradient(
    loss: Loss, scale: float, step: Float[Array, "7"], optimum: FramedMatrix, views: TwoViews
) -> Float[Array, "7"]:
    """Gradient of the cost a step away from the optimum."""
    return jax.grad(lambda step: _cost(_retract(optimum, step), views, loss, scale))(step)


def _slope(
    loss: Loss, scale: float, step: Float[Array, "7"], optimum: FramedMatrix, inputs: tuple[TwoViews, TwoViews]
) -> Float[Array, "7"]:
    """The gradient with that of the idle points, which is zero but for its derivatives."""
    views, idle = inputs
    return _gradient(loss, scale, step, optimum, views) + _gradient(loss, scale, step, optimum, idle)


def _solve(
    loss: Loss, scale: float, optimum: FramedMatrix, inputs: tuple[TwoViews, TwoViews], right: Float[Array, "7"]
) -> Float[Array, "7"]:
    """Solve for a step."""
    exact = jax.jacfwd(partial(_gradient, loss, scale))(jnp.zeros_like(right), optimum, inputs[0])
    return solve_exact(exact, _equations(optimum, inputs[0], loss, scale)[1].hessian, right)


def _cost(F: FramedMatrix, views: TwoViews, loss: Loss, scale: float) -> Scalar:
    squared = sampson_squared(F.matrix(), views.before, views.after) / jnp.square(views.threshold)
    return 0.5 * jnp.sum(views.weights * loss_value(squared, scale, loss))
