"""The camera's kernels against OpenCV's, 500 points.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_camera.py -s`. A call of any compiled JAX function costs about
15 us before it computes anything; inside `track_step` it does not.
"""

import cv2
import jax
import numpy as np
import pytest
from jaxslam_kernels.camera import normalize, project

from jaxslam.benchmark.kernels.scenes.single_view import DISTORTION, MATRIX, camera, make_scene
from jaxslam.benchmark.timing import compare

pytestmark = pytest.mark.benchmark

INTRINSICS = camera()


def test_normalize():
    scene = make_scene(0, 500)
    uv, f = scene.arrays()[1], jax.jit(normalize)
    points = np.ascontiguousarray(scene.uv.T[:, None], np.float32)
    comparison = compare(lambda: f(INTRINSICS, uv), lambda: cv2.undistortPoints(points, MATRIX, DISTORTION))
    print(f"\nundistort 500 points\n{comparison}")
    assert comparison.processor_ratio < 4.0


def test_project():
    scene = make_scene(0, 500)
    X_world, f = scene.arrays()[0], jax.jit(project)
    points = np.ascontiguousarray(scene.X_world.T, np.float32)
    comparison = compare(
        lambda: f(INTRINSICS, X_world), lambda: cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, DISTORTION)
    )
    print(f"\nproject 500 points\n{comparison}")
    assert comparison.processor_ratio < 2.0
