"""`Slam.track` with live threads at the sensor's rate, keyframes included, beside OpenCV's optical flow alone.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_live.py -s`
"""

import itertools
import time
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from benchmarks.timing import prefer_one_thread

from jaxslam import Slam, evaluate, load_config, open_dataset
from jaxslam.datasets import Dataset
from jaxslam.frame import Frame, to_grey

pytestmark = pytest.mark.benchmark

RATE_HZ, WARM_UP, RUNS = 30.0, 10, 5
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
    def p95(self) -> float:
        return float(np.percentile(self.ours, 95) / np.median(self.theirs))


def live_run(dataset: Dataset, frames: list[Frame], corners: list[np.ndarray]) -> Run:
    """Follow a recording frame by frame as it would come from a camera, with mapping going on beside it.

    OpenCV's flow takes the same frames in the same thread, before and after the tracker in turn.
    """
    grey = [to_grey(frame.image) for frame in frames]
    ours, theirs, keyframes = [], [], []
    with Slam(dataset.camera, load_config(overrides=["run.deterministic=false"])) as slam:
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
            ours.append(tracked.track_ms)
            keyframes.append(tracked.is_keyframe)
        slam.finish()
        assert dataset.ground_truth is not None
        ate_m = evaluate(slam.trajectory, dataset.ground_truth).ate_rmse_m
    ours, theirs, keyframes = (np.array(values)[WARM_UP:] for values in (ours, theirs, keyframes))
    return Run(ours, theirs, keyframes, ate_m)


@pytest.mark.parametrize("recording", ["tum/rgbd_dataset_freiburg1_rpy_excerpt", "bonn/rgbd_bonn_crowd"])
def test_live_tracking_keeps_pace_with_opencv_flow(data_dir, capsys, recording):
    dataset = open_dataset(data_dir / recording)
    frames = [dataset[index] for index in range(160)]
    corners = [cv2.goodFeaturesToTrack(to_grey(frame.image), 1000, 0.001, 7) for frame in frames]
    opencv_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        runs = [live_run(dataset, frames, corners) for _ in range(RUNS)]
    finally:
        cv2.setNumThreads(opencv_threads)
    with capsys.disabled():
        print(f"\n{recording}")
        for run in runs:
            print(
                f"  tracking median {np.median(run.ours):.2f} ms, p95 {np.percentile(run.ours, 95):.2f},"
                f" max {run.ours.max():.2f}; keyframes median {np.median(run.ours[run.keyframes]):.2f};"
                f" OpenCV's LK median {np.median(run.theirs):.2f}, p95 {np.percentile(run.theirs, 95):.2f};"
                f" ratio of medians {run.median:.3f}, p95 over LK's median {run.p95:.3f}; ATE {run.ate_m:.4f} m"
            )
    assert np.median([run.median for run in runs]) <= 1.0
    assert np.median([run.p95 for run in runs]) <= 2.5
