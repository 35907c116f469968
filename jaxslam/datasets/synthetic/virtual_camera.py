"""A camera in a rendered scene: what it measures at any time, and the exact picture behind it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.datasets.synthetic import homogeneous as rigid
from jaxslam.datasets.synthetic.actors import Actor
from jaxslam.datasets.synthetic.primitives import PlacedSolid
from jaxslam.datasets.synthetic.render import CameraView, Rendering, pack_scene, render
from jaxslam.datasets.synthetic.sensor_noise import SensorConfig, measure, sensor_params
from jaxslam.datasets.synthetic.shading import Light
from jaxslam.sensors.camera import Camera

START_NS = 1_600_000_000_000_000_000
"""Time of the first frame of every rendered recording."""


def frame_times_us(num_frames: int, fps: float) -> np.ndarray:
    """Return the times of frames since the first, `(n,)` int64 microseconds: six decimals of a second hold them."""
    return np.round(np.arange(num_frames) * (1e6 / fps)).astype(np.int64)


def automatic_gain(time_s: float, swing: float, phases: np.ndarray) -> float:
    """Return the factor of brightness of an automatic exposure that wanders by `swing`, with two `phases`."""
    waves = np.sin(2.0 * np.pi * time_s / np.array([9.0, 5.3]) + phases)
    return float(1.0 + swing * (0.7 * waves[0] + 0.3 * waves[1]))


class Stage:
    """Everything that can be seen, packed for rendering.

    Attributes:
        scene: The solids and the light.
    """

    def __init__(
        self,
        static: Sequence[PlacedSolid],
        actors: Sequence[Actor],
        light: Light,
        *,
        static_numbers: Sequence[int] | None = None,
        actor_numbers: Sequence[int] | None = None,
    ) -> None:
        """Pack solids.

        Args:
            static: What stands still; first a box around everything, seen from inside.
            actors: What moves.
            light: Light of the scene.
            static_numbers: Number of each of `static` in masks; by default 0.
            actor_numbers: Number of each actor in masks; by default 1, 2 and so on.
        """
        self._actors = tuple(actors)
        numbers = [0] * len(static) if static_numbers is None else list(static_numbers)
        for number, actor in zip(actor_numbers or range(1, len(actors) + 1), actors, strict=True):
            numbers += [number] * len(actor.solids)
        solids = [placed.solid for placed in static] + [solid for actor in actors for solid in actor.solids]
        self.scene, self._slots = pack_scene(solids, numbers, light)
        self._static_from_world = rigid.inverse(np.stack([placed.T_world_solid for placed in static]))

    def solid_from_cam(self, time_s: np.ndarray, world_from_cam: np.ndarray) -> np.ndarray:
        """Return transforms to the solids for `(t, 4, 4)` places of a camera at `(t,)` times: `(t, slots, 3, 4)`."""
        from_world = [np.broadcast_to(self._static_from_world, (len(time_s), *self._static_from_world.shape))]
        for actor in self._actors:
            root = rigid.matrix_from_pose(actor.root(time_s))
            from_world.append(rigid.inverse(root[:, None] @ actor.parts(time_s)))
        transforms = np.zeros((len(time_s), len(self.scene.owner), 3, 4), np.float32)
        transforms[:] = np.eye(4)[:3]
        transforms[:, self._slots] = (np.concatenate(from_world, axis=1) @ world_from_cam[:, None])[:, :, :3]
        return transforms


class TakenPicture(NamedTuple):
    """A picture as measured, and the exact one of its moment.

    Attributes:
        exact: Depth, owners and color of the middle of the exposure.
        rgb: `(height, width, 3)` uint8.
        depth_m: `(height, width)` float32, 0 where missing.
        right: `(height, width, 3)` uint8 of the right camera of a pair; `None` without one.
    """

    exact: Rendering
    rgb: np.ndarray
    depth_m: np.ndarray
    right: np.ndarray | None = None


class VirtualCamera:
    """Takes pictures of a stage, with the faults of a real camera."""

    def __init__(
        self,
        stage: Stage,
        camera: Camera,
        sensor: SensorConfig,
        pose_at: Callable[[np.ndarray], np.ndarray],
        gain_at: Callable[[float], float],
    ) -> None:
        """Set up a camera.

        Args:
            stage: What is to be seen.
            camera: Size and intrinsics, without distortion.
            sensor: The faults.
            pose_at: `(t, 7)` poses `T_world_cam`, wxyz_xyz, at `(t,)` seconds since the start.
            gain_at: Factor of brightness at a time.
        """
        self._stage, self._camera, self._sensor = stage, camera, sensor
        self._pose_at, self._gain_at = pose_at, gain_at

    def take(self, time_s: float, key: jax.Array) -> TakenPicture:
        """Take a picture, or both of a pair.

        Args:
            time_s: Middle of the exposure, seconds since the start.
            key: Random key of the noise.
        """
        left, baseline_m = self._take(time_s, key, 0.0), self._camera.baseline_m
        if baseline_m is None:
            return left
        return left._replace(right=self._take(time_s, jax.random.fold_in(key, 1), baseline_m).rgb)

    def _take(self, time_s: float, key: jax.Array, to_the_right_m: float) -> TakenPicture:
        moments = self._expose(time_s, to_the_right_m)
        own = moments[len(moments) // 2]
        colors, sensor = tuple(moment.color for moment in moments), sensor_params(self._sensor)
        gain = self._gain_at(time_s)
        channels, depth_m = measure(colors, own.depth_m, own.incidence, self._camera.fx, gain, sensor, key)
        # XLA needs as long to interleave the channels as to render a moment.
        return TakenPicture(own, cv2.merge(list(np.asarray(channels))), np.asarray(depth_m))

    def _expose(self, time_s: float, to_the_right_m: float) -> list[Rendering]:
        """The moments of one exposure, evenly in time, each on its own row and column within the pixel."""
        n = self._sensor.exposure_samples
        rank = np.arange(n)
        centered = (rank + 0.5) / n - 0.5
        offsets = np.stack([centered, centered[(2 * rank + (n + 1) // 2) % n]], axis=1)
        views = self._views(time_s + self._sensor.exposure_s * centered, offsets, to_the_right_m)
        height, width = self._camera.height, self._camera.width
        return [render(self._stage.scene, view, height=height, width=width) for view in views]

    def _views(self, time_s: np.ndarray, offsets: np.ndarray, to_the_right_m: float) -> list[CameraView]:
        world_from_cam = rigid.matrix_from_pose(self._pose_at(time_s))
        world_from_cam[:, :3, 3] += to_the_right_m * world_from_cam[:, :3, 0]
        solid_from_cam = self._stage.solid_from_cam(time_s, world_from_cam)
        camera = self._camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        return [
            CameraView(*map(jnp.asarray, (solids, place[:3].astype(np.float32), intrinsics, offset.astype(np.float32))))
            for solids, place, offset in zip(solid_from_cam, world_from_cam, offsets, strict=True)
        ]
