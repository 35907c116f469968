"""Collect pictures during a run: frames with their points, losses of tracking, and frames with masks."""

from collections.abc import Sequence

import numpy as np

from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.tracking.state import TrackStatus
from jaxslam.visualization.mask_gallery import MaskPictures
from jaxslam.visualization.plots import Snapshot

_NUM_SNAPSHOTS = 4
_MAX_LOSSES = 5


class Snapshots:
    """Keeps a few frames of a run, evenly spread, with their points: an `on_frame` of `Slam.run`."""

    def __init__(self, num_frames: int) -> None:
        """Choose which of `num_frames` frames to keep."""
        self._wanted = set(np.linspace(0, num_frames - 1, _NUM_SNAPSHOTS + 1)[1:].round().astype(int).tolist())
        self._seen = 0
        self.kept: list[Snapshot] = []

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame."""
        if self._seen in self._wanted and frame is not None and isinstance(result, FrameResult):
            title = f"frame {self._seen}: {result.status.name}, {result.num_inliers} inliers"
            self.kept.append(_snapshot(title, frame, result))
        self._seen += 1


class Losses:
    """Keeps the frames in which tracking was lost, the first of each loss: an `on_frame` of `Slam.run`."""

    def __init__(self, most: int = _MAX_LOSSES) -> None:
        """Keep those of the first `most` losses."""
        self._most, self._seen, self._lost = most, 0, False
        self.kept: list[Snapshot] = []

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame."""
        lost = result.status == TrackStatus.LOST
        begins = lost and not self._lost and len(self.kept) < self._most
        if begins and frame is not None and isinstance(result, FrameResult):
            self.kept.append(_snapshot(f"frame {self._seen}: LOST, {result.reason}", frame, result))
        self._lost = lost
        self._seen += 1


class RunPictures:
    """All of them: an `on_frame` of `Slam.run`, and what `write_results` draws."""

    def __init__(self, num_frames: int) -> None:
        """Keep nothing of `num_frames` frames yet."""
        self._snapshots, self._losses, self._masks = Snapshots(num_frames), Losses(), MaskPictures()

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame."""
        for watcher in (self._snapshots, self._losses, self._masks):
            watcher(frame, result)

    @property
    def snapshots(self) -> Sequence[Snapshot]:
        """Frames that are evenly spread over the run."""
        return self._snapshots.kept

    @property
    def losses(self) -> Sequence[Snapshot]:
        """The first frames of losses."""
        return self._losses.kept

    @property
    def masks(self) -> Sequence[np.ndarray]:
        """Pictures of frames with masks, as `MaskPictures` keeps them."""
        return self._masks.kept


def _snapshot(title: str, frame: Frame, result: FrameResult) -> Snapshot:
    return Snapshot(title, frame.image, result.uv, result.weights, result.followed)
