"""Calibration of whole recordings, through the tracker."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from miscalibrated_room import STATED, TRUTH, MiscalibratedRoom

from jaxslam import Camera
from jaxslam.calibration import Verdict, calibrate, open_with_start
from jaxslam.errors import CameraError
from jaxslam.visualization.calibration_plot import plot_calibration

_DATA = os.environ.get("JAXSLAM_DATA")
_EXCERPT = Path(_DATA or "") / "tum" / "rgbd_dataset_freiburg1_rpy_excerpt"


def test_stereo_pairs_are_refused() -> None:
    pair = replace(STATED, depth_scale_per_m=None, baseline_m=0.1)
    with pytest.raises(CameraError, match="expected a camera with depth images, got a stereo pair"):
        calibrate(MiscalibratedRoom(seed=0, truth=TRUTH, stated=pair))


@pytest.mark.slow
def test_room_that_its_camera_file_describes_wrongly(tmp_path: Path) -> None:
    """A focal length 5 % off, 8 ms from color to depth, 15 ms of readout, and 2 cm of offset are found."""
    stages: list[str] = []
    found = calibrate(MiscalibratedRoom(seed=0, path="rpy"), on_progress=lambda text, *_: stages.append(text))
    found.camera.save(tmp_path / "camera.yaml")
    camera = Camera.load(tmp_path / "camera.yaml")
    assert camera.fx == pytest.approx(TRUTH.fx, rel=0.004)
    assert camera.fy == pytest.approx(TRUTH.fy, rel=0.004)
    assert camera.depth_offset_m == pytest.approx(TRUTH.depth_offset_m, abs=0.01)
    assert camera.depth_delay_s == pytest.approx(TRUTH.depth_delay_s, abs=1.5e-3)
    assert camera.readout_s == pytest.approx(TRUTH.readout_s, abs=2e-3)
    assert camera.depth_scale_per_m == STATED.depth_scale_per_m
    assert found.estimate("depth_scale_per_m").verdict is Verdict.UNOBSERVABLE
    assert found.estimate("fx").verdict is Verdict.ACCEPTED
    assert found.held_out_gain > 0.05
    assert {"tracking, round 1", "held-out frames without focal length"} <= set(stages)
    plot_calibration(found, tmp_path / "residuals.png", title="room")
    assert (tmp_path / "residuals.png").stat().st_size > 10_000


_RESIZED, _CROP = (595, 446), (21, 13, 560, 420)
"""Width and height; left, top, width and height of what is kept of that."""


def _resized_and_cropped(folder: Path) -> Camera:
    """Write the excerpt with other images to a folder whose name tells nothing, and return its published camera."""
    left, top, width, height = _CROP
    for kind, method in (("rgb", cv2.INTER_AREA), ("depth", cv2.INTER_NEAREST)):
        (folder / kind).mkdir(parents=True)
        for path in (_EXCERPT / kind).iterdir():
            whole = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert whole is not None
            resized = cv2.resize(whole, _RESIZED, interpolation=method)
            cropped = resized[top : top + height, left : left + width]
            cv2.imwrite(str(folder / kind / path.with_suffix(".png").name), cropped)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (folder / name).write_text((_EXCERPT / name).read_text().replace(".jpg", ".png"))
    published = Camera.load("tum_fr1")
    u, v = _RESIZED[0] / published.width, _RESIZED[1] / published.height
    return replace(
        published, width=width, height=height, fx=u * published.fx, fy=v * published.fy,
        cx=u * (published.cx + 0.5) - 0.5 - left, cy=v * (published.cy + 0.5) - 0.5 - top,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(not _EXCERPT.is_dir(), reason="needs the excerpt of TUM fr1_rpy in JAXSLAM_DATA")
def test_real_recording_from_a_wrong_focal_length(tmp_path: Path) -> None:
    truth = _resized_and_cropped(tmp_path / "neutral")
    dataset, source = open_with_start(tmp_path / "neutral", focal_px=1.05 * truth.fx)
    assert source == "a guess, with the given focal length"
    found = calibrate(dataset)
    assert found.camera.fx == pytest.approx(truth.fx, rel=0.015)
    assert found.camera.fy == pytest.approx(truth.fy, rel=0.01)
    assert found.estimate("depth_scale_per_m").verdict is Verdict.UNOBSERVABLE
