"""How many keyframes of a map show what the camera sees."""

import numpy as np
import pytest
from exact_map import CAMERA, exact_map

from jaxslam.geometry.se3 import IDENTITY, compose, retract
from jaxslam.map.edit import with_positions
from jaxslam.map.point_records import observations_at, rows
from jaxslam.map.types import Map, empty_map
from jaxslam.mapping.view_coverage import ViewCoverage, in_view, seen_alike

SHARE = 0.8


def views(slam_map: Map, pose: np.ndarray, submap: int = 0) -> int:
    return ViewCoverage(SHARE).num_views(slam_map, pose, submap)


def all_points(slam_map: Map, pose: np.ndarray) -> int:
    """The same from every point of every keyframe."""
    count = 0
    for keyframe, at in zip(slam_map.ids, slam_map.T_world_cam, strict=True):
        points = slam_map.observations.point[slam_map.observations.keyframe == keyframe]
        X_world = slam_map.points.X_world[:, rows(slam_map.points.ids, points)]
        seen = in_view(slam_map.camera, pose, X_world)
        seen &= seen_alike(X_world, np.tile(at[4:, None], X_world.shape[1]), pose[4:, None])
        count += seen.mean() >= SHARE
    return count


@pytest.fixture(scope="module")
def slam_map() -> Map:
    return exact_map(num_keyframes=12, num_points=3000)


def test_as_from_all_points(slam_map: Map) -> None:
    """But for keyframes at the edge of what counts."""
    for at in slam_map.T_world_cam:
        assert abs(views(slam_map, at) - all_points(slam_map, at)) <= 2
        assert views(slam_map, at) >= 1


def test_none_from_elsewhere(slam_map: Map) -> None:
    at = slam_map.T_world_cam[5]
    assert views(slam_map, at, submap=1) == 0
    assert views(slam_map, retract(at, np.array([0, 0, 0, 0, np.pi, 0]))) == 0
    assert views(slam_map, retract(at, np.array([0, 0, -4.0, 0, 0, 0]))) == 0  # in view, but from far away
    assert views(empty_map(CAMERA), IDENTITY) == 0


def test_follows_the_map(slam_map: Map) -> None:
    """Keyframes that come, go and move as a whole."""
    coverage, change = ViewCoverage(SHARE), retract(IDENTITY, np.array([7.0, 0, 0, 0, 0.3, 0]))
    at = slam_map.T_world_cam[8]
    assert coverage.num_views(exact_map(num_keyframes=3, num_points=3000), at, 0) == 0
    before = coverage.num_views(slam_map, at, 0)
    moved = compose(change, slam_map.T_world_cam)
    none = np.zeros(0, np.int64)
    there = with_positions(slam_map, slam_map.ids, moved, none, np.zeros((3, 0)))
    assert coverage.num_views(there, at, 0) == 0
    assert coverage.num_views(there, compose(change, at), 0) == before


def test_keyframe_without_points(slam_map: Map) -> None:
    seen = observations_at(slam_map.observations, slam_map.observations.keyframe != 5)
    without = slam_map.with_arrays(observations=seen)
    assert views(slam_map, slam_map.T_world_cam[5]) - views(without, slam_map.T_world_cam[5]) == 1
