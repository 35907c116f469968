"""`Slam`: what a robot calls with every frame, and what runs a whole recording."""

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.camera import Camera
from jaxslam.config import Config, TrackConfig
from jaxslam.datasets import Dataset, prefetch
from jaxslam.errors import DatasetError, FrameError, JaxSlamError
from jaxslam.frame import Frame, check_frame
from jaxslam.frame_arrays import FrameArrays, frame_arrays
from jaxslam.state import TrackOutput, TrackParams, TrackPlan, TrackReason, TrackState, TrackStatus
from jaxslam.track import init_state, track_step
from jaxslam.trajectory import Trajectory
from jaxslam.xla import enable_compile_cache

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Tracked:
    """What became of one frame.

    Attributes:
        timestamp_ns: Its time.
        T_world_cam: `(7,)` float64 pose of the camera as `wxyz_xyz`; the last one where `status` is `LOST`.
        covariance: `(6, 6)` of the pose, in the tangent space at the camera: translation (m), then rotation (rad).
        status: What the pose is worth.
        reason: Why it is not worth more; empty if it is `OK`.
        num_inliers: Followed points that agree with the pose.
        inlier_ratio: Their share of the points that could be followed.
        num_looked_up: Points found again in keyframes.
        residual_px: Robust standard deviation of the inliers' reprojection error, pixels.
        uv: `(2, n)` float32 pixels of the points in the frame, those just found included.
        weights: `(n,)` float32 weight of each, 0 to 1; 0 for a slot without a point.
        followed: `(n,)` bool, true for points that came from the frame before, false for new ones.
        is_keyframe: Whether the frame was kept.
        track_ms: Time it took, in milliseconds.
    """

    timestamp_ns: int
    T_world_cam: np.ndarray
    covariance: np.ndarray
    status: TrackStatus
    reason: str
    num_inliers: int
    inlier_ratio: float
    num_looked_up: int
    residual_px: float
    uv: np.ndarray
    weights: np.ndarray
    followed: np.ndarray
    is_keyframe: bool
    track_ms: float


@dataclass(frozen=True)
class Rejected:
    """A frame of a recording that could not be read or does not fit; tracking goes on with the next one."""

    timestamp_ns: int
    error: JaxSlamError

    @property
    def status(self) -> TrackStatus:
        """Always `REJECTED`."""
        return TrackStatus.REJECTED

    @property
    def reason(self) -> str:
        """What was wrong."""
        return str(self.error)


_new_state = jax.jit(init_state, static_argnames=("height", "width", "plan"))
"""One program instead of some fifty."""


@partial(jax.jit, static_argnames="plan", donate_argnums=0)
def _step(
    state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan
) -> tuple[TrackState, TrackOutput]:
    return track_step(state, frame, params, plan)


@dataclass(frozen=True)
class FrameRecord:
    """One line of a run's log: a frame's fate without its arrays.

    Attributes are those of `Tracked`; a rejected frame has only a time, a status and a reason.
    """

    timestamp_ns: int
    status: TrackStatus
    reason: str
    num_inliers: int = 0
    inlier_ratio: float = 0.0
    num_looked_up: int = 0
    residual_px: float = 0.0
    is_keyframe: bool = False
    track_ms: float | None = None

    @classmethod
    def of(cls, result: "Tracked | Rejected") -> "FrameRecord":
        """The record of a result."""
        return cls(**{field.name: getattr(result, field.name) for field in fields(cls) if hasattr(result, field.name)})


