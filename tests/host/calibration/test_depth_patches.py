"""Planes of depth around tracked points."""

import numpy as np
import pytest

from jaxslam.calibration.depth_patches import DepthSettings, cut_patches, near_edges, planes_at
from jaxslam.sensors.sensor_model import DepthNoise

NOISE = DepthNoise(0.005, 0.007)
UV = np.array([[60.3, 101.7], [50.6, 40.2]])


def slanted(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a plane, and value and slope of its inverse depth at the first pixel."""
    v, u = np.mgrid[:height, :width]
    plane = np.array([0.5, 0.0008, -0.0005])
    return (1 / (plane[0] + plane[1] * u + plane[2] * v)).astype(np.float32), plane


@pytest.mark.parametrize(("width", "stride"), [(320, 1), (640, 2)])
def test_plane_is_found_beside_where_it_was_cut(width: int, stride: int) -> None:
    depth, plane = slanted(width, 120)
    settings = DepthSettings.of(NOISE, (0.3, 6.0), width)
    assert settings.stride == stride
    found = planes_at(cut_patches(depth, UV, settings), UV + np.array([[2.4], [-1.3]]), settings)
    u, v = UV + np.array([[2.4], [-1.3]])
    assert found.measured.all()
    np.testing.assert_allclose(found.plane[0], plane[0] + plane[1] * u + plane[2] * v, atol=2e-5)
    np.testing.assert_allclose(found.plane[1:], np.tile(plane[1:, None], 2), atol=2e-5)
    np.testing.assert_allclose(found.sigma, 0.005 * found.plane[0] ** 2 + 0.007)


def test_no_plane_without_depth_at_an_edge_or_out_of_reach() -> None:
    depth, _ = slanted(320, 120)
    depth[:, 150:] *= 0.5
    depth[:30, :30] = np.nan
    uv = np.array([[150.0, 12.0, 60.0, np.nan], [60.0, 12.0, 60.0, 60.0]])
    settings = DepthSettings.of(NOISE, (0.3, 6.0), 320)
    patches = cut_patches(depth, uv, settings)
    assert planes_at(patches, uv, settings).measured.tolist() == [False, False, True, False]
    far = uv + np.array([[5.0], [0.0]])
    assert not planes_at(patches, far, settings).measured.any()


def test_edges_are_a_step_or_missing_depth_and_noise_is_none() -> None:
    depth, _ = slanted(320, 120)
    depth[:, 150:] *= 0.9
    depth[:30, :60] = np.nan
    inverse = 1 / depth + 1e-3 * np.random.default_rng(0).normal(size=depth.shape)
    settings = DepthSettings.of(NOISE, (0.3, 6.0), 320)
    uv = np.array([[154.0, 40.0, 60.0, 90.0, 250.0, 200.0], [60.0, 26.0, 60.0, 80.0, 90.0, 40.0]])
    patches = cut_patches((1 / inverse).astype(np.float32), uv, settings)
    used = np.ones(6, bool)
    assert near_edges(patches, settings, used).tolist() == [True, True, False, False, False, False]
    without_noise = cut_patches(depth, uv, settings)
    assert near_edges(without_noise, settings, used).tolist() == [True, True, False, False, False, False]
    assert near_edges(patches, settings, ~used).all()  # nothing tells the noise
