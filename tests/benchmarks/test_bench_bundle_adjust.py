"""One step of local bundle adjustment: 12 keyframes, 1500 points, 7000 observations.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_bundle_adjust.py -s`
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.timing import compare, compile_seconds, pinned_to_one_core
from jaxslam_kernels.bundle_adjust import BundleStatus, bundle_adjust
from jaxslam_kernels.bundle_cost import Observations, observe
from jaxslam_kernels.camera import make_intrinsics
from kernels.posed_scene import pose_error, to_wxyz_xyz
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.benchmark

K, N, M = 12, 1500, 7000


def _window() -> tuple[np.ndarray, tuple[jax.Array, jax.Array, Observations]]:
    """The true poses, and where to start with what is seen."""
    rng = np.random.default_rng(0)
    X_world = rng.uniform([[-2.0], [-1.5], [2.0]], [[2.0], [1.5], [5.0]], (3, N))
    rotations = [Rotation.from_rotvec(0.05 * rng.normal(size=3)) for _ in range(K)]
    positions = np.linspace([-0.5, 0.0, 0.0], [0.5, 0.0, 0.2], K)
    X_cam = np.stack([r.inv().apply(X_world.T - t).T for r, t in zip(rotations, positions, strict=True)])
    camera, point = np.divmod(np.sort(rng.choice(K * N, M, replace=False)), N)
    X, Y, Z = X_cam[camera, :, point].T
    uv = 500.0 * np.stack([X / Z, Y / Z]) + [[320.0], [240.0]] + rng.normal(size=(2, M))
    sigma_depth = 0.005 * Z**2
    depth = Z + sigma_depth * rng.normal(size=M)
    truth = np.stack([to_wxyz_xyz(r, t) for r, t in zip(rotations, positions, strict=True)])
    start = truth.copy()
    start[1:, 4:] += 0.02 * rng.normal(size=(K - 1, 3))
    single = lambda x: jnp.asarray(x, jnp.float32)
    observations = observe(
        jnp.asarray(camera, jnp.int32),
        jnp.asarray(point, jnp.int32),
        single(uv),
        make_intrinsics(500.0, 500.0, 320.0, 240.0),
        depth=single(depth),
        sigma_depth=single(sigma_depth),
    )
    return truth, (single(start), single(X_world + 0.05 * rng.normal(size=X_world.shape)), observations)


TRUTH, ARGUMENTS = _window()
FIXED = jnp.arange(K) < 1


def _adjust(poses, X_world, observations, max_steps):
    """Runs all its steps: they are what is timed."""
    return bundle_adjust(
        poses, X_world, observations, fixed_poses=FIXED, tolerance=0.0, loss="cauchy", max_steps=max_steps
    )


def test_one_step():
    """Eleven steps against one: the difference is ten steps, whatever comes before and after them."""
    eleven, one = (jax.jit(partial(_adjust, max_steps=steps)) for steps in (11, 1))
    steps = int(eleven(*ARGUMENTS).num_steps) - 1
    comparison = compare(lambda: eleven(*ARGUMENTS), lambda: one(*ARGUMENTS))
    wall = np.median(comparison.ours_ms - comparison.theirs_ms) / steps
    processor = np.median(comparison.ours_processor_ms - comparison.theirs_processor_ms) / steps
    print(f"\nbundle_adjust, {K} keyframes, {N} points, {M} observations, {steps + 1} steps against one\n{comparison}")
    print(f"  a step {wall:.2f} ms, {processor:.2f} ms of processor time")
    print(f"  compile {compile_seconds(partial(_adjust, max_steps=11), *ARGUMENTS):.1f} s of processor time")
    assert processor < 5.0


def test_one_step_against_ceres():
    """Without depth, which COLMAP's cost functions lack, and so with two poses fixed. Ceres times its steps itself."""
    ceres_window = pytest.importorskip("benchmarks.ceres_window")
    poses, X_world, seen = (jax.tree.map(np.asarray, x) for x in ARGUMENTS)
    often = np.bincount(seen.point, minlength=N)[seen.point] > 1
    camera, point, steps = seen.camera[often], seen.point[often], 10
    uv = seen.xy[:, often] * 500.0 + [[320.0], [240.0]]
    fixed = jnp.arange(K) < 2
    observations = ARGUMENTS[2]._replace(depth=jnp.zeros(M), valid=jnp.asarray(often))
    ours = {n: jax.jit(partial(bundle_adjust, fixed_poses=fixed, tolerance=0.0, max_steps=n)) for n in (1, steps + 1)}
    inputs = *ARGUMENTS[:2], observations
    start = np.concatenate(
        [poses.astype(float)[:, :4] / np.linalg.norm(poses[:, :4], axis=1)[:, None], poses[:, 4:]], 1
    )
    for f in ours.values():
        jax.block_until_ready(f(*inputs))

    def one_round():
        adjuster, model = ceres_window.ceres_problem(start, X_world.astype(float), camera, point, uv, 2)
        one, (result, *all_steps) = (_timed(partial(ours[n], *inputs)) for n in (1, steps + 1))
        summary = ceres_window.solve(adjuster, steps)
        del model  # not before: Ceres works on its memory
        differences = (np.array(all_steps) - one[1:]) / (int(result.num_steps) - 1)
        return result, summary, (*differences, 1e3 * summary.minimizer_time_in_seconds / steps)

    with pinned_to_one_core():
        rounds = [one_round() for _ in range(12)]
    result, summary, _ = rounds[-1]
    times = np.array([r[2] for r in rounds[2:]])
    (wall, processor, theirs), least = np.median(times, axis=0), times.min(axis=0)
    print(f"\na step of {K} keyframes, {point.size} observations without depth: ours {wall:.2f} ms", end="")
    print(
        f" ({processor:.2f} ms of processor time, least {least[0]:.2f}), Ceres {theirs:.2f} ms (least {least[2]:.2f})"
    )
    print(f"  cost: ours {result.initial_cost:.1f} to {result.cost:.1f} in {result.num_steps} steps", end="")
    print(f", Ceres {summary.initial_cost:.1f} to {summary.final_cost:.1f} in {steps}")
    assert float(result.initial_cost) == pytest.approx(summary.initial_cost, rel=1e-3)
    assert float(result.cost) < 1.01 * summary.final_cost
    assert processor < theirs


