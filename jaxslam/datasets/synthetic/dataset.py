"""The synthetic recording: any frame of it, at any time, from a configuration and a seed."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from jaxslam.config.validation import Range, ValidatedConfig
from jaxslam.datasets.synthetic.actors import cast
from jaxslam.datasets.synthetic.camera_path import CameraPathKind, camera_path
from jaxslam.datasets.synthetic.parked_boxes import MAX_PARKED
from jaxslam.datasets.synthetic.room import furnish
from jaxslam.datasets.synthetic.seated_people import MAX_SEATED, chairs
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig
from jaxslam.datasets.synthetic.shading import ROOM_LIGHT
from jaxslam.datasets.synthetic.virtual_camera import (
    START_NS,
    Stage,
    VirtualCamera,
    automatic_gain,
    frame_times_us,
    noise_key,
)
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.trajectory.trajectory import Trajectory

DEPTH_COUNTS_PER_M = 5000.0
"""Of depth images in files, as in TUM RGB-D."""


@dataclass(frozen=True)
class SyntheticConfig(ValidatedConfig):
    """Settings of a synthetic recording. Frame `i` does not depend on the number of frames.

    Attributes:
        seed: Chooses textures, clothes, where things lie, the phases of all motions, and the noise.
        frames: Number of frames.
        path: Path of the camera; see `camera_path.CameraPathKind`. `loop` comes back after 32 s.
        people: Number of walking people: actors 1 to `people`. Two or three at times fill half of the picture.
        boxes: Number of carried boxes: the actors after the people.
        seated: Number of people who sit at the ends of the desk and move a little, as in the `sitting` recordings of
            TUM RGB-D: the actors after the boxes. Their chairs are static.
        parked: Number of boxes that stand for five seconds, are pushed for five, and so on: the last actors.
        width: Pixels of a row.
        height: Pixels of a column.
        fps: Frames a second.
        fx: Focal length along a row in pixels; `None` for `525 * width / 640`.
        fy: Focal length along a column in pixels; `None` for the same as `fx`.
        cx: Principal point in pixels; `None` for the middle of the image.
        cy: Principal point in pixels; `None` for the middle of the image.
        baseline_m: Baseline of a rectified stereo pair, in meters; `None` for a camera that measures depth.
        sensor: The faults of the camera, of both if there are two.

    Raises:
        ConfigError: A field has the wrong type or is out of range.
    """

    seed: Annotated[int, Range(at_least=0, below=2**31)] = 0
    frames: Annotated[int, Range(at_least=1)] = 300
    path: CameraPathKind = "xyz"
    people: Annotated[int, Range(at_least=0, at_most=24)] = 2
    boxes: Annotated[int, Range(at_least=0, at_most=24)] = 0
    seated: Annotated[int, Range(at_least=0, at_most=MAX_SEATED)] = 0
    parked: Annotated[int, Range(at_least=0, at_most=MAX_PARKED)] = 0
    width: Annotated[int, Range(at_least=8, at_most=8192)] = 640
    height: Annotated[int, Range(at_least=8, at_most=8192)] = 480
    fps: Annotated[float, Range(above=0, at_most=1000)] = 30.0
    fx: Annotated[float, Range(above=0)] | None = None
    fy: Annotated[float, Range(above=0)] | None = None
    cx: float | None = None
    cy: float | None = None
    baseline_m: Annotated[float, Range(above=0, at_most=1)] | None = None
    sensor: SensorConfig = field(default_factory=SensorConfig)


@dataclass(frozen=True)
class SyntheticFrame:
    """One frame with all that is known about it.

    Attributes:
        timestamp_ns: Time of the middle of the exposure.
        rgb: `(height, width, 3)` uint8, as measured.
        depth_m: `(height, width)` float32 depth as measured by a camera that does; 0 where missing.
        exact_depth_m: `(height, width)` float32 depth at the pixels' centers; never missing.
        instance_mask: `(height, width)` int32; 0 on static things, otherwise the number of the actor.
        T_world_cam: `(7,)` float64 camera pose, wxyz_xyz.
        T_world_actor: `(actors, 7)` float64 poses of the actors, wxyz_xyz; that of actor `k` is in row `k - 1`.
        right: `(height, width, 3)` uint8, what the right camera of a pair measured; `None` without one.
    """

    timestamp_ns: int
    rgb: np.ndarray
    depth_m: np.ndarray
    exact_depth_m: np.ndarray
    instance_mask: np.ndarray
    T_world_cam: np.ndarray
    T_world_actor: np.ndarray
    right: np.ndarray | None = None

    @property
    def mask_images(self) -> dict[str, np.ndarray]:
        """Numbers of the actors for a file, `(height, width)` uint8."""
        return {"mask": self.instance_mask.astype(np.uint8)}

    @property
    def measured(self) -> Frame:
        """Return what a camera would deliver: no mask of moving objects, and no depth for a stereo pair."""
        return Frame(self.timestamp_ns, self.rgb, self.depth_m if self.right is None else None, right=self.right)


class SyntheticDataset:
    """A recording of a furnished room with walking people, rendered when a frame is asked for.

    Two datasets of the same configuration give the same bytes on the same machine, in any order of frames.

    Args:
        config: Settings of the recording; everything has a default.
    """

    def __init__(self, config: SyntheticConfig | None = None) -> None:
        self.config = config = config or SyntheticConfig()
        seated = f"_{config.seated}seated" if config.seated else ""
        parked = f"_{config.parked}parked" if config.parked else ""
        pair = "_stereo" if config.baseline_m else ""
        actors = f"{config.people}people_{config.boxes}boxes{seated}{parked}"
        self.name = f"synthetic_{config.path}_{actors}{pair}_seed{config.seed}"
        self.width, self.height, self.fps = config.width, config.height, config.fps
        self.fx = 525.0 * config.width / 640.0 if config.fx is None else config.fx
        self.fy = self.fx if config.fy is None else config.fy
        self.cx = 0.5 * (config.width - 1) if config.cx is None else config.cx
        self.cy = 0.5 * (config.height - 1) if config.cy is None else config.cy
        elapsed_us = frame_times_us(config.frames, config.fps)
        self.timestamps_ns = START_NS + 1000 * elapsed_us
        self._time_s = 1e-6 * elapsed_us
        self.ground_truth = Trajectory(self.timestamps_ns, camera_path(config.path, self._time_s, config.seed))
        self.T_world_cam = self.ground_truth.T_world_cam
        self.camera = Camera(
            self.name,
            self.width,
            self.height,
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            depth_scale_per_m=None if config.baseline_m else DEPTH_COUNTS_PER_M,
            fps=self.fps,
            baseline_m=config.baseline_m,
        )
        self.actors = cast(config.path, config.people, config.boxes, config.seated, config.parked, config.seed)
        self.labels = tuple(actor.label for actor in self.actors)
        static = furnish(config.seed) + chairs(config.seated, config.seed)
        self._stage = Stage(static, self.actors, ROOM_LIGHT)
        self._filming = VirtualCamera(self._stage, self.camera, config.sensor, self._pose, self._gain)

    def __len__(self) -> int:
        return self.config.frames

    def __getitem__(self, index: int) -> Frame:
        """Frame `index` as a camera would deliver it: without a mask of what moves."""
        return self.render(index).measured

    def render(self, index: int) -> SyntheticFrame:
        """Frame `index` with its ground truth.

        Raises:
            IndexError: If there is no such frame.
        """
        index = range(len(self))[index]
        time_s = float(self._time_s[index])
        # Not made before: arrays start JAX.
        taken = self._filming.take(time_s, noise_key(self.config.seed, index))
        return SyntheticFrame(
            timestamp_ns=int(self.timestamps_ns[index]),
            rgb=taken.rgb,
            depth_m=taken.depth_m,
            exact_depth_m=taken.exact.depth_m,
            instance_mask=taken.exact.owner,
            T_world_cam=self.T_world_cam[index].copy(),
            T_world_actor=self.T_world_actor(np.array([time_s]))[0],
            right=taken.right,
        )

    def T_world_actor(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the actors at `(t,)` seconds since the start: `(t, actors, 7)` float64, wxyz_xyz."""
        poses = [actor.root(time_s) for actor in self.actors]
        return np.stack(poses, axis=1) if poses else np.zeros((len(time_s), 0, 7))

    def _pose(self, time_s: np.ndarray) -> np.ndarray:
        return camera_path(self.config.path, time_s, self.config.seed)

    def _gain(self, time_s: float) -> float:
        phases = np.random.default_rng([self.config.seed, 400]).uniform(0.0, 2.0 * np.pi, 2)
        return automatic_gain(time_s, self.config.sensor.gain_swing, phases)
