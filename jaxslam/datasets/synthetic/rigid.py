"""Rigid motions in NumPy float64, for ground truth that must be exact; the last axes hold the transform."""

import numpy as np

from jaxslam.rotation import matrices


def axis_rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    """Unit quaternions of rotations about one coordinate axis.

    Args:
        axis: 0, 1 or 2.
        angle: `(...,)` radians.

    Returns:
        `(..., 4)` quaternions, wxyz.
    """
    half = 0.5 * np.asarray(angle, np.float64)
    quaternion = np.zeros((*half.shape, 4))
    quaternion[..., 0] = np.cos(half)
    quaternion[..., 1 + axis] = np.sin(half)
    return quaternion


def multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Hamilton product of `(..., 4)` quaternions, wxyz: `second` acts first."""
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


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """`(..., 3, 3)` rotation matrices of `(..., 4)` unit quaternions, wxyz."""
    return matrices(quaternion.reshape(-1, 4)).reshape(*quaternion.shape[:-1], 3, 3)


def transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """`(..., 4, 4)` homogeneous transforms of `(..., 3, 3)` rotations and `(..., 3)` translations."""
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    matrix = np.zeros((*shape, 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def matrix_from_pose(pose: np.ndarray) -> np.ndarray:
    """`(..., 4, 4)` homogeneous transforms of `(..., 7)` poses, wxyz_xyz."""
    return transform(rotation_matrix(pose[..., :4]), pose[..., 4:])


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverses of `(..., 4, 4)` rigid transforms."""
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return transform(rotation, -np.einsum("...ij,...j->...i", rotation, matrix[..., :3, 3]))
