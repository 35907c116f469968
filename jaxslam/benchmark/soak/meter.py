"""Figures of a soak test, window by window."""

import csv
import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxslam.errors import BenchmarkError, TrajectoryError
from jaxslam.runtime.machine import rss_mb
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class Window:
    """Figures of some frames in a row.

    Attributes:
        frames: Number of frames since the start, at its end.
        keyframes: Number of keyframes in the map.
        map_points: Number of points in the map.
        rss_mb: Resident memory of the process, megabytes.
        lost: Number of lost frames although the lens was not covered.
        made_lost: Number of lost frames while the lens was covered, or right after.
        dropped: Number of frames that came too late to be tracked; only with `run.realtime`.
        median_ms: Median time of a frame, milliseconds.
        p95_ms: 95th percentile of it.
        max_ms: Largest.
        cpu_ms: Processor time of the process for a frame, all that is done beside included, milliseconds.
        ate_m: RMSE of the poses as they were given out, aligned with the ground truth, meters; `None` without one.
        submaps: Number of submaps.
        loops: Number of loops closed so far.
    """

    frames: int
    keyframes: int
    map_points: int
    rss_mb: float
    lost: int
    made_lost: int
    dropped: int
    median_ms: float
    p95_ms: float
    max_ms: float
    cpu_ms: float
    ate_m: float | None
    submaps: int
    loops: int


class SoakMeter:
    """Sums frames up in windows: an `on_frame` of `Slam.run`. Each window is a row of a table when it ends.

    Attributes:
        windows: The windows so far.
    """

    def __init__(
        self,
        slam: Slam,
        truth: Trajectory | None,
        window: int,
        may_be_lost: Callable[[int], bool],
        table: Path,
    ) -> None:
        """Start.

        Args:
            slam: The tracker.
            truth: True poses; `None` if they are unknown.
            window: Number of frames of a window.
            may_be_lost: Function that tells whether a frame may be lost, as the lens is covered.
            table: CSV file for the windows.
        """
        self.windows: list[Window] = []
        self._slam, self._truth, self._window, self._may_be_lost = slam, truth, window, may_be_lost
        self._table = table
        self._frames = 0
        if truth is not None:  # compile: after the first window, that would hold frames up for a second
            self._ate_m(truth.timestamps_ns[:window], truth.T_world_cam[:window])
        self._append([field.name for field in dataclasses.fields(Window)], mode="w")
        self._begin()

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame."""
        if result.status in (TrackStatus.LOST, TrackStatus.REJECTED):
            may = self._may_be_lost(self._frames)
            self._made_lost, self._lost = self._made_lost + may, self._lost + (not may)
        self._dropped += result.status == TrackStatus.DROPPED
        if isinstance(result, FrameResult):
            self._ms.append(result.track_ms)
            if result.status != TrackStatus.LOST and result.in_map_frame:
                self._times.append(result.timestamp_ns)
                self._poses.append(result.T_world_cam)
        self._frames += 1
        if self._frames % self._window == 0:
            self.end_window()

    def end_window(self) -> None:
        """Sum up the frames since the last window, if there are any."""
        if not self._ms:
            return
        ms, slam_map = np.array(self._ms), self._slam.map
        window = Window(
            frames=self._frames,
            keyframes=len(slam_map.ids),
            map_points=len(slam_map.points.ids),
            rss_mb=round(rss_mb(), 1),
            lost=self._lost,
            made_lost=self._made_lost,
            dropped=self._dropped,
            median_ms=round(float(np.median(ms)), 3),
            p95_ms=round(float(np.percentile(ms, 95)), 3),
            max_ms=round(float(ms.max()), 3),
            cpu_ms=round(1e3 * (time.process_time() - self._since_s) / len(ms), 3),
            ate_m=self._ate_m(np.array(self._times, np.int64), np.array(self._poses)),
            submaps=len(set(slam_map.submap.tolist())),
            loops=self._slam.loops_closed,
        )
        self.windows.append(window)
        self._append(["" if value is None else value for value in dataclasses.astuple(window)], mode="a")
        self._begin()

    def _begin(self) -> None:
        self._ms: list[float] = []
        self._times: list[int] = []
        self._poses: list[np.ndarray] = []
        self._lost = self._made_lost = self._dropped = 0
        self._since_s = time.process_time()

    def _ate_m(self, timestamps_ns: np.ndarray, T_world_cam: np.ndarray) -> float | None:
        if self._truth is None or not len(timestamps_ns):
            return None
        try:
            return round(evaluate(Trajectory(timestamps_ns, T_world_cam), self._truth).ate_rmse_m, 6)
        except TrajectoryError:  # too few poses with a truth
            return None

    def _append(self, row: list[object] | list[str], mode: str) -> None:
        try:
            with self._table.open(mode, newline="") as file:
                csv.writer(file, lineterminator="\n").writerow(row)
        except OSError as problem:
            raise BenchmarkError(f"{self._table}: cannot be written: {problem.strerror}") from None
