"""Points that are gone: a frame sees a surface behind them."""

from typing import Any

import numpy as np
import pytest
from small_map import CAMERA, small_map

from jaxslam.config.schema import TrackConfig
from jaxslam.map.edit import without_observations
from jaxslam.map.types import Map
from jaxslam.mapping.vanished_points import FrameDepth, VanishedPoints, vanished_points
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.slam.map_changes import MapChanges

Z_M = 2.5
NUM_POINTS = 60
KEYFRAMES = np.array([0, 1])


@pytest.fixture
def slam_map() -> Map:
    """Points in a plane, which four keyframes observe."""
    made = small_map(4, NUM_POINTS)
    X_world = made.points.X_world.copy()
    X_world[2] = Z_M
    return made.with_arrays(points=made.points._replace(X_world=X_world))


def depth_of(depth_m: float | np.ndarray, ignore: bool = False) -> FrameDepth:
    """A frame that sees a plane."""
    size = CAMERA.height, CAMERA.width
    depth = np.broadcast_to(np.float32(depth_m), size).copy()
    zero = np.zeros((), np.float32)
    arrays: Any = (np.zeros(size, np.uint8), depth, np.full(size, ignore), zero, zero)
    return FrameDepth(np.zeros(6, np.float32), FrameArrays(*arrays), sensor_model(CAMERA, TrackConfig()))


def look(slam_map: Map, seen: FrameDepth) -> VanishedPoints:
    """Compare the points with a frame at the pose of the latest keyframe."""
    return vanished_points(slam_map, KEYFRAMES, slam_map.pose(3), seen)


def test_points_before_a_surface_are_gone(slam_map: Map) -> None:
    vanished = look(slam_map, depth_of(1.5 * Z_M))
    assert len(vanished.ids) > NUM_POINTS // 2
    assert vanished.confirmed.all()
    assert vanished.num_shown == len(vanished.ids)
    assert not len(vanished.there)
    assert vanished.num_there == 0


def test_points_are_there_where_a_surface_is(slam_map: Map) -> None:
    vanished = look(slam_map, depth_of(Z_M))
    assert len(vanished.there) == vanished.num_there > NUM_POINTS // 2
    assert not vanished.contradict_pose


@pytest.mark.parametrize(
    ("num_gone", "num_there", "contradict"), [(8, 42, True), (8, 41, False), (60, 340, False), (61, 339, True)]
)
def test_a_pose_is_wrong_from_which_much_of_the_map_is_gone(num_gone: int, num_there: int, contradict: bool) -> None:
    assert seen_through(*range(num_gone), num_there=num_there).contradict_pose == contradict
    assert not seen_through(*range(num_gone), num_there=num_there, confirmed=False).contradict_pose


def test_only_points_of_the_given_keyframes_are_looked_at(slam_map: Map) -> None:
    seen = slam_map.observations
    slam_map = without_observations(slam_map, np.isin(seen.keyframe, KEYFRAMES) & (seen.point >= 20))
    vanished = look(slam_map, depth_of(1.5 * Z_M))
    assert len(vanished.ids) > 0
    assert vanished.ids.max() < 20


def test_points_that_two_keyframes_observe_are_not_confirmed(slam_map: Map) -> None:
    slam_map = without_observations(slam_map, slam_map.observations.keyframe > 1)
    vanished = look(slam_map, depth_of(1.5 * Z_M))
    assert len(vanished.ids)
    assert not vanished.confirmed.any()
    assert vanished.num_shown == 0


@pytest.mark.parametrize(
    ("seen", "what"),
    [
        (depth_of(Z_M), "the points are there"),
        (depth_of(1.03 * Z_M), "as exact as a pose is"),
        (depth_of(0.5 * Z_M), "something is before them"),
        (depth_of(0.0), "nothing was measured"),
        (depth_of(np.nan), "nothing was measured"),
        (depth_of(1.5 * Z_M, ignore=True), "the pixels are not to be trusted"),
    ],
)
def test_points_are_not_gone_where(slam_map: Map, seen: FrameDepth, what: str) -> None:
    assert not len(look(slam_map, seen).ids), what


def test_an_edge_tells_nothing(slam_map: Map) -> None:
    """Columns of near and far surfaces by turns: a point may be of either."""
    columns = np.where(np.arange(CAMERA.width) % 4 < 2, Z_M, 1.5 * Z_M)
    assert not len(look(slam_map, depth_of(columns)).ids)


def seen_through(
    *ids: int, there: int = 999, confirmed: bool = True, num_shown: int = 300, num_there: int = 300
) -> VanishedPoints:
    return VanishedPoints(
        np.array(ids, np.int64), np.full(len(ids), confirmed), np.array([there]), num_shown, num_there
    )


def test_a_point_is_gone_that_two_frames_see_through() -> None:
    changes = MapChanges()
    assert not len(changes.gone(seen_through(1, 2, 3)))
    assert changes.gone(seen_through(2, 3, 4, there=1)).tolist() == [2, 3]
    assert not len(changes.gone(seen_through()))
    assert changes.gone(seen_through(1, 4)).tolist() == [4], "1 was seen there in between"
    assert not changes.pending, "a few points"


def test_what_a_frame_of_a_wrong_pose_sees_is_no_change() -> None:
    changes, everything = MapChanges(), seen_through(*range(200))
    for _ in range(3):
        assert not len(changes.gone(everything))
    assert not changes.pending


def test_many_points_that_are_gone_are_a_change_until_a_keyframe() -> None:
    changes, many = MapChanges(), seen_through(*range(20))
    changes.gone(many)
    assert not changes.pending
    changes.gone(many)
    assert changes.pending
    changes.gone(seen_through())
    assert changes.pending, "no keyframe was made"
    changes.keyframe_made()
    assert not changes.pending


def test_points_that_are_gone_add_up_over_a_few_frames() -> None:
    few, more, nothing = seen_through(*range(11)), seen_through(*range(20, 31)), seen_through()
    assert pending_after(few, few, nothing, more, more)
    assert not pending_after(few, few, nothing, nothing, nothing, more, more), "long before"
    assert not pending_after(few, few, None, more, more), "a keyframe shows the first ones"


def pending_after(*looks: VanishedPoints | None) -> bool:
    """Tell whether a change is pending after frames, of which `None` is a keyframe."""
    changes = MapChanges()
    for vanished in looks:
        if vanished is None:
            changes.keyframe_made()
        else:
            changes.gone(vanished)
    return changes.pending


@pytest.mark.parametrize(
    ("vanished", "what"),
    [
        (seen_through(*range(19)), "too few"),
        (seen_through(*range(20), num_shown=4001), "less than 0.5 % of those in view"),
        (seen_through(*range(100), confirmed=False), "of someone who walked by"),
    ],
)
def test_it_is_no_change_where_points_are(vanished: VanishedPoints, what: str) -> None:
    changes = MapChanges()
    changes.gone(vanished)
    changes.gone(vanished)
    assert not changes.pending, what
