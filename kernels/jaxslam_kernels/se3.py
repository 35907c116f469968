"""Rigid transforms: jaxlie's, for callers that run JAX with strict promotion of types and ranks.

jaxlie (1.5) multiplies quaternions with integer signs and relies on both promotions; here, and only here, they are
allowed while it works. Where float64 is enabled it also turns float32 into it; here results keep the type they had.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import Points, Scalar


@contextmanager
def lenient_promotion() -> Iterator[None]:
    """Allow implicit promotion of types and ranks, as jaxlie needs."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@checked
def retract(T_a_b: SE3, tangent_b: Float[Array, "6"]) -> SE3:
    """`T_a_b @ exp(tangent_b)`: a pose moved in its own axes, translation first."""
    v, w = tangent_b[:3], tangent_b[3:]
    first, second = _exponential_factors(jnp.sum(jnp.square(w)))
    turned = jnp.cross(w, v)
    # jaxlie takes `R v` for small angles, which is off by half of `w x v`, in value and derivative.
    shift = v + first * turned + second * jnp.cross(w, turned)
    with lenient_promotion():
        moved = SE3.from_rotation_and_translation(SO3.exp(w), shift)
        return _typed(T_a_b @ moved, T_a_b)


@checked
def compose(T_a_b: Annotated[SE3, "..."], T_b_c: Annotated[SE3, "..."]) -> SE3:
    """`T_a_c`, its quaternion of unit length."""
    with lenient_promotion():
        return _typed((T_a_b @ T_b_c).normalize(), T_a_b)


@checked
def between(T_world_a: Annotated[SE3, "..."], T_world_b: Annotated[SE3, "..."]) -> SE3:
    """`T_a_b`: the second pose seen from the first."""
    with lenient_promotion():
        return _typed(T_world_a.inverse() @ T_world_b, T_world_b)


@checked
def displacement(T_world_a: SE3, T_world_b: SE3) -> Float[Array, "6"]:
    """The tangent in the axes of the first pose that leads to the second, translation first."""
    with lenient_promotion():
        return between(T_world_a, T_world_b).log().astype(T_world_b.wxyz_xyz.dtype)


_SMALL_ANGLE_SQUARED = 0.25
"""Below this squared angle the exponential is a series: the closed forms cancel digits, and divide by zero at last."""
_ROTATION = np.zeros((3, 3, 4, 4))
"""Entries of a rotation matrix as sums of products of two components `w, x, y, z` of the unit quaternion."""
for _row, _column, _factors in (
    (0, 0, {(0, 0): 1, (1, 1): 1, (2, 2): -1, (3, 3): -1}),
    (1, 1, {(0, 0): 1, (1, 1): -1, (2, 2): 1, (3, 3): -1}),
    (2, 2, {(0, 0): 1, (1, 1): -1, (2, 2): -1, (3, 3): 1}),
    (0, 1, {(1, 2): 2, (0, 3): -2}),
    (1, 0, {(1, 2): 2, (0, 3): 2}),
    (0, 2, {(1, 3): 2, (0, 2): 2}),
    (2, 0, {(1, 3): 2, (0, 2): -2}),
    (1, 2, {(2, 3): 2, (0, 1): -2}),
    (2, 1, {(2, 3): 2, (0, 1): 2}),
):
    for _pair, _factor in _factors.items():
        _ROTATION[_row, _column][_pair] = _factor


@checked
def rotation_matrix(T_a_b: SE3) -> Float[Array, "3 3"]:
    """Return the rotation matrix `R_a_b` of a pose.

    One multiplication by constants and a sum: jaxlie's own has twice as many instructions, and a step of the tracker
    holds sixty.
    """
    q = T_a_b.wxyz_xyz[:4]
    products = q[:, None] * q[None, :] / jnp.sum(jnp.square(q))
    return jnp.sum(jnp.asarray(_ROTATION, q.dtype) * products[None, None], axis=(2, 3))


@checked
def to_camera(T_world_cam: SE3, X_world: Points) -> Points:
    """World points in the axes of the camera."""
    R = rotation_matrix(T_world_cam)
    return R.T @ (X_world - T_world_cam.translation()[:, None])


@checked
def to_world(T_world_cam: SE3, X_cam: Points) -> Points:
    """Points in the axes of the camera, in the world."""
    return rotation_matrix(T_world_cam) @ X_cam + T_world_cam.translation()[:, None]


@checked
def cross_matrix(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix whose product with a vector is the cross product of `v` with it."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def _exponential_factors(squared: Scalar) -> tuple[Scalar, Scalar]:
    """`(1 - cos θ) / θ²` and `(θ - sin θ) / θ³` of a squared angle, with right derivatives of any order at 0 too."""
    small = squared < _SMALL_ANGLE_SQUARED
    x = jnp.where(small, squared, 0)
    terms = lambda first: [(-1) ** k / math.factorial(2 * k + first) for k in reversed(range(8))]
    series = [reduce(lambda value, term: value * x + term, terms(first), jnp.zeros_like(x)) for first in (2, 3)]
    large = jnp.where(small, 1, squared)
    angle = jnp.sqrt(large)
    exact = (1 - jnp.cos(angle)) / large, (angle - jnp.sin(angle)) / (large * angle)
    return jnp.where(small, series[0], exact[0]), jnp.where(small, series[1], exact[1])


def _typed(T: SE3, like: SE3) -> SE3:
    return SE3(T.wxyz_xyz.astype(like.wxyz_xyz.dtype))
