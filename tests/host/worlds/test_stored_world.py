"""Frames of worlds in the cache."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

from jaxslam.worlds import (
    Person,
    Road,
    Room,
    Row,
    StoredWorld,
    Thing,
    Way,
    World,
    WorldCamera,
    WorldImu,
    WorldRecording,
)
from jaxslam.worlds.stored_world import description_hash, frames_key, why_not_here

ROOM = World(
    about="A room.",
    seconds=1.0,
    way=Way(((-1.5, 0.0, 1.4), (-1.2, 0.5, 1.4)), speed_m_per_s=0.3, look=(1.0, 0.0, 0.8)),
    rooms=(Room((5.0, 4.0, 2.5)),),
    things=(Thing("dining table", (1.0, 0.5)),),
    people=(Person((1.2, -0.6)),),
    imu=WorldImu(),
    camera=WorldCamera(width=80, height=60),
)
PAIR = dataclasses.replace(ROOM, camera=dataclasses.replace(ROOM.camera, baseline_m=0.1))


@pytest.fixture(autouse=True)
def settled_sources(monkeypatch):
    """Sources that were just edited would not be trusted to be those that were loaded."""
    monkeypatch.setattr("jaxslam.worlds.stored_world.sources_hash", lambda: "the same")


def same(one, other) -> None:
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)
            assert value.dtype == getattr(other, name).dtype, name
    assert one.timestamp_ns == other.timestamp_ns
    assert (one.imu is None) == (other.imu is None)


@pytest.mark.parametrize("world", [ROOM, PAIR])
def test_a_kept_frame_is_the_same_to_the_byte(tmp_path, world):
    rendered = WorldRecording(world).render(7)
    for _ in range(2):
        same(StoredWorld(world, tmp_path).render(7), rendered)
    assert [file.name for file in tmp_path.rglob("*.npz")] == ["7.npz"]


def test_a_kept_frame_is_not_rendered_again(tmp_path, monkeypatch):
    first = StoredWorld(ROOM, tmp_path)
    first.render_all([2, 5])
    monkeypatch.setattr(WorldRecording, "render", None)
    again = StoredWorld(ROOM, tmp_path)
    same(again.render(5), first.render(5))
    same(again.render(-25), first.render(5))
    with pytest.raises(TypeError):
        again.render(3)


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_a_damaged_file_is_rendered_again(tmp_path, damage, caplog):
    StoredWorld(ROOM, tmp_path).render(0)
    (file,) = tmp_path.rglob("*.npz")
    data = bytearray(file.read_bytes())
    if damage == "changed":
        data[len(data) // 2] ^= 1
    file.write_bytes({"cut": data[: len(data) // 2], "changed": data, "empty": b""}[damage])
    same(StoredWorld(ROOM, tmp_path).render(0), WorldRecording(ROOM).render(0))
    assert "damaged, rendered again" in caplog.text
    caplog.clear()
    StoredWorld(ROOM, tmp_path).render(0)
    assert not caplog.text


def test_the_cache_stays_within_its_limit(tmp_path):
    worlds = [dataclasses.replace(ROOM, seed=seed) for seed in range(3)]
    frame = WorldRecording(ROOM).render(0)
    size = sum(value.nbytes for value in vars(frame).values() if isinstance(value, np.ndarray))
    limit = round(4.5 * size)
    for time_s, world in enumerate(worlds):
        stored = StoredWorld(world, tmp_path, limit)
        stored.render_all([0, 1])
        os.utime(tmp_path / str(frames_key(world)), (time_s, time_s))
    used = sum(file.stat().st_size for file in tmp_path.rglob("*.npz"))
    assert used <= limit * 1.02
    # The world opened longest ago has left.
    assert {folder.name for folder in tmp_path.iterdir()} == {frames_key(world) for world in worlds[1:]}


def test_frames_for_which_there_is_no_room_are_rendered_every_time(tmp_path):
    stored = StoredWorld(ROOM, tmp_path, limit_bytes=1000)
    same(stored.render(0), WorldRecording(ROOM).render(0))
    assert not list(tmp_path.rglob("*.npz"))


def test_a_cache_that_cannot_be_written_is_said_once(tmp_path, caplog):
    file = tmp_path / "file"
    file.write_text("")
    stored = StoredWorld(ROOM, file)
    same(stored.render(0), WorldRecording(ROOM).render(0))
    stored.render(1)
    assert caplog.text.count("frames are not kept") == 1


def test_every_change_of_a_description_is_another_world():
    changes = [
        {"seed": 1},
        {"people": ()},
        {"camera": dataclasses.replace(ROOM.camera, width=81)},
        {"about": "Another room."},
    ]
    hashes = {description_hash(dataclasses.replace(ROOM, **change)) for change in changes}
    assert len(hashes | {description_hash(ROOM)}) == 5
    assert description_hash(dataclasses.replace(ROOM)) == description_hash(ROOM)


def test_the_order_of_roads_counts():
    first, second = (Road(((0, y), (50, y)), rows=(Row(("tree",), 5.0, 5.0),)) for y in (0, 40))
    one = dataclasses.replace(ROOM, roads={"a": first, "b": second})
    other = dataclasses.replace(ROOM, roads={"b": second, "a": first})
    assert description_hash(one) != description_hash(other)


def test_the_content_of_files_counts(tmp_path):
    file = tmp_path / "way.txt"
    lines = [f"{time} {0.1 * time} 0 1.4 -0.5 0.5 -0.5 0.5" for time in range(6)]
    file.write_text("\n".join(lines))
    world = dataclasses.replace(ROOM, way=Way(file=str(file)), imu=None)
    before = description_hash(world)
    file.write_text("\n".join([*lines, "6 0.7 0 1.4 -0.5 0.5 -0.5 0.5"]))
    assert description_hash(world) != before


def test_what_a_world_needs_and_is_not_there(tmp_path, monkeypatch):
    assert why_not_here(ROOM) is None
    assert "not there" in str(why_not_here(dataclasses.replace(ROOM, way=Way(file=str(tmp_path / "no.txt")))))
    monkeypatch.delenv("JAXSLAM_DATA", raising=False)
    assert "JAXSLAM_DATA" in str(why_not_here(dataclasses.replace(ROOM, way=Way(file="$JAXSLAM_DATA/way.txt"))))


@pytest.mark.slow
def test_processes_share_a_cache(tmp_path):
    code = (
        "import sys\n"
        "import jaxslam.worlds.stored_world as stored\n"
        "stored.sources_hash = lambda: 'the same'\n"
        "from jaxslam.worlds import StoredWorld\n"
        "StoredWorld('kitchen', sys.argv[1]).render_all(range(3))\n"
    )
    both = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    assert sorted(file.name for file in tmp_path.rglob("*.npz")) == ["0.npz", "1.npz", "2.npz"]
    same(StoredWorld("kitchen", tmp_path).render(1), WorldRecording("kitchen").render(1))
