"""Perspective-three-point: how far away three known points are, from the directions they are seen in.

Many triples at once, in single precision, without a branch. With the distances λ along unit bearings y, the law of
cosines says for each two of the points

    λᵢ² + λⱼ² - 2 cᵢⱼ λᵢ λⱼ = dᵢⱼ,    cᵢⱼ = yᵢ · yⱼ,    dᵢⱼ = |Xᵢ - Xⱼ|²,

in short `λᵀ Mᵢⱼ λ = dᵢⱼ`. Two combinations are homogeneous, and so conics on which the direction of λ lies:

    λᵀ D₁ λ = λᵀ D₂ λ = 0,    D₁ = d₂₃ M₁₂ - d₁₂ M₂₃,    D₂ = d₂₃ M₁₃ - d₁₃ M₂₃.

They meet in up to four points. The pencil `D₁ + γ D₂` holds a degenerate conic, a pair of lines, at the root of a
cubic in γ; each line meets a conic in two points. Newton's method on the three laws of cosines then takes every
candidate to full precision, and those that leave a residual are discarded, so no decision hangs on the sign of a
rounded discriminant.

Source: Persson and Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver", ECCV
2018, section 3, for the pencil, the cubic and the refinement; Richter-Gebert, "Perspectives on Projective Geometry",
2011, section 11, for splitting a degenerate conic into lines.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.checks import checked
from jaxslam_kernels.program_parts import apart

_Vector: TypeAlias = tuple[Array, Array, Array]
"""Three coordinates apart: of λ, or of a line in the plane of its directions."""
_Pairs: TypeAlias = tuple[Array, Array, Array]
"""One number for each two of the points: 1-2, 1-3, 2-3."""


class _Conic(NamedTuple):
    """A symmetric 3 x 3 form, entry by entry."""

    xx: Array
    xy: Array
    xz: Array
    yy: Array
    yz: Array
    zz: Array


_CUBIC_STEPS = 2  # after the closed form, which float32 leaves short of a few digits
_NEWTON_STEPS = 4
_RESIDUAL = 1e-3  # summed, of the mean squared side: a root stands at rounding, a miss at a few per cent or more


@checked
def p3p(
    bearings: Float[Array, "3 3 h"], X_world: Float[Array, "3 3 h"]
) -> tuple[Float[Array, "3 4 h"], Bool[Array, "4 h"]]:
    """Distances from the camera to three points, up to four solutions a triple.

    With these, `distance * bearing` are the points in the camera's frame and the pose follows from
    `absolute_orientation`. Not meant for differentiation: which solution stands in which place may jump.

    Args:
        bearings: `(3, 3, h)` (coordinate, point, triple) unit vectors towards the points, camera frame.
        X_world: `(3, 3, h)` (coordinate, point, triple) the points, meters; in any frame, only distances count.

    Returns:
        `(3, 4, h)` (point, solution, triple) distances in meters, 0 where there is no solution, and `(4, h)` which
        solutions are real with all distances positive. The same solution may come twice. None for a triple that is
        not finite or in one place. All finite, whatever came in.
    """
    bearings, X_world, known = apart(lambda: _known(bearings, X_world))
    squared, versines, unit, spread = apart(lambda: _scaled(bearings, X_world))
    candidates = _at_size(_intersect(*_split_pencil(squared, versines)), squared, versines)
    return _in_meters(*_newton(candidates, squared, versines), unit, known & spread)


@checked
def p3p_near(
    bearings: Float[Array, "3 3 h"], X_world: Float[Array, "3 3 h"], distances: Float[Array, "3 h"]
) -> tuple[Float[Array, "3 1 h"], Bool[Array, "1 h"]]:
    """Distances from the camera to three points, the solution near approximate ones.

    Newton's method alone: a fifth of the program of `p3p` and a quarter of what follows it. Meant for points whose
    depth has been measured or predicted.

    Args:
        bearings: `(3, 3, h)` as for `p3p`.
        X_world: `(3, 3, h)` as for `p3p`.
        distances: `(3, h)` (point, triple) approximate distances, meters; positive. They are constant for a derivative:
            the solution does not depend on where the search begins.

    Returns:
        As `p3p`, with one solution a triple.
    """
    bearings, X_world, known = apart(lambda: _known(bearings, X_world))
    known = known & (jnp.isfinite(distances) & (distances > 0)).all(axis=0)
    squared, versines, unit, spread = apart(lambda: _scaled(bearings, X_world))
    near = jnp.where(known[None, :], lax.stop_gradient(distances), 1.0) * lax.rsqrt(unit)[None, :]
    return _in_meters(*_newton((near[:1], near[1:2], near[2:]), squared, versines), unit, known & spread)


def _known(bearings: Array, X_world: Array) -> tuple[Array, Array, Bool[Array, " h"]]:
    """Bearings and points, 0 in the triples that are not finite, and which triples are."""
    known = jnp.isfinite(bearings).all(axis=(0, 1)) & jnp.isfinite(X_world).all(axis=(0, 1))
    bearings, X_world = (jnp.where(known[None, None, :], a, 0.0) for a in (bearings, X_world))
    return bearings, X_world, known


def _scaled(bearings: Array, X_world: Array) -> tuple[_Pairs, _Pairs, Array, Bool[Array, " h"]]:
    """Squared sides in units of their mean, versines, the unit in m², and which triangles are not in one place."""
    d12, d13, d23 = _squared_sides(X_world)
    size = (d12 + d13 + d23) / 3.0
    spread = size > 0
    unit = jnp.where(spread, size, 1.0)
    e12, e13, e23 = _squared_sides(bearings)
    return (d12 / unit, d13 / unit, d23 / unit), (0.5 * e12, 0.5 * e13, 0.5 * e23), unit, spread


def _in_meters(
    candidates: _Vector, valid: Array, unit: Array, usable: Bool[Array, " h"]
) -> tuple[Float[Array, "3 s h"], Bool[Array, "s h"]]:
    """Distances in meters, 0 where there is no solution, and where there is one."""
    distances = jnp.stack(candidates) * jnp.sqrt(unit)[None, None, :]
    valid = valid & usable[None, :] & jnp.isfinite(distances).all(axis=0)
    return jnp.where(valid[None, :, :], distances, 0.0), valid


def _squared_sides(corners: Array) -> _Pairs:
    """Squared distances between the corners (coordinate, corner, triple) of triangles."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return jnp.square(a - b).sum(axis=0), jnp.square(a - c).sum(axis=0), jnp.square(b - c).sum(axis=0)


