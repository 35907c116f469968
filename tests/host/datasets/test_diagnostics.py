"""`doctor` finds what was broken on purpose, and nothing in what is sound."""

import dataclasses
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_recording import CAMERA, HEIGHT, WIDTH, times, write_ground_truth, write_recording

from jaxslam.cli.entry_point import main
from jaxslam.datasets.diagnostics import Diagnosis, Finding, Level, diagnose
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum
from jaxslam.errors import DatasetError
from jaxslam.sensors.camera import Camera

COUNT = 8


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    folder = write_recording(tmp_path / "walk", COUNT)
    write_ground_truth(folder, times(COUNT))
    return folder


def found(diagnosis: Diagnosis, topic: str) -> Finding:
    (finding,) = [finding for finding in diagnosis.findings if finding.topic == topic]
    return finding


def repaint(folder: Path, pixels: np.ndarray, count: int = COUNT) -> None:
    for file in sorted(folder.iterdir())[:count]:
        cv2.imwrite(str(file), pixels)


def test_sound(sound: Path) -> None:
    diagnosis = diagnose(sound, camera=CAMERA)
    assert diagnosis.ok
    assert diagnosis.at(Level.WARNING) == diagnosis.at(Level.ERROR) == []
    lines = str(diagnosis).splitlines()
    assert " ".join(lines[0].split()) == "ok recording walk: 8 frames of 32x24, camera tiny"
    assert lines[-1] == "errors: 0, warnings: 0"
    assert "30.0 frames a second" in found(diagnosis, "rate").text
    assert "8 poses, path 2.10 m; 100% of frames" in found(diagnosis, "ground truth").text


@pytest.mark.parametrize("path", ["rgbd_dataset_freiburg1_rpy_excerpt", "rgbd_bonn_crowd"])
def test_sound_real_recording(data_dir: Path, path: str) -> None:
    diagnosis = diagnose(data_dir / ("bonn" if "bonn" in path else "tum") / path)
    assert diagnosis.at(Level.WARNING) == diagnosis.at(Level.ERROR) == []


class TestErrors:
    @pytest.mark.parametrize(
        ("name", "what"),
        [("missing", "nothing there"), ("walk.tgz", "a file (an archive must be unpacked first)")],
    )
    def test_no_folder(self, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, what: str) -> None:
        """Nothing to look over: one line that names the folder, and exit code 1."""
        (tmp_path / "walk.tgz").touch()
        message = f"{tmp_path / name}: expected the folder of a recording, got {what}"
        with pytest.raises(DatasetError, match=re.escape(message)):
            diagnose(tmp_path / name)
        with pytest.raises(SystemExit) as stop:
            main(["doctor", str(tmp_path / name)])
        assert stop.value.code == 1
        assert capsys.readouterr() == ("", f"error: {message}\n")

    def test_folder_without_a_recording(self, tmp_path: Path) -> None:
        diagnosis = diagnose(tmp_path)
        assert not diagnosis.ok
        assert "rgb.txt and depth.txt" in found(diagnosis, "recording").text

    def test_unknown_camera(self, sound: Path) -> None:
        assert "--camera" in found(diagnose(sound), "recording").text

    def test_unreadable_image(self, sound: Path) -> None:
        min((sound / "rgb").iterdir()).write_bytes(b"no image")
        diagnosis = diagnose(sound, camera=CAMERA)
        assert found(diagnosis, "frame").level is Level.ERROR
        assert found(diagnosis, "frame").text.startswith("frame 0: ")
        assert found(diagnosis, "images").level is Level.OK

    def test_every_image_of_another_size(self, sound: Path) -> None:
        diagnosis = diagnose(sound, camera="bonn")
        assert len([finding for finding in diagnosis.at(Level.ERROR) if finding.topic == "frame"]) == COUNT

    def test_no_depth_at_all(self, sound: Path) -> None:
        repaint(sound / "depth", np.zeros((HEIGHT, WIDTH), np.uint16))
        finding = found(diagnose(sound, camera=CAMERA), "depth")
        assert (finding.level, "no sampled frame has any depth" in finding.text) == (Level.ERROR, True)

    def test_unreadable_ground_truth(self, sound: Path) -> None:
        (sound / "groundtruth.txt").write_text("1.0 2.0 3.0\n")
        assert found(diagnose(sound, camera=CAMERA), "ground truth").level is Level.ERROR


