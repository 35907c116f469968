"""Batched rotations on the host, in NumPy float64: unit quaternions (wxyz) and rotation matrices.

Compiled code uses jaxlie instead. jaxlie would compute in float64 only with `jax_enable_x64`, which applies to the
whole process.
"""

import numpy as np
from jaxtyping import Float

from jaxslam.geometry.types import Quaternions


def matrices(wxyz: Quaternions) -> Float[np.ndarray, "... 3 3"]:
    """Convert `(..., 4)` unit quaternions to `(..., 3, 3)` rotation matrices."""
    # Of one quaternion in plain Python: NumPy's calls would take ten times as long as the arithmetic.
    w, x, y, z = wxyz.tolist() if wxyz.ndim == 1 else np.moveaxis(wxyz, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows) if wxyz.ndim == 1 else np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def axis_rotation(axis: int, angle: Float[np.ndarray, "..."] | float) -> Quaternions:
    """Return the `(..., 4)` unit quaternions that rotate by `(...,)` radians about coordinate axis 0, 1 or 2."""
    half = 0.5 * np.asarray(angle, np.float64)
    quaternion = np.zeros((*half.shape, 4))
    quaternion[..., 0] = np.cos(half)
    quaternion[..., 1 + axis] = np.sin(half)
    return quaternion


def multiply(first: Quaternions, second: Quaternions) -> Quaternions:
    """Return the Hamilton products of `(..., 4)` quaternions: `second` acts first."""
    w, x, y, z = np.moveaxis(first, -1, 0)
    a, b, c, d = np.moveaxis(second, -1, 0)
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )


def quaternions(M: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4"]:
    """Convert `(n, 3, 3)` matrices to the `(n, 4)` unit quaternions of the nearest rotations, with w not negative.

    Source: Bar-Itzhack, "New Method for Extracting the Quaternion from a Rotation Matrix", 2000, version 3.
    """
    transposed = M.swapaxes(1, 2)
    trace = np.trace(M, axis1=1, axis2=2)
    K = np.empty((len(M), 4, 4))
    K[:, 0, 0] = trace
    K[:, 0, 1:] = K[:, 1:, 0] = (M - transposed)[:, [2, 0, 1], [1, 2, 0]]
    K[:, 1:, 1:] = M + transposed - trace[:, None, None] * np.eye(3)
    wxyz = np.linalg.eigh(K).eigenvectors[:, :, -1]
    return np.where(wxyz[:, :1] < 0, -wxyz, wxyz)


def slerp(
    first: Float[np.ndarray, "n 4"], second: Float[np.ndarray, "n 4"], share: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4"]:
    """Interpolate between `(n, 4)` unit quaternions along the shorter arc.

    Args:
        first: `(n, 4)` unit quaternions returned where `share` is 0.
        second: `(n, 4)` unit quaternions returned, up to sign, where `share` is 1.
        share: `(n,)` fractions of the arc from `first` to `second`.

    Source: Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985.
    """
    second = np.where((first * second).sum(axis=1, keepdims=True) < 0, -second, second)
    apart = np.linalg.norm(second - first, axis=1, keepdims=True)
    angle = 2 * np.arctan2(apart, np.linalg.norm(second + first, axis=1, keepdims=True))

    def weight(part: np.ndarray) -> np.ndarray:
        """Return `sin(part * angle) / sin(angle)`, or its limit where the angle is 0."""
        return part * np.sinc(part * angle / np.pi) / np.sinc(angle / np.pi)

    return weight(1 - share[:, None]) * first + weight(share[:, None]) * second
