"""Motions measured outside: their composition, what they tell of a pose, and what is refused."""

import numpy as np
import pytest

from jaxslam.errors import FrameError
from jaxslam.geometry.se3 import IDENTITY, compose, displacement, retract
from jaxslam.sensors import MotionPrior

RNG = np.random.default_rng(0)
FIRST = retract(IDENTITY, np.array([0.3, -0.2, 0.5, 0.4, -0.3, 0.2]))
SECOND = retract(IDENTITY, np.array([-0.1, 0.4, 0.2, -0.2, 0.5, 0.3]))


def spread(size: int = 6) -> np.ndarray:
    """A covariance of some 1 mm and 1 mrad."""
    root = 1e-3 * RNG.normal(size=(size, size))
    return root @ root.T + 1e-7 * np.eye(size)


def sampled(covariance: np.ndarray, count: int = 20_000) -> np.ndarray:
    return RNG.multivariate_normal(np.zeros(len(covariance)), covariance, count)


def deviations(T: np.ndarray, tangents: list[np.ndarray]) -> np.ndarray:
    """Covariance `(6, 6)` of poses about one."""
    return np.cov(np.array([displacement(T, moved) for moved in tangents]).T)


def test_two_motions_in_turn_are_as_uncertain_as_their_products() -> None:
    first, second = MotionPrior(FIRST, spread()), MotionPrior(SECOND, spread())
    both = first.then(second)
    np.testing.assert_allclose(both.T_last_cam, compose(FIRST, SECOND), atol=1e-12)
    products = [
        compose(retract(FIRST, one), retract(SECOND, other))
        for one, other in zip(sampled(first.covariance, 4000), sampled(second.covariance, 4000), strict=True)
    ]
    scale = np.sqrt(np.diag(both.covariance))
    apart = (deviations(both.T_last_cam, products) - both.covariance) / scale[:, None] / scale
    assert np.abs(apart).max() < 0.1


def test_what_is_known_of_a_pose_is_less_than_of_the_motion() -> None:
    motion, before = MotionPrior(FIRST, spread()), spread()
    expected = np.linalg.inv(MotionPrior(IDENTITY, before).then(motion).covariance)
    np.testing.assert_allclose(motion.information_from(before), expected, rtol=1e-9)


def test_a_rotation_says_nothing_of_translation() -> None:
    turned = MotionPrior(FIRST, 1e-6 * np.eye(3))
    assert not turned.has_translation
    information = turned.information_from(1e-6 * np.eye(6))
    np.testing.assert_allclose(information[3:, 3:], 5e5 * np.eye(3), rtol=1e-9, atol=1e-3)
    assert not information[:3].any()
    assert not information[:, :3].any()
    for pair in ((turned, MotionPrior(SECOND, spread())), (MotionPrior(SECOND, spread()), turned)):
        assert pair[0].then(pair[1]).covariance.shape == (3, 3)


def test_a_quaternion_of_about_unit_length_is_made_one() -> None:
    motion = MotionPrior(np.array([1.001, 0, 0, 0, 1, 2, 3]), np.eye(6).astype(np.float32))
    np.testing.assert_array_equal(motion.T_last_cam, [1, 0, 0, 0, 1, 2, 3])
    assert motion.covariance.dtype == np.float64


@pytest.mark.parametrize(
    ("motion", "covariance", "words"),
    [
        (np.eye(4), np.eye(6), r"T_last_cam: expected \(7,\) wxyz_xyz, got shape \(4, 4\)"),
        (
            np.array([0, 0, 0, 0, 1, 2, 3]),
            np.eye(6),
            "T_last_cam: expected a unit quaternion first, got one of length 0",
        ),
        (np.full(7, np.nan), np.eye(6), "T_last_cam: expected finite numbers"),
        ("forward", np.eye(6), "T_last_cam: expected an array of floats, got 'forward'"),
        (IDENTITY, np.ones(6), r"covariance: expected \(6, 6\), or \(3, 3\) of the rotation alone, got \(6,\)"),
        (IDENTITY, np.zeros((6, 6)), "covariance: expected a positive definite matrix, got the eigenvalue 0"),
        (IDENTITY, np.diag([1, 1, np.inf, 1, 1, 1]), "covariance: expected finite numbers"),
    ],
)
def test_what_is_no_motion_is_refused(motion, covariance, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        MotionPrior(motion, covariance)
