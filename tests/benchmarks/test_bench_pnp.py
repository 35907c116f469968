"""RANSAC against OpenCV's, 500 points.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_pnp.py -s`
"""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.pose.pnp import SAMPLE_SIZE, ransac_pnp, score_poses
from jaxslam_kernels.pose.pose_cost import pose_problem
from jaxslam_kernels.ransac_sampling import draw_samples
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.single_view import (
    DISTORTION,
    MATRIX,
    PosedPoints,
    camera,
    make_scene,
    pose_error,
    to_wxyz_xyz,
)
from jaxslam.benchmark.timing import compare, compile_seconds

pytestmark = pytest.mark.benchmark

N, HYPOTHESES, SCENES = 500, 128, 200
SUCCESS = (0.05, np.radians(1.0))
NO_POSE = (np.inf, np.inf)
INTRINSICS = camera()

_pixels_only = jax.jit(lambda key, X, uv, threshold: ransac_pnp(key, X, uv, INTRINSICS, threshold_px=threshold))


def _with_depth(key, X_world, uv, depth, threshold_depth):
    return ransac_pnp(key, X_world, uv, INTRINSICS, depth=depth, threshold_depth=threshold_depth)


def _opencv(scene: PosedPoints, threshold: float):
    """EPnP in RANSAC with OpenCV's default of iterations: rotation and translation vectors and inliers, or `None`."""
    X, uv = scene.X_world.T.copy(), scene.uv.T.copy()
    found, rvec, tvec, inliers = cv2.solvePnPRansac(
        X, uv, MATRIX, DISTORTION, flags=cv2.SOLVEPNP_EPNP, reprojectionError=threshold
    )
    return (rvec, tvec, inliers) if found and inliers is not None else None


def _opencv_error(scene: PosedPoints, threshold: float) -> tuple[float, float]:
    """Of OpenCV's pose after Levenberg-Marquardt on its inliers."""
    result = _opencv(scene, threshold)
    if result is None:
        return NO_POSE
    rvec, tvec, inliers = result
    keep = np.asarray(inliers)[:, 0].tolist()
    rvec, tvec = cv2.solvePnPRefineLM(scene.X_world.T[keep], scene.uv.T[keep], MATRIX, DISTORTION, rvec, tvec)
    world_cam = Rotation.from_rotvec(rvec[:, 0]).inv()
    return pose_error(to_wxyz_xyz(world_cam, -world_cam.apply(tvec[:, 0])), scene.pose)


@pytest.mark.parametrize("threshold", [3.0, 8.0])
def test_time(threshold):
    scene = make_scene(0, N, outliers=0.5)
    X_world, uv, depth, sigma = scene.arrays()
    key, limit = jax.random.key(0), jnp.asarray(threshold)
    comparison = compare(lambda: _pixels_only(key, X_world, uv, limit), lambda: _opencv(scene, threshold), rounds=100)
    print(f"\nransac_pnp, {N} points, half outliers, {threshold} px, against cv2.solvePnPRansac\n{comparison}")
    with_depth = jax.jit(_with_depth)
    depth_too = compare(
        lambda: with_depth(key, X_world, uv, depth, 3.0 * sigma), lambda: _opencv(scene, threshold), rounds=100
    )
    print(f"with depth\n{depth_too}")
    print(f"  compile {compile_seconds(_with_depth, key, X_world, uv, depth, 3.0 * sigma):.1f} s of processor time")
    assert comparison.processor_ratio < 0.5
    assert depth_too.processor_ratio < 0.5


def test_time_of_parts():
    """Scoring and drawing against a whole run of OpenCV, for scale."""
    scene = make_scene(0, N, outliers=0.5)
    X_world, uv, depth, sigma = scene.arrays()
    problem = pose_problem(X_world, uv, INTRINSICS, None, depth, 1.0, sigma, 3.0, None)[0]
    poses = jax.random.normal(jax.random.key(0), (3, 4, HYPOTHESES))
    score, draw = jax.jit(score_poses), jax.jit(draw_samples, static_argnums=(2, 3))
    key = jax.random.key(0)
    for name, f in (
        (f"score {HYPOTHESES} hypotheses x {N} points", lambda: score(poses, problem)),
        (f"draw {HYPOTHESES} samples of {N} points", lambda: draw(key, problem.weights, HYPOTHESES, SAMPLE_SIZE)),
    ):
        comparison = compare(f, lambda: _opencv(scene, 8.0), rounds=100)
        print(f"\n{name}\n{comparison}")
        assert comparison.processor_ratio < 0.1


@pytest.mark.parametrize(
    ("n", "outliers", "noise_px"), [(500, 0.5, 1.0), (500, 0.5, 0.5), (500, 0.7, 1.0), (50, 0.5, 1.0)]
)
@pytest.mark.parametrize("threshold", [3.0, 8.0])
def test_accuracy(n, outliers, noise_px, threshold):
    """At least as many poses found, and errors at least as small where OpenCV finds one."""
    ours, theirs = [], []
    for seed in range(SCENES):
        scene = make_scene(seed, n, noise_px=noise_px, outliers=outliers)
        X_world, uv, _, _ = scene.arrays()
        result = _pixels_only(jax.random.key(seed), X_world, uv, jnp.asarray(threshold))
        ours.append(pose_error(result.T_world_cam.wxyz_xyz, scene.pose))
        theirs.append(_opencv_error(scene, threshold))
    print(f"\n{SCENES} scenes, {n} points, {outliers:.0%} outliers, {noise_px} px noise, threshold {threshold} px")
    errors = {"ours": np.array(ours), "OpenCV": np.array(theirs)}
    found = {name: (e < SUCCESS).all(axis=1) for name, e in errors.items()}
    both = found["ours"] & found["OpenCV"]
    for name, e in errors.items():
        median, p95 = np.median(e[both], axis=0), np.percentile(e[both], 95, axis=0)
        print(
            f"  {name:7} found {found[name].mean():6.1%}  where both found: median {1e3 * median[0]:6.2f} mm "
            f"{1e3 * median[1]:6.3f} mrad, p95 {1e3 * p95[0]:6.2f} mm {1e3 * p95[1]:6.3f} mrad"
        )
    rms = {name: np.sqrt(np.mean(np.square(e[both]), axis=0)) for name, e in errors.items()}
    assert found["ours"].mean() >= found["OpenCV"].mean()
    assert (rms["ours"] <= 1.02 * rms["OpenCV"]).all()
