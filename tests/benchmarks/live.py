"""Live runs at the rate of a camera beside OpenCV's optical flow, frame by frame in one thread of one process."""

import itertools
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from jaxslam import Slam, evaluate, load_config, open_dataset
from jaxslam.benchmark.reference_flow import corners_of, flow_ms
from jaxslam.datasets import Dataset
from jaxslam.semantics import Detector
from jaxslam.sensors.frame import Frame, to_gray

WARM_UP = 10


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
    rate_hz: float


def part_of(folder: Path, frames: range, rate_hz: float = 30.0) -> Recording:
    """Some frames of a recording."""
    dataset = open_dataset(folder)
    read = [dataset[index] for index in frames]
    return Recording(dataset, read, [corners_of(frame.image) for frame in read], rate_hz)


def live_run(recording: Recording, model: Path | None = None, detector: Detector | None = None) -> Run:
    """Follow a recording frame by frame as it would come from a camera, with mapping and a detector beside it.

    OpenCV's flow takes the same frames in the same thread, before and after the tracker in turn.
    """
    dataset, frames, corners, rate_hz = recording
    gray = [to_gray(frame.image) for frame in frames]
    config = load_config(overrides=["run.deterministic=false", f"semantics.model={model or 'null'}"])
    ours, theirs, keyframes = [], [], []
    with Slam(dataset.camera, config, detector=detector) as slam:
        slam.warm_up()
        began = time.perf_counter()
        for index, (before, after) in enumerate(itertools.pairwise([gray[0], *gray])):
            time.sleep(max(0.0, began + index / rate_hz - time.perf_counter()))
            old = corners[max(index - 1, 0)]
            tracked = slam.track(frames[index]) if index % 2 else None
            theirs.append(flow_ms(before, after, old))
            tracked = tracked or slam.track(frames[index])
            assert not tracked.detector_error
            ours.append(tracked.track_ms)
            keyframes.append(tracked.is_keyframe)
        slam.finish()
        assert dataset.ground_truth is not None
        ate_m = evaluate(slam.trajectory, dataset.ground_truth).ate_rmse_m
    ours, theirs, keyframes = (np.array(values)[WARM_UP:] for values in (ours, theirs, keyframes))
    return Run(ours, theirs, keyframes, ate_m)


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
