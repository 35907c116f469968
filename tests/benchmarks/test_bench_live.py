"""`Slam.track` with live threads at the sensor's rate, keyframes included, beside OpenCV's optical flow alone.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_live.py -s`
"""

import os
import time
from pathlib import Path

import numpy as np
import pytest
from benchmarks.live import live_run, part_of, show

from jaxslam.runtime.threads import prefer_one_thread
from jaxslam.semantics import Detections, no_detections

pytestmark = [pytest.mark.benchmark, pytest.mark.usefixtures("opencv_in_one_thread")]

RUNS, NUM_FRAMES = 5, 160
WITH_PEOPLE = range(300, 300 + NUM_FRAMES)
"""Frames of Bonn `crowd` in which people are in the picture all the time."""
prefer_one_thread()


@pytest.mark.parametrize("recording", ["tum/rgbd_dataset_freiburg1_rpy_excerpt", "bonn/rgbd_bonn_crowd"])
def test_live_tracking_keeps_pace_with_opencv_flow(data_dir: Path, capsys: pytest.CaptureFixture[str], recording: str):
    part = part_of(data_dir / recording, range(NUM_FRAMES))
    runs = [live_run(part) for _ in range(RUNS)]
    show(capsys, recording, runs)
    assert np.median([run.median for run in runs]) <= 1.0
    assert np.median([run.p95 for run in runs]) <= 2.5


def test_live_tracking_beside_a_network(data_dir: Path, capsys: pytest.CaptureFixture[str]):
    """People in the picture, and YOLOX-nano looking for them in a thread."""
    model = Path(os.environ.get("JAXSLAM_MODELS") or "nowhere", "yolox_nano.onnx")
    if not model.is_file():
        pytest.skip("JAXSLAM_MODELS is not set, or holds no yolox_nano.onnx")
    part = part_of(data_dir / "bonn/rgbd_bonn_crowd", WITH_PEOPLE)
    runs = [live_run(part, model) for _ in range(RUNS)]
    show(capsys, "bonn/rgbd_bonn_crowd, people, YOLOX-nano beside", runs)
    assert np.median([run.mean for run in runs]) <= 1.2
    assert np.median([run.p95 for run in runs]) <= 3.0


def test_live_tracking_does_not_wait_for_a_slow_detector(data_dir: Path, capsys: pytest.CaptureFixture[str]):
    """One that takes half a second beside one that takes no time, in turn."""

    def slow(image: np.ndarray) -> Detections:
        del image
        time.sleep(0.5)
        return no_detections()

    part = part_of(data_dir / "bonn/rgbd_bonn_crowd", WITH_PEOPLE)
    pairs = [(live_run(part, detector=slow), live_run(part, detector=lambda _: no_detections())) for _ in range(RUNS)]
    show(capsys, "a detector that sleeps 0.5 s", [pair[0] for pair in pairs])
    show(capsys, "one that says at once that there is nothing", [pair[1] for pair in pairs])
    assert np.median([slow.mean / quick.mean for slow, quick in pairs]) <= 1.1
