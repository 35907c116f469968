"""Perspective-three-point: how far away three known points are, from the directions they are seen in.

Many triples at once, in single precision, without a branch. The law of cosines gives one quadratic form a pair of
points in the three distances λ. Two combinations of them are homogeneous: conics, which meet in up to four λ. The
pencil of the two conics holds a degenerate one, a pair of lines, at the root of a cubic; each line meets a conic in
two points. Newton's method on the three forms then takes every candidate to full precision, and the candidates that
leave a residual are discarded, so no decision hangs on the sign of a rounded discriminant.

Source: Persson and Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver", ECCV
2018, for the pencil and the cubic; Richter-Gebert, "Perspectives on Projective Geometry", 2011, section 11, for
splitting a degenerate conic into lines.
"""

from collections.abc import Sequence
from typing import TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

_Planes: TypeAlias = tuple[Array, ...]
"""Coordinates apart: three of a vector, or the upper triangle `00 01 02 11 12 22` of a symmetric form (a conic)."""

_CUBIC_STEPS = 2
_NEWTON_STEPS = 4
_RESIDUAL = 1e-3  # of the squared distances, relative: a root stands at rounding, a miss at a few per cent or more


def p3p(
    bearings: Float[Array, "3 3 h"], X_world: Float[Array, "3 3 h"]
) -> tuple[Float[Array, "3 4 h"], Bool[Array, "4 h"]]:
    """Distances from the camera to three points, up to four solutions a triple.

    With these, `distance * bearing` are the points in the camera's frame and the pose follows from
    `absolute_orientation`. Not meant for differentiation.

    Args:
        bearings: Unit vectors towards the points, (coordinate, point, triple), camera frame.
        X_world: The points, (coordinate, point, triple), metres.

    Returns:
        Distances in metres, (point, solution, triple), and which solutions are real, with all points in front. The
        same solution may come twice. All finite, whatever came in.
    """
    known = jnp.isfinite(bearings).all(axis=(0, 1)) & jnp.isfinite(X_world).all(axis=(0, 1))
    bearings, X_world = (jnp.where(known[None, None, :], a, 0.0) for a in (bearings, X_world))
    squared = _squared_sides(X_world)
    size = (squared[0] + squared[1] + squared[2]) / 3.0
    spread = size > 0
    squared = tuple(d / jnp.where(spread, size, 1.0) for d in squared)
    versines = tuple(0.5 * s for s in _squared_sides(bearings))  # 1 - cos, without cancellation
    lines, conic = _split_pencil(squared, versines)
    distances = _intersect(lines, conic)
    distances, valid = _polish(distances, squared, versines)
    distances = jnp.stack(distances) * jnp.sqrt(size)[None, None, :]
    valid = valid & (known & spread)[None, :] & jnp.isfinite(distances).all(axis=0)
    return jnp.where(valid[None, :, :], distances, 0.0), valid


