"""The rigid motion between two triangles, in closed form, for many pairs at once."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

Triangles = Float[Array, "3 3 *h"]
"""Coordinate, corner, and any number of further axes: one triangle an entry, metres."""

_Vector = list[Array]


def absolute_orientation(
    source: Triangles, target: Triangles
) -> tuple[Float[Array, "3 3 *h"], Float[Array, " 3 *h"], Bool[Array, " *h"]]:
    """The least-squares rotation R and translation t with `target = R source + t`, three points each.

    Three points span a plane. The best rotation brings the two planes together, normal on normal, and then turns
    within the plane by the angle that maximises the correlation of the centred corners: no eigenvalue problem, no
    iteration, and exact for congruent triangles.

    Source: Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987, section 5 (coplanar
    points).

    Args:
        source: Corners before the motion.
        target: The same corners after it.

    Returns:
        R as rows and columns first, t, and whether both triangles span a plane. Where they do not (corners on a line,
        in one place, or not finite) the motion is finite and means nothing.
    """
    source, source_known = _finite(source)
    target, target_known = _finite(target)
    source_centre, target_centre = source.mean(axis=1), target.mean(axis=1)
    source_axes, source_spans = _plane_axes(source)
    target_axes, target_spans = _plane_axes(target)
    cosine, sine = jnp.zeros_like(source[0, 0]), jnp.zeros_like(source[0, 0])
    for corner in range(3):
        px, py = (_dot(axis, source[:, corner] - source_centre) for axis in source_axes[:2])
        qx, qy = (_dot(axis, target[:, corner] - target_centre) for axis in target_axes[:2])
        cosine = cosine + px * qx + py * qy
        sine = sine + px * qy - py * qx
    norm = lax.rsqrt(jnp.maximum(cosine * cosine + sine * sine, jnp.finfo(source.dtype).tiny))
    cosine, sine = cosine * norm, sine * norm
    first, second, normal = target_axes
    turned = [
        [cosine * a + sine * b for a, b in zip(first, second, strict=True)],
        [cosine * b - sine * a for a, b in zip(first, second, strict=True)],
        normal,
    ]
    R = [
        [_dot([axis[row] for axis in turned], [axis[column] for axis in source_axes]) for column in range(3)]
        for row in range(3)
    ]
    t = [target_centre[row] - _dot(R[row], source_centre) for row in range(3)]
    valid = source_known & target_known & source_spans & target_spans
    return jnp.stack([jnp.stack(row) for row in R]), jnp.stack(t), valid


def _plane_axes(triangle: Array) -> tuple[list[_Vector], Array]:
    """Two orthonormal axes in the plane of the triangle and its normal; false if there is no plane."""
    tiny = jnp.finfo(triangle.dtype).tiny
    edge, other = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    normal = _cross(edge, other)
    edge2, other2, normal2 = (_dot(v, v) for v in (edge, other, normal))
    spans = normal2 > 1e-8 * edge2 * other2 + tiny  # the sine of the angle at the first corner above 1e-4
    first = [e * lax.rsqrt(jnp.maximum(edge2, tiny)) for e in edge]
    normal = [n * lax.rsqrt(jnp.maximum(normal2, tiny)) for n in normal]
    return [first, _cross(normal, first), normal], spans


def _finite(points: Array) -> tuple[Array, Array]:
    known = jnp.isfinite(points).all(axis=(0, 1))
    return jnp.where(known, points, 0.0), known


def _dot(u: Array | _Vector, v: Array | _Vector) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u: Array | _Vector, v: Array | _Vector) -> _Vector:
    return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
