"""A rendered room by a camera that its file describes wrongly: focal length, rolling shutter, late and long depth."""

from dataclasses import replace

import jax
import numpy as np

from jaxslam.datasets.synthetic.camera_path import camera_path
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.datasets.synthetic.room import furnish
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig
from jaxslam.datasets.synthetic.shading import ROOM_LIGHT
from jaxslam.datasets.synthetic.virtual_camera import START_NS, Optics, Stage, VirtualCamera, frame_times_us, noise_key
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.trajectory.trajectory import Trajectory

TRUTH = Camera(
    "true", 320, 240, 262.5, 262.5, 159.5, 119.5,
    depth_scale_per_m=5000.0, readout_s=0.015, depth_offset_m=0.02, depth_delay_s=0.008,
)  # fmt: skip
"""The camera that films."""
FOCAL_ERROR = 1.05
STATED = replace(
    TRUTH, name="stated", fx=FOCAL_ERROR * TRUTH.fx, fy=FOCAL_ERROR * TRUTH.fy, readout_s=0.0, depth_offset_m=0.0,
    depth_delay_s=0.0,
)  # fmt: skip
"""The camera that its file describes."""


class MiscalibratedRoom:
    """A recording of an empty room by `TRUTH`, which says that it is by `STATED`.

    Attributes:
        camera: The stated camera.
        name: Its name.
        timestamps_ns: Times of the frames.
        ground_truth: True poses.
    """

    def __init__(
        self,
        seed: int,
        path: CameraPathKind = "rpy",
        frames: int = 120,
        sensor: SensorConfig | None = None,
        truth: Camera = TRUTH,
        stated: Camera = STATED,
    ) -> None:
        self.camera, self.name, self._truth = stated, f"miscalibrated_{path}_{seed}", truth
        elapsed_us = frame_times_us(frames, 30.0)
        self._time_s, self._seed, self._path = 1e-6 * elapsed_us, seed, path
        self.timestamps_ns = START_NS + 1000 * elapsed_us
        self.ground_truth = Trajectory(self.timestamps_ns, self._pose(self._time_s))
        sensor = sensor or SensorConfig()
        stage = Stage(furnish(seed), (), ROOM_LIGHT)
        film = lambda sensor, optics: VirtualCamera(stage, truth, sensor, self._pose, lambda _: 1.0, optics)
        self._color = film(sensor, Optics(truth.readout_s))
        self._depth = film(replace(sensor, exposure_samples=1), Optics())

    def _pose(self, time_s: np.ndarray) -> np.ndarray:
        return camera_path(self._path, time_s, self._seed)

    def __len__(self) -> int:
        return len(self._time_s)

    def __getitem__(self, index: int) -> Frame:
        index = range(len(self))[index]
        time_s, key = float(self._time_s[index]), noise_key(self._seed, index)
        rgb = self._color.take(time_s, key).rgb
        depth_m = self._depth.take(time_s + self._truth.depth_delay_s, jax.random.fold_in(key, 1)).depth_m
        longer = np.where(depth_m > 0, depth_m + np.float32(self._truth.depth_offset_m), np.float32(0))
        return Frame(int(self.timestamps_ns[index]), rgb, longer)