def _squared_sides(corners: Array) -> _Planes:
    """Squared distances between corners 0-1, 0-2 and 1-2."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return tuple(jnp.square(u - v).sum(axis=0) for u, v in ((a, b), (a, c), (b, c)))


def _split_pencil(squared: _Planes, versines: _Planes) -> tuple[_Planes, _Planes]:
    """Two lines `(2, h)` through the common points of the conics, and the conic to cut them with."""
    d12, d13, d23 = squared
    c12, c13, c23 = (1.0 - e for e in versines)
    zero = jnp.zeros_like(d12)
    first = (d23, -d23 * c12, zero, d23 - d12, d12 * c23, -d12)
    second = (d23, zero, -d23 * c13, -d13, d13 * c23, d23 - d13)
    first_adjugate, second_adjugate = _adjugate(first), _adjugate(second)
    k0 = _inner(first, first_adjugate) / 3.0
    k1 = _inner(second, first_adjugate)
    k2 = _inner(first, second_adjugate)
    k3 = _inner(second, second_adjugate) / 3.0
    swap = jnp.abs(k3) < jnp.abs(k0)  # the pencil's parameter counts from the conic that is further from degenerate
    root = _steepest_root(*(jnp.where(swap, a, b) for a, b in ((k0, k3), (k1, k2), (k2, k1), (k3, k0))))
    of_first, of_second = jnp.where(swap, root, 1.0), jnp.where(swap, 1.0, root)
    degenerate = _combine(of_first, first, of_second, second)
    near_second = jnp.abs(of_first) < jnp.abs(of_second)
    other = tuple(jnp.where(near_second, a, b) for a, b in zip(first, second, strict=True))
    return _split(degenerate), other


def _split(conic: _Planes) -> _Planes:
    """The two lines of a degenerate conic, stacked: `C + [p]ₓ = l mᵀ` with p where the lines meet."""
    adjugate = _adjugate(conic)
    columns = [tuple(-adjugate[i] for i in column) for column in ((0, 1, 2), (1, 3, 4), (2, 4, 5))]
    diagonal = (columns[0][0], columns[1][1], columns[2][2])
    (*column, weight) = _where_largest(diagonal, [(*c, w) for c, w in zip(columns, diagonal, strict=True)])
    scale = lax.rsqrt(jnp.maximum(weight, jnp.finfo(weight.dtype).tiny))
    p0, p1, p2 = (-c * scale for c in column)
    a00, a01, a02, a11, a12, a22 = conic
    rows = ((a00, a01 - p2, a02 + p1), (a01 + p2, a11, a12 - p0), (a02 - p1, a12 + p0, a22))
    row, column = (
        _where_largest([v[0] ** 2 + v[1] ** 2 + v[2] ** 2 for v in vectors], vectors)
        for vectors in (rows, list(zip(*rows, strict=True)))
    )
    return tuple(jnp.stack(pair) for pair in zip(row, column, strict=True))


def _intersect(lines: _Planes, conic: _Planes) -> _Planes:
    """Where each of the two lines meets the conic: `(4, h)` points, up to scale.

    The coordinate with the largest factor in the line is eliminated, `c = α a + β b`, and with a = 1 (distances are
    never 0) a quadratic in b remains. A negative discriminant counts as zero: `_polish` rejects what is not a root.
    """
    sizes = [jnp.abs(x) for x in lines]
    c00, c01, c02, c11, c12, c22 = (x[None, :] for x in conic)
    l0, l1, l2 = lines
    la, lb, lc = _where_largest(sizes, [(l1, l2, l0), (l0, l2, l1), (l0, l1, l2)])
    aa, bb, cc, ab, ac, bc = _where_largest(
        sizes,
        [(c11, c22, c00, c12, c01, c02), (c00, c22, c11, c02, c01, c12), (c00, c11, c22, c01, c02, c12)],
    )
    alpha, beta = -la / _nonzero(lc), -lb / _nonzero(lc)
    quadratic = bb + 2.0 * bc * beta + cc * beta * beta
    half_linear = ab + ac * beta + bc * alpha + cc * alpha * beta
    constant = aa + 2.0 * ac * alpha + cc * alpha * alpha
    root = jnp.sqrt(jnp.maximum(half_linear * half_linear - quadratic * constant, 0.0))
    stable = -(half_linear + jnp.where(half_linear < 0, -root, root))
    b = jnp.concatenate([stable / _nonzero(quadratic), constant / _nonzero(stable)])
    alpha, beta, *sizes = (jnp.concatenate([x, x]) for x in (alpha, beta, *sizes))
    a, c = jnp.ones_like(b), alpha + beta * b
    return _where_largest(sizes, [(c, a, b), (a, c, b), (a, b, c)])


def _polish(distances: _Planes, squared: _Planes, versines: _Planes) -> tuple[_Planes, Array]:
    """Newton's method on the three laws of cosines from a direction `(4, h)`; which ends are roots."""
    d12, d13, d23 = (d[None, :] for d in squared)
    e12, e13, e23 = (e[None, :] for e in versines)

    def sides(x: Array, y: Array, z: Array) -> _Planes:
        return (
            jnp.square(x - y) + 2.0 * e12 * x * y,
            jnp.square(x - z) + 2.0 * e13 * x * z,
            jnp.square(y - z) + 2.0 * e23 * y * z,
        )

    def step(_: Array, xyz: _Planes) -> _Planes:
        x, y, z = xyz
        s12, s13, s23 = sides(x, y, z)
        f12, f13, f23 = 0.5 * (s12 - d12), 0.5 * (s13 - d13), 0.5 * (s23 - d23)
        a, b = x - y + e12 * y, y - x + e12 * x  # the Jacobian: [a b 0], [c 0 d], [0 e g]
        c, d = x - z + e13 * z, z - x + e13 * x
        e, g = y - z + e23 * z, z - y + e23 * y
        inverse = -1.0 / _nonzero(a * d * e + b * c * g)
        return (
            x + (d * e * f12 + b * g * f13 - b * d * f23) * inverse,
            y + (c * g * f12 - a * g * f13 + a * d * f23) * inverse,
            z + (a * e * f13 - c * e * f12 + b * c * f23) * inverse,
        )

    s12, s13, s23 = sides(*distances)
    total = s12 + s13 + s23
    scale = jnp.sqrt((d12 + d13 + d23) / jnp.maximum(total, jnp.finfo(total.dtype).tiny))
    start = tuple(scale * x for x in distances)
    x, y, z = lax.fori_loop(0, _NEWTON_STEPS, step, start)
    s12, s13, s23 = sides(x, y, z)
    error = jnp.abs(s12 - d12) + jnp.abs(s13 - d13) + jnp.abs(s23 - d23)
    return (x, y, z), (error < _RESIDUAL) & (jnp.minimum(jnp.minimum(x, y), z) > 0)


