"""Worlds of worlds, groups of people, and what else is told in short."""

import dataclasses

import numpy as np
import pytest

from jaxslam.datasets.synthetic.homogeneous import matrix_from_pose
from jaxslam.errors import ConfigError
from jaxslam.worlds import World, WorldRecording, load_world
from jaxslam.worlds.description import Group, Opening, Person, Place, Room, Route, Thing, Way, WorldCamera
from jaxslam.worlds.expansion import expanded, placed
from jaxslam.worlds.library import with_places

WAY = Way(((-0.7, 0.0, 1.4), (-0.5, 0.5, 1.4)), speed_m_per_s=0.3, look=(1.0, 0.0, 0.8))
SMALL = World(
    about="A room with a door to the east.",
    seconds=1.0,
    way=WAY,
    rooms=(Room((4.0, 3.0, 2.5), (1.0, 0.5), openings=(Opening("east", 0.4), Opening("north", -1.0))),),
    things=(Thing("chair", (1.5, 0.5), turn_deg=10), Thing("carton", route=Route(((0.0, 0.0), (1.0, 0.0))))),
    people=(Person((2.0, 1.0), 90.0),),
    camera=WorldCamera(width=160, height=120),
)


def test_a_quarter_turn_turns_rooms_doors_things_and_routes():
    turned = placed(SMALL, Place("small", (10.0, 0.0), 90))
    (room,) = turned.rooms
    assert room.size_m == (3.0, 4.0, 2.5)
    assert room.at_m == pytest.approx((9.5, 1.0))
    # A door 0.4 m to the north in the east wall comes to the west of the middle of the north wall.
    assert [(each.wall, each.along_m) for each in room.openings] == [("north", -0.4), ("west", -1.0)]
    chair, carton = turned.things
    assert chair.at_m == pytest.approx((9.5, 1.5))
    assert chair.turn_deg == 100
    assert carton.route is not None
    np.testing.assert_allclose(carton.route.points_m, [[10.0, 0.0], [10.0, 1.0]])
    assert turned.people[0].turn_deg == 180


def test_four_quarter_turns_are_none():
    world = SMALL
    for _ in range(4):
        world = placed(world, Place("small", (0.0, 0.0), 90))
    assert world.rooms[0].openings == SMALL.rooms[0].openings
    np.testing.assert_allclose(world.rooms[0].at_m, SMALL.rooms[0].at_m, atol=1e-12)


def test_a_world_in_another_looks_the_same_from_the_same_place():
    """The camera stands in the placed kitchen as it does in the kitchen itself; textures are chosen anew."""
    kitchen = dataclasses.replace(load_world("kitchen"), camera=WorldCamera(width=160, height=120), seconds=1.0)
    points = tuple((x + 20.0, y - 5.0, z) for x, y, z in kitchen.way.points_m)
    look = kitchen.way.look if kitchen.way.look == "ahead" else tuple(np.add(kitchen.way.look, (20.0, -5.0, 0.0)))
    moved = dataclasses.replace(
        kitchen,
        places=(Place("kitchen", (20.0, -5.0)),),
        rooms=(),
        things=(),
        people=(),
        kinds={},
        way=dataclasses.replace(kitchen.way, points_m=points, look=look),
    )
    here, there = (WorldRecording(world).render(20) for world in (kitchen, moved))
    np.testing.assert_array_equal(here.instance_mask, there.instance_mask)
    np.testing.assert_allclose(here.exact_depth_m, there.exact_depth_m, atol=2e-3)


