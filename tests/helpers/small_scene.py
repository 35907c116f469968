"""A small picture of the synthetic room and a small tracker, for tests of the tracker as a whole."""

import functools
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config.schema import Config, TrackConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays, stack_frames
from jaxslam.slam.slam import Slam
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.state import TrackParams, TrackState
from jaxslam.trajectory.trajectory import Trajectory

WIDTH, HEIGHT = 160, 120
TRACK = TrackConfig(
    num_points=128,
    num_levels=3,
    num_keyframes=3,
    num_sources=1,
    points_per_source=64,
    num_hypotheses=32,
    cell_px=10,
    weak_inliers=30,  # it begins with some 40, as many as make a frame of 640x480 weak
)
SETTINGS = [
    f"track.{field.name}={getattr(TRACK, field.name)}"
    for field in fields(TRACK)
    if getattr(TRACK, field.name) != field.default
]
"""The same for the command line: no other small tracker need be compiled."""
CONFIG = Config(track=TRACK)
PLAN = track_plan(TRACK)


class Clip:
    """A rendered recording held in memory, whose frames a test may replace: a `Dataset`."""

    def __init__(self, source: SyntheticDataset, frames: Sequence[Frame], name: str = "clip") -> None:
        self.source, self.name, self.camera = source, name, source.camera
        self.ground_truth: Trajectory | None = source.ground_truth
        self.frames = list(frames)
        self.timestamps_ns = np.array([frame.timestamp_ns for frame in frames], np.int64)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]


@functools.cache
def _source(people: int, frames: int) -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=frames, people=people))


@functools.cache
def _frames(people: int, frames: int) -> tuple[Frame, ...]:
    source = _source(people, frames)
    with jax.enable_x64(False):  # the same pictures for tests in float64
        return tuple(source[index] for index in range(frames))


def clip(people: int = 0, frames: int = 60) -> Clip:
    """The first frames of the room, rendered once a process; the list of frames is the caller's own."""
    return Clip(_source(people, frames), _frames(people, frames))


def truth_from_start(trajectory: Trajectory) -> np.ndarray:
    """`(n, 4, 4)` true poses with the first one as the world, which is the world of the tracker."""
    matrices = pose_matrices(trajectory.T_world_cam)
    return np.linalg.inv(matrices[0]) @ matrices


def pose_matrices(wxyz_xyz: np.ndarray) -> np.ndarray:
    """`(n, 4, 4)` of `(n, 7)`."""
    w, x, y, z = (wxyz_xyz[:, :4] / np.linalg.norm(wxyz_xyz[:, :4], axis=1, keepdims=True)).T
    result = np.tile(np.eye(4), (len(wxyz_xyz), 1, 1))
    result[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    result[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    result[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    result[:, :3, 3] = wxyz_xyz[:, 4:]
    return result


def new_state(dtype: type[np.floating] = np.float32, image_dtype: type = np.uint8, seed: int = 0) -> TrackState:
    return init_state(HEIGHT, WIDTH, PLAN, seed=seed, image_dtype=jnp.dtype(image_dtype), dtype=jnp.dtype(dtype))


def params(dtype: type[np.floating] = np.float32) -> TrackParams:
    return track_params(_source(0, 60).camera, TRACK, dtype)


def stacked(
    frames: Sequence[Frame], dtype: type[np.floating] = np.float32, image_dtype: type = np.uint8
) -> FrameArrays:
    """Frames as arrays with the time as the first axis, as `lax.scan` takes them."""
    arrays = stack_frames(frames, frames[0].timestamp_ns - 33_333_000, dtype)
    return jax.tree.map(jnp.asarray, arrays._replace(image=arrays.image.astype(image_dtype)))


def at(frames: FrameArrays, index: int) -> FrameArrays:
    """One frame of those `stacked`."""
    return jax.tree.map(lambda array: array[index], frames)


def track_round_trip(slam: Slam, frames: Sequence[Frame], steps: int) -> None:
    """Track the frames forward and backward again and again, each later than the one before."""
    slam.reset()
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for index in range(steps):
        frame = frames[order[index % len(order)]]
        slam.track(type(frame)(index * 33_333_000, frame.image, frame.depth_m))


def resident_mb() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1e3
    raise AssertionError("no VmRSS in /proc/self/status")
