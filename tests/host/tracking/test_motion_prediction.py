"""Predicting the pose from the velocity: as constant velocity where that is steady, less where it is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.se3 import displacement

from jaxslam.tracking.motion_prediction import VelocityStatistics, predict_pose, updated_statistics

DT_S = 0.05
NONE = VelocityStatistics(jnp.zeros(2), jnp.zeros(2))


@jax.jit
def _after(twists: jax.Array, dt_s: jax.Array) -> VelocityStatistics:
    before = jnp.concatenate([jnp.zeros((1, 6)), twists[:-1]])
    take = lambda statistics, pair: (updated_statistics(statistics, pair[0], pair[1], dt_s), None)
    return lax.scan(take, NONE, (before, twists))[0]


def after(twists: np.ndarray, dt_s: float = DT_S) -> VelocityStatistics:
    """Statistics of velocities `(k, 6)` that follow each other, the first one after rest."""
    return _after(jnp.asarray(twists, jnp.float32), jnp.float32(dt_s))


def share_predicted(twists: np.ndarray, elapsed_s: float, dt_s: float = DT_S) -> np.ndarray:
    """Shares `(2,)` of constant velocity that are predicted, of translation and rotation."""
    twist = np.asarray(twists[-1], np.float32)
    pose = predict_pose(SE3.identity(), jnp.asarray(twist), after(twists, dt_s), jnp.float32(elapsed_s))
    moved = np.asarray(displacement(SE3.identity(), pose)).reshape(2, 3)
    full = twist.reshape(2, 3) * elapsed_s
    return np.sum(moved * full, axis=1) / np.sum(full * full, axis=1)


def steady(count: int = 60) -> np.ndarray:
    return np.tile([12.0, 0, 0.3, 0, 0.2, 0], (count, 1))


def shaken(count: int = 400) -> np.ndarray:
    """A velocity that forgets itself within 0.2 s."""
    random, decay = np.random.default_rng(0), np.exp(-DT_S / 0.2)
    twists = [np.zeros(6)]
    for _ in range(count):
        twists.append(decay * twists[-1] + np.sqrt(1 - decay**2) * random.normal(size=6))
    return 0.3 * np.array(twists)


def test_a_steady_velocity_is_believed_for_long() -> None:
    np.testing.assert_allclose(share_predicted(steady(), 1.0), 1, atol=0.05)


def test_a_shaken_camera_is_predicted_to_stop() -> None:
    """By the time constant of its velocity: after `t`, `tau (1 - exp(-t / tau))` of the velocity."""
    for elapsed_s in (0.05, 0.2, 1.0):
        expected = 0.2 * (1 - np.exp(-elapsed_s / 0.2)) / elapsed_s
        # Velocities that are sampled look somewhat steadier than they are, and few of them count.
        shares = [share_predicted(shaken()[k : k + 100], elapsed_s) for k in range(0, 300, 10)]
        np.testing.assert_allclose(np.mean(shares, axis=0), expected, rtol=0.4)


def test_no_length_is_large() -> None:
    large, small = (shaken() * np.repeat([scale, 1], 3) for scale in (1e3, 1e-3))
    np.testing.assert_allclose(share_predicted(large, 0.2), share_predicted(small, 0.2), rtol=1e-3)


def test_the_first_velocity_is_believed() -> None:
    np.testing.assert_allclose(share_predicted(steady(1), 3 * DT_S), 1, rtol=1e-5)


@pytest.mark.parametrize("elapsed_s", [0.0, -1.0])
def test_nothing_moves_without_time(elapsed_s: float) -> None:
    pose = predict_pose(SE3.identity(), jnp.asarray(steady()[0], jnp.float32), after(steady()), jnp.float32(elapsed_s))
    np.testing.assert_array_equal(pose.wxyz_xyz, SE3.identity().wxyz_xyz)


def test_a_camera_at_rest_stays_and_has_a_derivative() -> None:
    def moved_m(twist: jax.Array) -> jax.Array:
        statistics = updated_statistics(NONE, jnp.zeros(6), twist, jnp.float32(DT_S))
        return predict_pose(SE3.identity(), twist, statistics, jnp.float32(0.1)).translation().sum()

    value, gradient = jax.value_and_grad(moved_m)(jnp.zeros(6))
    assert value == 0
    np.testing.assert_allclose(gradient[:3], 0.1, rtol=1e-5)
    assert np.isfinite(gradient).all()
