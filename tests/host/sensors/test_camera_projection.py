"""Projection by an ideal pinhole, and its inverse."""

import cv2
import numpy as np

from jaxslam.sensors.camera import Camera

CAMERA = Camera("mine", 640, 480, 525.0, 524.0, 319.5, 239.5)
X_CAM = np.array([[0.0, 1.2, -0.7, 3.0], [0.0, -0.4, 0.9, 2.0], [1.0, 2.5, 0.6, 4.0]])


def test_matches_opencv() -> None:
    K = np.array([[525.0, 0, 319.5], [0, 524.0, 239.5], [0, 0, 1]])
    expected, _ = cv2.projectPoints(X_CAM.T.copy(), np.zeros(3), np.zeros(3), K, np.zeros(5))
    np.testing.assert_allclose(CAMERA.project(X_CAM), expected[:, 0].T, rtol=1e-12)


def test_the_optical_axis_meets_the_principal_point() -> None:
    np.testing.assert_array_equal(CAMERA.project(X_CAM[:, :1]), [[319.5], [239.5]])


def test_back_projection_inverts_projection() -> None:
    np.testing.assert_allclose(CAMERA.back_project(CAMERA.project(X_CAM), X_CAM[2]), X_CAM, rtol=1e-12, atol=1e-15)


def test_distortion_is_ignored() -> None:
    distorted = Camera("mine", 640, 480, 525.0, 524.0, 319.5, 239.5, (0.3, -0.1, 0.001, 0.002, 0.0))
    np.testing.assert_array_equal(distorted.project(X_CAM), CAMERA.project(X_CAM))


def test_the_dtype_is_kept() -> None:
    X_cam = X_CAM.astype(np.float32)
    uv = CAMERA.project(X_cam)
    assert uv.dtype == np.float32
    assert CAMERA.back_project(uv, X_cam[2]).dtype == np.float32


def test_no_points_give_no_pixels() -> None:
    assert CAMERA.project(np.zeros((3, 0))).shape == (2, 0)
    assert CAMERA.back_project(np.zeros((2, 0)), np.zeros(0)).shape == (3, 0)
