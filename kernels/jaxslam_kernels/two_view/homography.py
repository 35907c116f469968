"""Whether a homography explains two views as well as a fundamental matrix does: no motion, pure rotation, one plane.

Points of such views lie on the epipolar lines of many fundamental matrices, and which one is found means nothing.
The two models are compared by Torr's criterion, which charges a model for its parameters and for the freedom that it
leaves to each point.

Source: Torr, "Geometric Motion Segmentation and Model Selection", Phil. Trans. R. Soc. A, 1998 (GRIC); Hartley and
Zisserman 2004, sections 4.1 and 4.2.6, for the homography and its Sampson distance.
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key

from jaxslam_kernels.ransac_sampling import draw_samples
from jaxslam_kernels.two_view.epipolar import sampson_squared
from jaxslam_kernels.two_view.fundamental_refine import Matrix, TwoViews
from jaxslam_kernels.types import Flag, Weights

THRESHOLD_SIGMAS = 1.96
"""A threshold is taken as so many standard deviations of a Sampson distance: 95 % of a Gaussian."""

_SAMPLES = 32
_STEPS = 4
_FREEDOM = 4.0  # numbers a match
_LARGEST_SLOPE = 8.0  # squared and summed: two of two
_LARGEST_COST = 2.0  # a match costs at most this times the constraints of a model, in squared deviations


def homography_suffices(key: Key[Array, ""], F: Matrix, views: TwoViews) -> Flag:
    """Whether the criterion of a homography is at most that of F, on the points of positive weight.

    Args:
        key: Random key, for the samples of four points.
        F: The fundamental matrix that has been found.
        views: Its inliers, as `TwoViews`; the others have weight 0.
    """
    weights = jnp.where(views.weights > 0, 1.0, 0.0).astype(views.weights.dtype)
    views = lax.stop_gradient(views._replace(weights=weights))
    H = _best_homography(key, views)
    inverse_variance = jnp.square(THRESHOLD_SIGMAS / views.threshold)
    of_F = sampson_squared(F, views.before, views.after) * inverse_variance
    of_H = homography_squared(H[:, :, None], views)[0] * inverse_variance
    return _criterion(of_H, weights, 2.0, 8.0) <= _criterion(of_F, weights, 3.0, 7.0)


def homography_squared(H: Float[Array, "3 3 h"], views: TwoViews) -> Float[Array, "h n"]:
    """Squared Sampson distances of each homography: `eᵀ (A Aᵀ + I)⁻¹ e`, e the error in the second view, A its slope.

    A slope larger than a zoom by two counts as that: near a singular homography the first order would call any
    error small.
    """
    (a, b, c), (d, e, f), (g, h, i) = (tuple(x[:, None] for x in row) for row in H)
    u, v = views.before[:, None]
    w = g * u + h * v + i
    inverse = 1.0 / jnp.where(jnp.abs(w) > 1e-6, w, 1e-6)
    x, y = (a * u + b * v + c) * inverse, (d * u + e * v + f) * inverse
    ex, ey = views.after[:1] - x, views.after[1:] - y
    xu, xv, yu, yv = (a - g * x) * inverse, (b - h * x) * inverse, (d - g * y) * inverse, (e - h * y) * inverse
    xx, xy, yy = xu * xu + xv * xv, xu * yu + xv * yv, yu * yu + yv * yv
    bound = jnp.minimum(1.0, _LARGEST_SLOPE / jnp.maximum(xx + yy, 1e-12))
    xx, xy, yy = bound * xx + 1.0, bound * xy, bound * yy + 1.0
    squared = (yy * ex * ex - 2.0 * xy * ex * ey + xx * ey * ey) / jnp.maximum(xx * yy - xy * xy, 1.0)
    return jnp.where(jnp.isfinite(squared), squared, jnp.inf)


def _criterion(squared: Weights, weights: Weights, dimension: float, parameters: float) -> Array:
    """`Σ min(e²/σ², 2 (r - d)) + n d ln r + k ln(r n)` for points of r numbers, d of which a model leaves free."""
    count = jnp.maximum(weights.sum(), 1.0)
    cost = jnp.sum(weights * jnp.minimum(squared, _LARGEST_COST * (_FREEDOM - dimension)))
    return cost + count * dimension * math.log(_FREEDOM) + parameters * jnp.log(_FREEDOM * count)


def _best_homography(key: Key[Array, ""], views: TwoViews) -> Matrix:
    """The homography that most points agree on: the best of a few samples, then least squares on who agrees with it."""
    samples = draw_samples(key, views.weights, _SAMPLES, 4)
    H = four_point(views.before[:, samples], views.after[:, samples])
    gate = jnp.square(views.threshold) * (6.0 / THRESHOLD_SIGMAS**2)  # 95 % of two numbers

    def agreement(H: Float[Array, "3 3 h"]) -> Array:
        return jnp.minimum(homography_squared(H, views) / gate, 1.0) @ views.weights

    def step(_: Int[Array, ""], best: Matrix) -> Matrix:
        squared = homography_squared(best[:, :, None], views)[0]
        weights = views.weights / jnp.square(1.0 + squared / (4.0 * gate))
        refined = _least_squares(best, views, jnp.where(squared < 9.0 * gate, weights, 0.0))
        costs = agreement(jnp.stack([best, refined], axis=2))
        return jnp.where(costs[1] < costs[0], refined, best)

    return lax.fori_loop(0, _STEPS, step, H[:, :, jnp.argmin(agreement(H))])


def four_point(before: Float[Array, "2 4 h"], after: Float[Array, "2 4 h"]) -> Float[Array, "3 3 h"]:
    """Homographies from four pairs each, by way of the projective frame; anything where three are on a line."""
    return _product(_frame(after), _inverse(_frame(before)))


def _frame(p: Float[Array, "2 4 h"]) -> Float[Array, "3 3 h"]:
    """The matrix that carries the unit vectors and their sum to four points."""
    columns = jnp.concatenate([p, jnp.ones_like(p[:1])])
    inverse = _inverse(columns[:, :3])
    return columns[:, :3] * (inverse * columns[None, :, 3]).sum(axis=1)[None]


def _inverse(M: Float[Array, "3 3 h"]) -> Float[Array, "3 3 h"]:
    """The adjugate, scaled to a mean entry of about one: an inverse up to its factor."""
    x, y, z = M[:, 0], M[:, 1], M[:, 2]
    rows = jnp.stack([jnp.cross(a, b, axis=0) for a, b in ((y, z), (z, x), (x, y))])
    return rows * lax.rsqrt(jnp.maximum(jnp.square(rows).mean(axis=(0, 1), keepdims=True), 1e-30))


def _product(A: Float[Array, "3 3 h"], B: Float[Array, "3 3 h"]) -> Float[Array, "3 3 h"]:
    product = (A[:, :, None] * B[None]).sum(axis=1)
    return product * lax.rsqrt(jnp.maximum(jnp.square(product).mean(axis=(0, 1), keepdims=True), 1e-30))


def _least_squares(H: Matrix, views: TwoViews, weights: Weights) -> Matrix:
    """One Gauss-Newton step on the distances in the second view, the last entry of H held."""
    u, v = views.before
    w = H[2, 0] * u + H[2, 1] * v + H[2, 2]
    inverse = 1.0 / jnp.where(jnp.abs(w) > 1e-6, w, 1e-6)
    x, y = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) * inverse, (H[1, 0] * u + H[1, 1] * v + H[1, 2]) * inverse
    p = jnp.stack([u, v, jnp.ones_like(u)]) * inverse[None]
    zero = jnp.zeros_like(p)
    by_x, by_y = jnp.concatenate([p, zero, -x[None] * p[:2]]), jnp.concatenate([zero, p, -y[None] * p[:2]])
    hessian = (by_x * weights[None]) @ by_x.T + (by_y * weights[None]) @ by_y.T
    gradient = by_x @ (weights * (views.after[0] - x)) + by_y @ (weights * (views.after[1] - y))
    ridge = 4.0 * jnp.finfo(H.dtype).eps * jnp.trace(hessian) + jnp.finfo(H.dtype).tiny
    step = jnp.linalg.solve(hessian + ridge * jnp.eye(8, dtype=H.dtype), gradient)
    moved = H + jnp.append(step, 0.0).reshape(3, 3)
    return jnp.where(jnp.isfinite(moved).all(), moved, H)
