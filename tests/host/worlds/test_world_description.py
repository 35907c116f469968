"""Descriptions of worlds: what is read, and what is refused, with the name of what is wrong."""

from pathlib import Path

import pytest

from jaxslam.errors import ConfigError
from jaxslam.worlds import World, WorldRecording, load_world, worlds
from jaxslam.worlds.description import Thing, Way

MINIMAL = """
about: An empty room.
seconds: 1
rooms: [{size_m: [4, 3, 2.5]}]
way: {points_m: [[-1, 0, 1.4], [1, 0, 1.4]]}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", worlds())
def test_every_world_is_read(name):
    world = load_world(name)
    assert isinstance(world, World)
    assert world.about.endswith(".")


def test_a_world_of_few_lines_is_read(tmp_path):
    world = load_world(written(tmp_path, MINIMAL))
    assert world.rooms[0].size_m == (4.0, 3.0, 2.5)
    assert world.way.look == "ahead"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("things: [{kind: tabel}]", r"things\[0\]: kind: expected a known name, got 'tabel'.*(table|tv)"),
        ("people: [{carries: ball}]", r"people\[0\]: carries: expected a known name, got 'ball'"),
        ("backdrop: nothing", r"backdrop: expected a known name, got 'nothing'"),
        ("seconds: 0", r"'seconds' stands twice"),
        ("lights: 3", r"unknown key"),
        ("people: [{route: {points_m: [[0, 0]]}}]", r"Route.points_m: expected at least two points, got 1"),
        ("people: [{route: {points_m: [[0, 0], [0, 0]]}}]", r"expected different points in a row"),
        ("things: [{kind: chair, from_s: 3, until_s: 2}]", r"until_s: expected more than from_s, 3.0, got 2.0"),
        ("things: [{kind: chair, at_m: [1]}]", r"things\[0\].*at_m"),
        ("exposure: [{at_s: 2, factor: 1}, {at_s: 1, factor: 1}]", r"expected times in order, got \[2.0, 1.0\]"),
        ("camera: {sensor: {exposure_samples: 2}}", r"expected an odd integer, got 2"),
        ("lighting: {from_m: [0, 0, 0]}", r"expected a direction"),
        ("kinds: {ball: {label: ball, parts: []}}", r"expected at least one part"),
        ("kinds: {ball: {label: ball, parts: [{size_m: [1, 1, 1], at_m: [0, 0, 0], look: rubber}]}}", r"got 'rubber'"),
        (
            "kinds: {c: {label: c, parts: [{size_m: [1, 1, 0.5], at_m: [0, 0, 0], look: wood, shape: capsule}]}}",
            r"expected a capsule at least as long as wide",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path, line, message):
    with pytest.raises(ConfigError, match=message):
        load_world(written(tmp_path, MINIMAL + line + "\n"))


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match=r"got 'kitchn'.*kitchen"):
        load_world("kitchn")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load_world(tmp_path / "nowhere.yaml")


def test_a_world_made_in_python_is_checked_too():
    way = Way(((0.0, 0.0, 1.0), (1.0, 0.0, 1.0)))
    with pytest.raises(ConfigError, match=r"world: things\[0\]: kind: expected a known name, got 'elephant'"):
        WorldRecording(World("An elephant.", 1.0, way, things=(Thing("elephant"),)))