def _split_pencil(squared: _Pairs, versines: _Pairs) -> tuple[_Vector, _Conic]:
    """Two lines `(2, h)` through the common points of D₁ and D₂, and the one of these conics to cut them with."""
    d12, d13, d23 = squared
    c12, c13, c23 = (1.0 - e for e in versines)
    zero = jnp.zeros_like(d12)
    first = _Conic(d23, -d23 * c12, zero, d23 - d12, d12 * c23, -d12)
    second = _Conic(d23, zero, -d23 * c13, -d13, d13 * c23, d23 - d13)
    first_adjugate, second_adjugate = _adjugate(first), _adjugate(second)
    # det(D₁ + γ D₂) = k0 + k1 γ + k2 γ² + k3 γ³
    k0 = _inner(first, first_adjugate) / 3.0
    k1 = _inner(second, first_adjugate)
    k2 = _inner(first, second_adjugate)
    k3 = _inner(second, second_adjugate) / 3.0
    # γ multiplies the conic that is further from degenerate, so that the leading coefficient is the larger one.
    swap = jnp.abs(k3) < jnp.abs(k0)
    root = _steepest_root(*(jnp.where(swap, a, b) for a, b in ((k0, k3), (k1, k2), (k2, k1), (k3, k0))))
    of_first, of_second = jnp.where(swap, root, 1.0), jnp.where(swap, 1.0, root)
    degenerate = _Conic(*(of_first * a + of_second * b for a, b in zip(first, second, strict=True)))
    near_second = jnp.abs(of_first) < jnp.abs(of_second)
    other = _Conic(*(jnp.where(near_second, a, b) for a, b in zip(first, second, strict=True)))
    return _split(degenerate), other


def _split(conic: _Conic) -> _Vector:
    """The two lines of a degenerate conic, stacked: `C + [p]ₓ = l mᵀ` with p where they meet, `p pᵀ = -adj(C)`.

    Every column of the adjugate is p up to scale, and every row and column of `l mᵀ` is one of the lines: the largest
    are taken.
    """
    xx, xy, xz, yy, yz, zz = _adjugate(conic)
    squares = (-xx, -yy, -zz)
    *p, square = _where_largest(squares, [(xx, xy, xz, squares[0]), (xy, yy, yz, squares[1]), (xz, yz, zz, squares[2])])
    scale = lax.rsqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))
    px, py, pz = (x * scale for x in p)
    xx, xy, xz, yy, yz, zz = conic
    rows = ((xx, xy - pz, xz + py), (xy + pz, yy, yz - px), (xz - py, yz + px, zz))
    columns = tuple(zip(*rows, strict=True))
    line, other = (_where_largest([x**2 + y**2 + z**2 for x, y, z in lines], lines) for lines in (rows, columns))
    x, y, z = (jnp.stack(pair) for pair in zip(line, other, strict=True))
    return x, y, z


