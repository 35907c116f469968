"""Batched rigid transforms on the host, in NumPy float64, stored as `wxyz_xyz` like everywhere in jaxslam.

Compiled code uses jaxlie instead. jaxlie would compute in float64 only with `jax_enable_x64`, which applies to the
whole process.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Num

from jaxslam.geometry.so3 import matrices, multiply
from jaxslam.geometry.types import Points, Pose, Transforms

IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])
"""The identity transform, `(7,)` `wxyz_xyz`."""


def rotate(T: Transforms, vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Rotate `(..., 3)` vectors by the rotations of `(..., 7)` transforms."""
    return np.einsum("...ij,...j->...i", matrices(T[..., :4]), vectors)


def compose(first: Transforms, second: Transforms) -> Transforms:
    """Compose `(..., 7)` transforms, `second` acting first: return `T_a_c` for `T_a_b` and `T_b_c`."""
    if first.ndim == second.ndim == 1:
        return _compose_one(first.tolist(), second.tolist())
    rotation = multiply(first[..., :4], second[..., :4])
    rotation /= np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([rotation, rotate(first, second[..., 4:]) + first[..., 4:]], axis=-1)


def _compose_one(first: Sequence[float], second: Sequence[float]) -> Pose:
    """Compose two single transforms in plain Python: NumPy's calls would take ten times as long as the arithmetic."""
    w, x, y, z, t, u, v = first
    a, b, c, d, e, f, g = second
    rotation = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    length = math.hypot(*rotation)
    # The rotated vector is v + 2 w (q x v) + 2 q x (q x v).
    i, j, k = 2 * (y * g - z * f), 2 * (z * e - x * g), 2 * (x * f - y * e)
    shifted = (
        e + w * i + y * k - z * j + t,
        f + w * j + z * i - x * k + u,
        g + w * k + x * j - y * i + v,
    )
    return np.array([part / length for part in rotation] + list(shifted))


def inverse(T: Transforms) -> Transforms:
    """Invert `(..., 7)` transforms."""
    if T.ndim == 1:
        w, x, y, z, *shift = T.tolist()
        turned_back = _compose_one([w, -x, -y, -z, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, *shift])
        return np.concatenate([[w, -x, -y, -z], -turned_back[4:]])
    conjugate = np.concatenate([T[..., :4] * np.array([1.0, -1, -1, -1]), np.zeros_like(T[..., 4:])], axis=-1)
    return np.concatenate([conjugate[..., :4], -rotate(conjugate, T[..., 4:])], axis=-1)


def between(first: Transforms, second: Transforms) -> Transforms:
    """Return the `(..., 7)` relative transforms from `second` to `first`: `T_a_b` for `T_world_a` and `T_world_b`."""
    return compose(inverse(first), second)


def transform(T: Float[np.ndarray, "7"], X: Points) -> Points:
    """Transform `(3, n)` points by one `(7,)` transform: `X_a` for `T_a_b` and `X_b`, meters."""
    return matrices(T[:4]) @ X + T[4:, None]


def to_local(T: Float[np.ndarray, "7"], X: Points) -> Points:
    """Transform `(3, n)` points by the inverse of one `(7,)` transform: `X_b` for `T_a_b` and `X_a`, meters."""
    return matrices(T[:4]).T @ (X - T[4:, None])


def angle(T: Transforms) -> Float[np.ndarray, "..."]:
    """Return the `(...,)` rotation angles of `(..., 7)` transforms, radians, 0 to pi."""
    return np.asarray(2 * np.arctan2(np.linalg.norm(T[..., 1:4], axis=-1), np.abs(T[..., 0])))


def adjoint(T: Pose) -> Float[np.ndarray, "6 6"]:
    """Return the adjoint of `T_a_b`, which maps a tangent (translation first) from frame b to frame a."""
    R, (x, y, z) = matrices(T[:4]), T[4:].tolist()
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = R
    result[:3, 3:] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    return result


def displacement(first: Transforms, second: Transforms) -> Float[np.ndarray, "... 6"]:
    """Return the `(..., 6)` tangents with which `retract` leads from the first `(..., 7)` transforms to the second."""
    change = between(first, second)
    sine = np.linalg.norm(change[..., 1:4], axis=-1, keepdims=True)
    turn = angle(change)[..., None] * np.copysign(1.0, change[..., :1])
    axis = change[..., 1:4] / np.where(sine > 0, sine, 1.0)
    return np.concatenate([change[..., 4:], turn * axis], axis=-1)


def retract(T: Transforms, tangent: Num[np.ndarray, "... 6"]) -> Transforms:
    """Retract `(..., 6)` tangent vectors at `(..., 7)` transforms: the product of `T` and the small motion.

    The tangent holds a translation (meters) and a rotation vector (radians), both in the local axes of `T`. The two are
    applied separately, so this is the retraction of SO(3) x R^3 and not the exponential map of SE(3).
    """
    turn = np.linalg.norm(tangent[..., 3:], axis=-1, keepdims=True)
    axis = np.sinc(turn / (2 * np.pi)) * 0.5 * tangent[..., 3:]
    return compose(T, np.concatenate([np.cos(turn / 2), axis, tangent[..., :3]], axis=-1))
