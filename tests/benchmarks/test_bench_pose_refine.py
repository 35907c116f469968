"""Pose refinement, 500 points, 20 % outliers.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_pose_refine.py -s`
"""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jaxlie import SE3
from jaxslam_kernels.pose.pose_cost import pose_problem
from jaxslam_kernels.pose.pose_refine import refine_pose
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.single_view import DISTORTION, MATRIX, camera, make_scene, pose_error, pose_of
from jaxslam.benchmark.timing import compare, compile_seconds

pytestmark = pytest.mark.benchmark

N = 500
SCENE = make_scene(0, N)
ARGUMENTS = (pose_of(SCENE.initial), *SCENE.arrays(), camera())


def _refine(T, X_world, uv, depth, sigma_depth, intrinsics):
    return refine_pose(T, X_world, uv, intrinsics, depth=depth, sigma_depth=sigma_depth)


def _tall_refine(T, X_world, uv, depth, sigma_depth, intrinsics):
    """The same cost handed to optimistix as residuals, its Levenberg-Marquardt with every default."""
    problem = pose_problem(X_world, uv, intrinsics, None, depth, 1.0, sigma_depth, 2.0, None)[0]

    def residuals(tangent, problem):
        R, t = T.rotation().as_matrix(), T.translation()
        step = SE3.exp(tangent)
        X_base = R.T @ (problem.X_world - t[:, None])
        X, Y, Z = step.rotation().as_matrix().T @ (X_base - step.translation()[:, None])
        errors = jnp.stack([X / Z - problem.xy[0], Y / Z - problem.xy[1], Z - problem.depth]) * problem.precision
        s = jnp.square(errors).sum(axis=0)
        c2 = jnp.square(problem.scale)
        return errors * jnp.sqrt(problem.weights * c2 * jnp.log1p(s / c2) / s)[None, :]

    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
    return optx.least_squares(residuals, solver, jnp.zeros(6), problem, max_steps=25, throw=False).value


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


def test_refine_against_default_optimistix():
    refine, tall = jax.jit(_refine), jax.jit(_tall_refine)
    comparison = compare(lambda: refine(*ARGUMENTS), lambda: tall(*ARGUMENTS), rounds=50)
    print(f"\nrefine_pose, {N} points, against optimistix.LevenbergMarquardt with its defaults\n{comparison}")
    assert comparison.processor_ratio < 0.2


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
