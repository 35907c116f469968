"""Epipolar geometry of two views: distances to epipolar lines, and fundamental matrices from seven points.

A fundamental matrix F maps a pixel of the first view, `p1 = (u, v, 1)`, to the line `F p1` of the second on which
its partner p2 lies: `p2ᵀ F p1 = 0`. Its scale and sign mean nothing.

Source: Hartley and Zisserman, "Multiple View Geometry in Computer Vision", 2004, sections 11.1.2 (seven points) and
11.4.3 (Sampson distance); Hartley, "In Defense of the Eight-Point Algorithm", 1997, for the normalization.
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.checks import checked
from jaxslam_kernels.se3 import between, cross_matrix
from jaxslam_kernels.types import Pixels, Weights

_CUBIC_STEPS = 2  # after the closed form, which float32 leaves short of a few digits
_TINY = 1e-20  # a squared length from which on a line has a direction
MIN_SLOPE = 1e-12  # squared; second derivatives by it are finite in float32

Matrices = Float[Array, "3 3 *batch"]


@checked
def epipolar_distances(F: Float[Array, "3 3"], uv_before: Pixels, uv_after: Pixels) -> Weights:
    """Distance of each second point from the epipolar line of the first, `|p2ᵀ F p1| / √(X² + Y²)`, `(X, Y, Z) = F p1`.

    Source: the formula by which DS-SLAM (Yu et al., IROS 2018) and RTS-SLAM (Sensors 2026) tell moving points.

    Args:
        F: A fundamental matrix, any scale.
        uv_before: Pixels in the first view.
        uv_after: Pixels in the second view.

    Returns:
        Pixels; 0 where there is no line (X = Y = 0, as at an epipole or with F = 0) or a point is not finite. Finite
        with finite derivatives.
    """
    known, p1, p2 = _known(uv_before, uv_after)
    X, Y, Z = _lines(F, p1)
    return _ratio(p2[0] * X + p2[1] * Y + Z, X * X + Y * Y, known)


@checked
def sampson_distances(F: Float[Array, "3 3"], uv_before: Pixels, uv_after: Pixels) -> Weights:
    """Sampson distance: how far both points must move, to first order, to satisfy F: `|p2ᵀ F p1| / |gradient|`, pixels.

    Symmetric in the two views, and one standard deviation for points with one of noise in each coordinate. Arguments
    and degenerate cases as in `epipolar_distances`.
    """
    known, p1, p2 = _known(uv_before, uv_after)
    X, Y, Z = _lines(F, p1)
    x, y, _ = _lines(F.T, p2)
    return _ratio(p2[0] * X + p2[1] * Y + Z, X * X + Y * Y + x * x + y * y, known)


@checked
def sampson_squared(F: Matrices, before: Pixels, after: Pixels) -> Float[Array, "*batch n"]:
    """Squares of `sampson_distances` of many matrices at once; points have to be finite."""
    (a, b, c), (d, e, f), (g, h, i) = (tuple(x[..., None] for x in row) for row in F)
    u, v = (x.reshape((1,) * (F.ndim - 2) + (-1,)) for x in before)
    X, Y, Z = a * u + b * v + c, d * u + e * v + f, g * u + h * v + i
    u, v = (x.reshape((1,) * (F.ndim - 2) + (-1,)) for x in after)
    x, y = a * u + d * v + g, b * u + e * v + h
    error = u * X + v * Y + Z
    return error * error / jnp.maximum(X * X + Y * Y + x * x + y * y, MIN_SLOPE)


@checked
def fundamental_of_poses(T_world_before: SE3, T_world_after: SE3, intrinsics: Intrinsics) -> Float[Array, "3 3"]:
    """The fundamental matrix of two poses of one camera, `K⁻ᵀ [t]ₓ R K⁻¹`; zero where the camera only turned.

    Source: Hartley and Zisserman 2004, equation 9.12.

    Args:
        T_world_before: Pose of the first view.
        T_world_after: Pose of the second view.
        intrinsics: The camera; lens distortion is left out.
    """
    T_after_before = between(T_world_after, T_world_before)
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    rays = jnp.stack(
        [jnp.stack([1 / fx, zero, -cx / fx]), jnp.stack([zero, 1 / fy, -cy / fy]), jnp.stack([zero, zero, one])]
    )
    return rays.T @ cross_matrix(T_after_before.translation()) @ T_after_before.rotation().as_matrix() @ rays


@checked
def seven_point(
    uv_before: Float[Array, "2 7 h"], uv_after: Float[Array, "2 7 h"]
) -> tuple[Float[Array, "3 3 3 h"], Bool[Array, "3 h"]]:
    """The up to three fundamental matrices on which seven pairs of points agree, many samples at once.

    The matrices with `p2ᵀ F p1 = 0` for seven pairs form a pencil, found by Householder reflections; those of rank
    two in it are at the roots of a cubic. Not meant for differentiation: which solution stands in which place may jump.

    Args:
        uv_before: Pixels in the first view.
        uv_after: Pixels in the second view.

    Returns:
        `(3, 3, 3, h)` (row, column, solution, sample) matrices of unit norm and `(3, h)` which of them are real; 0
        where not, or where a sample is not finite.
    """
    known = jnp.isfinite(uv_before).all(axis=(0, 1)) & jnp.isfinite(uv_after).all(axis=(0, 1))
    (u1, v1), shift1, scale1 = _normalized(jnp.where(known[None, None, :], uv_before, 0.0))
    (u2, v2), shift2, scale2 = _normalized(jnp.where(known[None, None, :], uv_after, 0.0))
    ones = jnp.ones_like(u1)
    columns = jnp.stack([u2 * u1, u2 * v1, u2, v2 * u1, v2 * v1, v2, u1, v1, ones])  # (entry of F, pair, sample)
    pencil = _null_space(columns)
    first, second = (f.reshape(3, 3, -1) for f in (pencil[:, 0], pencil[:, 1]))
    F, real = _singular_members(first, second)
    F = _in_pixels(F, shift1, scale1, shift2, scale2)
    size = jnp.sqrt(jnp.square(F).sum(axis=(0, 1)))
    real = real & known[None, :] & jnp.isfinite(size) & (size > 0)
    return jnp.where(real[None, None], F / jnp.where(size > 0, size, 1.0)[None, None], 0.0), real


@checked
def adjugate(F: Matrices) -> Matrices:
    """The transposed cofactors: the inverse times the determinant."""
    (a, b, c), (d, e, f), (g, h, i) = F
    rows = (
        (e * i - f * h, c * h - b * i, b * f - c * e),
        (f * g - d * i, a * i - c * g, c * d - a * f),
        (d * h - e * g, b * g - a * h, a * e - b * d),
    )
    return jnp.stack([jnp.stack(row) for row in rows])


def _known(uv_before: Pixels, uv_after: Pixels) -> tuple[Array, Array, Array]:
    known = jnp.isfinite(uv_before).all(axis=0) & jnp.isfinite(uv_after).all(axis=0)
    return known, jnp.where(known[None, :], uv_before, 0.0), jnp.where(known[None, :], uv_after, 0.0)


def _lines(F: Array, p: Array) -> tuple[Array, Array, Array]:
    u, v = p
    X, Y, Z = (row[0] * u + row[1] * v + row[2] for row in F)
    return X, Y, Z


def _ratio(error: Array, squared: Array, known: Array) -> Array:
    usable = known & (squared > _TINY)
    return jnp.where(usable, jnp.abs(error) * lax.rsqrt(jnp.where(usable, squared, 1.0)), 0.0)


def _normalized(uv: Array) -> tuple[Array, Array, Array]:
    """Points around the origin, √2 away on average, and what has been subtracted and multiplied."""
    shift = uv.mean(axis=1)
    centered = uv - shift[:, None]
    spread = jnp.sqrt(jnp.square(centered).sum(axis=0)).mean(axis=0)
    scale = math.sqrt(2.0) / jnp.where(spread > 0, spread, math.sqrt(2.0))
    return centered * scale[None, None, :], shift, scale


def _in_pixels(F: Array, shift1: Array, scale1: Array, shift2: Array, scale2: Array) -> Array:
    """`T2ᵀ F T1` of a matrix for points `T p`, `T` a shift followed by a scale."""
    scale1, scale2 = scale1[None, None, :], scale2[None, None, :]
    shift1, shift2 = shift1[:, None, None, :], shift2[:, None, None, :]
    c1, c2, c3 = F[:, 0] * scale1, F[:, 1] * scale1, F[:, 2]
    F = jnp.stack([c1, c2, c3 - shift1[0] * c1 - shift1[1] * c2], axis=1)
    r1, r2, r3 = F[0] * scale2, F[1] * scale2, F[2]
    return jnp.stack([r1, r2, r3 - shift2[0] * r1 - shift2[1] * r2])


def _null_space(columns: Float[Array, "9 7 h"]) -> Float[Array, "9 2 h"]:
    """Two orthonormal vectors orthogonal to seven, by Householder reflections: fixed shapes, backward stable.

    Loops with masks: unrolled it is ten times the code, and takes 0.1 ms more where that is not in the caches.
    """
    rows, steps = jnp.arange(9)[:, None], columns.shape[1]

    def reflected(x: Array, normal: Array) -> Array:
        return x - normal[:, None] * (normal[:, None] * x).sum(axis=0)[None]

    def reduced(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, normals = state
        x = jnp.where(rows >= k, rest[:, k], 0.0)
        size = jnp.sqrt(jnp.square(x).sum(axis=0))
        normal = x + jnp.where(rows == k, jnp.where(x[k] < 0, -size, size), 0.0)
        factor = jnp.square(normal).sum(axis=0)
        normal = normal * jnp.sqrt(2.0 / jnp.where(factor > 0, factor, jnp.inf))[None, :]
        return reflected(rest, normal), normals.at[k].set(normal)

    _, normals = lax.fori_loop(0, steps, reduced, (columns, jnp.zeros_like(columns.swapaxes(0, 1))))
    last = jnp.broadcast_to(jnp.eye(9, dtype=columns.dtype)[:, 7:, None], (9, 2, columns.shape[2]))
    return lax.fori_loop(0, steps, lambda k, null: reflected(null, normals[steps - 1 - k]), last)


def _singular_members(first: Matrices, second: Matrices) -> tuple[Array, Array]:
    """The up to three members of a pencil of matrices whose determinant is zero, and which of them are real.

    The pencil is turned by an eighth until the determinant of its first matrix is large: the cubic in x then has a
    leading coefficient to divide by, and no root far away.
    """
    k3, k2, k1, k0 = _determinants(first, second)
    half = math.sqrt(0.5)
    turns = [(1.0, 0.0), (0.0, 1.0), (half, half), (half, -half)]
    sizes = jnp.abs(jnp.stack([k3 * c**3 + k2 * c * c * s + k1 * c * s * s + k0 * s**3 for c, s in turns]))
    cosine, sine = jnp.asarray(turns, first.dtype)[jnp.argmax(sizes, axis=0)].T[:, None, None]
    turned, other = cosine * first + sine * second, cosine * second - sine * first
    roots, real = _real_roots(*_determinants(turned, other))
    return roots[None, None] * turned[:, :, None] + other[:, :, None], real


def _determinants(first: Matrices, second: Matrices) -> tuple[Array, Array, Array, Array]:
    """`det(x first + second)` as a cubic in x, from the leading coefficient on."""
    of_first, of_second = adjugate(first), adjugate(second)
    trace = lambda a, b: (a * b.swapaxes(0, 1)).sum(axis=(0, 1))
    return (
        trace(of_first, first) / 3.0,
        trace(of_first, second),
        trace(of_second, first),
        trace(of_second, second) / 3.0,
    )


def _real_roots(k3: Array, k2: Array, k1: Array, k0: Array) -> tuple[Float[Array, "3 h"], Bool[Array, "3 h"]]:
    """The roots of `k3 x³ + k2 x² + k1 x + k0`, the first real, and whether the others are.

    Three by the trigonometric form, one by Cardano's, its cube root the one in which nothing cancels; Newton's method
    then gives back the digits that rounding took.
    """
    tiny = jnp.finfo(k3.dtype).tiny
    k3, k2, k1, k0 = (k[None, :] for k in (k3, k2, k1, k0))
    k3 = jnp.where(jnp.abs(k3) > tiny, k3, 1.0)
    b, c, d = k2 / k3, k1 / k3, k0 / k3
    third = b / 3.0
    p, q = c - b * third, 2.0 * third * third * third - third * c + d  # x = t - b/3, t³ + p t + q = 0
    radius = jnp.sqrt(jnp.abs(p) / 3.0)
    ratio = jnp.abs(q) / jnp.maximum(2.0 * radius * radius * radius, tiny)
    three = (p < 0) & (ratio <= 1.0)
    angle = jnp.arccos(jnp.minimum(ratio, 1.0)) / 3.0
    t = jnp.concatenate([2.0 * radius * jnp.cos(angle + turn * math.pi / 3.0) for turn in (0.0, 2.0, -2.0)])
    cardano = jnp.cbrt(0.5 * jnp.abs(q) + jnp.sqrt(jnp.maximum(0.25 * q * q + p * p * p / 27.0, 0.0)))
    t = jnp.where(three, t, cardano - p / (3.0 * jnp.maximum(cardano, tiny)))
    x = jnp.where(q < 0, t, -t) - third
    for _ in range(_CUBIC_STEPS):
        slope = (3.0 * x + 2.0 * b) * x + c
        step = (((x + b) * x + c) * x + d) / jnp.where(jnp.abs(slope) > tiny, slope, jnp.inf)
        x = x - jnp.where(jnp.abs(step) < 0.1 * (1.0 + jnp.abs(x)), step, 0.0)  # a double root throws no one far
    return x, jnp.concatenate([jnp.ones_like(three), three, three])
