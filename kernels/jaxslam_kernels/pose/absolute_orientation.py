"""The rigid motion between two triangles, in closed form, for many pairs at once.

Three points span a plane. The best rotation brings the two planes together and then turns within the plane by the
angle that maximizes the correlation of the centered corners: no eigenvalue problem, no iteration, and exact for
congruent triangles. Of the two ways in which planes coincide it is always the one with normal on normal, as both
normals see the corners in the same order.

Source: Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987, section 5 (coplanar points).
"""

from typing import TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.checks import checked

Triangles: TypeAlias = Float[Array, "3 3 *h"]
"""Coordinate, corner, and any number of further axes: one triangle an entry, meters."""

_MIN_SINE = 1e-4
"""Of the angle at the first corner; below it the corners count as on a line."""

_Vectors: TypeAlias = Float[Array, " 3 *h"]
_Axes: TypeAlias = Float[Array, "3 3 *h"]
"""Axis and coordinate: two orthonormal axes in the plane of a triangle, and its normal."""


@checked
def absolute_orientation(
    source: Triangles, target: Triangles
) -> tuple[Float[Array, "3 3 *h"], Float[Array, " 3 *h"], Bool[Array, " *h"]]:
    """The least-squares rotation R and translation t with `target = R source + t`, three points each.

    Differentiable; where there is no plane the gradient is zero.

    Args:
        source: `(3, 3, *h)` corners (coordinate, corner, ...) before the motion, meters.
        target: `(3, 3, *h)` the same corners after it.

    Returns:
        R `(3, 3, *h)` (row, column, ...), t `(3, *h)` meters, and `(*h,)` whether both triangles span a plane. Where
        they do not (corners on a line, in one place, or not finite) the motion is the identity.
    """
    valid = _spans_plane(source) & _spans_plane(target)
    unit_triangle = jnp.eye(3, dtype=source.dtype).reshape(3, 3, *(1,) * (source.ndim - 2))
    source, target = (jnp.where(valid[None, None], corners, unit_triangle) for corners in (source, target))
    source_center, target_center = source.mean(axis=1), target.mean(axis=1)
    source_axes, target_axes = _plane_axes(source), _plane_axes(target)
    cosine, sine = _turn_in_plane(
        _in_plane(source, source_center, source_axes), _in_plane(target, target_center, target_axes)
    )
    first, second, normal = target_axes
    turned = jnp.stack([cosine * first + sine * second, cosine * second - sine * first, normal])
    R = (turned[:, :, None] * source_axes[:, None, :]).sum(axis=0)
    return R, target_center - (R * source_center[None]).sum(axis=1), valid


def _turn_in_plane(source: Float[Array, "2 3 *h"], target: Float[Array, "2 3 *h"]) -> tuple[Array, Array]:
    """Cosine and sine `(1, *h)` of the angle that maximizes `Σ qᵀ R(angle) p` over corners p and q in the plane.

    The sum is never zero there, as both triangles go round the same way; `tiny` is for the rounded one.
    """
    cosine = (source * target).sum(axis=(0, 1))
    sine = (source[0] * target[1] - source[1] * target[0]).sum(axis=0)
    inverse = lax.rsqrt(cosine * cosine + sine * sine + jnp.finfo(cosine.dtype).tiny)
    return (cosine * inverse)[None], (sine * inverse)[None]


def _spans_plane(triangle: Triangles) -> Bool[Array, " *h"]:
    """Whether the corners are finite and not on a line; false for NaN, as no comparison with it is true."""
    edge, other = _edges(triangle)
    normal = _cross(edge, other)
    return _dot(normal, normal) > _MIN_SINE**2 * _dot(edge, edge) * _dot(other, other)


def _plane_axes(triangle: Triangles) -> _Axes:
    """Two orthonormal axes in the plane of the triangle, and its normal, about which the corners turn left."""
    edge, other = _edges(triangle)
    first, normal = _unit(edge), _unit(_cross(edge, other))
    return jnp.stack([first, _cross(normal, first), normal])


def _in_plane(triangle: Triangles, center: _Vectors, axes: _Axes) -> Float[Array, "2 3 *h"]:
    """Each corner relative to the center along the two axes in the plane: `(axis, corner, ...)`."""
    return (axes[:2, :, None] * (triangle - center[:, None])[None]).sum(axis=1)


def _edges(triangle: Triangles) -> tuple[_Vectors, _Vectors]:
    """From the first corner to the two others."""
    return triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]


def _unit(v: _Vectors) -> _Vectors:
    return v * lax.rsqrt(_dot(v, v))[None]


def _dot(u: _Vectors, v: _Vectors) -> Float[Array, " *h"]:
    # A sum over an axis, not three products: XLA does not compute it again in every kernel that uses it.
    return (u * v).sum(axis=0)


def _cross(u: _Vectors, v: _Vectors) -> _Vectors:
    return jnp.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
