"""Frames of a recording tracked in any order, with black ones between."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from room_round import TRACK

from jaxslam.config.schema import Config, RunConfig
from jaxslam.datasets import Dataset
from jaxslam.geometry.se3 import between
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.trajectory import Trajectory

CONFIG = Config(track=TRACK)


HOLD, PREDICT, SUBMAP = (replace(CONFIG, run=RunConfig(on_loss=policy)) for policy in ("hold", "predict", "submap"))


BLACK = None


Order = Sequence[int | None]


class Played:
    """Frames of a recording in any order, black ones between them, each later than the one before."""

    def __init__(self, slam: Slam, dataset: Dataset, order: Order, fps: float, gap_s: float = 0.0) -> None:
        """Track them; after a frame that is not followed by the next one or a black one come `gap_s` seconds."""
        self.slam, self.order, self.results = slam, order, list[FrameResult]()
        time_ns, before = slam._clock.last_ns or 0, None
        for index in order:
            cut = before is not None and index is not None and index != before + 1
            time_ns += int(1e9 / fps + (gap_s * 1e9 if cut else 0))
            self.results.append(slam.track(at_time(dataset, index, time_ns)))
            before = index
        slam.finish()
        truth = dataset.ground_truth
        assert truth is not None
        self.shown = [place for place, index in enumerate(order) if index is not None]
        times = np.array([dataset.timestamps_ns[index] for index in order if index is not None])
        poses = np.concatenate([truth.at(time[None]).T_world_cam for time in times])
        self.truth = Trajectory(np.array([self.results[place].timestamp_ns for place in self.shown]), poses)

    @property
    def statuses(self) -> list[TrackStatus]:
        return [result.status for result in self.results]

    def first(self, status: TrackStatus, after: int = 0) -> int:
        """The first frame from one on that has a status."""
        return self.statuses.index(status, after)

    def errors_m(self, places: range) -> np.ndarray:
        """How far the poses given out for frames are from the truth, the first frame as the world of both."""
        true = {
            place: between(self.truth.T_world_cam[0], pose)
            for place, pose in zip(self.shown, self.truth.T_world_cam, strict=True)
        }
        return np.array([np.linalg.norm(self.results[place].T_world_cam[4:] - true[place][4:]) for place in places])

    def aligned_errors_m(self, fitted: range, places: range) -> np.ndarray:
        """The same with the truth turned and shifted to fit the poses of some frames; for a truth that is measured."""
        true = dict(zip(self.shown, self.truth.T_world_cam[:, 4:], strict=True))
        given = np.array([self.results[place].T_world_cam[4:] for place in fitted])
        wanted = np.array([true[place] for place in fitted])
        center, true_center = given.mean(axis=0), wanted.mean(axis=0)
        U, _, Vt = np.linalg.svd((given - center).T @ (wanted - true_center))  # Kabsch 1976
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        expected = [R @ (true[place] - true_center) + center for place in places]
        return np.array(
            [np.linalg.norm(self.results[p].T_world_cam[4:] - x) for p, x in zip(places, expected, strict=True)]
        )


def at_time(dataset: Dataset, index: int | None, time_ns: int) -> Frame:
    """A frame moved in time, or a black one."""
    if index is None:
        shape = (dataset.camera.height, dataset.camera.width)
        return Frame(time_ns, np.zeros(shape, np.uint8), np.zeros(shape, np.float32))
    frame = dataset[index]
    depth_ns = frame.depth_timestamp_ns
    return replace(
        frame,
        timestamp_ns=time_ns,
        depth_timestamp_ns=None if depth_ns is None else depth_ns - frame.timestamp_ns + time_ns,
    )
