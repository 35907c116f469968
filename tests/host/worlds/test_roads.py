"""Roads: middle lines, ways along them, and what stands beside."""

import dataclasses

import numpy as np
import pytest

from jaxslam.errors import ConfigError
from jaxslam.worlds import World, WorldRecording
from jaxslam.worlds.description import Road, Route, Row, Thing, Way, WorldCamera
from jaxslam.worlds.roads import middle_line, points_along, things_beside

STRAIGHT = Road(((0.0, 0.0), (100.0, 0.0)))
BEND = Road(((0.0, 0.0), (100.0, 0.0), (100.0, 80.0)), corner_m=20.0)
ROUND = Road(((0.0, 0.0), (100.0, 0.0), (100.0, 80.0), (0.0, 80.0)), closed=True, corner_m=20.0)
WORLD = World(
    about="A street.",
    seconds=4.0,
    way=Way(along="street", beside_m=-1.75, speed_m_per_s=10.0, ends="stop", down_deg=0.0, tremor=0.0),
    roads={"street": dataclasses.replace(BEND, rows=(Row(("house",), 20.0, 14.0), Row(("tree",), 10.0, 5.0)))},
    things=(Thing("red car", route=Route(along="street", beside_m=1.75, from_m=50, until_m=0, speed_m_per_s=10.0)),),
    ground="grass",
    backdrop="sky",
    backdrop_m=500.0,
    camera=WorldCamera(width=320, height=120, fps=10.0, baseline_m=0.5),
)


@pytest.mark.parametrize(
    ("road", "length_m"),
    [
        (STRAIGHT, 100.0),
        (BEND, 180.0 - 40.0 + np.pi * 10.0),
        (ROUND, 360.0 - 160.0 + 2.0 * np.pi * 20.0),
        (dataclasses.replace(BEND, corner_m=0.0), 180.0),
    ],
)
def test_corners_are_arcs(road, length_m):
    line = middle_line(road)
    assert line.length_m == pytest.approx(length_m, rel=2e-3)
    steps = np.linalg.norm(np.diff(line.points_m, axis=0), axis=1)
    assert np.ptp(steps[2:-2]) < 0.5


def test_the_middle_of_a_corner_is_as_far_from_the_arcs_middle_as_its_radius():
    line = middle_line(BEND)
    corner = (line.points_m[:, 0] > 81.0) & (line.points_m[:, 1] < 19.0)
    np.testing.assert_allclose(np.linalg.norm(line.points_m[corner] - [80.0, 20.0], axis=1), 20.0, atol=0.02)
    np.testing.assert_allclose(np.ptp(line.headings), np.pi / 2.0, atol=1e-6)


def test_left_is_left_and_right_is_right():
    line = middle_line(STRAIGHT)
    np.testing.assert_allclose(line.beside(np.array([30.0]), 2.0), [[30.0, 2.0]])
    np.testing.assert_allclose(line.beside(np.array([30.0]), -2.0), [[30.0, -2.0]])


def test_a_way_along_a_road_changes_lanes_where_it_is_told_to():
    lanes = ((20.0, -2.0), (40.0, 2.0))
    points = points_along({"a": STRAIGHT}, "a", lanes, 0.0, None, "stop")
    at = lambda x: points[np.argmin(np.abs(points[:, 0] - x)), 1]
    assert [at(10), at(30), at(60)] == pytest.approx([-2.0, 0.0, 2.0])


def test_a_way_against_a_road_is_on_its_other_side():
    points = points_along({"a": STRAIGHT}, "a", 2.0, 80.0, 10.0, "stop")
    np.testing.assert_allclose(points[[0, -1]], [[80.0, 2.0], [10.0, 2.0]])


