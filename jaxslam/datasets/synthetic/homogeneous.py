"""Rigid motions as 4 x 4 matrices in NumPy float64, for ground truth that must be exact."""

import numpy as np

from jaxslam.geometry.so3 import matrices


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
    return transform(matrices(pose[..., :4]), pose[..., 4:])


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverses of `(..., 4, 4)` rigid transforms."""
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return transform(rotation, -np.einsum("...ij,...j->...i", rotation, matrix[..., :3, 3]))
