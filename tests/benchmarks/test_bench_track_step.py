"""The whole step beside OpenCV's optical flow alone, on a real recording."""

import cv2
import jax
import jax.numpy as jnp
import pytest
from benchmarks.timing import compare

from jaxslam import Slam, frame_arrays, open_dataset, track_params, track_plan, track_step
from jaxslam.config import TrackConfig
from jaxslam.frame import to_grey

pytestmark = pytest.mark.benchmark


def test_step_is_not_slower_than_opencv_flow(data_dir, capsys):
    dataset = open_dataset(data_dir / "tum" / "rgbd_dataset_freiburg1_rpy_excerpt")
    config = TrackConfig()
    params, plan = track_params(dataset.camera, config), track_plan(config)
    slam = Slam(dataset.camera)
    for index in range(60):
        slam.track(dataset[index])
    state = jax.tree.map(jnp.copy, slam._state)
    before, frame = dataset[59], dataset[60]
    arrays = frame_arrays(frame, 1 / 30)
    step = jax.jit(track_step, static_argnames="plan")
    previous, current = to_grey(before.image), to_grey(frame.image)
    corners = cv2.goodFeaturesToTrack(previous, 1000, 0.001, 7)
    assert len(corners) == 1000
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)

    result = compare(
        lambda: step(state, arrays, params, plan),
        lambda: cv2.calcOpticalFlowPyrLK(
            previous, current, corners, corners.copy(), winSize=(21, 21), maxLevel=3, criteria=criteria
        ),
    )
    with capsys.disabled():
        print(f"\ntrack_step, {plan.num_points} points, against OpenCV's LK alone, 1000 points: {result}")
    assert result.ratio <= 1.0