def test_a_loop_ends_before_its_beginning():
    points = points_along({"a": ROUND}, "a", 0.0, 50.0, None, "loop")
    # Distances begin where the first corner does, 20 m before it.
    np.testing.assert_allclose(points[0], [20.0 + 50.0 - 10.0 * np.pi, 0.0], atol=0.1)
    assert 0.5 < np.linalg.norm(points[0] - points[-1]) < 1.5


@pytest.mark.parametrize(
    ("road", "from_m", "ends", "message"),
    [(STRAIGHT, 0.0, "loop", "expected true for a way round"), (STRAIGHT, 120.0, "stop", "up to its length, 100.0 m")],
)
def test_ways_that_no_road_holds_are_errors(road, from_m, ends, message):
    with pytest.raises(ConfigError, match=message):
        points_along({"a": road}, "a", 0.0, from_m, None, ends)


def test_rows_stand_beside_the_road_and_face_it():
    row = Row(("tree",), every_m=10.0, beside_m=5.0)
    things = things_beside(STRAIGHT, row, np.random.default_rng(0))
    assert len(things) == 20
    assert {thing.at_m[1] for thing in things} == {5.0, -5.0}
    assert {round(thing.turn_deg) for thing in things if thing.at_m[1] > 0} == {-90}
    assert {round(thing.turn_deg) for thing in things if thing.at_m[1] < 0} == {90}


def test_a_smaller_share_leaves_the_others_where_they_are():
    row = Row(("tree", "hedge"), every_m=10.0, beside_m=5.0, vary_m=(2.0, 1.0), vary_deg=30.0)
    every = things_beside(STRAIGHT, row, np.random.default_rng(0))
    some = things_beside(STRAIGHT, dataclasses.replace(row, share=0.5), np.random.default_rng(0))
    assert 0 < len(some) < len(every)
    assert set(some) < set(every)


@pytest.mark.slow
def test_the_camera_drives_on_the_right_and_a_car_comes_on_the_left():
    street = WorldRecording(WORLD)
    path = street.ground_truth.T_world_cam[:, 4:]
    np.testing.assert_allclose(path[:20, 1], -1.75, atol=1e-3)
    np.testing.assert_allclose(path[:, 2], 1.65)
    frame = street.render(5)
    car = street.labels.index("car") + 1
    assert street.labels.count("house") + street.labels.count("tree") + 1 == len(street.labels)
    _, columns = np.nonzero(frame.instance_mask == car)
    assert columns.size > 50
    assert columns.mean() < 160
    np.testing.assert_array_equal(np.unique(frame.instance_mask[frame.moving_mask]), [car])
    heading = frame.T_world_instance[car - 1, :4]
    np.testing.assert_allclose(np.abs(heading), [0.0, 0.0, 0.0, 1.0], atol=0.05)


def test_the_road_is_under_the_camera_and_the_sky_has_no_depth():
    frame = WorldRecording(WORLD).render(0)
    camera = WorldRecording(WORLD).camera
    rows = np.arange(camera.height)
    drop = (rows - camera.cy) / camera.fy * frame.exact_depth_m[:, camera.width // 2]
    # In front of the camera lies the road, a few millimeters high.
    np.testing.assert_allclose(drop[-20:], 1.65, atol=0.02)
    assert (frame.exact_depth_m[:20, 140:180] == 0).mean() > 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"way": Way(along="lane")}, "way: along: expected the name of a road, got 'lane'"),
        (
            {"things": (Thing("red car", route=Route(along="lane")),)},
            r"things\[0\]: along: expected the name",
        ),
        ({"roads": {"street": dataclasses.replace(BEND, surface="tar")}}, "roads: street: surface"),
        ({"roads": {"street": dataclasses.replace(BEND, rows=(Row(("hut",), 9.0, 9.0),))}}, r"rows\[0\]: kinds"),
        ({"ground": "mud"}, "ground: expected a known name"),
    ],
)
def test_names_that_are_not_there_are_errors(change, message):
    with pytest.raises(ConfigError, match=message):
        WorldRecording(dataclasses.replace(WORLD, **change))