class Slam:
    """Tracks a camera through a scene, frame by frame.

    The world is the camera's place at the first frame. Calls must come from one thread at a time.
    """

    def __init__(self, camera: Camera, config: Config | None = None) -> None:
        """Prepare for frames of a camera. Compiling happens at the first frame or in `warm_up`."""
        self.camera = camera
        self.config = config or Config()
        self.compile_s = 0.0
        self._params = track_params(camera, self.config.track)
        self._plan = track_plan(self.config.track)
        self._ready = False
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next frame starts a new world."""
        self._state = _new_state(self.camera.height, self.camera.width, self._plan, seed=self.config.run.seed)
        self._last_ns: int | None = None
        self._times_ns: list[int] = []
        self._poses: list[np.ndarray] = []

    def warm_up(self) -> float:
        """Compile the step, or load it from the cache of an earlier run; gives the seconds it took, once."""
        if not self._ready:
            enable_compile_cache()
            began = time.perf_counter()
            blank = _new_state(self.camera.height, self.camera.width, self._plan, seed=self.config.run.seed)
            shape = (self.camera.height, self.camera.width)
            nothing = frame_arrays(Frame(0, np.zeros(shape, np.uint8), np.zeros(shape, np.float32)), 0.0)
            jax.block_until_ready(_step(blank, nothing, self._params, self._plan))
            self.compile_s = time.perf_counter() - began
            self._ready = True
        return self.compile_s

    def track(self, frame: Frame) -> Tracked:
        """Track one frame.

        Args:
            frame: Image and depth of the camera's size, later than the frame before.

        Returns:
            The pose and what it is worth. A frame without anything to track, such as a black one, is no error: its
            status is `LOST`.

        Raises:
            FrameError: If the frame does not fit the camera, or its time is not later than the last one's. Nothing
                has happened then; go on with the next frame.
        """
        check_frame(frame, self.camera.width, self.camera.height, self._last_ns)
        self.warm_up()
        began = time.perf_counter()
        dt_s = 1 / self.camera.fps if self._last_ns is None else (frame.timestamp_ns - self._last_ns) * 1e-9
        self._state, output = _step(self._state, frame_arrays(frame, dt_s), self._params, self._plan)
        output: TrackOutput = jax.device_get(output)
        tracked = _tracked(frame.timestamp_ns, output, (time.perf_counter() - began) * 1e3)
        self._last_ns = frame.timestamp_ns
        if tracked.status != TrackStatus.LOST:
            self._times_ns.append(frame.timestamp_ns)
            self._poses.append(tracked.T_world_cam)
        return tracked

    def run(
        self, dataset: Dataset, on_frame: Callable[[Frame | None, Tracked | Rejected], None] | None = None
    ) -> list[FrameRecord]:
        """Track a whole recording.

        A frame that cannot be read or does not fit is reported as `Rejected`, and the run goes on.

        Args:
            dataset: The recording; its camera must be this one.
            on_frame: Called after every frame, for progress and pictures; the frame is `None` if it was unreadable.
        """
        self.warm_up()
        records: list[FrameRecord] = []
        for timestamp_ns, frame in zip(dataset.timestamps_ns, _read_ahead(dataset, self.config), strict=True):
            result: Tracked | Rejected
            try:
                result = Rejected(int(timestamp_ns), frame) if isinstance(frame, JaxSlamError) else self.track(frame)
            except FrameError as error:
                result = Rejected(int(timestamp_ns), error)
            if isinstance(result, Rejected):
                _log.warning("frame at %d ns rejected: %s", result.timestamp_ns, result.reason)
            records.append(FrameRecord.of(result))
            if on_frame is not None:
                on_frame(frame if isinstance(frame, Frame) else None, result)
        return records

    @property
    def online_trajectory(self) -> Trajectory:
        """Every pose as it was given out; frames that were lost have none."""
        poses = np.array(self._poses).reshape(-1, 7)
        poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
        return Trajectory(np.array(self._times_ns, np.int64), poses)

    @property
    def trajectory(self) -> Trajectory:
        """Every pose as it is known now. Without a map that is adjusted later, the same as `online_trajectory`."""
        return self.online_trajectory


def track_plan(config: TrackConfig) -> TrackPlan:
    """The static part of the tracker's settings."""
    return TrackPlan(**{name: getattr(config, name) for name in TrackPlan._fields if hasattr(config, name)})


def track_params(camera: Camera, config: TrackConfig, dtype: type[np.floating] = np.float32) -> TrackParams:
    """The traced part of the tracker's settings, with the camera; `track_step` takes it."""
    traced = (name for name in TrackParams._fields if name not in ("intrinsics", "readout_s"))
    settings = {name: jnp.asarray(getattr(config, name), dtype) for name in traced}
    return TrackParams(intrinsics=camera.intrinsics(dtype), readout_s=jnp.asarray(camera.readout_s, dtype), **settings)


def _tracked(timestamp_ns: int, output: TrackOutput, track_ms: float) -> Tracked:
    return Tracked(
        timestamp_ns=timestamp_ns,
        T_world_cam=np.asarray(output.T_world_cam.wxyz_xyz, np.float64),
        covariance=np.asarray(output.covariance),
        status=TrackStatus(int(output.status)),
        reason=TrackReason(int(output.reason)).text,
        num_inliers=int(output.num_inliers),
        inlier_ratio=float(output.inlier_ratio),
        num_looked_up=int(output.num_looked_up),
        residual_px=float(output.residual_px),
        uv=np.asarray(output.uv),
        weights=np.asarray(output.weights),
        followed=np.asarray(output.tracked),
        is_keyframe=bool(output.is_keyframe),
        track_ms=track_ms,
    )


class _Tolerant:
    """A recording whose unreadable frames are errors as values."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame | JaxSlamError:
        try:
            return self._dataset[index]
        except (DatasetError, FrameError) as error:
            return error


def _read_ahead(dataset: Dataset, config: Config) -> Iterator[Frame | JaxSlamError]:
    return prefetch(_Tolerant(dataset), ahead=config.run.prefetch_frames)
