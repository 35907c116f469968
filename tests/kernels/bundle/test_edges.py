"""Bundle adjustment with measured relative poses: against SciPy, and derivatives against finite differences."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.bundle.bundle_adjust import BundleAdjustment, BundleStatus, bundle_adjust
from jaxslam_kernels.bundle.cost import Observations
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxslam_kernels.se3 import between, retract
from linearized import differentiate
from quick_compile import quick_compile
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from small_problems import bundle_inputs

SIGMAS = np.array([0.01, 0.02, 0.03, 0.004, 0.006, 0.008])
FIXED = np.array([True, True, False, False])

pytestmark = pytest.mark.usefixtures("float64")


class Inputs(NamedTuple):
    """Four cameras, of which the first two are fixed and the last sees nothing, and two edges and a spare slot."""

    poses: jax.Array
    X_world: jax.Array
    observations: Observations
    edges: PoseGraphEdges


def make_inputs(seed: int = 1) -> Inputs:
    rng = np.random.default_rng(seed)
    poses, X_world, observations = bundle_inputs(seed=seed)
    noisy = lambda T, size: retract(T, jnp.asarray(size * SIGMAS * rng.normal(size=6)))
    last = retract(SE3(poses[2]), jnp.array([0.3, 0.1, -0.2, 0.1, -0.3, 0.2]))
    measured = [between(SE3(poses[1]), noisy(SE3(poses[2]), 2)), between(SE3(poses[2]), noisy(last, 2)), SE3.identity()]
    edges = PoseGraphEdges(
        source=jnp.array([1, 2, 0]),
        target=jnp.array([2, 3, 0]),
        T_source_target=SE3(jnp.stack([T.wxyz_xyz for T in measured])),
        information=jnp.broadcast_to(jnp.diag(SIGMAS**-2.0), (3, 6, 6)),
        weights=jnp.array([0.7, 1.0, jnp.nan]),
        mask=jnp.array([True, True, False]),
    )
    return Inputs(jnp.concatenate([poses, last.wxyz_xyz[None]]), X_world, observations, edges)


def adjust(inputs: Inputs) -> BundleAdjustment:
    return bundle_adjust(
        *inputs[:3], fixed_poses=jnp.asarray(FIXED), edges=inputs.edges, tolerance=0.0, max_steps=60, loss="squared"
    )


_adjusted = quick_compile(adjust)


def _scipy_optimum(inputs: Inputs) -> tuple[np.ndarray, float]:
    """Positions and rotations (as matrices) of the free cameras in one array, and the cost."""
    poses, X_start, seen, edges = jax.tree.map(np.asarray, inputs)
    start = Rotation.from_quat(np.roll(poses[:, :4], -1, axis=1))

    def unpack(x):
        tangents = np.zeros((4, 6))
        tangents[~FIXED] = x[:12].reshape(2, 6)
        return (
            start * Rotation.from_rotvec(tangents[:, 3:]),
            poses[:, 4:] + tangents[:, :3],
            X_start + x[12:].reshape(3, -1),
        )

    def residuals(x):
        turned, at, X_world = unpack(x)
        X, Y, Z = turned[seen.camera].inv().apply(X_world[:, seen.point].T - at[seen.camera]).T
        r = [((np.stack([X / Z, Y / Z]) - seen.xy) * seen.precision[:2]).ravel()]
        for k in range(2):
            s, t = edges.source[k], edges.target[k]
            measured = edges.T_source_target.wxyz_xyz[k]
            R_measured = Rotation.from_quat(np.roll(measured[:4], -1))
            apart = R_measured.inv().apply(turned[s].inv().apply(at[t] - at[s]) - measured[4:])
            quaternion = (R_measured.inv() * turned[s].inv() * turned[t]).as_quat()
            error = np.concatenate([apart, 2 * np.sign(quaternion[3]) * quaternion[:3]])
            r.append(np.sqrt(edges.weights[k]) * error / SIGMAS)
        return np.concatenate(r)

    fit = least_squares(residuals, np.zeros(12 + X_start.size), method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    turned, at, _ = unpack(fit.x)
    return np.concatenate([turned.as_matrix()[~FIXED].ravel(), at[~FIXED].ravel()]), float(fit.cost)


def test_matches_reference():
    inputs = make_inputs()
    result = _adjusted(inputs)
    reference, cost = _scipy_optimum(inputs)
    poses = np.asarray(result.poses)[~FIXED]
    found = np.concatenate(
        [Rotation.from_quat(np.roll(poses[:, :4], -1, axis=1)).as_matrix().ravel(), poses[:, 4:].ravel()]
    )
    assert BundleStatus(int(result.status)) == BundleStatus.OK
    np.testing.assert_allclose(found, reference, atol=1e-7)
    assert float(result.cost) == pytest.approx(cost, rel=1e-9)
    assert float(result.cost) < 0.5 * float(result.initial_cost)


def test_camera_without_observations_follows_its_edge():
    inputs = make_inputs()
    result = _adjusted(inputs)
    T = between(SE3(result.poses[2]), SE3(result.poses[3])).wxyz_xyz
    np.testing.assert_allclose(T, inputs.edges.T_source_target.wxyz_xyz[1], atol=1e-9)


def test_edges_that_do_not_count():
    """Weight 0, NaN, no slot of their own: as if there were none."""
    inputs = make_inputs()
    edges = inputs.edges
    nothing = quick_compile(lambda inputs: adjust(inputs._replace(edges=None)))(inputs)
    no_weight = edges._replace(weights=jnp.zeros(3))
    not_finite = edges._replace(information=edges.information * jnp.nan)
    masked = edges._replace(mask=jnp.zeros(3, bool))
    for ignored in (no_weight, not_finite, masked, edges._replace(source=jnp.array([9, -1, 0]))):
        result = _adjusted(inputs._replace(edges=ignored))
        assert BundleStatus(int(result.status)) == BundleStatus.OK
        np.testing.assert_allclose(result.poses, nothing.poses, atol=1e-9)
        np.testing.assert_allclose(result.poses[3], inputs.poses[3], atol=1e-12)


def test_edges_alone():
    """Without observations the measured poses decide."""
    inputs = make_inputs()
    unseen = inputs.observations._replace(valid=jnp.zeros_like(inputs.observations.valid))
    result = _adjusted(inputs._replace(observations=unseen))
    assert BundleStatus(int(result.status)) == BundleStatus.OK
    T = between(SE3(result.poses[1]), SE3(result.poses[2])).wxyz_xyz
    np.testing.assert_allclose(T, inputs.edges.T_source_target.wxyz_xyz[0], atol=1e-9)
    np.testing.assert_array_equal(result.X_world, inputs.X_world)


@pytest.mark.slow
def test_gradient():
    """Forward = reverse = finite differences: measured poses, information, weights, what is fixed, observations."""
    rng = np.random.default_rng(4)
    inputs, probe = make_inputs(), rng.normal(size=(4, 7))

    def moved(x) -> Inputs:
        edges = inputs.edges
        measured = jax.vmap(lambda T, t: retract(SE3(T), t).wxyz_xyz)(edges.T_source_target.wxyz_xyz, x["measured"])
        edges = edges._replace(
            T_source_target=SE3(measured),
            information=edges.information * x["information"][:, None, None],
            weights=edges.weights.at[:2].multiply(x["weights"]),
        )
        poses = inputs.poses.at[1].set(retract(SE3(inputs.poses[1]), x["fixed"]).wxyz_xyz)
        observations = inputs.observations._replace(xy=inputs.observations.xy + x["xy"])
        return inputs._replace(poses=poses, observations=observations, edges=edges)

    def summary(x):
        result = adjust(moved(x))
        return jnp.sum(probe * result.poses) + 1e-2 * result.cost + 1e-3 * result.initial_cost, result.status

    at = {
        "measured": np.zeros((3, 6)),
        "information": np.ones(3),
        "weights": np.ones(2),
        "fixed": np.zeros(6),
        "xy": np.zeros(inputs.observations.xy.shape),
    }
    size = {"measured": 0.01, "information": 1.0, "weights": 1.0, "fixed": 0.01, "xy": 0.01}
    direction = {name: size[name] * rng.normal(size=np.shape(value)) for name, value in at.items()}
    at, direction = (jax.tree.map(jnp.asarray, tree) for tree in (at, direction))
    status, gradient, change = quick_compile(lambda x, d: differentiate(summary, x, d))(at, direction)
    assert BundleStatus(int(status)) == BundleStatus.OK
    shifted = quick_compile(summary)
    step = 1e-5
    ahead, behind = (
        float(shifted(jax.tree.map(lambda x, d, sign=sign: x + sign * step * d, at, direction))[0]) for sign in (1, -1)
    )
    along = sum(float(jnp.vdot(gradient[name], direction[name])) for name in at)
    assert along == pytest.approx(float(change), rel=1e-9)
    assert along == pytest.approx((ahead - behind) / (2 * step), rel=1e-6)
    assert all(np.abs(gradient[name]).max() > 0 for name in at)
