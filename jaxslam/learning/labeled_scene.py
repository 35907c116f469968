"""Rendered scenes with what is true of them: where the camera is, and which pixels move."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.datasets.registry import open_dataset
from jaxslam.datasets.synthetic.dataset import SyntheticConfig, SyntheticDataset
from jaxslam.errors import DatasetError
from jaxslam.learning.weights_recipe import RoomScene, StillScene, WorldScene
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays, stack_frames
from jaxslam.worlds.library import load_world
from jaxslam.worlds.stored_world import StoredWorld, why_not_here

_MAX_GAP_S = 0.2
"""Largest time between a frame and the true pose that it is given."""


@dataclass(frozen=True)
class LabeledScene:
    """A clip of `t` frames with true labels.

    Attributes:
        name: Name of the scene.
        camera: Camera that takes the frames.
        clip: Frames, stacked along a first axis, in NumPy.
        moving: `(t, h, w)` which pixels show something that moves.
        T_world_cam: `(t, 7)` true poses of the camera, `wxyz_xyz`.
    """

    name: str
    camera: Camera
    clip: FrameArrays
    moving: Bool[np.ndarray, "t h w"]
    T_world_cam: Float[np.ndarray, "t 7"]

    def part(self, start: int, stop: int) -> FrameArrays:
        """Return the frames from one to before another; the last one is repeated past the end."""
        index = np.minimum(np.arange(start, stop), len(self.moving) - 1)
        fields = (None if array is None else array[index] for array in self.clip)
        return FrameArrays(*fields)  # pyright: ignore[reportArgumentType]


def render_room(room: RoomScene, num_frames: int) -> LabeledScene:
    """Render frames of a room. Its people and boxes never rest."""
    last = room.start + (num_frames - 1) * room.every
    source = SyntheticDataset(
        SyntheticConfig(
            seed=room.seed,
            frames=last + 1,
            path=room.path,
            people=room.people,
            boxes=room.boxes,
            width=room.width,
            height=room.width * 3 // 4,
            fx=room.focal * room.width,
        )
    )
    rendered = [source.render(index) for index in range(room.start, last + 1, room.every)]
    moving = np.stack([frame.instance_mask > 0 for frame in rendered])
    poses = np.stack([frame.T_world_cam for frame in rendered])
    return _labeled(source.name, source.camera, (frame.measured for frame in rendered), moving, poses)


def render_world(scene: WorldScene, num_frames: int) -> LabeledScene | None:
    """Render frames of a world, or take them from the cache; `None` where the data that it names are not there.

    Raises:
        ConfigError: If there is no such world.
        DatasetError: If its recording cannot be read.
    """
    world = load_world(scene.world)
    if why_not_here(world) is not None:
        return None
    width, height = scene.width, scene.width * 3 // 4
    focal = scene.focal * width
    camera = replace(world.camera, width=width, height=height, fx=focal, fy=None, cx=None, cy=None)
    source = StoredWorld(replace(world, camera=camera))
    indices = [scene.start + number * scene.every for number in range(num_frames)]
    rendered = [source.render(index) for index in indices if index < len(source)]
    moving = np.stack([frame.moving_mask for frame in rendered])
    poses = np.stack([frame.T_world_cam for frame in rendered])
    return _labeled(scene.world, source.camera, (frame.measured for frame in rendered), moving, poses)


def open_still(scene: StillScene, num_frames: int) -> LabeledScene | None:
    """Read frames of a real recording in which nothing moves; `None` where it is not there.

    Raises:
        DatasetError: If the recording cannot be read, or its ground truth does not cover the frames.
        CameraError: If its camera is not known.
    """
    base = os.environ.get("JAXSLAM_DATA")
    if base is None or not (Path(base) / scene.recording).is_dir():
        return None
    source = open_dataset(Path(base) / scene.recording)
    if source.ground_truth is None:
        raise DatasetError(f"{scene.recording}: expected a ground truth, got none")
    indices = [scene.start + number * scene.every for number in range(num_frames)]
    frames = [source[index] for index in indices if index < len(source)]
    times = np.array([frame.timestamp_ns for frame in frames])
    truth = source.ground_truth
    nearest = np.abs(truth.timestamps_ns[None, :] - times[:, None]).argmin(axis=1)
    apart_s = 1e-9 * float(np.abs(truth.timestamps_ns[nearest] - times).max())
    if apart_s > _MAX_GAP_S:
        raise DatasetError(
            f"{scene.recording}: expected a true pose within {_MAX_GAP_S} s of every frame, got {apart_s:.3f} s"
        )
    moving = np.zeros((len(frames), source.camera.height, source.camera.width), bool)
    poses = truth.T_world_cam[nearest]
    return _labeled(Path(scene.recording).name, source.camera, iter(frames), moving, poses)


def _labeled(name: str, camera: Camera, frames: Iterator[Frame], moving: np.ndarray, poses: np.ndarray) -> LabeledScene:
    return LabeledScene(f"{name}_{camera.width}", camera, stack_frames(list(frames)), moving, poses)
