"""The whole step beside OpenCV's optical flow alone, over the same frames of a real recording."""

import itertools

import jax
import pytest

from jaxslam import Slam, frame_arrays, open_dataset, track_params, track_plan, track_step
from jaxslam.benchmark.reference_flow import corners_of, opencv_flow
from jaxslam.benchmark.timing import compare
from jaxslam.config.schema import Config, TrackConfig
from jaxslam.sensors.frame import to_gray

pytestmark = pytest.mark.benchmark

FIRST, ROUNDS, WARM_UP = 60, 60, 5


def test_step_is_not_slower_than_opencv_flow(data_dir, capsys):
    """Both go through the recording frame by frame: new points and keyframes are part of the step where they fall."""
    dataset = open_dataset(data_dir / "tum" / "rgbd_dataset_freiburg1_rpy_excerpt")
    config = Config(track=TrackConfig(num_points=500))
    params, plan = track_params(dataset.camera, config.track), track_plan(config.track)
    slam = Slam(dataset.camera, config)
    for index in range(FIRST):
        slam.track(dataset[index])
    step = jax.jit(track_step, static_argnames="plan", donate_argnames="state")
    state, statuses = slam._tracker.state, []
    frames = [dataset[index] for index in range(FIRST - 1, FIRST + ROUNDS + WARM_UP)]
    arrays = iter([frame_arrays(frame, 1 / 30) for frame in frames[1:]])
    gray = [to_gray(frame.image) for frame in frames]
    pairs = iter([(a, b, corners_of(a)) for a, b in itertools.pairwise(gray)])

    def ours():
        nonlocal state
        state, output = step(state, next(arrays), params, plan)
        statuses.append(output.status)
        return state, output

    def theirs():
        before, after, corners = next(pairs)
        assert len(corners) == 1000
        opencv_flow(before, after, corners)

    result = compare(ours, theirs, rounds=ROUNDS, warm_up=WARM_UP)
    with capsys.disabled():
        print(f"\ntrack_step, {plan.num_points} points, against OpenCV's LK alone, 1000 points: {result}")
    assert not any(map(int, statuses)), "a frame was not tracked"
    assert result.ratio <= 1.0
