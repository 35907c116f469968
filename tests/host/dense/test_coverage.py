"""How much of a frame is in the pictures of keyframes."""

import numpy as np
import pytest

from jaxslam.dense.coverage import SeenArea
from jaxslam.geometry.se3 import IDENTITY
from jaxslam.sensors.camera import Camera

CAMERA = Camera("test", 320, 240, 260.0, 260.0, 159.5, 119.5, depth_scale_per_m=5000.0)
WALL_M = 2.0
NOTHING = np.zeros((240, 320), bool)


def _area(*keyframes: np.ndarray) -> SeenArea:
    area = SeenArea(CAMERA, nearest_m=0.3, farthest_m=6.0)
    for T_world_cam in keyframes:
        area.add(T_world_cam)
    return area


def _at(x: float = 0.0, z: float = 0.0) -> np.ndarray:
    return np.array([1, 0, 0, 0, x, 0, z], float)


def _wall(z: float = 0.0) -> np.ndarray:
    """Depth of a wall across the axis, from so far ahead of the first place."""
    return np.full((240, 320), WALL_M - z, np.float32)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 0.9, 1.0])
def test_to_the_side(share: float) -> None:
    """The camera goes to the right by a share of what it sees of the wall."""
    width_m = CAMERA.width / CAMERA.fx * WALL_M
    seen = _area(_at()).share(_wall(), NOTHING, _at(x=share * width_m))
    assert seen == pytest.approx(1 - share, abs=1 / 32)


@pytest.mark.parametrize("back_m", [0.1, 0.5, 2.0])
def test_backwards_and_forwards(back_m: float) -> None:
    """From farther away it sees all that the keyframe shows, and more; from nearer, nothing new."""
    expected = (WALL_M / (WALL_M + back_m)) ** 2
    assert _area(_at()).share(_wall(-back_m), NOTHING, _at(z=-back_m)) == pytest.approx(expected, abs=0.07)
    assert _area(_at(z=-back_m)).share(_wall(), NOTHING, _at()) == 1.0


def test_several_keyframes_together() -> None:
    half_m = 0.5 * CAMERA.width / CAMERA.fx * WALL_M
    assert _area(_at(x=-half_m), _at(x=half_m)).share(_wall(), NOTHING, _at()) == pytest.approx(1.0, abs=1 / 32)
    assert _area(_at(x=-half_m)).share(_wall(), NOTHING, _at()) == pytest.approx(0.5, abs=1 / 32)


def test_turned_round() -> None:
    assert _area(np.array([0, 0, 1, 0, 0, 0, 0], float)).share(_wall(), NOTHING, IDENTITY) == 0.0


def test_without_keyframes_nothing_is_shown() -> None:
    assert _area().share(_wall(), NOTHING, IDENTITY) == 0.0


@pytest.mark.parametrize("depth_m", [0.0, 0.1, 7.0, np.nan])
def test_without_depth_nothing_is_said(depth_m: float) -> None:
    assert _area().share(np.full((240, 320), depth_m, np.float32), NOTHING, IDENTITY) == 1.0
    assert _area().share(_wall(), ~NOTHING, IDENTITY) == 1.0


def test_what_moves_is_not_counted() -> None:
    """Only the right half counts, and it is new."""
    left = NOTHING.copy()
    left[:, :160] = True
    half_m = 0.5 * CAMERA.width / CAMERA.fx * WALL_M
    assert _area(_at(x=-half_m)).share(_wall(), left, _at()) == pytest.approx(0.0, abs=1 / 16)
