"""The map's file: equal to the bit after a round trip, and one clear line for whatever is not such a file."""

import io
import json
import os
import re
import subprocess
import sys
import textwrap
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from npz_members import Members, array_of, npy, packed, unpacked
from small_map import CAMERA, keyframe, pose, same, small_map

from jaxslam.errors import MapFileError
from jaxslam.map import npz_file as map_file
from jaxslam.map.edit import with_keyframe
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.npz_file import load_map, save_map
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map, empty_map
from jaxslam.sensors.camera import Camera

HELPERS = str(Path(__file__).resolve().parents[2] / "helpers")


def full_map() -> Map:
    """With two submaps, a culled keyframe, one without features, and a camera that uses every field."""
    camera = Camera("größe 1", 64, 48, 50.1, 51.3, 31.2, 24.7, (0.1, -0.2, 0.001, 0.002, 0.05), 5000.0, 29.97, 0.12)
    rng = np.random.default_rng(2)
    slam_map = without_keyframe(small_map(num_keyframes=4, camera=camera), 1)
    return with_keyframe(slam_map, keyframe(slam_map, rng, count=0), pose(rng), NONE, 1)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "full.map"
    save_map(path, full_map())
    return path.read_bytes()


class TestRoundTrip:
    @pytest.mark.parametrize("slam_map", [full_map(), empty_map(CAMERA), small_map()], ids=["full", "empty", "small"])
    def test_is_equal_to_the_bit(self, slam_map, tmp_path):
        save_map(tmp_path / "a.map", slam_map)
        again = load_map(tmp_path / "a.map")
        assert same(again, slam_map)
        save_map(tmp_path / "b.map", again)
        assert (tmp_path / "a.map").read_bytes() == (tmp_path / "b.map").read_bytes()

    def test_arrays_are_whole_and_can_be_copied_on(self, saved, tmp_path):
        (tmp_path / "a.map").write_bytes(saved)
        features = load_map(tmp_path / "a.map").keyframes[1].features
        assert all(array.flags.c_contiguous and array.flags.owndata for array in features)

    def test_numpy_opens_it(self, saved):
        with np.load(io.BytesIO(saved), allow_pickle=False) as file:
            np.testing.assert_array_equal(file["points.X_world"], full_map().points.X_world)

    def test_docstring_lists_every_array(self, saved):
        """A change of a record is a change of the format: then the version must rise."""
        rows = re.findall(r"^    (\w+\.\w+) +(\w+) +(\([^)]*\))", map_file.__doc__ or "", re.MULTILINE)
        documented = {name: (dtype, shape) for name, dtype, shape in rows}
        layout = {
            name: (field.dtype.name, f"({', '.join(field.dims)})".replace("+", " + "))
            for name, field in map_file._layout().items()
        }
        assert documented == layout
        assert {name.removesuffix(".npy") for name in unpacked(saved)} == {"header.json", *layout}


