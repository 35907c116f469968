"""`Slam.track` with live threads at the sensor's rate, keyframes included, beside OpenCV's optical flow alone.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_live.py -s`
"""

import itertools
import time

import cv2
import numpy as np
import pytest
from benchmarks.timing import prefer_one_thread

from jaxslam import Slam, evaluate, load_config, open_dataset
from jaxslam.frame import to_grey

pytestmark = pytest.mark.benchmark

RATE_HZ, WARM_UP = 30.0, 10
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)

prefer_one_thread()


@pytest.mark.parametrize("recording", ["tum/rgbd_dataset_freiburg1_rpy_excerpt", "bonn/rgbd_bonn_crowd"])
def test_live_tracking_keeps_pace_with_opencv_flow(data_dir, capsys, recording):
    """Both follow the recording frame by frame as it would come from a camera, with mapping going on beside them."""
    dataset = open_dataset(data_dir / recording)
    frames = [dataset[index] for index in range(160)]
    grey = [to_grey(frame.image) for frame in frames]
    corners = [cv2.goodFeaturesToTrack(image, 1000, 0.001, 7) for image in grey]
    opencv_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    ours, theirs, keyframes = [], [], []
    try:
        with Slam(dataset.camera, load_config(overrides=["run.deterministic=false"])) as slam:
            slam.warm_up()
            began = time.perf_counter()
            for index, (before, after) in enumerate(itertools.pairwise([grey[0], *grey])):
                time.sleep(max(0.0, began + index / RATE_HZ - time.perf_counter()))
                tracked = slam.track(frames[index])
                at = time.perf_counter()
                old = corners[max(index - 1, 0)]
                cv2.calcOpticalFlowPyrLK(
                    before, after, old, old.copy(), winSize=(21, 21), maxLevel=3, criteria=CRITERIA
                )
                theirs.append(1e3 * (time.perf_counter() - at))
                ours.append(tracked.track_ms)
                keyframes.append(tracked.is_keyframe)
            slam.finish()
            assert dataset.ground_truth is not None
            ate_m = evaluate(slam.trajectory, dataset.ground_truth).ate_rmse_m
    finally:
        cv2.setNumThreads(opencv_threads)
    ours, theirs, keyframes = (np.array(values)[WARM_UP:] for values in (ours, theirs, keyframes))
    median, p95 = np.median(ours) / np.median(theirs), np.percentile(ours, 95) / np.median(theirs)
    with capsys.disabled():
        print(
            f"\n{recording}: tracking median {np.median(ours):.2f} ms, p95 {np.percentile(ours, 95):.2f},"
            f" max {ours.max():.2f}; keyframes median {np.median(ours[keyframes]):.2f};"
            f" OpenCV's LK median {np.median(theirs):.2f}, p95 {np.percentile(theirs, 95):.2f};"
            f" ratio of medians {median:.3f}, p95 over LK's median {p95:.3f}; ATE {ate_m:.4f} m"
        )
    assert median <= 1.0
    assert p95 <= 2.5
