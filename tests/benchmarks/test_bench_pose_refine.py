"""Pose refinement, 500 points, 20 % outliers.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_pose_refine.py -s`
"""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from jaxslam_kernels.pose.pose_refine import PoseStatus, refine_pose
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.single_view import DISTORTION, MATRIX, camera, make_scene, pose_error, pose_of
from jaxslam.benchmark.timing import compare, compile_seconds

pytestmark = pytest.mark.benchmark

N = 500
SCENE = make_scene(0, N)
ARGUMENTS = (pose_of(SCENE.initial), *SCENE.arrays(), camera())


SOLVERS = {
    "LevenbergMarquardt": optx.LevenbergMarquardt,
    "LevenbergMarquardt, Cholesky": partial(optx.LevenbergMarquardt, linear_solver=lx.Normal(lx.Cholesky())),
    "Dogleg, Cholesky": partial(optx.Dogleg, linear_solver=lx.Normal(lx.Cholesky())),
    "GaussNewton, Cholesky": partial(optx.GaussNewton, linear_solver=lx.Normal(lx.Cholesky())),
}
"""Least-squares solvers of optimistix, which see residuals; the first one has defaults alone."""


def _refine(T, X_world, uv, depth, sigma_depth, intrinsics, solver=None):
    return refine_pose(T, X_world, uv, intrinsics, depth=depth, sigma_depth=sigma_depth, solver=solver)


def test_refine_against_opencv():
    """OpenCV's refinement is not robust: it gets the inliers alone, and no depth."""
    refine = jax.jit(_refine)
    inliers = ~SCENE.outlier
    X, uv = SCENE.X_world.T[inliers].copy(), SCENE.uv.T[inliers].copy()
    start = Rotation.from_quat(np.roll(SCENE.initial[:4], -1)).inv()
    rvec, tvec = start.as_rotvec()[:, None], -start.apply(SCENE.initial[4:])[:, None]
    comparison = compare(
        lambda: refine(*ARGUMENTS),
        lambda: cv2.solvePnPRefineLM(X, uv, MATRIX, DISTORTION, rvec.copy(), tvec.copy()),
    )
    error = pose_error(refine(*ARGUMENTS).T_world_cam.wxyz_xyz, SCENE.pose)
    print(f"\nrefine_pose, {N} points, against cv2.solvePnPRefineLM\n{comparison}")
    print(f"  {refine(*ARGUMENTS).num_steps} steps, error {1e3 * error[0]:.2f} mm, {1e3 * error[1]:.2f} mrad")
    print(f"  compile {compile_seconds(_refine, *ARGUMENTS):.1f} s of processor time")
    assert comparison.processor_ratio < 1.2


@pytest.mark.parametrize("name", SOLVERS)
def test_refine_against_optimistix(name):
    """Steps, cost and time with `ManifoldLevenbergMarquardt` and with a solver of optimistix, stopped alike."""
    solver = SOLVERS[name](rtol=1e-4, atol=1e-4)
    ours, theirs = jax.jit(_refine), jax.jit(partial(_refine, solver=solver))
    comparison = compare(lambda: ours(*ARGUMENTS), lambda: theirs(*ARGUMENTS), rounds=50)
    print(f"\nrefine_pose, {N} points, against optimistix: {name}\n{comparison}")
    for refine in (ours, theirs):
        result = refine(*ARGUMENTS)
        print(f"  {result.num_steps} steps to a cost of {result.cost:.4f}, {PoseStatus(int(result.status)).name}")
    seconds = compile_seconds(partial(_refine, solver=solver), *ARGUMENTS)
    print(f"  compile {compile_seconds(_refine, *ARGUMENTS):.1f} and {seconds:.1f} s of processor time")
    assert comparison.processor_ratio < 1


def test_gradient_costs_little():
    """The derivative by all inputs, against the value alone."""

    def loss(*arguments):
        return jnp.sum(jnp.sin(_refine(*arguments).T_world_cam.wxyz_xyz))

    by_all = jax.grad(loss, argnums=(1, 2, 3, 4, 5))
    gradient, refine = jax.jit(by_all), jax.jit(_refine)
    comparison = compare(lambda: gradient(*ARGUMENTS), lambda: refine(*ARGUMENTS))
    print(f"\ngradient of refine_pose, {N} points, against its value\n{comparison}")
    print(f"  compile {compile_seconds(by_all, *ARGUMENTS):.1f} s of processor time")
    assert comparison.processor_ratio < 4.0
