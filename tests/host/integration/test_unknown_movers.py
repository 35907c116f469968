"""Boxes that are carried before the camera, which no network knows: what geometry alone makes of them."""

from functools import cache

import numpy as np
import pytest
from small_scene import Clip

from jaxslam.config.loading import load_config
from jaxslam.datasets.synthetic import SceneDetector, SyntheticConfig, SyntheticDataset
from jaxslam.sensors.frame import Frame
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate

FRAMES = 36
FLOOR_M = 0.002
"""Errors below this are not told apart."""


@cache
def recording() -> tuple[Clip, SceneDetector]:
    """Two boxes that cover a third of the picture from the first frame on."""
    room = SyntheticDataset(SyntheticConfig(frames=FRAMES, people=0, boxes=2))
    rendered = [room.render(index) for index in range(FRAMES)]
    assert np.mean([np.mean(frame.instance_mask > 0) for frame in rendered]) > 0.3
    frames = [Frame(frame.timestamp_ns, frame.rgb, frame.depth_m) for frame in rendered]
    return Clip(room, frames), SceneDetector(room, rendered)


@cache
def ate_m(preset: str, *overrides: str, true_masks: bool = False) -> float:
    """Of the whole recording, in which nothing may be lost."""
    clip, detector = recording()
    config = load_config(preset, overrides=overrides)
    with Slam(clip.camera, config, detector=detector if true_masks else None) as slam:
        records = slam.run(clip)
    assert all(record.status in (TrackStatus.OK, TrackStatus.STARTED) for record in records)
    assert clip.ground_truth is not None
    return max(evaluate(slam.trajectory, clip.ground_truth).ate_rmse_m, FLOOR_M)


WITHOUT = ("dynamics.cues=[]", "dynamics.balance_regions=false")


@pytest.mark.slow
def test_votes_of_points_follow_a_box() -> None:
    """What cues and even votes are for."""
    assert ate_m("default", "semantics.model=null", *WITHOUT) > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "trs-geometry"])
def test_as_good_as_with_true_masks(preset: str) -> None:
    in_every_frame = "semantics.frames=every", "semantics.latency_frames=0"
    truth_m = ate_m("default", *in_every_frame, *WITHOUT, true_masks=True)
    assert ate_m(preset, "semantics.model=null") <= 1.5 * truth_m
