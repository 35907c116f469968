"""Second derivatives of everything that is found by iteration: equal to central differences of the first."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.camera import make_intrinsics, normalize
from jaxslam_kernels.flow.lk_flow import FlowPlan, lk_flow
from jaxslam_kernels.flow.lk_search import LevelPlan
from jaxslam_kernels.flow.patch_align import align_patches
from jaxslam_kernels.image.pyramid import build_pyramid
from jaxslam_kernels.pose.pose_refine import refine_pose
from jaxslam_kernels.se3 import retract
from quick_compile import quick_compile
from small_problems import (
    CAMERA,
    PoseInputs,
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

pytestmark = pytest.mark.usefixtures("float64")
slow = partial(pytest.param, marks=pytest.mark.slow)


def _varied(n, seed=0):
    """Weights that differ, and a direction in which they change."""
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(0.7, 1.3, n)), jnp.asarray(rng.normal(size=n) * 0.1)


def _pose(t):
    """By weights, points, pixels, intrinsics, robust scale and depth, all at once."""
    T, X_world, uv = pose_inputs()
    rng = np.random.default_rng(1)
    weights, change = _varied(12)
    camera = make_intrinsics(*CAMERA, (0.1, -0.05, 0.001, 0.002, 0.01), dtype=jnp.float64)
    refined = refine_pose(
        T,
        X_world + t * jnp.asarray(rng.normal(size=(3, 12)) * 0.02),
        uv + t * jnp.asarray(rng.normal(size=(2, 12))),
        camera._replace(fx=camera.fx + t, cy=camera.cy - t, distortion=camera.distortion * (1 + t)),
        weights=weights + t * change,
        depth=X_world[2] * (1 + 0.01 * t),
        scale=2.0 + t,
        max_steps=100,
    )
    return jnp.concatenate(
        [refined.T_world_cam.wxyz_xyz, refined.covariance.ravel(), refined.cost[None], refined.residual_scale[None]]
    )


def _consensus(t):
    weights, change = _varied(12)
    return ransac(pose_inputs(), weights + t * change).T_world_cam.wxyz_xyz


def _bundle(t):
    """By weights of points and observations, pixels, depths, and the poses and points that are fixed."""
    inputs = bundle_inputs()
    (weights, change), (of_points, change_of_points) = _varied(24), _varied(8, 1)
    observations = inputs.observations
    moved = jnp.asarray(np.random.default_rng(2).normal(size=observations.xy.shape)) * 0.002
    poses = jax.vmap(lambda pose: retract(SE3(pose), 0.01 * t * jnp.arange(6.0)).wxyz_xyz)(inputs.poses)
    inputs = inputs._replace(poses=poses, observations=observations._replace(xy=observations.xy + t * moved))
    adjusted = adjust(inputs, of_points + t * change_of_points, weights + t * change)
    return jnp.concatenate([adjusted.poses.ravel(), adjusted.X_world.ravel(), adjusted.cost[None]])


def _graph(t):
    (start, edges), (weights, change) = graph_inputs(), _varied(6)
    moved = jax.vmap(lambda T: retract(SE3(T), 0.05 * t * jnp.arange(6.0)).wxyz_xyz)
    edges = edges._replace(T_source_target=SE3(moved(edges.T_source_target.wxyz_xyz)))
    optimized = optimize((SE3(moved(start.wxyz_xyz)), edges), weights + t * change)
    return jnp.concatenate([optimized.T_world_cam.wxyz_xyz.ravel(), optimized.cost[None]])


def _match(t):
    (before, after), (weights, change) = match_inputs(), _varied(20)
    moved = jnp.asarray(np.random.default_rng(3).normal(size=before.shape)) * 0.1
    return match((before + t * moved, after), weights + t * change).F.ravel()


def _texture(shift):
    v, u = np.mgrid[:40, :40].astype(float)
    return jnp.asarray(128 + 40 * np.sin(0.35 * (u + shift)) + 30 * np.cos(0.29 * v) + 20 * np.sin(0.2 * u + 0.31 * v))


POINTS = np.array([[17.3, 22.6], [20.7, 18.2]])
LEVEL = LevelPlan(9, 60, 1e-9)


def _flow(t):
    moved = jnp.asarray(np.random.default_rng(0).normal(size=(2, 40, 40)))
    previous, current = (build_pyramid(_texture(s) + t * m, num_levels=1) for s, m in zip((0, 0.7), moved, strict=True))
    flow = lk_flow(previous, current, POINTS + 0.1 * t, plan=FlowPlan(LEVEL, LEVEL, LEVEL))
    return jnp.concatenate([flow.points.ravel(), flow.residual, flow.texture])


def _patches(t):
    moved = jnp.asarray(np.random.default_rng(1).normal(size=(2, 40, 40)))
    pictures = (_texture(0) + t * moved[0])[None]
    current = build_pyramid(_texture(0.7) + t * moved[1], num_levels=1)
    warp = jnp.broadcast_to(jnp.eye(2)[:, :, None], (2, 2, 2)) * (1 + 0.01 * t)
    match = align_patches(
        pictures,
        jnp.zeros(2, jnp.int32),
        POINTS + 0.1 * t,
        warp,
        current,
        jnp.asarray(POINTS),
        jnp.ones(2, bool),
        plan=LEVEL,
    )
    return jnp.concatenate([match.points.ravel(), match.correlation])


def _directions(t):
    camera = make_intrinsics(200.0, 210.0, 80.0, 60.0, (0.2, -0.1, 0.002, -0.003, 0.03), dtype=jnp.float64)
    moved = camera._replace(fx=camera.fx + 10 * t, distortion=camera.distortion * (1 + t))
    return normalize(moved, jnp.array([[20.0, 150, 80], [30.0, 100, 61]]) + 10 * t).ravel()


@pytest.mark.parametrize(
    "kernel", [_directions, *(slow(k) for k in (_bundle, _consensus, _flow, _graph, _match, _patches, _pose))]
)
def test_right(kernel):
    along = lambda f, t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]
    first = lambda t: along(kernel, t)
    both = quick_compile(lambda t: (first(t), along(first, t)))
    h = 1e-3  # solvers end where steps are below the root of the precision, so that smaller ones are noise
    at = {k: both(jnp.asarray(k * h)) for k in (-2, -1, 0, 1, 2)}
    expected, second = (8 * (at[1][0] - at[-1][0]) - (at[2][0] - at[-2][0])) / (12 * h), at[0][1]
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(second, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    probe = jnp.asarray(np.random.default_rng(2).normal(size=expected.shape))
    reverse = quick_compile(jax.grad(jax.grad(lambda t: kernel(t) @ probe)))
    np.testing.assert_allclose(reverse(jnp.zeros(())), second @ probe, rtol=1e-7)


SOLVERS = {
    "refine_pose": (lambda w: refine(pose_inputs(), w), 12),
    "bundle_adjust": (lambda w: adjust(bundle_inputs(), w), 8),
    "optimize_pose_graph": (lambda w: optimize(graph_inputs(), w), 6),
}


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["refine_pose", "bundle_adjust", "optimize_pose_graph"])
def test_of_weights_of_zero(solver):
    """The limit from above, as the first derivatives are."""
    solve, n = SOLVERS[solver]
    rng = np.random.default_rng(4)
    probes = [jnp.asarray(rng.normal(size=leaf.shape)) for leaf in _poses_and_cost(jax.eval_shape(solve, jnp.ones(n)))]
    loss = lambda w: sum(jnp.vdot(*pair) for pair in zip(probes, _poses_and_cost(solve(w)), strict=True))
    weights = jnp.ones(n).at[jnp.array([1, 3])].set(0.0)
    gradient = quick_compile(jax.grad(loss))
    for direction in (jnp.ones(n).at[jnp.array([1, 3])].set(0.0), jnp.zeros(n).at[1].set(1.0)):
        second = quick_compile(lambda w, d=direction: jax.jvp(jax.grad(loss), (w,), (d,))[1])(weights)
        h = 1e-2
        moved = [gradient(weights + k * h * direction) for k in range(4)]
        expected = (-11 * moved[0] + 18 * moved[1] - 9 * moved[2] + 2 * moved[3]) / (6 * h)  # from one side
        np.testing.assert_allclose(second, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def _poses_and_cost(result):
    poses = result.poses if hasattr(result, "poses") else result.T_world_cam.wxyz_xyz
    return poses, result.cost


ORDERS = {
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "of compiled": lambda f: jax.jacfwd(jax.jit(jax.grad(f))),
    "of a checkpoint": lambda f: jax.hessian(jax.checkpoint(f)),
    "batch": lambda f: lambda x: jax.vmap(jax.hessian(f))(jnp.stack([x, x]))[1],
}


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_in_any_order(order):
    inputs = pose_inputs(8)
    loss = lambda w: refine(inputs, w).T_world_cam.wxyz_xyz.sum()
    weights = _varied(8)[0]
    expected = quick_compile(jax.hessian(loss))(weights)
    np.testing.assert_allclose(expected, expected.T, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_allclose(ORDERS[order](loss)(weights), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


class TestThroughScan:
    """Solvers that get what the ones before them found: to second order in whatever way the loop is written."""

    STEPS = 2

    def loss(self, weights, scan):
        start, X_world, uv = pose_inputs(8)

        def step(X_world, shift):
            pose = refine(PoseInputs(start, X_world, uv + shift), weights).T_world_cam
            return X_world + 0.1 * jnp.sin(pose.translation())[:, None] * weights[None], pose.translation()

        shifts = 0.3 * jnp.asarray(np.random.default_rng(3).normal(size=(self.STEPS, 2, 8)))
        return jnp.sum(jnp.square(scan(step, X_world, shifts)[1]))

    @staticmethod
    def unrolled(step, carry, shifts):
        found = []
        for shift in shifts:
            carry, one = step(carry, shift)
            found.append(one)
        return carry, jnp.stack(found)

    @pytest.mark.slow
    @pytest.mark.parametrize("checkpoint", [False, True])
    def test_as_unrolled(self, checkpoint):
        rematerialized = lambda step, *rest: jax.lax.scan(jax.checkpoint(step, prevent_cse=False), *rest)
        scan = rematerialized if checkpoint else jax.lax.scan
        weights, direction = _varied(8)
        along = lambda f: quick_compile(lambda w: jax.jvp(f, (w,), (direction,))[1])(weights)
        curvature = lambda scan: along(jax.grad(partial(self.loss, scan=scan)))
        second = curvature(scan)
        np.testing.assert_allclose(second, curvature(self.unrolled), rtol=1e-6, atol=1e-9 * np.abs(second).max())


@pytest.mark.slow
def test_of_what_is_undetermined():
    """Points on one line, or too few: no derivative, and no NaN."""
    T, X_world, uv = pose_inputs()
    line = jnp.stack([jnp.linspace(-1.0, 1.0, 12), jnp.zeros(12), jnp.full(12, 3.0)])
    loss = lambda w, X: refine_pose(T, X, uv, make_intrinsics(*CAMERA, dtype=jnp.float64), weights=w).T_world_cam
    hessian = quick_compile(jax.hessian(lambda w, X: loss(w, X).wxyz_xyz.sum()))
    for weights, points in ((jnp.ones(12), line), (jnp.zeros(12).at[:2].set(1.0), X_world)):
        assert not hessian(weights, points).any()
