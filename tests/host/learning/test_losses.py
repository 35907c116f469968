"""Losses of trajectories: their values against evaluation, their derivatives against differences."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jaxlie import SE3
from jaxslam_kernels.se3 import compose, retract
from quick_compile import quick_compile, quick_compile_nested

from jaxslam.learning import ate_loss, pose_loss, relative_pose_loss

COUNT = 8
LOSSES: list[Callable[..., Any]] = [pose_loss, relative_pose_loss, ate_loss]


@quick_compile_nested
def moved(poses: SE3, tangents: jax.Array) -> SE3:
    """Poses moved in their own axes."""
    return jax.vmap(retract)(poses, tangents)


@pytest.fixture
def truth() -> SE3:
    random = np.random.default_rng(0)
    start = SE3(jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (COUNT, 1)))
    return moved(start, jnp.asarray(random.normal(size=(COUNT, 6)), jnp.float32))


@pytest.fixture
def noise() -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).normal(scale=0.05, size=(COUNT, 6)), jnp.float32)


@pytest.mark.parametrize("loss", LOSSES)
def test_zero_with_a_finite_derivative_at_the_truth(loss: Callable[..., Any], truth: SE3) -> None:
    at = quick_compile(jax.value_and_grad(lambda t: loss(moved(truth, t), truth)))
    value, slope = at(jnp.zeros((COUNT, 6)))
    assert abs(float(value)) < 1e-11
    assert jnp.isfinite(slope).all()
    assert float(jnp.abs(slope).max()) < 1e-5


@pytest.mark.parametrize("loss", [LOSSES[0], *(pytest.param(loss, marks=pytest.mark.slow) for loss in LOSSES[1:])])
def test_derivatives_equal_differences(loss: Callable[..., Any], truth: SE3, noise: jax.Array) -> None:
    with jax.enable_x64(True):
        exact = SE3(truth.wxyz_xyz.astype(jnp.float64))
        exact = SE3(exact.wxyz_xyz.at[:, :4].divide(jnp.linalg.norm(exact.wxyz_xyz[:, :4], axis=1)[:, None]))
        of_tangents = jax.jit(lambda t: loss(moved(exact, t), exact))
        check_grads(of_tangents, (noise.astype(jnp.float64),), order=1, atol=1e-7, rtol=1e-5)


def test_known_values(truth: SE3) -> None:
    """All poses are 0.3 m and 0.2 rad off in their own axes."""
    tangents = jnp.tile(jnp.array([0.3, 0, 0, 0.2, 0, 0]), (COUNT, 1))
    off = moved(truth, tangents)
    assert float(pose_loss(off, truth)) == pytest.approx(0.3**2 + 0.2**2, rel=1e-4)
    assert float(pose_loss(off, truth, meters_per_radian=2.0)) == pytest.approx(0.3**2 + 0.4**2, rel=1e-4)
    some = jnp.zeros(COUNT).at[0].set(1.0)
    assert float(pose_loss(off, truth, weights=some)) == pytest.approx(0.3**2 + 0.2**2, rel=1e-4)
    assert float(pose_loss(off, truth, weights=jnp.zeros(COUNT))) == 0


@pytest.mark.parametrize("loss", [relative_pose_loss, ate_loss])
@pytest.mark.slow
def test_no_world_matters(loss: Callable[..., Any], truth: SE3, noise: jax.Array) -> None:
    estimated = moved(truth, noise)
    world = retract(SE3(jnp.array([1.0, 0, 0, 0, 0, 0, 0])), jnp.array([1.0, 2.0, -3.0, 0.4, 0.5, -0.6]))
    elsewhere = jax.vmap(lambda pose: compose(world, SE3(pose)))(estimated.wxyz_xyz)
    assert float(loss(elsewhere, truth)) == pytest.approx(float(loss(estimated, truth)), rel=1e-3)
    assert float(loss(estimated, truth)) > 0


def test_over_more_frames_errors_add_up(truth: SE3) -> None:
    """A drift of 1 cm a frame is 3 cm over three."""
    drift = jnp.arange(COUNT, dtype=jnp.float32)[:, None] * jnp.array([0.01, 0, 0])[None]
    still = SE3(jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (COUNT, 1)))
    drifting = SE3(still.wxyz_xyz.at[:, 4:].add(drift))
    assert float(relative_pose_loss(drifting, still, step=3)) == pytest.approx(0.03**2, rel=1e-4)


class TestRefused:
    def test_other_numbers(self, truth: SE3) -> None:
        fewer = SE3(truth.wxyz_xyz[1:])
        for loss in LOSSES:
            with pytest.raises(ValueError, match=r"truth: expected \(8, 7\) as estimated, got \(7, 7\)"):
                loss(truth, fewer)
            with pytest.raises(ValueError, match=r"weights: expected \(8,\), one for each pose, got \(3,\)"):
                loss(truth, truth, weights=jnp.ones(3))
            with pytest.raises(ValueError, match=r"estimated: expected a batch of poses \(n, 7\), got \(7,\)"):
                loss(SE3(truth.wxyz_xyz[0]), truth)

    @pytest.mark.parametrize("step", [0, COUNT])
    def test_step(self, truth: SE3, step: int) -> None:
        with pytest.raises(ValueError, match="step: expected from 1 to 7"):
            relative_pose_loss(truth, truth, step=step)
