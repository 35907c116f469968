"""The derivative by a weight of exactly 0 is the limit from above, of every kernel that takes weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.bundle.bundle_adjust import BundleStatus
from jaxslam_kernels.pose.pose_refine import PoseStatus
from jaxslam_kernels.pose_graph.pose_graph import PoseGraphStatus
from jaxslam_kernels.scene_flow import upper_limit
from jaxslam_kernels.trajectory.alignment import align, ate
from jaxslam_kernels.two_view.fundamental import FundamentalStatus
from quick_compile import quick_compile
from small_problems import (
    adjust,
    bundle_inputs,
    graph_inputs,
    match,
    match_inputs,
    optimize,
    pose_inputs,
    ransac,
    refine,
)

H = 1e-4


pytestmark = pytest.mark.usefixtures("float64")


def _mixed(*arrays):
    """One number that all entries have a part in."""
    flat = jnp.concatenate([jnp.ravel(array) for array in arrays])
    return flat @ jnp.asarray(np.random.default_rng(7).normal(size=flat.size))


def _compare(solve, weights, zeros, status=None, rtol=1e-5):
    """Gradients of a mixture of each output at weights of 0 equal one-sided differences, forward and reverse.

    Args:
        solve: From weights to outputs and a status.
        weights: Where, but for zeros.
        zeros: Which weights are 0.
        status: What the status is there.
        rtol: Relative tolerance.

    Returns:
        The derivatives, an output a row.
    """
    weights = jnp.asarray(weights).at[jnp.array(zeros)].set(0.0)

    def mixtures(weights):
        outputs, status = solve(weights)
        return jnp.stack([_mixed(output) for output in outputs]), status

    @quick_compile
    def run(weights, along):
        value, forward, status = jax.linearize(mixtures, weights, has_aux=True)
        (jacobian,) = jax.vmap(jax.linear_transpose(forward, weights))(jnp.eye(value.size))
        return value, forward(along), jacobian, status

    jacobian = jnp.zeros((0, weights.size))
    for index in zeros:
        along = jnp.zeros_like(weights).at[index].set(1.0)
        here, forward, jacobian, found = run(weights, along)
        assert status is None or found == status
        once, twice = (run(weights + step * along, along)[0] for step in (H, 2 * H))
        expected = (4 * once - 3 * here - twice) / (2 * H)
        scale = np.abs(expected).max()
        assert scale > 0
        np.testing.assert_allclose(jacobian[:, index], expected, rtol=rtol, atol=1e-3 * rtol * scale)
        np.testing.assert_allclose(forward, jacobian[:, index], rtol=1e-8, atol=1e-10 * scale)
    return jacobian


def test_refine_pose():
    inputs = pose_inputs()

    def solve(weights):
        result = refine(inputs, weights)
        outputs = result.T_world_cam.wxyz_xyz, result.cost, 1e3 * result.covariance, result.residual_scale
        return outputs, result.status

    _compare(solve, np.linspace(0.5, 1.0, 12), [0, 1], PoseStatus.OK)


@quick_compile
def _refined(weights, inputs, cotangent):
    """The refined pose, `(7,)`, and the derivative of its product with a cotangent by the weights."""
    pose, pull_back = jax.vjp(lambda weights: refine(inputs, weights).T_world_cam.wxyz_xyz, weights)
    return pose, pull_back(cotangent)[0]


def test_masked_points_stay_out():
    """What is not finite, behind the camera or out of range has derivative 0 by its weight of 0, and hurts no other."""
    inputs = pose_inputs()
    wrong = jnp.array([[jnp.nan, 0.0, 1e300], [0.0, 0.0, -1e300], [3.0, -5.0, 1.0]])
    spoilt = inputs._replace(X_world=inputs.X_world.at[:, :3].set(wrong), uv=inputs.uv.at[:, 3].set(jnp.inf))
    weights, mixture = jnp.ones(12).at[:5].set(0.0), jax.grad(_mixed)(jnp.zeros(7))
    whole, part = (_refined(weights, some, mixture)[1] for some in (inputs, spoilt))
    np.testing.assert_array_equal(part[:4], 0.0)
    assert part[4] != 0
    np.testing.assert_allclose(part[4:], whole[4:], rtol=1e-9)


@pytest.mark.slow
def test_ransac_pnp():
    """A point beyond the threshold has none."""
    inputs = pose_inputs()
    inputs = inputs._replace(uv=inputs.uv.at[0, 1].add(30.0))

    def solve(weights):
        result = ransac(inputs, weights)
        return (result.T_world_cam.wxyz_xyz,), result.status

    jacobian = _compare(solve, np.where(np.arange(12) == 1, 0.0, 1.0), [0], PoseStatus.OK)
    assert jacobian[0, 1] == 0


@pytest.mark.slow
def test_bundle_adjust_points():
    """A point that has no weight counts where it would go, not where it started."""
    inputs = bundle_inputs()
    started = inputs._replace(X_world=inputs.X_world.at[:, 2].add(jnp.array([0.1, -0.1, 0.4])))

    def solve(weights):
        result = adjust(started, weights)
        still = jnp.where(weights[2] == 0, jnp.sum(jnp.abs(result.X_world - started.X_world)[:, 2]), 0.0) == 0
        outputs = result.poses, result.cost, jnp.delete(result.X_world, np.array([2, 5]), axis=1)
        return outputs, jnp.where(still, result.status, -1)

    _compare(solve, np.linspace(0.5, 1.0, 8), [2, 5], BundleStatus.OK)


@pytest.mark.slow
def test_bundle_adjust_observations():
    """By the weight of one observation of a point that others see; alone, any observation can be fitted exactly."""
    inputs = bundle_inputs()
    unseen = np.array([1, 9, 17])

    def solve(weights):
        result = adjust(inputs, None, weights)
        return (result.poses, result.cost), result.status

    weights = jnp.asarray(np.linspace(0.5, 1.0, 24)).at[unseen].set(0.0)
    jacobian = _compare(solve, weights, [3, 20], BundleStatus.OK)
    np.testing.assert_allclose(jacobian[:, unseen], 0.0, atol=1e-15)


@pytest.mark.slow
def test_pose_graph():
    """An edge to a node without others has none: it is fitted exactly."""
    start, edges = graph_inputs()
    edges = edges._replace(target=edges.target.at[5].set(3))

    def solve(weights):
        result = optimize((start, edges), weights)
        return (result.T_world_cam.wxyz_xyz[:3], result.cost, result.cost_before), result.status

    jacobian = _compare(solve, jnp.ones(6).at[5].set(0.0), [1], PoseGraphStatus.DISCONNECTED)
    np.testing.assert_array_equal(jacobian[:2, 5], 0.0)


@pytest.mark.slow
def test_ransac_fundamental():
    inputs = match_inputs()

    def solve(weights):
        result = match(inputs, weights)
        return (result.F,), result.status

    _compare(solve, np.linspace(0.5, 1.0, 20), [0, 1], FundamentalStatus.OK)


def test_align_and_ate():
    rng = np.random.default_rng(0)
    x, y = jnp.asarray(rng.normal(size=(2, 3, 6)))

    def solve(weights):
        fitted, errors = align(x, y, weights, with_scale=True), ate(x, y, weights).statistics
        outputs = fitted.T_reference_estimate.wxyz_xyz, fitted.scale, errors.rmse, errors.mean, errors.std
        return outputs, fitted.status

    _compare(solve, np.linspace(0.5, 1.0, 6), [1, 4], 0)


def test_upper_limit():
    intensity = jnp.asarray(np.random.default_rng(0).uniform(size=6))
    solve = lambda weights: ((upper_limit(intensity, weights, 3.0, robust=False),), 0)
    _compare(solve, np.ones(6), [1, 4], 0)


def test_weights_come_back():
    """Gradient descent raises a weight that has been clipped at 0 where that lowers the loss."""
    inputs, still = pose_inputs(), jnp.zeros(7)
    truth, _ = _refined(jnp.ones(12), inputs, still)

    def step(weights):
        pose, _ = _refined(weights, inputs, still)
        return 1e4 * jnp.sum(jnp.square(pose - truth)), _refined(weights, inputs, 2e4 * (pose - truth))[1]

    weights = jnp.ones(12).at[0].set(0.0)
    before, gradient = after, _ = step(weights)
    assert gradient[0] < 0
    for _ in range(20):
        weights = jnp.maximum(weights - 0.05 * gradient / jnp.abs(gradient).max(), 0.0)
        after, gradient = step(weights)
    assert weights[0] > 0.2
    assert after < 0.5 * before
