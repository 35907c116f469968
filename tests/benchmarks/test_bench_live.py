"""`Slam.track` with live threads at the sensor's rate, keyframes included, beside OpenCV's optical flow alone.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_live.py -s`
"""

import itertools
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from jaxslam import Slam, evaluate, load_config, open_dataset
from jaxslam.datasets import Dataset
from jaxslam.frame import Frame, to_grey
from jaxslam.semantics import Detections, Detector, no_detections
from jaxslam.xla import prefer_one_thread

pytestmark = pytest.mark.benchmark

RATE_HZ, WARM_UP, RUNS, NUM_FRAMES = 30.0, 10, 5, 160
PEOPLE_FROM = 300
"""Frame of Bonn `crowd` from which on people are in the picture all the time."""
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)

prefer_one_thread()


class Run(NamedTuple):
    """One live run: milliseconds of every frame, ours and OpenCV's, which frames were kept, and the error."""

    ours: np.ndarray
    theirs: np.ndarray
    keyframes: np.ndarray
    ate_m: float

    @property
    def median(self) -> float:
        return float(np.median(self.ours) / np.median(self.theirs))

    @property
    def mean(self) -> float:
        return float(np.mean(self.ours) / np.mean(self.theirs))

    @property
    def p95(self) -> float:
        return float(np.percentile(self.ours, 95) / np.median(self.theirs))


class Recording(NamedTuple):
    """Frames in memory, and the corners that OpenCV follows from each."""

    dataset: Dataset
    frames: list[Frame]
    corners: list[np.ndarray]


def part_of(folder: Path, start: int) -> Recording:
    """So many frames of a recording from one on."""
    dataset = open_dataset(folder)
    frames = [dataset[index] for index in range(start, start + NUM_FRAMES)]
    return Recording(dataset, frames, [cv2.goodFeaturesToTrack(to_grey(f.image), 1000, 0.001, 7) for f in frames])


def live_run(recording: Recording, model: Path | None = None, detector: Detector | None = None) -> Run:
    """Follow a recording frame by frame as it would come from a camera, with mapping and a detector beside it.

    OpenCV's flow takes the same frames in the same thread, before and after the tracker in turn.
    """
    dataset, frames, corners = recording
    grey = [to_grey(frame.image) for frame in frames]
    config = load_config(overrides=["run.deterministic=false", f"semantics.model={model or 'null'}"])
    ours, theirs, keyframes = [], [], []
    with Slam(dataset.camera, config, detector=detector) as slam:
        slam.warm_up()
        began = time.perf_counter()
        for index, (before, after) in enumerate(itertools.pairwise([grey[0], *grey])):
            time.sleep(max(0.0, began + index / RATE_HZ - time.perf_counter()))
            old = corners[max(index - 1, 0)]
            tracked = slam.track(frames[index]) if index % 2 else None
            at = time.perf_counter()
            cv2.calcOpticalFlowPyrLK(before, after, old, old.copy(), winSize=(21, 21), maxLevel=3, criteria=CRITERIA)
            theirs.append(1e3 * (time.perf_counter() - at))
            tracked = tracked or slam.track(frames[index])
            assert not tracked.detector_error
            ours.append(tracked.track_ms)
            keyframes.append(tracked.is_keyframe)
        slam.finish()
        assert dataset.ground_truth is not None
        ate_m = evaluate(slam.trajectory, dataset.ground_truth).ate_rmse_m
    ours, theirs, keyframes = (np.array(values)[WARM_UP:] for values in (ours, theirs, keyframes))
    return Run(ours, theirs, keyframes, ate_m)


@pytest.fixture(autouse=True)
def _opencv_in_one_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


def show(capsys: pytest.CaptureFixture[str], title: str, runs: list[Run]) -> None:
    with capsys.disabled():
        print(f"\n{title}")
        for run in runs:
            print(
                f"  tracking mean {np.mean(run.ours):.2f} ms, median {np.median(run.ours):.2f},"
                f" p95 {np.percentile(run.ours, 95):.2f}, max {run.ours.max():.2f};"
                f" keyframes median {np.median(run.ours[run.keyframes]):.2f};"
                f" OpenCV's LK mean {np.mean(run.theirs):.2f}, median {np.median(run.theirs):.2f}; ratio of means"
                f" {run.mean:.3f}, of medians {run.median:.3f}, p95 over LK's median {run.p95:.3f};"
                f" ATE {run.ate_m:.4f} m"
            )


@pytest.mark.parametrize("recording", ["tum/rgbd_dataset_freiburg1_rpy_excerpt", "bonn/rgbd_bonn_crowd"])
def test_live_tracking_keeps_pace_with_opencv_flow(data_dir: Path, capsys: pytest.CaptureFixture[str], recording: str):
    part = part_of(data_dir / recording, 0)
    runs = [live_run(part) for _ in range(RUNS)]
    show(capsys, recording, runs)
    assert np.median([run.median for run in runs]) <= 1.0
    assert np.median([run.p95 for run in runs]) <= 2.5


def test_live_tracking_beside_a_network(data_dir: Path, capsys: pytest.CaptureFixture[str]):
    """People in the picture, and YOLOX-nano looking for them in a thread."""
    model = Path(os.environ.get("JAXSLAM_MODELS") or "nowhere", "yolox_nano.onnx")
    if not model.is_file():
        pytest.skip("JAXSLAM_MODELS is not set, or holds no yolox_nano.onnx")
    part = part_of(data_dir / "bonn/rgbd_bonn_crowd", PEOPLE_FROM)
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

    part = part_of(data_dir / "bonn/rgbd_bonn_crowd", PEOPLE_FROM)
    pairs = [(live_run(part, detector=slow), live_run(part, detector=lambda _: no_detections())) for _ in range(RUNS)]
    show(capsys, "a detector that sleeps 0.5 s", [pair[0] for pair in pairs])
    show(capsys, "one that says at once that there is nothing", [pair[1] for pair in pairs])
    assert np.median([slow.mean / quick.mean for slow, quick in pairs]) <= 1.1