def _timed(function):
    """The result, and milliseconds on the wall clock and of processor time."""
    began, processor_began = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(function())
    return result, (time.perf_counter() - began) * 1e3, (time.process_time() - processor_began) * 1e3


def test_it_arrives():
    result = jax.jit(partial(bundle_adjust, fixed_poses=FIXED))(*ARGUMENTS)
    errors = [pose_error(a, b) for a, b in zip(result.poses, TRUTH, strict=True)]
    print(f"\n  {result.num_steps} steps, cost {result.initial_cost:.0f} to {result.cost:.0f}")
    print(f"  largest error {1e3 * max(e[0] for e in errors):.2f} mm, {1e3 * max(e[1] for e in errors):.2f} mrad")
    assert BundleStatus(int(result.status)) == BundleStatus.OK
    assert max(max(e) for e in errors) < 0.02


def test_gradient_costs_little():
    """The derivative by all observations, against the value alone."""

    def loss(poses, X_world, observations):
        return jnp.sum(jnp.sin(_adjust(poses, X_world, observations, 11).poses))

    by_all = jax.grad(loss, argnums=2, allow_int=True)
    gradient, adjust = jax.jit(by_all), jax.jit(partial(_adjust, max_steps=11))
    comparison = compare(lambda: gradient(*ARGUMENTS).weights, lambda: adjust(*ARGUMENTS), rounds=20)
    print(f"\ngradient of bundle_adjust, 11 steps, against its value\n{comparison}")
    assert comparison.processor_ratio < 4.0
