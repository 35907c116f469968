"""Files that are not what they should be: one clear line, or the right result, and soon."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from camera_texts import ORB_SLAM2
from npz_members import array_of, npy, packed, unpacked
from rig_texts import KALIBR, ORB_SLAM3, OWN
from small_map import small_map

from jaxslam.config.loading import load_config
from jaxslam.datasets.catalog import known_recordings
from jaxslam.errors import JaxSlamError
from jaxslam.map.npz_file import load_map, save_map
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.rectification import RectifiedPair
from jaxslam.trajectory.formats import read_rows
from jaxslam.trajectory.trajectory import read_tum

MEGABYTE = 10**6
LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
RECORDINGS = "- {dataset: D, kind: tum, license: L, page: P, about: A, recordings: {r: {url: URL}}}\n"


def _config(path: Path) -> Any:
    return load_config("default", path)


def _without(text: str, line: str) -> str:
    kept = [other for other in text.splitlines() if line not in other]
    assert len(kept) < len(text.splitlines())
    return "\n".join(kept)


def _changed(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new)


BAD: dict[str, tuple[Callable[[Path], Any], str | bytes, str]] = {
    "bool_tag": (_config, "run: {seed: !!bool z}", "f:1: not readable as YAML: expected a value of type bool, got 'z'"),
    "timestamp_tag": (
        _config,
        "run:\n  seed: !!timestamp x",
        "f:2: not readable as YAML: expected a value of type time",
    ),
    "map_tag": (_config, "run: !!map x", "expected `key: value` lines, got 'x'"),
    "date": (_config, "run: {seed: 2001-01-01}", "f: run.seed: expected an integer >= 0"),
    "digits": (_config, f"run: {{seed: {'1' * 400}}}", "expected a value of type int, got '1111"),
    "python_tag": (_config, "run: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
    "laughs": (_config, LAUGHS, "values, got"),
    "holds_itself": (_config, "run: &a [*a]", "nested too deep, or holds itself"),
    "deep": (_config, "run: " + "[" * 10_000, "nested too deep, or holds itself"),
    "long_line": (_config, "run: " + "x" * MEGABYTE, "expected at most 131072 characters of YAML, got 1000005"),
    "long_list": (_config, "run: [" + "1, " * 300_000 + "]", "expected at most 131072 characters of YAML"),
    "long_value": (_config, "run: {seed: " + "x" * 3000 + "}", "got 'xxxxxxxxxxxx...xxx"),
    "long_key": (_config, "x" * 1000 + ": 1", "xxx...: unknown key (valid: "),
    "camera_number": (Camera.load, _changed(ORB_SLAM2, "Camera.bf: 40.0", "Camera.bf: " + "x" * 3000), "Camera.bf"),
    "rig_key": (RectifiedPair.load, _without(KALIBR, "intrinsics"), "cam0.intrinsics: expected 4 numbers, got None"),
    "rig_transform": (
        RectifiedPair.load,
        _changed(ORB_SLAM3, "Stereo.T_c1_c2", "Stereo.T"),
        "missing 'Stereo.T_c1_c2'",
    ),
    "rig_type": (RectifiedPair.load, "Camera2.fx: 1\nCamera.type: [1]", "Camera.type: expected one of PinHole"),
    "rig_number_key": (RectifiedPair.load, _changed(OWN, "left: {", "left: {3: 4, "), "left: unknown key '3'"),
    "rig_size": (
        RectifiedPair.load,
        _changed(KALIBR, "resolution: [", "resolution: [.nan, "),
        "resolution: expected 2",
    ),
    "rig_far": (RectifiedPair.load, _changed(OWN, "T_left_right: [", "T_left_right: [1.0e+300, "), "4 x 4 matrix"),
    "recordings_latin": (known_recordings, RECORDINGS.replace("URL", "http://\xe9.zip").encode("latin-1"), "in UTF-8"),
    "recordings_url": (known_recordings, RECORDINGS.replace("URL", "ftp://" + "x" * 3000), "url: expected http"),
    "recordings_list": (known_recordings, RECORDINGS.replace("URL", "[1]"), "url: expected"),
    "poses_long_word": (read_rows, "1 x" + "1" * MEGABYTE + " 0 0 0 0 0 1", "could not convert string to float: 'x11"),
    "poses_long_time": (read_rows, "1e" + "1" * MEGABYTE + " 0 0 0 0 0 0 1", "not finite"),
    "poses_long_line": (read_rows, "1 " * (MEGABYTE // 2), "expected 8 (TUM) or 12 (KITTI) columns, found 500000"),
    "poses_no_text": (read_rows, b"\xff\xfe" * MEGABYTE, "cannot be read: 'utf-8' codec"),
    "euroc_overflow": (read_rows, "#t,x\n" + "9" * 30 + ",0,0,0,1,0,0,0", "f:2: expected nanoseconds"),
    "map_text": (load_map, b"keyframes: 3", "not a jaxslam map"),
    "map_empty": (load_map, b"", "is empty"),
    "map_member": (load_map, packed({"x\n" * 5000: b""}), "not a jaxslam map: an archive of x x x"),
    "map_camera": (load_map, "camera", "header: camera: unknown key 'xxx"),
    "map_header": (load_map, "header", "points.ids: expected the header of a NumPy array"),
    "map_far": (load_map, "far", "points.X_world: expected coordinates of at most 1e+12 m, got 1e+200"),
    "map_behind": (load_map, "behind", "is damaged: holds bytes before or behind the archive"),
}


def _bad_map(kind: str, path: Path) -> bytes:
    save_map(path, small_map())
    data = path.read_bytes()
    members = unpacked(data)
    if kind == "camera":
        members["header.json"] = members["header.json"].replace(b'"cx"', b'"' + b"x" * 3000 + b'"')
    elif kind == "header":
        members["points.ids.npy"] = b"\x93NUMPY\x01\x00\x10\x00{'descr': (" + b" " * 6
    elif kind == "far":
        X = array_of(members, "points.X_world")
        X[0, 0] = 1e200
        members["points.X_world.npy"] = npy(X)
    return data + data if kind == "behind" else packed(members)


@pytest.fixture(scope="module")
def largest_good_s() -> float:
    """Processor time that YAML takes for the largest file of settings that is read."""
    began = time.process_time()
    yaml.safe_load("run: [" + "1, " * 43_000 + "]")
    return time.process_time() - began


@pytest.mark.parametrize("name", BAD)
def test_one_line_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, largest_good_s: float) -> None:
    """An error takes no longer than a good file of the largest size may take, three times over: about two seconds."""
    read, content, words = BAD[name]
    monkeypatch.chdir(tmp_path)
    path = Path("f")
    if read is load_map and isinstance(content, str):
        content = _bad_map(content, path)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    began = time.process_time()
    with pytest.raises(JaxSlamError) as error:
        read(path)
    assert time.process_time() - began < 3 * largest_good_s
    line = str(error.value)
    assert words in line
    assert len(line) <= 300
    assert "\n" not in line


def test_many_digits_are_a_time(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("1." + "1" * MEGABYTE + " 0 0 0 0 0 0 1\n")
    assert read_tum(path).timestamps_ns.tolist() == [1_111_111_111]
