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
        in one place, or not finite) the motion is the identity.
    """
    valid = _spans_plane(source) & _spans_plane(target)
    unit_triangle = jnp.eye(3, dtype=source.dtype).reshape(3, 3, *(1,) * (source.ndim - 2))
    source, target = jnp.where(valid, source, unit_triangle), jnp.where(valid, target, unit_triangle)
    source_centre, target_centre = source.mean(axis=1), target.mean(axis=1)
    source_axes, target_axes = _plane_axes(source), _plane_axes(target)
    cosine, sine = jnp.zeros_like(source[0, 0]), jnp.zeros_like(source[0, 0])
    for corner in range(3):
        px, py = (_dot(axis, source[:, corner] - source_centre) for axis in source_axes[:2])
        qx, qy = (_dot(axis, target[:, corner] - target_centre) for axis in target_axes[:2])
        cosine = cosine + px * qx + py * qy
        sine = sine + px * qy - py * qx
    norm = lax.rsqrt(cosine * cosine + sine * sine + jnp.finfo(source.dtype).tiny)
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
    return jnp.stack([jnp.stack(row) for row in R]), jnp.stack(t), valid


def _spans_plane(triangle: Array) -> Array:
    """Whether the corners are finite and the sine of the angle at the first one is above 1e-4."""
    triangle = lax.stop_gradient(triangle)
    edge, other = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    normal = _cross(edge, other)
    return _dot(normal, normal) > 1e-8 * _dot(edge, edge) * _dot(other, other)  # false for NaN


def _plane_axes(triangle: Array) -> list[_Vector]:
    """Two orthonormal axes in the plane of the triangle, and its normal."""
    edge, other = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    first, normal = _unit([edge[0], edge[1], edge[2]]), _unit(_cross(edge, other))
    return [first, _cross(normal, first), normal]


def _unit(v: _Vector) -> _Vector:
    inverse = lax.rsqrt(_dot(v, v))
    return [x * inverse for x in v]


def _dot(u: Array | _Vector, v: Array | _Vector) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u: Array | _Vector, v: Array | _Vector) -> _Vector:
    return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
