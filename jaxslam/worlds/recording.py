"""A recording of a world: any frame of it, with exact ground truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxslam.datasets.synthetic.dataset import DEPTH_COUNTS_PER_M
from jaxslam.datasets.synthetic.primitives import PlacedSolid
from jaxslam.datasets.synthetic.render import BACKDROP
from jaxslam.datasets.synthetic.sensor_noise import LensParams, scaled_sensor
from jaxslam.datasets.synthetic.shading import Light
from jaxslam.datasets.synthetic.virtual_camera import (
    START_NS,
    Optics,
    Stage,
    TakenPicture,
    VirtualCamera,
    automatic_gain,
    frame_times_us,
    noise_key,
)
from jaxslam.errors import ConfigError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.imu import ImuSamples
from jaxslam.trajectory.trajectory import Trajectory
from jaxslam.worlds.building import build
from jaxslam.worlds.camera_way import camera_way
from jaxslam.worlds.description import World, focal_px
from jaxslam.worlds.expansion import expanded
from jaxslam.worlds.imu import record_imu
from jaxslam.worlds.library import load_world, with_catalog, with_places
from jaxslam.worlds.real_people import LABEL, PeopleCutter

_FLAT_M = 0.051
"""Half the thickness of floors and ceilings, and a little."""


@dataclass(frozen=True)
class WorldFrame:
    """One frame with all that is known about it.

    Attributes:
        timestamp_ns: Time of the middle of the exposure.
        rgb: `(height, width, 3)` uint8, as measured; where the camera has a fault, what it delivers.
        depth_m: `(height, width)` float32 depth as measured by a camera that does; 0 where missing.
        exact_depth_m: `(height, width)` float32 depth at the centers of the pixels; 0 on the backdrop. On real people
            it is the measured depth of their recording, 0 where that is missing.
        instance_mask: `(height, width)` int32 numbers of things and people; 0 on rooms and the backdrop. Real people
            have the last number, one for all, and count as moving.
        moving_mask: `(height, width)` bool, true on what moves in this frame.
        T_world_cam: `(7,)` float64 pose of the camera, wxyz_xyz.
        T_world_instance: `(n, 7)` float64 poses of things and people, wxyz_xyz; number `k` is in row `k - 1`.
            NaN for real people, whose poses nobody knows.
        right: `(height, width, 3)` uint8, what the right camera of a pair measured; `None` without one.
        imu: Samples of the IMU since the frame before; `None` without one.
    """

    timestamp_ns: int
    rgb: np.ndarray
    depth_m: np.ndarray
    exact_depth_m: np.ndarray
    instance_mask: np.ndarray
    moving_mask: np.ndarray
    T_world_cam: np.ndarray
    T_world_instance: np.ndarray
    right: np.ndarray | None = None
    imu: ImuSamples | None = None

    @property
    def mask_images(self) -> dict[str, np.ndarray]:
        """Numbers of what moves, and of all things and people, for files, `(height, width)` uint16."""
        numbers = self.instance_mask.astype(np.uint16)
        return {"mask": np.where(self.moving_mask, numbers, np.uint16(0)), "instance": numbers}

    @property
    def measured(self) -> Frame:
        """Return what a camera would deliver: no mask of moving objects, and no depth for a stereo pair."""
        depth_m = self.depth_m if self.right is None else None
        return Frame(self.timestamp_ns, self.rgb, depth_m, right=self.right, imu=self.imu)


class WorldRecording:
    """A recording of a world, rendered when a frame is asked for: a dataset as `open_dataset` returns.

    Two recordings of the same world give the same bytes on the same machine, in any order of frames.

    Attributes:
        world: The world.
        name: Name of the recording.
        camera: The camera that takes it.
        timestamps_ns: `(n,)` int64 times of the frames.
        ground_truth: Trajectory of the camera.
        labels: Class label of each thing and person; that of number `k` is `labels[k - 1]`.
        movable: Whether each can move.
        imu: Data sheet of the IMU, with the place of the camera on it; `None` without one.
        imu_samples: All its samples, from the first frame or before to the last or after; `None` without one.
        imu_states: What is true of it at the times of the frames; `None` without one.
    """

    def __init__(self, world: World | str | Path) -> None:
        """Build a world.

        Args:
            world: A world, the name of one that comes with jaxslam, or a YAML file.

        Raises:
            ConfigError: If there is no such world, or something in its description is wrong.
            TrajectoryError: If the file of its way cannot be read.
            DatasetError: If samples of its IMU, or the recording of its real people, cannot be read.
            ModelError: If the network that cuts real people out cannot be read.
        """
        self.name = "world" if isinstance(world, World) else Path(world).stem
        self.world = world = world if isinstance(world, World) else load_world(world)
        filmed = world.camera
        fx = focal_px(filmed)
        self.camera = Camera(
            self.name,
            filmed.width,
            filmed.height,
            fx,
            fx if filmed.fy is None else filmed.fy,
            0.5 * (filmed.width - 1) if filmed.cx is None else filmed.cx,
            0.5 * (filmed.height - 1) if filmed.cy is None else filmed.cy,
            depth_scale_per_m=None if filmed.baseline_m else DEPTH_COUNTS_PER_M,
            fps=filmed.fps,
            baseline_m=filmed.baseline_m and world.scale * filmed.baseline_m,
        )
        num_frames = max(round(world.seconds * filmed.fps), 1)
        elapsed_us = frame_times_us(num_frames, filmed.fps)
        self._numbers = np.flatnonzero(~self._has_fault("missing", 1e-6 * elapsed_us))
        elapsed_us = elapsed_us[self._numbers]
        if not len(elapsed_us):
            raise ConfigError("World.faults: expected some frames that are not missing, got none")
        self._time_s, self.timestamps_ns = 1e-6 * elapsed_us, START_NS + 1000 * elapsed_us
        whole = expanded(with_catalog(with_places(world)))
        self._way = camera_way(whole)
        self.ground_truth = Trajectory(self.timestamps_ns, self._way.poses(self._time_s))
        self.imu, self.imu_samples, self.imu_states = record_imu(whole, self._way, self.timestamps_ns)
        self._built = built = build(whole, self._way.poses)
        self.instances = tuple(built.instances)
        self.labels = tuple(instance.label for instance in built.instances)
        self.movable = tuple(instance.movable for instance in built.instances)
        self._real_people = None
        if world.real_people is not None:
            self._real_people = PeopleCutter(world.real_people, self.camera, world.seconds, world.scale)
            self.labels, self.movable = (*self.labels, LABEL), (*self.movable, True)
        numbers = {"static_numbers": built.static_numbers, "actor_numbers": built.actor_numbers}
        sensor = scaled_sensor(filmed.sensor, world.scale)
        self._stage = Stage(built.static, built.actors, self._light, **numbers)
        ideal = filmed.gamma == 1.0 and filmed.vignetting == 0.0
        optics = Optics(filmed.rolling_shutter_s, None if ideal else LensParams(filmed.vignetting, filmed.gamma))
        self._filming = VirtualCamera(self._stage, self.camera, sensor, self._way.poses, self._gain, optics)
        self._poses = np.full((len(self.labels), 7), np.nan)
        for row, instance in enumerate(built.instances):
            self._poses[row] = instance.poses(np.zeros(1))[0]
        # Real people move.
        self._moves = np.arange(len(self.labels) + 1) > len(built.instances)
        self._gain_phases = np.random.default_rng([world.seed, 601]).uniform(0.0, 2.0 * np.pi, 2)

    def __len__(self) -> int:
        return len(self._time_s)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index` as a camera would deliver it: without a mask of what moves."""
        return self.render(index).measured

    def render(self, index: int) -> WorldFrame:
        """Frame `index` with its ground truth.

        Raises:
            IndexError: If there is no such frame.
        """
        index = range(len(self))[index]
        now, source = self._time_s[index : index + 1], self._source(index)
        taken = self._take(index)
        delivered = taken if source == index else self._take(source)
        rgb, right = delivered.rgb, delivered.right
        depth_m = _without_backdrop(delivered.depth_m, delivered)
        if self._has_fault("black", now)[0]:
            rgb, depth_m = np.zeros_like(rgb), np.zeros_like(depth_m)
            right = None if right is None else np.zeros_like(right)
        instance_mask = np.maximum(taken.exact.owner, 0)
        moves, poses = self._moves.copy(), self._poses.copy()
        for number, instance in enumerate(self.instances, 1):
            if not instance.rests:
                moves[number], poses[number - 1] = instance.is_moving(now)[0], instance.poses(now)[0]
        return WorldFrame(
            timestamp_ns=int(self.timestamps_ns[index]),
            rgb=rgb,
            depth_m=depth_m,
            exact_depth_m=_without_backdrop(taken.exact.depth_m, taken),
            instance_mask=instance_mask,
            moving_mask=moves.take(instance_mask),
            T_world_cam=self.ground_truth.T_world_cam[index].copy(),
            T_world_instance=poses,
            right=right,
            imu=self._imu_of(index),
        )

    def _imu_of(self, index: int) -> ImuSamples | None:
        if self.imu_samples is None:
            return None
        return self.imu_samples.since_last_frame(self.timestamps_ns, index, self.camera.fps)

    def _take(self, index: int) -> TakenPicture:
        time_s = float(self._time_s[index])
        # Not made before: arrays start JAX.
        taken = self._filming.take(time_s, noise_key(self.world.seed, int(self._numbers[index])))
        if self._real_people is None:
            return taken
        return self._real_people.set_into(taken, time_s, len(self.labels))

    def _source(self, index: int) -> int:
        """Return the frame whose picture is delivered: an earlier one where the camera is frozen."""
        while index > 0 and self._has_fault("frozen", self._time_s[index : index + 1])[0]:
            index -= 1
        return index

    def _has_fault(self, pictures: str, time_s: np.ndarray) -> np.ndarray:
        """Tell at which of `(t,)` times the camera has a fault of this kind."""
        has_fault = np.zeros(len(time_s), bool)
        for fault in self.world.faults:
            if fault.pictures == pictures:
                has_fault |= (time_s >= fault.from_s) & (time_s < fault.until_s)
        return has_fault

    def footprints(self) -> list[tuple[np.ndarray, bool]]:
        """Outlines of what stands still, from above: corners `(4, 2)` in meters, and whether it belongs to a thing.

        Floors, ceilings and the backdrop are left out.
        """
        return [
            (_outline(placed), number > 0)
            for placed, number in zip(self._built.static, self._built.static_numbers, strict=True)
            if number > 0 or (number == 0 and placed.solid.size[2] > _FLAT_M)
        ]

    def labels_text(self) -> str:
        """Number, class label, and whether it can move, of each thing and person: lines of a file."""
        rows = zip(self.labels, self.movable, strict=True)
        lines = [f"{number} {int(movable)} {label}" for number, (label, movable) in enumerate(rows, 1)]
        return "\n".join(["# number movable label", *lines]) + "\n"

    def _light(self, time_s: float) -> Light:
        """Light at a time, without its flicker."""
        lights = self._built.lights
        light = lights[0]
        for change, later in zip(self.world.light_changes, lights[1:], strict=True):
            if time_s >= change.at_s:
                share = 1.0 if change.over_s == 0.0 else min((time_s - change.at_s) / change.over_s, 1.0)
                light = light.blended(later, share)
        return light

    def _gain(self, time_s: float) -> float:
        """Factor of brightness: what the exposure says, an automatic one that wanders, and lamps that flicker."""
        wander = automatic_gain(time_s, self.world.camera.sensor.gain_swing, self._gain_phases)
        times, factors = [0.0], [1.0]
        for change in self.world.exposure:
            times += [change.at_s, change.at_s + change.over_s]
            factors += [factors[-1], change.factor]
        return float(wander * self._flicker(time_s) * np.interp(time_s, times, factors))

    def _flicker(self, time_s: float) -> float:
        """Factor of the light of lamps that flicker, on average over an exposure."""
        lighting = self.world.lighting
        for change in self.world.light_changes:
            lighting = change.light if time_s >= change.at_s else lighting
        over_exposure = np.sinc(lighting.flicker_hz * self.world.camera.sensor.exposure_s)
        return float(1.0 + lighting.flicker * over_exposure * np.sin(2.0 * np.pi * lighting.flicker_hz * time_s))


def _outline(placed: PlacedSolid) -> np.ndarray:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * placed.solid.size[:2]
    return corners @ placed.T_world_solid[:2, :2].T + placed.T_world_solid[:2, 3]


def _without_backdrop(depth_m: np.ndarray, taken: TakenPicture) -> np.ndarray:
    """Depth `(height, width)`, 0 where the picture shows nothing but the backdrop."""
    kept = depth_m.copy()
    kept[taken.exact.owner == BACKDROP] = 0.0
    return kept