def test_kinds_of_a_place_come_with_it(tmp_path):
    (tmp_path / "two.yaml").write_text(
        "about: Two kitchens.\nseconds: 1\nplaces: [{world: kitchen}, {world: kitchen, at_m: [6, 0], turn_deg: 180}]\n"
        "way: {points_m: [[0, 0, 1], [1, 0, 1]]}\n"
    )
    whole = with_places(load_world(tmp_path / "two.yaml"))
    kitchen = load_world("kitchen")
    assert len(whole.rooms) == 2
    assert len(whole.things) == 2 * len(kitchen.things)
    assert whole.kinds == kitchen.kinds


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("places: [{world: cellar}]\n", "expected the name of a world or a YAML file, got 'cellar'"),
        ("places: [{world: own.yaml}]\n", "expected one that is not part of itself"),
        ("places: [{world: kitchen, turn_deg: 45}]\n", "turn_deg"),
        (
            "places: [{world: kitchen}]\n"
            "kinds: {trolley: {label: cart, parts: [{size_m: [1, 1, 1], at_m: [0, 0, 0], look: wood}]}}\n",
            "kinds: expected other names or the same entries, got another trolley",
        ),
    ],
)
def test_places_that_cannot_be_are_errors(tmp_path, text, message):
    path = tmp_path / "own.yaml"
    path.write_text(f"about: A world.\nseconds: 1\nway: {{points_m: [[0, 0, 1], [1, 0, 1]]}}\n{text}")
    with pytest.raises(ConfigError, match=message):
        WorldRecording(path)


def test_a_group_meets_at_its_time_and_faces_its_middle():
    group = Group(5, (1.0, 2.0), radius_m=0.8, come_from_m=3.0, meet_s=8.0, stay_s=6.0)
    recording = WorldRecording(dataclasses.replace(SMALL, groups=(group,)))
    walks = [each.walk for each in recording.instances[-5:]]
    assert recording.labels[-5:] == ("person",) * 5
    distance = lambda time_s: [
        np.linalg.norm(walk(np.array([time_s])).position[0] - np.array(group.at_m)) for walk in walks
    ]
    assert max(distance(12.0)) < 0.85
    assert min(distance(3.0)) > 1.5
    for walk in walks:
        position, heading, speed = (value[0] for value in walk(np.array([12.5])))
        inward = np.array(group.at_m) - position
        assert np.cos(np.arctan2(inward[1], inward[0]) - heading) > 0.95
        assert speed < 0.05


def test_a_group_comes_along_a_corridor_side_by_side():
    group = Group(4, (1.0, 0.3), radius_m=0.4, come_from_m=4.0, meet_s=8.0, stay_s=6.0, come_from_deg=(0, 180))
    recording = WorldRecording(dataclasses.replace(SMALL, groups=(group,)))
    walks = [each.walk for each in recording.instances[-4:]]
    at = lambda time_s: np.array([walk(np.array([time_s])).position[0, :2] for walk in walks]) - group.at_m
    many = np.array([at(time_s) for time_s in np.arange(0, 40, 0.25)])
    assert np.abs(many[:, :, 1]).max() < 0.41
    assert (np.sign(at(3.0)[:, 0]) == [1, -1, 1, -1]).all()
    assert np.abs(at(3.0)[:, 0]).min() > 3.0
    assert np.linalg.norm(at(12.0), axis=1).max() < 0.45


def test_someone_sits_and_sways():
    seated = dataclasses.replace(SMALL, people=(Person((1.5, -0.3), 180.0, sits=True),), way=WAY)
    recording = WorldRecording(seated)
    frame = recording.render(0)
    number = len(recording.labels)
    there = frame.instance_mask == number
    assert there.sum() > 200
    v, u = np.nonzero(there)
    camera = recording.camera
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
    T_world_cam = matrix_from_pose(frame.T_world_cam)
    height = (frame.exact_depth_m[there][:, None] * rays) @ T_world_cam[2, :3] + T_world_cam[2, 3]
    assert 1.1 < height.max() < 1.5
    assert not np.array_equal(there, recording.render(29).instance_mask == number)
    with pytest.raises(ConfigError, match="sits: expected one who neither walks nor carries"):
        Person(sits=True, carries="carton")


def test_expanding_leaves_a_plain_world_as_it_is():
    assert expanded(SMALL) == SMALL
