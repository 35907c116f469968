"""One step of local bundle adjustment: 12 keyframes, 1500 points, 7000 observations.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_bundle_adjust.py -s`
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.bundle.bundle_adjust import BundleStatus, bundle_adjust

from jaxslam.benchmark.kernels.scenes.bundle_window import make_window, without_depth
from jaxslam.benchmark.kernels.scenes.single_view import pose_error
from jaxslam.benchmark.timing import compare, compile_seconds, pinned_to_one_core

pytestmark = pytest.mark.benchmark

K, N, M = 12, 1500, 7000
WINDOW = make_window(K, N, M)
ARGUMENTS = WINDOW.poses, WINDOW.X_world, WINDOW.observations
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
    ceres_window = pytest.importorskip("jaxslam.benchmark.kernels.rivals.ceres")
    window, fixed, steps = without_depth(WINDOW), jnp.arange(K) < 2, 10
    ours = {n: jax.jit(partial(bundle_adjust, fixed_poses=fixed, tolerance=0.0, max_steps=n)) for n in (1, steps + 1)}
    inputs = window.poses, window.X_world, window.observations
    for f in ours.values():
        jax.block_until_ready(f(*inputs))

    def one_round():
        adjuster, model = ceres_window.ceres_problem(window, 2)
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
    num = int(window.observations.valid.sum())
    print(f"\na step of {K} keyframes, {num} observations without depth: ours {wall:.2f} ms", end="")
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
    errors = [pose_error(a, b) for a, b in zip(result.poses, WINDOW.truth, strict=True)]
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
