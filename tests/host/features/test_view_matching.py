"""The pose of one view relative to another from their features, from an approximate pose or from none."""

import jax
import numpy as np
import pytest
from room_views import features, room, sensor

from jaxslam.features.pose_from_matches import PLACE_GATES
from jaxslam.features.view_matching import ViewPose, match_views, match_views_near, pixels_apart
from jaxslam.geometry.se3 import IDENTITY, angle, between, retract

SOURCE, VIEW = 0, 20


def errors(found: ViewPose) -> tuple[float, float]:
    """Meters and radians."""
    poses = room().T_world_cam
    wrong = between(between(poses[SOURCE], poses[VIEW]), found.T_source_cam)
    return float(np.linalg.norm(wrong[4:])), float(angle(wrong))


def truth() -> np.ndarray:
    return between(room().T_world_cam[SOURCE], room().T_world_cam[VIEW])


def test_without_any_pose() -> None:
    found = match_views(features(SOURCE), features(VIEW), sensor(), jax.random.key(0))
    assert found is not None
    assert found.is_place
    assert errors(found) < (0.01, 0.01)


@pytest.mark.parametrize(("turn_rad", "found_there"), [(0.0, True), (0.06, True), (0.5, False)])
def test_from_an_approximate_pose(turn_rad: float, found_there: bool) -> None:
    """Within the radius that is searched, 40 pixels are 0.08 rad."""
    about = retract(truth(), np.array([0, 0, 0, 0, turn_rad, 0]))
    found = match_views_near(features(SOURCE), features(VIEW), about, sensor(), (45.0, 15.0, 5.0))
    assert (found is not None) == found_there
    if found is not None:
        assert errors(found) < (0.01, 0.01)
        assert found.pairs.shape[1] >= PLACE_GATES.min_inliers


def test_pixels_apart() -> None:
    """A turn moves all features alike, but for the lens; a shift moves them by focal length x shift / depth."""
    focal, still = float(sensor().intrinsics.fx), truth()
    turned = retract(still, np.array([0, 0, 0, 0, 0.02, 0]))
    assert pixels_apart(features(SOURCE), still, turned, sensor()) == pytest.approx(0.02 * focal, rel=0.25)
    shifted = retract(IDENTITY, np.array([0.05, 0, 0, 0, 0, 0]))
    depth = features(SOURCE).depth
    expected = 0.05 * focal / np.median(depth[depth > 0])
    assert pixels_apart(features(SOURCE), IDENTITY, shifted, sensor()) == pytest.approx(expected, rel=0.02)
    nothing = features(SOURCE)._replace(depth=np.zeros_like(depth))
    assert pixels_apart(nothing, still, turned, sensor()) == np.inf


def test_a_pose_that_is_no_place() -> None:
    """Few features are enough where the caller asks for few."""
    some = np.arange(0, 1000, 40)
    view = type(features(VIEW))(
        *(array[..., some] if array.ndim == 1 or len(array) == 2 else array[some] for array in features(VIEW))
    )
    gates = PLACE_GATES._replace(min_inliers=8, min_cells=4)
    found = match_views_near(features(SOURCE), view, truth(), sensor(), (15.0,), gates=gates)
    assert found is not None
    assert not found.is_place
    assert match_views_near(features(SOURCE), view, truth(), sensor(), (15.0,)) is None