def _intersect(lines: _Vector, conic: _Conic) -> _Vector:
    """Intersect each of the two lines `(2, h)` with the conic: `(4, h)` points, up to scale.

    The coordinate with the largest factor in the line is eliminated, `c = α a + β b`, and with a = 1 (distances are
    never 0) a quadratic in b remains. A negative discriminant counts as zero: `_newton` rejects what is not a root.
    """
    sizes = [jnp.abs(x) for x in lines]
    xx, xy, xz, yy, yz, zz = (x[None, :] for x in conic)
    lx, ly, lz = lines
    la, lb, lc = _where_largest(sizes, [(ly, lz, lx), (lx, lz, ly), (lx, ly, lz)])
    aa, bb, cc, ab, ac, bc = _where_largest(
        sizes, [(yy, zz, xx, yz, xy, xz), (xx, zz, yy, xz, xy, yz), (xx, yy, zz, xy, xz, yz)]
    )
    alpha, beta = -la / _nonzero(lc), -lb / _nonzero(lc)
    quadratic = bb + 2.0 * bc * beta + cc * beta * beta
    half_linear = ab + ac * beta + bc * alpha + cc * alpha * beta
    constant = aa + 2.0 * ac * alpha + cc * alpha * alpha
    root = jnp.sqrt(jnp.maximum(half_linear * half_linear - quadratic * constant, 0.0))
    stable = -(half_linear + jnp.where(half_linear < 0, -root, root))  # a sum of equal signs: nothing cancels
    b = jnp.concatenate([stable / _nonzero(quadratic), constant / _nonzero(stable)])
    alpha, beta, *sizes = (jnp.concatenate([x, x]) for x in (alpha, beta, *sizes))
    a, c = jnp.ones_like(b), alpha + beta * b
    x, y, z = _where_largest(sizes, [(c, a, b), (a, c, b), (a, b, c)])
    return x, y, z


def _sides(xyz: _Vector, versines: _Pairs) -> _Pairs:
    """Squared sides of the triangle so far away: `x² + y² - 2 c x y = (x - y)² + 2 (1 - c) x y`."""
    x, y, z = xyz
    e12, e13, e23 = (e[None, :] for e in versines)
    return (
        jnp.square(x - y) + 2.0 * e12 * x * y,
        jnp.square(x - z) + 2.0 * e13 * x * z,
        jnp.square(y - z) + 2.0 * e23 * y * z,
    )


def _at_size(directions: _Vector, squared: _Pairs, versines: _Pairs) -> _Vector:
    """Scale directions `(4, h)` of λ to where the triangles have the right size."""
    (s12, s13, s23), (d12, d13, d23) = _sides(directions, versines), squared
    total = s12 + s13 + s23
    scale = jnp.sqrt((d12 + d13 + d23)[None, :] / jnp.maximum(total, jnp.finfo(total.dtype).tiny))
    x, y, z = directions
    return scale * x, scale * y, scale * z


def _newton(near: _Vector, squared: _Pairs, versines: _Pairs) -> tuple[_Vector, Bool[Array, "s h"]]:
    """Newton's method on the laws of cosines from distances `(s, h)`: where it ends, and whether at a root."""
    d12, d13, d23 = (d[None, :] for d in squared)
    e12, e13, e23 = (e[None, :] for e in versines)

    def step(_: Array, xyz: _Vector) -> _Vector:
        x, y, z = xyz
        s12, s13, s23 = _sides(xyz, versines)
        f12, f13, f23 = 0.5 * (s12 - d12), 0.5 * (s13 - d13), 0.5 * (s23 - d23)
        # The Jacobian has the rows [a b 0], [c 0 d], [0 e g]; its inverse is written out.
        a, b = x - y + e12 * y, y - x + e12 * x
        c, d = x - z + e13 * z, z - x + e13 * x
        e, g = y - z + e23 * z, z - y + e23 * y
        inverse = -1.0 / _nonzero(a * d * e + b * c * g)
        return (
            x + (d * e * f12 + b * g * f13 - b * d * f23) * inverse,
            y + (c * g * f12 - a * g * f13 + a * d * f23) * inverse,
            z + (a * e * f13 - c * e * f12 + b * c * f23) * inverse,
        )

    x, y, z = lax.fori_loop(0, _NEWTON_STEPS, step, near)
    s12, s13, s23 = apart(lambda: _sides((x, y, z), versines))
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
    # Three roots: the trigonometric form. One: Cardano's, its cube root being the one in which nothing cancels.
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


def _adjugate(conic: _Conic) -> _Conic:
    xx, xy, xz, yy, yz, zz = conic
    return _Conic(
        xx=yy * zz - yz * yz,
        xy=xz * yz - xy * zz,
        xz=xy * yz - xz * yy,
        yy=xx * zz - xz * xz,
        yz=xy * xz - xx * yz,
        zz=xx * yy - xy * xy,
    )


def _inner(a: _Conic, b: _Conic) -> Array:
    """The trace of the product of two symmetric matrices."""
    return a.xx * b.xx + a.yy * b.yy + a.zz * b.zz + 2.0 * (a.xy * b.xy + a.xz * b.xz + a.yz * b.yz)


def _where_largest(sizes: Sequence[Array], choices: Sequence[Sequence[Array]]) -> tuple[Array, ...]:
    """Select, entry by entry, the largest of three choices, each a sequence of arrays."""
    first = (sizes[0] >= sizes[1]) & (sizes[0] >= sizes[2])
    second = sizes[1] >= sizes[2]
    return tuple(jnp.where(first, a, jnp.where(second, b, c)) for a, b, c in zip(*choices, strict=True))


def _nonzero(x: Array) -> Array:
    """A divisor: itself, or 1 where it is too small to divide by."""
    return jnp.where(jnp.abs(x) > jnp.finfo(x.dtype).tiny, x, 1.0)
