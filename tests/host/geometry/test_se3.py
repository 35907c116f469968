"""Rigid transforms of many poses, against SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.geometry import se3 as pose
from jaxslam.geometry.se3 import IDENTITY


def some_poses(*shape: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = int(np.prod(shape))
    wxyz = Rotation.random(count, rng=rng).as_quat(scalar_first=True)
    return np.hstack([wxyz, rng.normal(size=(count, 3))]).reshape(*shape, 7)


def reference(T: np.ndarray) -> np.ndarray:
    """`(..., 4, 4)` homogeneous matrices."""
    M = np.tile(np.eye(4), (*T.shape[:-1], 1, 1))
    M[..., :3, :3] = (
        Rotation.from_quat(T[..., :4].reshape(-1, 4), scalar_first=True).as_matrix().reshape(M[..., :3, :3].shape)
    )
    M[..., :3, 3] = T[..., 4:]
    return M


def assert_is(T: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(reference(T), expected, atol=1e-14)


def test_compose():
    first, second = some_poses(9, seed=1), some_poses(9, seed=2)
    assert_is(pose.compose(first, second), reference(first) @ reference(second))
    assert_is(pose.compose(first[0], second), reference(first[0]) @ reference(second))
    assert pose.compose(some_poses(2, 3), some_poses(3)).shape == (2, 3, 7)


def test_compose_does_not_lose_unit_length():
    T = some_poses(1)[0]
    far = T
    for _ in range(1000):
        far = pose.compose(far, T)
    assert np.linalg.norm(far[:4]) == pytest.approx(1, abs=1e-15)


def test_inverse_and_between():
    first, second = some_poses(9, seed=1), some_poses(9, seed=2)
    assert_is(pose.inverse(first), np.linalg.inv(reference(first)))
    assert_is(pose.between(first, second), np.linalg.inv(reference(first)) @ reference(second))
    np.testing.assert_allclose(pose.between(first, first), np.tile(IDENTITY, (9, 1)), atol=1e-14)


def test_points():
    T, X = some_poses(1)[0], np.random.default_rng(3).normal(size=(3, 5))
    np.testing.assert_allclose(pose.transform(T, X), (reference(T) @ np.vstack([X, np.ones((1, 5))]))[:3], atol=1e-14)
    np.testing.assert_allclose(pose.to_local(T, pose.transform(T, X)), X, atol=1e-14)


def test_rotate():
    T, vectors = some_poses(5), np.random.default_rng(3).normal(size=(5, 3))
    expected = Rotation.from_quat(T[:, :4], scalar_first=True).apply(vectors)
    np.testing.assert_allclose(pose.rotate(T, vectors), expected, atol=1e-14)


def test_angle_is_that_of_the_shorter_way_and_exact_near_zero():
    T = some_poses(50)
    expected = Rotation.from_quat(T[:, :4], scalar_first=True).magnitude()
    np.testing.assert_allclose(pose.angle(T), expected, atol=1e-14)
    np.testing.assert_allclose(pose.angle(-T), expected, atol=1e-14)
    tiny = np.array([1.0, 5e-10, 0, 0, 0, 0, 0])
    assert pose.angle(tiny) == pytest.approx(1e-9, rel=1e-12)


def test_displacement():
    """It undoes `retract`, whichever sign the quaternions have."""
    rng = np.random.default_rng(4)
    for first in some_poses(9, seed=5):
        tangent = rng.uniform(-1.5, 1.5, 6)  # less than half a turn
        second = pose.retract(first, tangent) * np.array([-1, -1, -1, -1, 1, 1, 1])
        np.testing.assert_allclose(pose.displacement(first, second), tangent, atol=1e-12)
    np.testing.assert_array_equal(pose.displacement(IDENTITY, IDENTITY), np.zeros(6))
