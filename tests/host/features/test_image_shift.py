"""The turn of a camera from the shift of the picture: images warped by known turns, and images that tell none."""

import cv2
import numpy as np
import pytest
from room_views import picture, sensor

from jaxslam.features.image_shift import turn_between
from jaxslam.features.pose_from_matches import pinhole
from jaxslam.geometry.se3 import IDENTITY, angle, between, matrices, retract
from jaxslam.geometry.types import Pose


def turned(image: np.ndarray, T_last_cam: Pose) -> np.ndarray:
    """Warp an image to that of a camera that turned; gray where the first one did not look."""
    (fx, fy), (cx, cy) = (column[:, 0] for column in pinhole(sensor()))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    H = K @ matrices(T_last_cam[:4]).T @ np.linalg.inv(K)
    return cv2.warpPerspective(image, H, image.shape[::-1], borderMode=cv2.BORDER_CONSTANT, borderValue=(127,))


@pytest.mark.parametrize("index", [0, 200, 400, 600, 800])
@pytest.mark.parametrize("degrees", [(0, 15, 0), (0, -15, 0), (12, 0, 0), (-12, 0, 0), (8, -10, 2), (0, 0, 0)])
def test_a_turn_is_found(index, degrees):
    image = np.asarray(picture(index).image)
    image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    T_last_cam = retract(IDENTITY, np.append(np.zeros(3), np.radians(degrees)))
    found = turn_between(image, turned(image, T_last_cam), sensor())
    assert found is not None
    np.testing.assert_array_equal(found[4:], 0)
    roll = np.radians(abs(degrees[2]))
    assert angle(between(found, T_last_cam)) < 0.03 + roll


def test_images_without_a_common_shift_tell_nothing():
    black, noise = np.zeros((240, 320), np.uint8), np.random.default_rng(0).integers(0, 256, (2, 240, 320), np.uint8)
    assert turn_between(black, black, sensor()) is None
    assert turn_between(noise[0], noise[1], sensor()) is None
    image = cv2.cvtColor(np.asarray(picture(0).image), cv2.COLOR_RGB2GRAY)
    assert turn_between(image, np.zeros_like(image), sensor()) is None


@pytest.mark.parametrize("shape", [(1, 1), (3, 500), (16, 16), (61, 40), (376, 1241)])
def test_any_size(shape):
    image = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    found = turn_between(image, image, sensor())
    assert found is None or angle(found) < 1e-3