def refused(path: Path, data: bytes) -> str:
    """The message, after the path, about a file of these bytes."""
    path.write_bytes(data)
    with pytest.raises(MapFileError) as caught:
        load_map(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


class TestForeign:
    def test_missing(self, tmp_path):
        with pytest.raises(MapFileError, match=r"no\.map: cannot be read: No such file or directory"):
            load_map(tmp_path / "no.map")

    def test_folder(self, tmp_path):
        with pytest.raises(MapFileError, match="cannot be read: Is a directory"):
            load_map(tmp_path)

    def test_other_files(self, tmp_path):
        path = tmp_path / "a.map"
        assert refused(path, b"") == "is empty"
        assert refused(path, full_map().keyframes[0].image_file) == "not a jaxslam map"
        assert refused(path, b"keyframes: 3\n" * 100) == "not a jaxslam map"
        assert refused(path, npy(np.zeros(3))) == "not a jaxslam map"

    def test_other_archives(self, tmp_path):
        path = tmp_path / "a.map"
        assert refused(path, packed({"a.txt": b"x"})) == "not a jaxslam map: an archive of a.txt"
        assert refused(path, packed({})) == "not a jaxslam map: an archive of nothing"
        buffer = io.BytesIO()
        np.savez(buffer, points=np.zeros(3))
        assert refused(path, buffer.getvalue()) == "not a jaxslam map: an archive of points.npy"
        assert "header does not say so" in refused(path, packed({"header.json": b'{"format": "else"}'}))
        assert "header does not say so" in refused(path, packed({"header.json": b"[]"}))
        assert "damaged" in refused(path, packed({"header.json": b"[" * 50_000}))


BEFORE_VERSION_3 = {
    "observations.": "sightings.",
    "uv_raw": "seen_uv",
    "points.has_descriptor": "points.recognisable",
    "points.reference_keyframe": "points.made_by",
}
BEFORE_VERSION_4 = {"images.files": "images.png"}


def of_version(members: Members, version: int) -> Members:
    """The members of a map file under the names that they had in an earlier version."""
    old = {}
    for name, data in members.items():
        old_name = name
        for new, before in (BEFORE_VERSION_4 | (BEFORE_VERSION_3 if version < 3 else {})).items():
            old_name = old_name.replace(new, before)
        old[old_name] = data
    header = json.loads(members["header.json"])
    header["version"], counts = version, header["counts"]
    if version < 3:
        counts["sightings"] = counts.pop("observations")
    if version == 1:
        del old["points.state.npy"]
    return old | {"header.json": json.dumps(header).encode()}


class TestEarlierVersions:
    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_load(self, version, tmp_path):
        path, slam_map = tmp_path / "a.map", small_map()
        save_map(path, slam_map)
        path.write_bytes(packed(of_version(unpacked(path.read_bytes()), version)))
        state = slam_map.points.state if version > 1 else np.zeros_like(slam_map.points.state)
        assert same(load_map(path), slam_map.with_arrays(points=slam_map.points._replace(state=state)))

    def test_old_names_are_no_part_of_the_present_version(self, saved, tmp_path):
        old = of_version(unpacked(saved), 2)
        header = json.loads(unpacked(saved)["header.json"])
        mixed = packed(old | {"header.json": json.dumps(header).encode()})
        assert "unknown or missing members: " in refused(tmp_path / "a.map", mixed)


class TestDamaged:
    @pytest.mark.parametrize("more", [b"x", b"\0" * 22, b"more" * 10_000])
    def test_bytes_before_or_behind(self, saved, tmp_path, more):
        path = tmp_path / "a.map"
        assert refused(path, saved + more).startswith("is damaged")
        assert refused(path, more + saved).startswith(("is damaged", "not a jaxslam map"))
        assert refused(path, saved + saved) == "is damaged: holds bytes before or behind the archive"
        commented = saved[:-2] + len(more).to_bytes(2, "little") + more
        assert refused(path, commented) == "is damaged: holds bytes before or behind the archive"

    def test_cut_short_anywhere(self, saved, tmp_path):
        path = tmp_path / "a.map"
        for length in [*range(1, 200), *range(200, len(saved), 97), *range(len(saved) - 200, len(saved))]:
            assert refused(path, saved[:length]).startswith(
                "is damaged or cut short" if length > 1 else "not a jaxslam"
            )

    @settings(max_examples=300, deadline=None)
    @given(st.data())
    def test_changed_bytes_are_noticed_or_make_no_difference(self, saved, tmp_path_factory, data):
        path = tmp_path_factory.getbasetemp() / "changed.map"
        where = st.integers(0, len(saved) - 1) | st.integers(len(saved) - 3500, len(saved) - 1)
        damaged = bytearray(saved)
        for place in data.draw(st.lists(where, min_size=1, max_size=4)):
            damaged[place] = data.draw(st.integers(0, 255))
        path.write_bytes(damaged)
        try:
            slam_map = load_map(path)
        except MapFileError:
            return  # noticed; any other error fails the test
        assert same(slam_map, full_map())


def edited(members: Members, path: list[str], value: Any) -> bytes:
    header = json.loads(members["header.json"])
    inner = header
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return packed({**members, "header.json": json.dumps(header).encode()})


class TestHeader:
    @pytest.mark.parametrize(
        ("path", "value", "message"),
        [
            (["version"], 5, "expected a map file of version 1, 2, 3, 4, got version 5"),
            (["version"], None, "expected a map file of version 1, 2, 3, 4, got version None"),
            (["version"], True, "expected a map file of version 1, 2, 3, 4, got version True"),
            (["counts"], 3, "header: counts: expected `key: value` lines, got 3"),
            (["counts", "points"], -1, "header: counts: points: expected an integer >= 0 and <= 4e+18, got -1"),
            (["counts", "points"], 1.5, "header: counts: points: expected an integer >= 0 and <= 4e+18, got 1.5"),
            (["next_point"], None, "header: next_point: expected an integer >= 0"),
            (["camera", "fx"], -4.0, "header: camera: fx: expected a finite number > 0, got -4.0"),
            (["camera", "fx"], float("nan"), "header: camera: fx: expected a finite number > 0, got nan"),
            (["camera", "zoom"], 1, "header: camera: unknown key 'zoom' (valid: "),
            (["next_keyframe"], 3, "the map is not whole: ids: expected them to ascend from 0 and end before 3"),
        ],
    )
    def test_refuses(self, path, value, message, saved, tmp_path):
        assert message in refused(tmp_path / "a.map", edited(unpacked(saved), path, value))

    @pytest.mark.parametrize("count", [10**9, 10**15, 2**61])
    def test_announced_sizes_take_no_memory(self, count, saved, tmp_path):
        data = edited(unpacked(saved), ["counts", "points"], count)
        tracemalloc.start()
        message = refused(tmp_path / "a.map", data)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert re.fullmatch(rf"announces \d+ bytes of arrays in a file of {len(data)}", message)
        assert most < 2_000_000

    def test_refuses_compression(self, saved, tmp_path):
        zeros = {**unpacked(saved), "images.files.npy": npy(np.zeros(50_000_000, np.uint8))}
        assert (
            refused(tmp_path / "a.map", packed(zeros, zipfile.ZIP_DEFLATED)) == "header.json: expected no compression"
        )


class TestArrays:
    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("points.X_world", lambda a: a.astype(np.float32), "points.X_world: expected float64 (3, 10), got float32"),
            ("points.X_world", lambda a: a.T.copy(), "points.X_world: expected float64 (3, 10), got float64 (10, 3)"),
            ("points.X_world", np.asfortranarray, "points.X_world: expected float64 (3, 10)"),
            ("points.X_world", lambda a: a.astype(">f8"), "points.X_world: expected float64 (3, 10), got >f8 (3, 10)"),
            ("points.ids", lambda a: a[::-1].copy(), "the map is not whole: points.ids: expected them to ascend"),
            (
                "points.X_world",
                lambda a: a * np.nan,
                "the map is not whole: points.X_world: holds a number that is not",
            ),
            ("keyframes.parent", lambda a: a * 0, "the map is not whole: parent: goes round in a circle"),
            (
                "keyframes.image_offsets",
                lambda a: a[::-1].copy(),
                "keyframes.image_offsets: expected them to rise from 0",
            ),
            (
                "keyframes.feature_offsets",
                lambda a: a + 1,
                "keyframes.feature_offsets: expected them to rise from 0 to",
            ),
        ],
    )
    def test_refuses(self, name, change: Callable[[np.ndarray], np.ndarray], message, saved, tmp_path):
        members = unpacked(saved)
        members[f"{name}.npy"] = npy(change(array_of(members, name)))
        assert message in refused(tmp_path / "a.map", packed(members))

    @pytest.mark.parametrize("X", [1e200, -1e13])
    @pytest.mark.parametrize("name", ["points.X_world", "keyframes.T_world_cam"])
    def test_refuses_places_that_overflow(self, name, X, saved, tmp_path):
        members = unpacked(saved)
        array = array_of(members, name)
        array[2, -1] = X
        members[f"{name}.npy"] = npy(array)
        message = f"the map is not whole: {name.removeprefix('keyframes.')}: expected coordinates of at most 1e+12 m"
        assert message in refused(tmp_path / "a.map", packed(members))

    @pytest.mark.parametrize(
        "header",
        [b"{'descr': (", b"x" * 60, b"(" * 600, b"1" * 60_000, b"{}", b"[1]", b"{'descr': 3}", b"\xff\0", b"(\n)'"],
    )
    def test_refuses_headers_that_are_none(self, header, saved, tmp_path):
        members = unpacked(saved)
        members["points.ids.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        message = refused(tmp_path / "a.map", packed(members))
        assert message.startswith("points.ids: expected the header of a NumPy array, got b")
        assert len(message) < 200

    def test_refuses_pickles(self, saved, tmp_path):
        objects = np.array([print] * 10, object)
        members = {**unpacked(saved), "points.weight.npy": npy(objects)}
        assert "points.weight: expected float32 (10,), got object (10,)" in refused(tmp_path / "a.map", packed(members))

    def test_refuses_members_too_many_or_too_few(self, saved, tmp_path):
        members = unpacked(saved)
        extra = packed({**members, "notes.npy": npy(np.zeros(1))})
        assert refused(tmp_path / "a.map", extra) == "unknown or missing members: notes.npy"
        del members["culled.ids.npy"]
        assert refused(tmp_path / "a.map", packed(members)) == "unknown or missing members: culled.ids.npy"

    def test_refuses_arrays_cut_short_or_with_more_behind(self, saved, tmp_path):
        members = unpacked(saved)
        weight = members["points.weight.npy"]
        for data in (weight[:-4], weight + b"more"):
            changed = packed({**members, "points.weight.npy": data})
            assert "points.weight: expected float32 (10,), got" in refused(tmp_path / "a.map", changed)


KILLED = """
    import sys, zipfile
    sys.path[:0] = sys.argv[2:]
    import numpy as np
    from small_map import small_map
    from jaxslam.map.npz_file import save_map

    write = np.lib.format.write_array
    def slowly(file, array, **options):
        write(file, array, **options)
        print("writing", flush=True)
        sys.stdin.read()
    np.lib.format.write_array = slowly
    save_map(sys.argv[1], small_map(seed=5))
"""


SAVING = """
    import itertools, sys
    sys.path[:0] = sys.argv[2:]
    from small_map import small_map
    from jaxslam.map.npz_file import save_map

    maps = [small_map(12, 200, seed) for seed in (1, 2)]
    for number in itertools.count():
        save_map(sys.argv[1], maps[number % 2])
        print("saved", flush=True)
"""


def killed_while_saving(path: Path, times: int) -> int:
    """Kill -9 at moments of a save: one of the two maps is there as a whole, and the next save leaves nothing else.

    Returns:
        How many kills were within a save: a temporary file was there.
    """
    maps = [small_map(12, 200, seed) for seed in (1, 2)]
    script = [sys.executable, "-c", textwrap.dedent(SAVING), str(path), HELPERS]
    left = 0
    for number in range(times):
        with subprocess.Popen(script, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            began = [process.stdout.readline() and time.monotonic() for _ in range(3)]
            time.sleep((began[2] - began[1]) * number / times)
            process.kill()
        assert any(same(load_map(path), slam_map) for slam_map in maps)
        left += len(list(path.parent.iterdir())) - 1
        save_map(path, maps[0])
        assert list(path.parent.iterdir()) == [path]
    return left


class TestAtomic:
    @pytest.mark.slow
    def test_kills_leave_a_good_map_and_no_litter(self, tmp_path):
        killed_while_saving(tmp_path / "a.map", 2)

    @pytest.mark.benchmark
    def test_many_kills_leave_a_good_map_and_no_litter(self, tmp_path):
        within = killed_while_saving(tmp_path / "a.map", 50)
        print(f"{within} of 50 kills within a save")
        assert within > 10

    def test_a_kill_leaves_the_old_file(self, saved, tmp_path):
        path = tmp_path / "a.map"
        path.write_bytes(saved)
        script = [sys.executable, "-c", textwrap.dedent(KILLED), str(path), HELPERS]
        with subprocess.Popen(script, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"writing\n"
            process.kill()
        assert process.returncode != 0
        assert len(list(tmp_path.iterdir())) == 2  # what was written so far lies beside it
        assert path.read_bytes() == saved
        save_map(path, small_map())
        assert list(tmp_path.iterdir()) == [path]

    def test_failure_leaves_the_old_file_and_nothing_else(self, saved, tmp_path, monkeypatch):
        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        path = tmp_path / "a.map"
        path.write_bytes(saved)
        monkeypatch.setattr(os, "replace", full)
        with pytest.raises(MapFileError, match=r"a\.map: cannot be written: .*No space left"):
            save_map(path, small_map())
        assert path.read_bytes() == saved
        assert list(tmp_path.iterdir()) == [path]

    def test_no_folder(self, tmp_path):
        with pytest.raises(MapFileError, match="cannot be written"):
            save_map(tmp_path / "no" / "a.map", small_map())

    def test_a_map_that_is_not_whole_is_not_written(self, tmp_path):
        slam_map = small_map()
        with pytest.raises(MapFileError, match=r"not written: parent: 76 is not in the map"):
            save_map(tmp_path / "a.map", slam_map._replace(parent=slam_map.parent + 77))
        assert not list(tmp_path.iterdir())