def _steepest_root(k3: Array, k2: Array, k1: Array, k0: Array) -> Array:
    """The real root of `k3 x³ + k2 x² + k1 x + k0` at which the cubic is steepest.

    Of three roots this is the one that stands apart from the other two; if the conics meet in real points at all, the
    degenerate conic there is a pair of real lines (Persson and Nordberg 2018, section 3).
    """
    k3 = _nonzero(k3)
    b, c, d = k2 / k3, k1 / k3, k0 / k3
    third = b / 3.0
    p, q = c - b * third, 2.0 * third * third * third - third * c + d  # x = t - b/3, t³ + p t + q = 0
    tiny = jnp.finfo(b.dtype).tiny
    radius = jnp.sqrt(jnp.abs(p) / 3.0)
    ratio = jnp.abs(q) / jnp.maximum(2.0 * radius * radius * radius, tiny)
    three_roots = (p < 0) & (ratio <= 1.0)
    trigonometric = 2.0 * radius * jnp.cos(jnp.arccos(jnp.minimum(ratio, 1.0)) / 3.0)
    cube = 0.5 * jnp.abs(q) + jnp.sqrt(jnp.maximum(0.25 * q * q + p * p * p / 27.0, 0.0))
    cardano = jnp.cbrt(cube)
    cardano = cardano - p / (3.0 * jnp.maximum(cardano, tiny))
    size = jnp.where(three_roots, trigonometric, cardano)
    root = jnp.where(q < 0, size, -size) - third

    def newton(_: Array, x: Array) -> Array:
        return x - (((x + b) * x + c) * x + d) / _nonzero((3.0 * x + 2.0 * b) * x + c)

    return lax.fori_loop(0, _CUBIC_STEPS, newton, root)


def _adjugate(conic: _Planes) -> _Planes:
    a00, a01, a02, a11, a12, a22 = conic
    return (
        a11 * a22 - a12 * a12,
        a02 * a12 - a01 * a22,
        a01 * a12 - a02 * a11,
        a00 * a22 - a02 * a02,
        a01 * a02 - a00 * a12,
        a00 * a11 - a01 * a01,
    )


def _inner(a: _Planes, b: _Planes) -> Array:
    """The trace of the product of two symmetric matrices."""
    return a[0] * b[0] + a[3] * b[3] + a[5] * b[5] + 2.0 * (a[1] * b[1] + a[2] * b[2] + a[4] * b[4])


def _combine(alpha: Array, a: _Planes, beta: Array, b: _Planes) -> _Planes:
    return tuple(alpha * x + beta * y for x, y in zip(a, b, strict=True))


def _where_largest(sizes: Sequence[Array], choices: Sequence[_Planes]) -> _Planes:
    """Of three choices, each a sequence of arrays, the one whose size is the largest, entry by entry."""
    first = (sizes[0] >= sizes[1]) & (sizes[0] >= sizes[2])
    second = sizes[1] >= sizes[2]
    return tuple(jnp.where(first, a, jnp.where(second, b, c)) for a, b, c in zip(*choices, strict=True))


def _nonzero(x: Array) -> Array:
    return jnp.where(jnp.abs(x) > jnp.finfo(x.dtype).tiny, x, 1.0)
