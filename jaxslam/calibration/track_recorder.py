"""Records the tracks of points while a recording is tracked, with the depth measured around them, and cuts blocks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxslam_kernels.camera import back_project
from jaxtyping import Float, Int

from jaxslam.calibration.depth_patches import (
    DepthPatches,
    DepthPlanes,
    DepthSettings,
    cut_patches,
    near_edges,
    planes_at,
)
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.config.schema import TrackConfig
from jaxslam.errors import DatasetError
from jaxslam.geometry.se3 import between, rotate
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.sensor_model import depth_noise, max_valid_depth, min_valid_depth
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.tracking.state import TrackStatus

_USABLE = (TrackStatus.OK, TrackStatus.WEAK, TrackStatus.STARTED)
_LONGEST_STEP = 1.8
"""Time between frames of a block, in those of the recording: not twice as long, as where a frame is missing."""
_BLOCK_FRAMES = (10, 30)
"""Fewest and most frames of a block: enough to turn and move, and not so many that there are few blocks."""
_WANTED_BLOCKS, _MOST_BLOCKS, _FEWEST_BLOCKS = 10, 24, 4
_FEWEST_SEEN = 4
"""Frames of a block in which a point must be seen."""
_MOST_POINTS, _FEWEST_POINTS = 384, 24
"""Points of a block."""
_MOST_AT_EDGES = 0.3
"""Share of the frames of a track in which it may be near an edge in depth; of more, the track is left out."""


class _Recorded(NamedTuple):
    """The `n` points of a frame; those of the frame before are continued where `track` is the same.

    Attributes:
        timestamp_ns: Its time.
        pose: `(7,)` its pose as tracked.
        track: `(n,)` number of the track of each point.
        uv: `(2, n)` pixels.
        patches: Depth around where the points are by the time of the depth image.
        depth_uv: `(2, n)` pixels where that is, about.
        delay_s: Time from the image to the depth image by their timestamps.
        time_sign: 1, or -1 where the recording is played backward.
    """

    timestamp_ns: int
    pose: Float[np.ndarray, "7"]
    track: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "2 n"]
    patches: DepthPatches
    depth_uv: Float[np.ndarray, "2 n"]
    delay_s: float
    time_sign: float


@dataclass(eq=False)
class TrackRecorder:
    """Records frame after frame of a run of `Slam`, as its `on_frame`.

    Attributes:
        camera: Camera with which the recording is tracked.
        config: Settings of the tracker, which know the noise of depth.
        num_frames: Number of frames so far.
        num_tracked: Number of those whose pose is known.
    """

    camera: Camera
    config: TrackConfig
    num_frames: int = 0
    num_tracked: int = 0
    _runs: list[list[_Recorded]] = field(default_factory=list)
    _track: Int[np.ndarray, " n"] | None = None
    _uv: Float[np.ndarray, "2 n"] | None = None
    _next: int = 0

    @property
    def depth(self) -> DepthSettings:
        """Noise and range of the depth sensor."""
        limits = min_valid_depth(self.camera, self.config), max_valid_depth(self.camera, self.config)
        return DepthSettings.of(depth_noise(self.camera, self.config), limits, self.camera.width)

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Record a frame.

        Args:
            frame: The frame; `None` if it could not be read.
            result: Result of tracking it.
        """
        self.num_frames += 1
        if frame is None or isinstance(result, Rejected) or result.status not in _USABLE:
            self._track = None
            return
        self.num_tracked += 1
        track = self._continued(result)
        moving = self._uv is not None and self._track is not None
        flow = np.where(result.followed, result.uv - self._uv, 0.0) if moving else np.zeros_like(result.uv)
        if not moving:
            self._runs.append([])
        run = self._runs[-1]
        step_s = 1e-9 * (frame.timestamp_ns - run[-1].timestamp_ns) if run else np.inf
        recorded = self._recorded(frame, result, track, flow / step_s)
        run.append(recorded)
        self._track, self._uv = track, result.uv.astype(np.float64)

    def _continued(self, result: FrameResult) -> Int[np.ndarray, " n"]:
        """Number the tracks of all slots of the tracker; -1 for a point without weight."""
        new = self._next + np.arange(len(result.weights))
        self._next += len(new)
        track = new if self._track is None else np.where(result.followed & (self._track >= 0), self._track, new)
        return np.where(result.weights > 0, track, -1)

    def _recorded(self, frame: Frame, result: FrameResult, track: np.ndarray, velocity: np.ndarray) -> _Recorded:
        kept = track >= 0
        uv = result.uv[:, kept].astype(np.float64)
        delay_s, time_sign = 1e-9 * frame.depth_delay_ns, -1.0 if frame.played_backward else 1.0
        # So that the patches need not reach far.
        depth_uv = uv + velocity[:, kept] * (delay_s + time_sign * self.camera.depth_delay_s)
        depth_m = frame.depth_m if frame.depth_m is not None else np.zeros(frame.size[::-1], np.float32)
        patches = cut_patches(depth_m, depth_uv, self.depth)
        return _Recorded(frame.timestamp_ns, result.T_world_cam, track[kept], uv, patches, depth_uv, delay_s, time_sign)

    def blocks(self) -> list[TrackBlock]:
        """Cut what was recorded into blocks of frames, all of one size, evenly over the recording.

        Raises:
            DatasetError: If too little of the recording was tracked.
        """
        runs = self._even_runs()
        total = sum(len(run) for run in runs)
        length = int(np.clip(total // _WANTED_BLOCKS, *_BLOCK_FRAMES))
        cut = [run[first : first + length] for run in runs for first in range(0, len(run) - length + 1, length)]
        blocks = [block for block in (self._block(frames) for frames in cut) if block is not None]
        if len(blocks) < _FEWEST_BLOCKS:
            raise DatasetError(
                f"recording: expected at least {_FEWEST_BLOCKS} parts of {length} frames that are tracked throughout,"
                f" got {len(blocks)} ({self.num_tracked} of {self.num_frames} frames are tracked)"
            )
        chosen = np.unique(np.linspace(0, len(blocks) - 1, min(len(blocks), _MOST_BLOCKS)).round().astype(int))
        return [blocks[index] for index in chosen]

    def _even_runs(self) -> list[list[_Recorded]]:
        """Return frames in a row, without gaps in time."""
        steps = [b.timestamp_ns - a.timestamp_ns for run in self._runs for a, b in pairwise(run)]
        longest_ns = _LONGEST_STEP * float(np.median(steps)) if steps else 0.0
        even = []
        for run in self._runs:
            gaps = np.flatnonzero(np.diff([frame.timestamp_ns for frame in run]) > longest_ns) + 1
            even += [run[first:last] for first, last in zip([0, *gaps], [*gaps, len(run)], strict=True)]
        return even

    def _block(self, frames: Sequence[_Recorded]) -> TrackBlock | None:
        """Gather the tracks through some frames; `None` if there are too few."""
        numbers, counts = np.unique(np.concatenate([frame.track for frame in frames]), return_counts=True)
        longest = np.argsort(-counts, kind="stable")[:_MOST_POINTS]
        chosen = np.sort(numbers[longest[counts[longest] >= _FEWEST_SEEN]])
        if len(chosen) < _FEWEST_POINTS:
            return None
        grid = _Grid(frames, _MOST_POINTS)
        for index, frame in enumerate(frames):
            place = np.searchsorted(chosen, frame.track)
            own = np.flatnonzero((place < len(chosen)) & (chosen[np.minimum(place, len(chosen) - 1)] == frame.track))
            grid.put(index, place[own], frame, own)
        patches = DepthPatches(grid.counts, grid.origin)
        at_edges = (near_edges(patches, self.depth, grid.seen) & grid.seen).sum(axis=0)
        grid.seen &= at_edges <= _MOST_AT_EDGES * grid.seen.sum(axis=0)
        if grid.seen.any(axis=0).sum() < _FEWEST_POINTS:
            return None
        origin = frames[0].pose
        poses = np.stack([between(origin, frame.pose) for frame in frames])
        depth = planes_at(patches, grid.depth_uv, self.depth)
        stamps = np.array([frame.timestamp_ns for frame in frames], np.int64)
        return TrackBlock(
            times_s=1e-9 * (stamps - stamps[0]),
            poses=poses,
            X_world=self._positions(grid, depth, poses),
            uv=grid.uv,
            seen=grid.seen,
            depth=depth,
            patches=patches,
            delay_s=np.array([frame.delay_s for frame in frames]),
            time_sign=np.array([frame.time_sign for frame in frames]),
            origin=origin,
            timestamps_ns=stamps,
        )

    def _positions(self, grid: "_Grid", planes: DepthPlanes, poses: np.ndarray) -> Float[np.ndarray, "3 p"]:
        """Return where the points are by the median of their measured depths; a point without any at the middle one."""
        num_frames, _, num_points = grid.uv.shape
        measured = grid.seen & planes.measured
        depth = np.where(measured, 1 / np.where(measured, planes.plane[:, 0], 1.0), np.nan)
        typical = float(np.nanmedian(depth)) if measured.any() else 2.0
        depth = np.where(np.isnan(depth), typical, depth)
        flat = np.swapaxes(grid.uv, 0, 1).reshape(2, -1).astype(np.float32)
        intrinsics = self.camera.intrinsics()
        X_cam = np.asarray(back_project(intrinsics, flat, depth.reshape(-1).astype(np.float32)), np.float64)  # pyright: ignore[reportArgumentType]
        X_cam = X_cam.reshape(3, num_frames, num_points)
        X_world = rotate(poses[:, None], np.moveaxis(X_cam, 0, -1)) + poses[:, None, 4:]
        best = grid.seen & (measured | ~measured.any(axis=0))
        masked = np.where(best[..., None], X_world, np.nan)
        middle = np.full((num_points, 3), [0.0, 0.0, typical])
        there = best.any(axis=0)
        middle[there] = np.nanmedian(masked[:, there], axis=0)
        return middle.T


class _Grid:
    """Arrays of a block to be filled: the same place for a point in all frames."""

    def __init__(self, frames: Sequence[_Recorded], num_points: int) -> None:
        num_frames = len(frames)
        self.uv = np.zeros((num_frames, 2, num_points))
        self.depth_uv = np.zeros((num_frames, 2, num_points))
        self.origin = np.zeros((num_frames, 2, num_points), np.int64)
        self.counts = np.zeros((num_frames, num_points, frames[0].patches.counts.shape[-1]), np.uint16)
        self.seen = np.zeros((num_frames, num_points), bool)

    def put(self, index: int, place: np.ndarray, frame: _Recorded, own: np.ndarray) -> None:
        """Fill in the points `own` of a frame at their places."""
        self.uv[index][:, place] = frame.uv[:, own]
        self.depth_uv[index][:, place] = frame.depth_uv[:, own]
        self.origin[index][:, place] = frame.patches.origin[:, own]
        self.counts[index][place] = frame.patches.counts[own]
        self.seen[index][place] = True
