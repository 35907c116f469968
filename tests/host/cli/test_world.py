"""`jaxslam world` as a user types it."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxslam.cli import main
from jaxslam.datasets import open_dataset

TINY = """
about: An empty room.
seconds: 0.2
rooms: [{size_m: [4, 3, 2.5]}]
things: [{kind: chair, at_m: [0.5, 0.5]}]
camera: {width: 64, height: 48}
way: {points_m: [[-1, 0, 1.4], [1, 0, 1.4]]}
"""


def tiny(folder: Path) -> str:
    path = folder / "tiny.yaml"
    path.write_text(TINY)
    return str(path)


def test_list_names_every_world(capsys):
    main(["world", "list", "--json"])
    assert {"flat", "kitchen"} <= {entry["name"] for entry in json.loads(capsys.readouterr().out)}


def test_show_writes_a_sheet_a_plan_and_a_clip(tmp_path, capsys):
    main(["world", "show", tiny(tmp_path), "--out", str(tmp_path / "out"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["things and people"]) == (6, "1 chair")
    sheet, plan, clip = (Path(file) for file in told["files"])
    with Image.open(sheet) as picture:
        assert picture.size == (4 * 320, 2 * 240)
    with Image.open(plan) as picture:
        assert np.asarray(picture).std() > 1
    with Image.open(clip) as animation:
        animation.seek(5)
        with pytest.raises(EOFError):
            animation.seek(6)


def test_render_writes_a_recording_that_opens(tmp_path, capsys):
    main(["world", "render", tiny(tmp_path), str(tmp_path / "tiny")])
    assert "6 frames" in capsys.readouterr().out
    assert len(open_dataset(tmp_path / "tiny")) == 6


@pytest.mark.parametrize(
    ("lines", "options", "file", "to_open"),
    [
        ("", (), "rgb.txt", ""),
        ("camera: {width: 64, height: 48, baseline_m: 0.1}", (), "poses/00.txt", "sequences/00"),
        ("camera: {width: 64, height: 48, baseline_m: 0.1}\nimu: {rate_hz: 100}", (), "mav0/imu0/data.csv", ""),
        ("camera: {width: 64, height: 48, baseline_m: 0.1}", ("--layout", "euroc"), "mav0/cam1/data.csv", ""),
    ],
)
def test_render_chooses_the_layout_by_the_camera(tmp_path, capsys, lines, options, file, to_open):
    world = Path(tiny(tmp_path))
    if lines:
        world.write_text(TINY.replace("camera: {width: 64, height: 48}", lines))
    main(["world", "render", str(world), str(tmp_path / "out"), *options])
    assert f"jaxslam run {tmp_path / 'out' / to_open}" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "out" / file).is_file()
    assert (tmp_path / "out" / to_open / "labels.txt").is_file()
    assert len(open_dataset(tmp_path / "out" / to_open)) == 6


def test_a_layout_that_does_not_suit_the_camera_is_an_error(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["world", "render", tiny(tmp_path), str(tmp_path / "out"), "--layout", "kitti"])
    assert ended.value.code == 1
    assert "expected a stereo pair (baseline_m), got a camera with depth images" in capsys.readouterr().err


def test_an_unknown_world_is_an_error_in_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["world", "show", "kitchn"])
    assert ended.value.code == 1
    assert "expected the name of a world or a YAML file, got 'kitchn'" in capsys.readouterr().err
