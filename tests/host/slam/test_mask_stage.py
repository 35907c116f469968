"""The stage beside optical flow: it shares no buffer with anybody, and nothing of a frame outlives it."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from small_scene import CONFIG, clip

from jaxslam.config.schema import Config
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.ground_truth_detector import SceneDetector
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam

FRAMES = 12


def arrays_of(owner: Any) -> list[np.ndarray]:
    return [value for value in vars(owner).values() if isinstance(value, np.ndarray)]


def fill_with_rubbish(slam: Slam, rng: np.random.Generator) -> None:
    """Overwrite every buffer of the frame and of the stage, as a later frame might."""
    nothing = slam._memory._nothing
    for array in (*arrays_of(slam._memory), *arrays_of(slam._masks)):
        if array is not nothing:  # constant: a frame without a mask is shown it
            array[:] = rng.integers(0, 2, array.shape) if array.dtype == bool else rng.uniform(0, 200, array.shape)


def tracked(config: Config, frames: list[Frame], camera: Any, detector: Any, *, rubbish: bool) -> list[FrameResult]:
    rng, results = np.random.default_rng(0), []
    with Slam(camera, config, detector=detector) as slam:
        for frame in frames:
            results.append(slam.track(frame))
            if rubbish:
                fill_with_rubbish(slam, rng)
    return results


@pytest.mark.parametrize("masked", [pytest.param(False, marks=pytest.mark.slow), True])
def test_buffers_are_not_read_after_the_frame(masked: bool) -> None:
    recording = clip(people=1, frames=FRAMES)
    settings = replace(CONFIG, semantics=replace(CONFIG.semantics, frames="every"))
    frames = recording.frames
    if masked:
        left = np.zeros(frames[0].size[::-1], bool)
        left[:, :20] = True
        frames = [replace(frame, dynamic_mask=left) for frame in frames]
    runs = [
        tracked(settings, frames, recording.camera, SceneDetector(recording.source), rubbish=rubbish)
        for rubbish in (False, True)
    ]
    for calm, spoiled in zip(*runs, strict=True):
        assert calm.status == spoiled.status
        np.testing.assert_array_equal(calm.T_world_cam, spoiled.T_world_cam)
        np.testing.assert_array_equal(calm.dynamic_mask, spoiled.dynamic_mask)
        assert calm.mask_source == spoiled.mask_source


def test_depth_of_a_pair_is_in_a_buffer_of_its_own() -> None:
    """While points are followed, the worker writes to no array that the tracker reads."""
    room = SyntheticDataset(SyntheticConfig(width=160, height=120, frames=2, people=0, baseline_m=0.1))
    with Slam(room.camera, CONFIG) as slam:
        frame = room[0]
        arrays = slam._memory.hold(frame, 0.0, depth_follows=True)
        before = jax.tree.map(np.array, arrays)
        slam._masks.begin(0, frame, arrays, np.array([1.0, 0, 0, 0, 0, 0, 0]))
        after, _ = slam._masks.result(frame, arrays)
        np.testing.assert_array_equal(before.depth, arrays.depth)
        assert np.count_nonzero(after.depth) > 100
        assert not np.shares_memory(np.asarray(after.depth), np.asarray(arrays.depth))
