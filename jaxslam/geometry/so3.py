"""Rotations of many poses at once on the host, in NumPy float64: unit quaternions, wxyz, and matrices.

jaxlie's are for compiled code, where float64 needs a setting of the whole process.
"""

import numpy as np


def matrices(wxyz: np.ndarray) -> np.ndarray:
    """`(..., 3, 3)` rotation matrices of `(..., 4)` unit quaternions."""
    w, x, y, z = np.moveaxis(wxyz, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def axis_rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    """`(..., 4)` unit quaternions of rotations by `(...,)` radians about coordinate axis 0, 1 or 2."""
    half = 0.5 * np.asarray(angle, np.float64)
    quaternion = np.zeros((*half.shape, 4))
    quaternion[..., 0] = np.cos(half)
    quaternion[..., 1 + axis] = np.sin(half)
    return quaternion


def multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """`(..., 4)` Hamilton products of `(..., 4)` quaternions: `second` acts first."""
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


def quaternions(M: np.ndarray) -> np.ndarray:
    """`(n, 4)` unit quaternions, w not negative, of the rotations nearest to `(n, 3, 3)` matrices.

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


def slerp(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """`(n, 4)` unit quaternions a `share` `(n,)` of the way from `first` to `second`, the shorter way round.

    Source: Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985.
    """
    second = np.where((first * second).sum(axis=1, keepdims=True) < 0, -second, second)
    apart = np.linalg.norm(second - first, axis=1, keepdims=True)
    angle = 2 * np.arctan2(apart, np.linalg.norm(second + first, axis=1, keepdims=True))

    def weight(part: np.ndarray) -> np.ndarray:
        """`sin(part * angle) / sin(angle)`, and its limit where the angle is 0."""
        return part * np.sinc(part * angle / np.pi) / np.sinc(angle / np.pi)

    return weight(1 - share[:, None]) * first + weight(share[:, None]) * second
