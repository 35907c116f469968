"""A map grows with the space that it shows, not with time: recordings played to and fro, and a camera at rest."""

from collections import Counter

import numpy as np
import pytest
from small_scene import CONFIG, clip

from jaxslam import Slam, load_config
from jaxslam.benchmark.soak.meter import SoakMeter, Window
from jaxslam.config.schema import Config
from jaxslam.datasets import Dataset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.to_and_fro import ToAndFro
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.tracking.state import TrackStatus


class Rested:
    """Frames of a recording that a camera at rest delivers over and over, with new noise each time."""

    def __init__(self, dataset: Dataset, num_frames: int) -> None:
        self._played = ToAndFro(dataset, num_frames)
        self.name, self.camera, self.ground_truth = "at rest", dataset.camera, None
        self.timestamps_ns = self._played.timestamps_ns

    def __len__(self) -> int:
        return len(self._played)

    def __getitem__(self, index: int):
        frame = self._played[index]
        noise = np.random.default_rng([index, 3]).integers(-2, 3, frame.image.shape[:2])
        image = np.clip(frame.image.astype(np.int16) + noise[..., None], 0, 255).astype(np.uint8)
        return type(frame)(frame.timestamp_ns, image, frame.depth_m)


def windows_of(dataset: Dataset, config: Config, window: int, tmp_path) -> tuple[list[Window], Counter[TrackStatus]]:
    """Track a recording; gives the figures of its windows, and how many frames had each status."""
    statuses: Counter[TrackStatus] = Counter()
    with Slam(dataset.camera, config) as slam:
        meter = SoakMeter(slam, dataset.ground_truth, window, lambda index: False, tmp_path / "soak.csv")

        def on_frame(frame: object, result: FrameResult | Rejected) -> None:
            statuses[result.status] += 1
            meter(None, result)

        slam.run(dataset, on_frame)
    return meter.windows, statuses


@pytest.mark.slow
def test_no_keyframes_where_the_camera_has_been(tmp_path) -> None:
    whole = clip()
    windows, statuses = windows_of(ToAndFro(whole, 16 * (len(whole) - 1)), CONFIG, 2 * (len(whole) - 1), tmp_path)
    assert not statuses[TrackStatus.LOST]
    assert windows[-1].keyframes <= 1.3 * windows[0].keyframes
    assert windows[-1].keyframes == windows[4].keyframes


@pytest.mark.slow
def test_a_camera_at_rest_makes_no_keyframes(tmp_path) -> None:
    """For twenty seconds here."""
    still = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=8, people=0, path="static"))
    windows, statuses = windows_of(Rested(still, 600), load_config(overrides=["semantics.model=null"]), 200, tmp_path)
    assert not statuses[TrackStatus.LOST]
    assert windows[-1].keyframes <= 3


@pytest.mark.slow
def test_a_camera_at_rest_for_ten_minutes(tmp_path) -> None:
    still = SyntheticDataset(SyntheticConfig(width=320, height=240, frames=8, people=0, path="static"))
    windows, statuses = windows_of(
        Rested(still, 18_000), load_config(overrides=["semantics.model=null"]), 2000, tmp_path
    )
    assert not statuses[TrackStatus.LOST]
    assert windows[-1].keyframes <= 3
    assert windows[-1].rss_mb - windows[1].rss_mb < 60


@pytest.mark.slow
def test_a_turning_camera_for_12000_frames(tmp_path) -> None:
    """A rendered room to and fro, as the recordings of a camera that turns."""
    turning = SyntheticDataset(SyntheticConfig(frames=160, people=0, path="rpy"))
    frames = [turning[index] for index in range(len(turning))]

    class Rendered:
        name, camera, ground_truth = turning.name, turning.camera, turning.ground_truth
        timestamps_ns = turning.timestamps_ns

        def __len__(self) -> int:
            return len(frames)

        def __getitem__(self, index: int):
            return frames[index]

    config = load_config(overrides=["semantics.model=null"])
    windows, statuses = windows_of(ToAndFro(Rendered(), 12_000), config, 1500, tmp_path)
    assert not statuses[TrackStatus.LOST]
    assert windows[0].keyframes <= 60
    assert windows[-1].keyframes <= min(75, 1.3 * windows[0].keyframes)
    assert windows[-1].rss_mb - windows[0].rss_mb < 60
