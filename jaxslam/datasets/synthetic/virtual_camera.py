"""A camera in a rendered scene: what it measures at any time, and the exact picture behind it."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import cv2
import jax
import numpy as np

from jaxslam.datasets.synthetic import homogeneous as rigid
from jaxslam.datasets.synthetic.actors import Actor
from jaxslam.datasets.synthetic.culling import Candidates, Tiling
from jaxslam.datasets.synthetic.primitives import PlacedSolid
from jaxslam.datasets.synthetic.render import (
    CameraView,
    Rendering,
    RenderScene,
    arrange_scene,
    find_candidates,
    pack_solids,
    render,
    untiled,
)
from jaxslam.datasets.synthetic.sensor_noise import (
    LensParams,
    SensorConfig,
    depth_params,
    measure_color,
    measure_depth,
)
from jaxslam.datasets.synthetic.shading import Light
from jaxslam.runtime.freed_memory import keep_freed_memory
from jaxslam.runtime.threads import start_with_one_thread, usable_cores
from jaxslam.sensors.camera import Camera

START_NS = 1_600_000_000_000_000_000
"""Time of the first frame of every rendered recording."""


def frame_times_us(num_frames: int, fps: float) -> np.ndarray:
    """Return the times of frames since the first, `(n,)` int64 microseconds: six decimals of a second hold them."""
    return np.round(np.arange(num_frames) * (1e6 / fps)).astype(np.int64)


def noise_key(seed: int, number: int) -> jax.Array:
    """Return the random key of the noise of a frame, by its number.

    Often the first array of a process, with which XLA begins. It does with one thread, as a `Slam` would ask for, since
    parts of pictures have threads of their own: with two of XLA as well, a pair of a road takes 142 ms instead of 118.
    """
    start_with_one_thread()
    return jax.random.fold_in(jax.random.key(seed), number)


def automatic_gain(time_s: float, swing: float, phases: np.ndarray) -> float:
    """Return the factor of brightness of an automatic exposure that wanders by `swing`, with two `phases`."""
    waves = np.sin(2.0 * np.pi * time_s / np.array([9.0, 5.3]) + phases)
    return float(1.0 + swing * (0.7 * waves[0] + 0.3 * waves[1]))


_SMALL_SCENE = 512
"""Solids up to which all are rendered, in sight or not."""
_SMALLEST_PX = 1.0
"""Radius below which a solid of a large scene is left out of the picture."""


class Stage:
    """Everything that can be seen, packed for rendering."""

    def __init__(
        self,
        static: Sequence[PlacedSolid],
        actors: Sequence[Actor],
        light: Light | Callable[[float], Light],
        *,
        static_numbers: Sequence[int] | None = None,
        actor_numbers: Sequence[int] | None = None,
    ) -> None:
        """Pack solids.

        Args:
            static: What stands still; first a box around everything, seen from inside.
            actors: What moves.
            light: Light of the scene, or that at a time.
            static_numbers: Number of each of `static` in masks; by default 0.
            actor_numbers: Number of each actor in masks; by default 1, 2 and so on.
        """
        self._actors = tuple(actors)
        self._light_at = light if callable(light) else lambda _: light
        numbers = [0] * len(static) if static_numbers is None else list(static_numbers)
        for number, actor in zip(actor_numbers or range(1, len(actors) + 1), actors, strict=True):
            numbers += [number] * len(actor.solids)
        solids = [placed.solid for placed in static] + [solid for actor in actors for solid in actor.solids]
        self._packed = pack_solids(solids, numbers)
        self._static_from_world = rigid.inverse(np.stack([placed.T_world_solid for placed in static]))
        self._centers = np.stack([placed.T_world_solid[:3, 3] for placed in static])
        extent_m = self._packed.size[: len(static)].copy()
        extent_m[:, 2] *= 1.0 + self._packed.stem[: len(static)]
        self._radii = np.linalg.norm(extent_m, axis=1)
        self._is_small = len(solids) <= _SMALL_SCENE

    @cached_property
    def whole(self) -> tuple[RenderScene, np.ndarray]:
        """All solids, and the slot of each; a small scene has them in every picture.

        Made for the first picture: arrays start JAX, and a tracker made before it still sets the number of threads.
        """
        return self._arranged(np.arange(len(self._packed.stem)), 0.0)

    def seen_from(
        self, time_s: np.ndarray, world_from_cam: np.ndarray, camera: Camera
    ) -> tuple[RenderScene, np.ndarray]:
        """Return the solids in sight of a camera that is at `(t, 4, 4)` places at `(t,)` times.

        The light is that of the middle one.

        Returns:
            The solids, and transforms to them from the camera, `(t, slots, 3, 4)` float32.
        """
        middle_s = float(time_s[len(time_s) // 2])
        if self._is_small:
            chosen, (scene, slots) = np.arange(len(self._packed.stem)), self.whole
            scene = scene._replace(light=jax.device_put(self._light_at(middle_s)))
        else:
            chosen = self._in_sight(world_from_cam, camera)
            scene, slots = self._arranged(chosen, middle_s)
        static = self._static_from_world[chosen[chosen < len(self._centers)]]
        # One product for all solids: a twentieth of the time of one for each.
        from_cam = [(static[:, :3].reshape(-1, 4) @ world_from_cam).reshape(len(time_s), -1, 3, 4)]
        for actor in self._actors:
            root = rigid.matrix_from_pose(actor.root(time_s))
            from_world = rigid.inverse(root[:, None] @ actor.parts(time_s))
            from_cam.append((from_world @ world_from_cam[:, None])[:, :, :3])
        transforms = np.zeros((len(time_s), len(scene.owner), 3, 4), np.float32)
        transforms[:] = np.eye(4)[:3]
        transforms[:, slots] = np.concatenate(from_cam, axis=1)
        return scene, transforms

    def _arranged(self, chosen: np.ndarray, time_s: float) -> tuple[RenderScene, np.ndarray]:
        capacity = _next_64 if self._is_small else _next_power_of_2
        return arrange_scene(self._packed, chosen, self._light_at(time_s), capacity)

    def _in_sight(self, world_from_cam: np.ndarray, camera: Camera) -> np.ndarray:
        """Indices of the static solids that are in the picture at one of the places, and of all that move."""
        cam_from_world = rigid.inverse(world_from_cam)
        x, y, z = np.moveaxis(self._centers @ np.swapaxes(cam_from_world[:, :3, :3], 1, 2), -1, 0)
        x, y, z = (each + cam_from_world[:, k, 3:] for k, each in enumerate((x, y, z)))
        in_sight = (z > -self._radii) & (self._radii * camera.fx > _SMALLEST_PX * z)
        for along, half in ((x, 0.5 * camera.width / camera.fx), (y, 0.5 * camera.height / camera.fy)):
            # Distance from the planes through the edges of the picture, for any principal point near its middle.
            slope = 1.1 * half
            in_sight &= np.abs(along) - slope * z < self._radii * np.hypot(1.0, slope)
        static = in_sight.any(axis=0)
        static[0] = True
        return np.concatenate([np.flatnonzero(static), np.arange(len(static), len(self._packed.stem))])


def _next_64(count: int) -> int:
    return 64 * -(-max(count, 1) // 64)


def _next_power_of_2(count: int) -> int:
    return 1 << max(count - 1, 63).bit_length()


class ExactPicture(NamedTuple):
    """Exact depth and owners of a picture in the middle of its exposure.

    Attributes:
        depth_m: `(height, width)` float32 depth along the optical axis; every ray hits something.
        owner: `(height, width)` int32, 0 on static things, `BACKDROP` on the backdrop, otherwise the number of the
            actor.
    """

    depth_m: np.ndarray
    owner: np.ndarray


class TakenPicture(NamedTuple):
    """A picture as measured, and the exact one of its moment.

    Attributes:
        exact: Depth and owners in the middle of the exposure.
        rgb: `(height, width, 3)` uint8.
        depth_m: `(height, width)` float32, 0 where missing.
        right: `(height, width, 3)` uint8 of the right camera of a pair; `None` without one.
    """

    exact: ExactPicture
    rgb: np.ndarray
    depth_m: np.ndarray
    right: np.ndarray | None = None


class Optics(NamedTuple):
    """Exposure of the rows and faults of the lens; by default, all rows at once and none.

    Attributes:
        rolling_shutter_s: Time from the exposure of the first row to that of the last; 0 for all at once.
        lens: Faults of the lens; `None` for none.
    """

    rolling_shutter_s: float = 0.0
    lens: LensParams | None = None


class VirtualCamera:
    """Takes pictures of a stage, with the faults of a real camera."""

    def __init__(
        self,
        stage: Stage,
        camera: Camera,
        sensor: SensorConfig,
        pose_at: Callable[[np.ndarray], np.ndarray],
        gain_at: Callable[[float], float],
        optics: Optics | None = None,
    ) -> None:
        """Set up a camera.

        Args:
            stage: What is to be seen.
            camera: Size and intrinsics, without distortion.
            sensor: The faults.
            pose_at: `(t, 7)` poses `T_world_cam`, wxyz_xyz, at `(t,)` seconds since the start.
            gain_at: Factor of brightness at a time.
            optics: How it exposes.
        """
        keep_freed_memory()
        self._optics = optics or Optics()
        self._stage, self._camera, self._sensor = stage, camera, sensor
        self._pose_at, self._gain_at = pose_at, gain_at

    def take(self, time_s: float, key: jax.Array) -> TakenPicture:
        """Take a picture, or both of a pair.

        Args:
            time_s: Middle of the exposure, seconds since the start; with a rolling shutter, of the middle row.
            key: Random key of the noise.
        """
        baseline_m = self._camera.baseline_m
        to_the_right_m = (0.0,) if baseline_m is None else (0.0, baseline_m)
        keys = [key, *(jax.random.fold_in(key, number) for number in range(1, len(to_the_right_m)))]
        scene, cameras = self._expose(time_s, to_the_right_m)
        middle, cores = len(cameras[0]) // 2, usable_cores()
        # What waits for pictures does so in threads of its own, so that no core does.
        with ThreadPoolExecutor(cores) as pool, ThreadPoolExecutor(1 + len(cameras) * cores) as sensors:
            renderers = [_Renderer(pool, scene, moments, self._camera) for moments in cameras]
            exact = renderers[0].submit(cameras[0][middle])
            depth = sensors.submit(self._depth, exact, key)
            colors = []
            for renderer, moments, its_key in zip(renderers, cameras, keys, strict=True):
                pictures = [exact if view is cameras[0][middle] else renderer.submit(view) for view in moments]
                by_part = zip(renderer.firsts, *pictures, strict=True)
                colors.append([sensors.submit(self._color, time_s, its_key, *part) for part in by_part])
            left, *right = (self._put_together(parts) for parts in colors)
            whole, depth_m = depth.result()
            return TakenPicture(whole, left, depth_m, *right)

    def _depth(self, picture: "_Parts", key: jax.Array) -> tuple[ExactPicture, np.ndarray]:
        camera, parts = self._camera, [part.result() for part in picture]
        depth_m, incidence, owner = (
            untiled(planes, camera.height, camera.width)
            for planes in zip(*((part.depth_m, part.incidence, part.owner) for part in parts), strict=True)
        )
        measured = measure_depth(depth_m, incidence, camera.fx, depth_params(self._sensor), key)
        return ExactPicture(depth_m, owner), np.asarray(measured)

    def _color(self, time_s: float, key: jax.Array, first: int, *moments: "Future[Rendering]") -> np.ndarray:
        """Measure some rows of tiles, those below the `first`."""
        size = {"height": self._camera.height, "width": self._camera.width}
        exposures = tuple(moment.result().color for moment in moments)
        gain = self._gain_at(time_s)
        if self._rolls:
            height, count = Tiling.of(**size).height, len(exposures[0])
            since_s = self._row_times(np.arange(first * height, (first + count) * height))
            gain = self._gain_of_rows(time_s + since_s).reshape(1, count, 1, height, 1)
        noise = self._sensor.image_noise
        return np.asarray(measure_color(exposures, first, gain, noise, key, self._optics.lens, **size))

    def _gain_of_rows(self, times_s: np.ndarray) -> np.ndarray:
        return np.array([self._gain_at(float(time_s)) for time_s in times_s])

    def _put_together(self, parts: "list[Future[np.ndarray]]") -> np.ndarray:
        """Picture `(height, width, 3)` of parts `(3, rows, columns, h, w)` below each other."""
        by_channel = zip(*(part.result() for part in parts), strict=True)
        # XLA needs as long to interleave the channels as to render a moment.
        return cv2.merge([untiled(channel, self._camera.height, self._camera.width) for channel in by_channel])

    def _expose(self, time_s: float, to_the_right_m: Sequence[float]) -> tuple[RenderScene, list[list[CameraView]]]:
        """The moments of one exposure, evenly in time, each on its own row and column within the pixel, by camera."""
        n = self._sensor.exposure_samples
        rank = np.arange(n)
        centered = (rank + 0.5) / n - 0.5
        offsets = np.stack([centered, centered[(2 * rank + (n + 1) // 2) % n]], axis=1)
        scene, views = self._views(time_s + self._sensor.exposure_s * centered, offsets, to_the_right_m)
        return scene, [views[k : k + n] for k in range(0, len(views), n)]

    def _row_times(self, rows: np.ndarray) -> np.ndarray:
        """Times of `(r,)` rows since that of the middle one, `(r,)`; a single 0 if all are taken at once."""
        share = rows / max(self._camera.height - 1, 1) - 0.5
        return self._optics.rolling_shutter_s * share if self._rolls else np.zeros(1)

    @property
    def _rolls(self) -> bool:
        return self._optics.rolling_shutter_s > 0.0

    def _views(
        self, time_s: np.ndarray, offsets: np.ndarray, to_the_right_m: Sequence[float]
    ) -> tuple[RenderScene, list[CameraView]]:
        """Return the scene in sight of cameras side by side, and their views at `(t,)` times, camera by camera."""
        camera, num_views = self._camera, len(time_s) * len(to_the_right_m)
        tiling = Tiling.of(camera.height, camera.width)
        since_s = self._row_times(np.arange(tiling.rows + 1) * tiling.height)
        times = np.tile((time_s[:, None] + since_s).ravel(), len(to_the_right_m))
        world_from_cam = rigid.matrix_from_pose(self._pose_at(times))
        aside_m = np.repeat(to_the_right_m, len(time_s) * len(since_s))
        world_from_cam[:, :3, 3] += aside_m[:, None] * world_from_cam[:, :3, 0]
        scene, solid_from_cam = self._stage.seen_from(times, world_from_cam, camera)
        by_view = solid_from_cam.reshape(num_views, len(since_s), *solid_from_cam.shape[1:])
        places = world_from_cam.reshape(num_views, len(since_s), 4, 4)[:, len(since_s) // 2, :3].astype(np.float32)
        intrinsics: Any = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        shifts = np.tile(offsets.astype(np.float32), (len(to_the_right_m), 1))
        arrays: Any = zip(by_view if self._rolls else by_view[:, 0], places, shifts, strict=True)
        return scene, [CameraView(solids, place, intrinsics, shift) for solids, place, shift in arrays]


_PART_PIXELS = 160_000
"""Pixels of a part of a picture at most. XLA clears planes of more than a megabyte, 262,000 pixels, in its pool of
threads, and the rest of a program stays in it, where programs wait for each other.
"""

_Parts: TypeAlias = "list[Future[Rendering]]"
"""Parts of a picture, rows of tiles below each other, that are being rendered."""


class _Renderer:
    """Renders what one camera sees over an exposure, on all processor cores: XLA renders one picture at a time."""

    def __init__(self, pool: ThreadPoolExecutor, scene: RenderScene, moments: list[CameraView], camera: Camera) -> None:
        """Find what is in sight.

        Args:
            pool: A thread for each core.
            scene: What is to be seen.
            moments: The views over the exposure.
            camera: Size of the picture.
        """
        self._pool, self._scene = pool, scene
        self._size = {"height": camera.height, "width": camera.width}
        tiling = Tiling.of(**self._size)
        self._rows = tiling.rows
        pixels = tiling.columns * tiling.height * tiling.width
        self._share = max(min(_PART_PIXELS // pixels, -(-tiling.rows // usable_cores())), 1)
        self._candidates = pool.submit(self._find, moments)

    @property
    def firsts(self) -> range:
        """First rows of tiles of the parts of a picture."""
        return range(0, self._rows, self._share)

    def submit(self, view: CameraView) -> _Parts:
        """Begin to render a view in parts, rows of tiles below each other."""
        # A program that is given large NumPy arrays runs in XLA's pool of threads, one after the other.
        view = jax.block_until_ready(jax.device_put(view))
        return [self._pool.submit(self._render_part, view, first) for first in self.firsts]

    def _find(self, moments: list[CameraView]) -> Candidates:
        solid_from_cam = np.stack([np.asarray(view.solid_from_cam) for view in moments])
        return find_candidates(self._scene, solid_from_cam, np.asarray(moments[0].intrinsics), **self._size)

    def _render_part(self, view: CameraView, first: int) -> Rendering:
        rows = min(self._share, self._rows - first)
        part = render(self._scene, view, self._candidates.result(), first, rows=rows, **self._size)
        return jax.block_until_ready(part)
