"""A camera whose picture loses its texture, as before a blank wall: it is lost, and the map is not harmed."""

from dataclasses import replace

import numpy as np
import pytest
from small_scene import CONFIG, clip

from jaxslam.slam import FrameResult, Slam
from jaxslam.tracking.state import TrackStatus

FADE, BLANK, BACK = 20, 32, 42
"""Frames from which on the contrast falls, from which on only noise is left, and from which on all is as before."""
NOISE = 1.5
"""Standard deviation of the noise, gray levels."""


Run = tuple[list[FrameResult], dict[int, np.ndarray], dict[int, np.ndarray]]


@pytest.fixture(scope="module")
def run() -> Run:
    """Results, and poses of the keyframes when the wall fills the picture and when it ends."""
    recording, generator = clip(), np.random.default_rng(0)
    for index in range(FADE, BACK):
        contrast = max(0.0, 1 - (index + 1 - FADE) / (BLANK - FADE))
        image = recording[index].image.astype(float)
        faded = image.mean() + contrast * (image - image.mean()) + generator.normal(0, NOISE, image.shape)
        recording.frames[index] = replace(recording[index], image=np.clip(np.rint(faded), 0, 255).astype(np.uint8))
    results: list[FrameResult] = []
    maps: list[dict[int, np.ndarray]] = []
    with Slam(recording.camera, CONFIG) as slam:
        for index, frame in enumerate(recording.frames):
            results.append(slam.track(frame))
            if index in (BLANK + 1, BACK - 1):
                slam.finish()
                maps.append({int(key): slam.map.pose(int(key)) for key in slam.map.ids})
    return results, maps[0], maps[1]


def test_says_that_it_is_lost(run: Run) -> None:
    for result in run[0][BLANK + 1 : BACK]:
        assert result.status == TrackStatus.LOST
        assert result.reason
        np.testing.assert_array_equal(result.covariance, 100 * np.eye(6))


def test_leaves_the_map_alone(run: Run) -> None:
    _, before, after = run
    assert before.keys() == after.keys()
    for key, pose in before.items():
        np.testing.assert_array_equal(after[key], pose)


def test_goes_on_in_the_old_map(run: Run) -> None:
    results = run[0]
    assert [result.status for result in results[BACK + 1 :]] == [TrackStatus.OK] * (len(results) - BACK - 1)
    assert all(result.submap == 0 for result in results)