class TestWarnings:
    def check(self, folder: Path, topic: str, words: str, camera: Camera = CAMERA) -> None:
        finding = found(diagnose(folder, camera=camera), topic)
        assert finding.level is Level.WARNING
        assert words in finding.text

    def test_one_frame(self, tmp_path: Path) -> None:
        self.check(write_recording(tmp_path / "walk", 1), "recording", "one frame makes no trajectory")

    def test_rate(self, sound: Path) -> None:
        self.check(sound, "rate", "camera 'tiny' says 60", dataclasses.replace(CAMERA, fps=60.0))

    def test_gap(self, tmp_path: Path) -> None:
        stamps = [*times(4), *times(4, first=102)]
        self.check(
            write_recording(tmp_path / "walk", color_times=stamps, depth_times=stamps),
            "gaps",
            "1 gaps longer than 2.5 frames, the longest 1.900 s after frame 3",
        )

    def test_association(self, tmp_path: Path) -> None:
        folder = write_recording(tmp_path / "walk", color_times=times(8), depth_times=times(6))
        self.check(folder, "association", "2 color and 0 depth images have no partner")

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"fx": 300.0, "fy": 300.0}, "field of view of 6 degrees"),
            ({"fx": 3.0, "fy": 3.0}, "field of view of 159 degrees"),
            ({"fy": 40.0}, "fx 30 and fy 40 far apart"),
            ({"cx": 8.0}, "a principal point (8, 11.5) far from the center"),
            ({"distortion": (-2.0, 0.0, 0.0, 0.0, 0.0)}, "folds the image over"),
        ],
        ids=["narrow", "wide", "oblong", "off center", "distortion"],
    )
    def test_calibration(self, sound: Path, changes: dict[str, object], words: str) -> None:
        self.check(sound, "calibration", words, dataclasses.replace(CAMERA, **changes))

    @pytest.mark.parametrize("scale", [1.0, 1000.0, 50_000.0])
    def test_depth_scale(self, sound: Path, scale: float) -> None:
        camera = dataclasses.replace(CAMERA, depth_scale_per_m=scale)
        self.check(sound, "depth scale", "depth_scale_per_m is rather 5000;", camera)

    def test_depth_that_no_room_shows_but_the_sensor(self, tmp_path: Path) -> None:
        """Depth five times too small is as plausible as any, but for the steps of the sensor."""
        room = SyntheticDataset(SyntheticConfig(frames=2, width=160, height=120, people=0))
        write_tum(room, tmp_path / "room")
        camera = dataclasses.replace(room.camera, depth_scale_per_m=25_000.0)
        self.check(tmp_path / "room", "depth scale", "looks like depth 5 times too small", camera)

    def test_much_depth_missing(self, sound: Path) -> None:
        counts = np.zeros((HEIGHT, WIDTH), np.uint16)
        counts[:, :8] = 5000
        repaint(sound / "depth", counts)
        self.check(sound, "depth", "75% missing: too few points")

    @pytest.mark.parametrize(
        ("level", "count", "words"),
        [(5, COUNT, "8 dark"), (250, 2, "2 overexposed"), (128, 3, "3 blurred or blank")],
    )
    def test_images(self, sound: Path, level: int, count: int, words: str) -> None:
        repaint(sound / "rgb", np.full((HEIGHT, WIDTH, 3), level, np.uint8), count)
        self.check(sound, "images", words)

    def test_images_scaled_to_one(self, sound: Path) -> None:
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        picture[:, WIDTH // 2 :] = 1
        repaint(sound / "rgb", picture)
        self.check(sound, "images", "8 with values of 0 and 1 only")

    def test_frozen_images(self, sound: Path) -> None:
        first, *others = sorted((sound / "rgb").iterdir())
        for file in others[:3]:
            shutil.copy(first, file)
        self.check(sound, "images", "3 the same as the one before")

    def test_ground_truth_of_another_time(self, sound: Path) -> None:
        write_ground_truth(sound, times(COUNT, first=100.1))
        self.check(sound, "ground truth", "62% of frames have one within 20 ms")


def test_no_ground_truth_is_no_fault(sound: Path) -> None:
    (sound / "groundtruth.txt").unlink()
    finding = found(diagnose(sound, camera=CAMERA), "ground truth")
    assert (finding.level, finding.text) == (Level.OK, "none: it can be tracked, but not evaluated")
