"""Where a calibration begins: a given camera, a file, or a guess, and never the name of a folder."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_recording import CAMERA, HEIGHT, WIDTH, write_recording

from jaxslam.calibration import open_with_start
from jaxslam.errors import CameraError, DatasetError


@pytest.fixture
def named(tmp_path: Path) -> Path:
    """A recording whose name tells a known camera."""
    return write_recording(tmp_path / "rgbd_dataset_freiburg1_tiny")


def test_name_of_the_folder_tells_nothing(named: Path) -> None:
    dataset, source = open_with_start(named)
    assert source == "a guess: a field of view of 60 degrees"
    assert dataset.camera.fx == dataset.camera.fy == pytest.approx(0.5 * WIDTH / np.tan(np.deg2rad(30)))
    assert (dataset.camera.width, dataset.camera.height) == (WIDTH, HEIGHT)
    assert (dataset.camera.cx, dataset.camera.cy) == (15.5, 11.5)
    assert dataset.camera.distortion == (0, 0, 0, 0, 0)
    assert dataset.camera.depth_scale_per_m == 5000
    assert dataset[0].size == (WIDTH, HEIGHT)


def test_given_focal_length(named: Path) -> None:
    dataset, source = open_with_start(named, focal_px=31.0, depth_scale_per_m=1000.0)
    assert (dataset.camera.fx, dataset.camera.fy, dataset.camera.depth_scale_per_m) == (31, 31, 1000)
    assert "the given focal length" in source


def test_camera_file_of_the_folder(named: Path) -> None:
    replace(CAMERA, fy=33.0).save(named / "camera.yaml")
    dataset, source = open_with_start(named)
    assert source == "the calibration in the folder"
    assert (dataset.camera.fx, dataset.camera.fy) == (30, 33)
    assert open_with_start(named, focal_px=60.0).dataset.camera.fy == 66


def test_given_camera_comes_first(named: Path, tmp_path: Path) -> None:
    CAMERA.save(named / "camera.yaml")
    replace(CAMERA, fx=29.0).save(tmp_path / "mine.yaml")
    dataset, source = open_with_start(named, camera=tmp_path / "mine.yaml")
    assert (dataset.camera.fx, source) == (29, "the given camera")


def test_errors(named: Path, tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"focal_px: .*expected pixels that suit an image of 32"):
        open_with_start(named, focal_px=1.0)
    with pytest.raises(DatasetError, match="nothing there"):
        open_with_start(tmp_path / "nowhere")
    shutil.move(named / "rgb", tmp_path / "gone")
    with pytest.raises(DatasetError, match="missing"):
        open_with_start(named)
