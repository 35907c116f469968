"""The dense map in the making, in a thread of its own: what keyframes see is put in, and moved when they are.

The tracker's thread hands over copies and goes on. At most so many keyframes wait; when more come, the oldest of them
is never looked at. Memory is bounded by the settings: the grids have a fixed size, and what is kept of keyframes is
dropped oldest first.
"""

import threading
from collections import deque
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np

from jaxslam.camera import Camera
from jaxslam.config import DenseConfig
from jaxslam.dense.cloud import DenseCloud
from jaxslam.dense.key_regions import Neighbour, Neighbours, object_boxes, points_inside
from jaxslam.dense.occupancy import Occupancy, occupancy
from jaxslam.dense.places import distance, poses_of
from jaxslam.dense.view import Looks, View
from jaxslam.dense.voxel_layer import Part, VoxelLayer
from jaxslam.errors import MapFileError
from jaxslam.frame_arrays import FrameArrays
from jaxslam.local_mapping import NewKeyframe
from jaxslam.map import NONE, Map, has
from jaxslam.map_link import pose_of
from jaxslam.map_movers import Movers
from jaxslam.pose import IDENTITY, angle, between, compose, moved
from jaxslam.semantics import Detector
from jaxslam.stage_times import StageTimes, Stopwatch
from jaxslam.state import TrackOutput
from jaxslam.stereo import DenseDepth
from jaxslam.worker import Worker, make_worker

_MOST_WAITING = 8
"""Keyframes that wait: 2.5 MB each at 640x480, and more than two seconds of a tracker that makes three a second."""
_VOXELS_DEEP = 300
"""Voxels from the camera to the farthest depth believed, if the settings do not give their side."""
_CELL_VOXELS = 2.5
_KEY_SHARE = 0.25
"""Side of the voxels of key objects, in others."""
_LEAST_MOVE_VOXELS = 0.25
"""A keyframe that moves a point by less, two metres away, stays where it is."""
_LOOK_EVERY = 5
"""Frames, of which one has its look at what is not there any more: with keyframes alone, twice as many ghosts stay.
A keyframe of a camera that measures depth has none of its own besides."""
_NUM_LOOKS = 4
"""Earlier keyframes that new points are compared with,"""
_NEAR_M, _NEAR_RAD = 1.5, 0.6
"""of those so near, and turned by so little."""
_DEPTH_COUNTS = 65535
_KEY_POINTS = 131_072
"""Points of key objects in a keyframe and its neighbours, at most."""


class DenseFigures(NamedTuple):
    """How the map was made.

    Attributes:
        keyframes: Put in.
        passed_over: Keyframes that were never looked at, because too many waited.
        frozen: Keyframes that are forgotten, whose points move no more.
        moved: Times that the points of a keyframe were moved with it.
        coarsened: Times that voxels became twice as large.
        measured: Pixels with depth to be believed in all keyframes put in, and in all parts of neighbours.
        working_mb: Memory in use, megabytes.
    """

    keyframes: int
    passed_over: int
    frozen: int
    moved: int
    coarsened: int
    measured: int
    working_mb: float


class _Shown(NamedTuple):
    """A keyframe handed over, copied.

    Attributes:
        keyframe: Its id.
        image: `(h, w, 3)` RGB or `(h, w)`.
        depth: `(h, w)` metres; of a pair rough.
        pair: Left and right image, grey, of a pair.
        ignore: `(h, w)` where something moves or may.
        T_cam_depth: `(7,)` from where depth was taken, seen from where the image was.
        neighbours: Frames before.
    """

    keyframe: int
    image: np.ndarray
    depth: np.ndarray
    pair: tuple[np.ndarray, np.ndarray] | None
    ignore: np.ndarray
    T_cam_depth: np.ndarray
    neighbours: tuple[Neighbour, ...]


class _Look(NamedTuple):
    """What a frame between keyframes sees, at the size of what is kept.

    Attributes:
        depth: `(h, w)` metres.
        ignore: `(h, w)` where something moves or may.
        T_world_cam: `(7,)` where depth was taken.
    """

    depth: np.ndarray
    ignore: np.ndarray
    T_world_cam: np.ndarray


class _Kept(NamedTuple):
    """What is kept of a keyframe besides its points.

    Attributes:
        depth: `(h, w)` uint16, parts of the farthest depth.
        T_cam_depth: As of `_Shown`.
    """

    depth: np.ndarray
    T_cam_depth: np.ndarray


_Job: TypeAlias = _Shown | _Look | Movers | None


class DenseMapping:
    """Makes the dense map of keyframes that are in the map.

    All but `cloud`, `cells` and `figures` is called from the tracker's thread.
    """

    def __init__(
        self,
        camera: Camera,
        config: DenseConfig,
        *,
        nearest_m: float,
        farthest_m: float,
        deterministic: bool,
        key_detector: Detector | None = None,
        times: StageTimes | None = None,
    ) -> None:
        """Begin empty.

        Args:
            camera: That takes the frames.
            config: Settings.
            nearest_m: Nearest depth believed.
            farthest_m: Farthest.
            deterministic: Work in turn; else in a thread.
            key_detector: Finds key objects.
            times: Where to keep how long it takes.
        """
        self._config, self._farthest_m, self._times = config, farthest_m, times or StageTimes()
        self._view = View(camera, config.pixel_step, farthest_m, nearest_m)
        self._small = self._view.halved()
        voxel_m = config.voxel_m or farthest_m / _VOXELS_DEEP
        self._first_voxel_m, self._cell_m = voxel_m, config.cell_m or _CELL_VOXELS * voxel_m
        most = self._view.rays.shape[1]
        self._layer = VoxelLayer(config.max_points, config.keyframe_points, most, voxel_m, farthest_m)
        self._keys: VoxelLayer | None = None
        if key_detector is not None:
            fine_m = _KEY_SHARE * voxel_m
            self._keys = VoxelLayer(config.key_points, config.keyframe_points, _KEY_POINTS, fine_m, farthest_m)
            self._whole = View(camera, 1, farthest_m, nearest_m)
        self._stereo = DenseDepth(camera) if camera.is_stereo else None
        self._key_detector = key_detector
        self.neighbours = None if key_detector is None else Neighbours(config.key_window, config.key_frames)
        self._kept: dict[int, _Kept] = {}
        self._on_the_way: dict[int, _Shown] = {}
        self._waiting: deque[_Job] = deque()
        self._map: Map | None = None
        self._lock, self._waiting_lock = threading.Lock(), threading.Lock()
        self._put = self._passed_over = self._frozen = self._moved = self._measured = 0
        self.worker: Worker[None, None] = make_worker(
            self._next_job, "jaxslam-dense", deterministic=deterministic, latency_frames=0
        )

    def compile(self) -> None:
        """Compile all that is needed."""
        with self._lock:
            for layer in self._layers():
                layer.compile(self._view, self._small, _NUM_LOOKS)

    def keyframe_made(self, new: NewKeyframe, image: np.ndarray, pose: np.ndarray, frame: int) -> None:
        """Take a keyframe; it is put in when it is in the map.

        Args:
            new: As local mapping gets it.
            image: `(h, w, 3)` RGB or `(h, w)`; copied.
            pose: `(7,)` where the tracker has it.
            frame: Its number.
        """
        arrays = new.frame
        self._on_the_way[new.id] = _Shown(
            keyframe=new.id,
            image=image.copy(),
            depth=np.asarray(arrays.depth),
            pair=None if arrays.right is None else (np.asarray(arrays.image), np.asarray(arrays.right)),
            ignore=np.asarray(arrays.ignore),
            T_cam_depth=moved(IDENTITY, new.twist * float(arrays.depth_delay_s)),
            neighbours=() if self.neighbours is None else self.neighbours.before(frame, pose),
        )

    def frame_tracked(self, frame: int, image: np.ndarray, arrays: FrameArrays, output: TrackOutput) -> None:
        """Take in a frame that was tracked.

        It may show key objects of a keyframe to come, and what it sees past is not there.
        """
        depth, ignore, pose = np.asarray(arrays.depth), np.asarray(arrays.ignore), pose_of(output)
        if self.neighbours is not None:
            self.neighbours.see(frame, image, depth, ignore, pose)
        wanted = self._config.carve and frame % _LOOK_EVERY == 0
        # Rough depth of a pair would see past what is there: keyframes, which are matched again, look instead.
        if wanted and arrays.right is None and len(self._waiting) < _MOST_WAITING:
            pose = moved(pose, np.asarray(output.twist) * float(arrays.depth_delay_s))
            seen = _Look(self._small.every(depth).copy(), self._small.every(ignore).copy(), pose)
            self._add_job(seen, frame)

    def map_made(self, map: Map, keyframe: int, frame: int) -> None:
        """Take in a new map, and the keyframe that is new in it, or `NONE`."""
        self._map = map
        shown = self._on_the_way.pop(keyframe, None)
        self._add_job(shown, frame)

    def remove(self, movers: Movers, frame: int) -> None:
        """Take in what may move in a keyframe."""
        shown = self._on_the_way.get(movers.keyframe)
        if shown is not None:
            self._on_the_way[movers.keyframe] = shown._replace(ignore=shown.ignore | movers.mask)
        elif movers.keyframe != NONE:
            self._add_job(movers, frame)

    def take(self, frame: int) -> None:
        """Raise what went wrong, if something did."""
        self.worker.take(frame)

    def finish(self) -> None:
        """Wait until all is in, and every keyframe where the map has it."""
        self.worker.drain()
        with self._lock:
            wanted = self._wanted()
            while self._correct(len(wanted), wanted):
                pass  # voxels may have become larger

    def cloud(self) -> DenseCloud:
        """The points as they are now, in the submap with most keyframes; from any thread."""
        with self._lock:
            shown = [self._layer.shown()] + ([] if self._keys is None else [self._keys.shown()])
            voxel_m = self._layer.voxel_m
        points, colours, counts = (np.concatenate(column) for column in zip(*shown, strict=True))
        is_key = np.arange(len(points)) >= len(shown[0][0])
        return DenseCloud(points, colours, counts, is_key, voxel_m)

    def cells(self) -> Occupancy:
        """What is occupied and free, by all keyframes that are kept; from any thread.

        Raises:
            MapFileError: If there is none yet.
        """
        with self._lock:
            wanted = self._wanted()
            kept = [(self._unpacked(self._kept[id]), pose) for id, pose in wanted.items() if pose is not None]
        if not kept:
            raise MapFileError("octree: expected at least one keyframe with depth in the dense map, got none")
        depths, poses = zip(*kept, strict=True)
        return occupancy(depths, np.stack(poses), self._small.rays, self._cell_m)

    @property
    def sees_anything(self) -> bool:
        """Whether a keyframe that is kept has depth."""
        with self._lock:
            wanted = self._wanted()
            return any(kept.depth.any() and wanted[id] is not None for id, kept in self._kept.items())

    def figures(self) -> DenseFigures:
        """How the map was made so far; from any thread."""
        with self._lock:
            layers = [self._layer] + ([] if self._keys is None else [self._keys])
            kept = sum(kept.depth.nbytes for kept in self._kept.values())
            return DenseFigures(
                keyframes=self._put,
                passed_over=self._passed_over,
                frozen=self._frozen,
                moved=self._moved,
                coarsened=round(np.log2(self._layer.voxel_m / self._first_voxel_m)),
                measured=self._measured,
                working_mb=(sum(layer.nbytes for layer in layers) + kept) / 1e6,
            )

    def _add_job(self, job: _Job, frame: int) -> None:
        if job is None and self._waiting:
            return  # the newest map is looked at with each job
        if isinstance(job, _Shown):
            jobs = tuple(self._waiting)
            waiting = [number for number, other in enumerate(jobs) if isinstance(other, _Shown)]
            if len(waiting) >= _MOST_WAITING:
                self._pass_over(jobs[waiting[0]])
        self._waiting.append(job)
        self.worker.offer(None, frame)

    def _pass_over(self, job: _Job) -> None:
        """Take the place of a job that waits, unless its turn has come; then nothing is done in that turn."""
        with self._waiting_lock:
            for number, other in enumerate(self._waiting):
                if other is job:
                    del self._waiting[number]
                    self._passed_over += 1
                    return

    def _next_job(self, _: None) -> None:
        with self._waiting_lock:
            if not self._waiting:
                return
            job = self._waiting.popleft()
        with self._lock:
            if isinstance(job, _Shown):
                self._add(job)
            elif isinstance(job, Movers):
                self._remove(job)
            elif isinstance(job, _Look):
                self._look(job)
            else:
                self._correct(self._config.corrections, self._wanted())

    def _add(self, shown: _Shown) -> None:
        whole, watch = shown.depth, self._times.stopwatch()
        if shown.pair is not None and self._stereo is not None:
            whole = self._stereo.of(*shown.pair)
            watch.ends("dense: match pair")
        total = self._times.stopwatch()
        depth = self._view.depth(whole, shown.ignore)
        part = self._layer.reduce(*self._view.cloud(depth, shown.image))
        watch.ends("dense: reduce")
        self._kept[shown.keyframe] = _Kept(self._packed(depth), shown.T_cam_depth)
        wanted = self._wanted()
        if shown.pair is not None and self._config.carve and (pose := wanted[shown.keyframe]) is not None:
            self._see_past(depth, pose, self._view)
            watch.ends("dense: carve")
        self._put_in(self._layer, shown.keyframe, part, wanted, watch)
        self._put += 1
        self._correct(self._config.corrections, wanted)
        self._bound()
        watch.ends("dense: move")
        total.ends("dense")
        self._measured += self._num_believed(whole, shown.ignore)
        if self._keys is not None and wanted[shown.keyframe] is not None:
            self._add_keys(self._keys, shown, whole, depth, wanted, watch)

    def _put_in(
        self,
        layer: VoxelLayer,
        keyframe: int,
        part: Part,
        wanted: dict[int, np.ndarray | None],
        watch: Stopwatch,
    ) -> None:
        """Put the points of a keyframe into a layer."""
        pose, past = wanted[keyframe], None
        if pose is None:
            layer.parts[keyframe] = part
            return
        if self._config.carve:
            past = self._num_past(layer, keyframe, part, wanted)
            watch.ends("dense: compare")
        layer.put(keyframe, part, pose, past)
        layer.make_room()
        watch.ends("dense: put in")

    def _look(self, seen: _Look) -> None:
        """Take in what a frame between keyframes sees past."""
        watch = self._times.stopwatch()
        self._see_past(self._small.cleaned(seen.depth, seen.ignore), seen.T_world_cam, self._small)
        watch.ends("dense: look")

    def _see_past(self, depth: np.ndarray, pose: np.ndarray, view: View) -> None:
        """Take in which voxels of all layers a depth image sees again, and which it sees past."""
        looks = view.looks(depth)
        for layer in self._layers():
            layer.look(looks, pose, view)

    def _num_believed(self, depth: np.ndarray, ignore: np.ndarray) -> int:
        """Pixels of a whole depth image that a map without voxels would hold."""
        good = cv2.inRange(depth, np.array([1e-6]), np.array([self._farthest_m])).view(bool)
        return int(np.count_nonzero(good & ~ignore))

    def _add_keys(
        self,
        keys: VoxelLayer,
        shown: _Shown,
        whole: np.ndarray,
        depth: np.ndarray,
        wanted: dict[int, np.ndarray | None],
        watch: Stopwatch,
    ) -> None:
        """Put in the key objects that the network sees in a keyframe, from it and from its neighbours."""
        assert self._key_detector is not None
        image = shown.image if shown.image.ndim == 3 else np.repeat(shown.image[..., None], 3, axis=2)
        found = self._key_detector(image)
        watch.ends("dense: find key objects")
        own = Neighbour(shown.image, whole, shown.ignore, IDENTITY)
        boxes = object_boxes(found, depth, self._view)
        parts = [points_inside(boxes, frame, self._whole) for frame in (own, *shown.neighbours)]
        X, colours = (np.concatenate(column, axis=1) for column in zip(*parts, strict=True))
        self._measured += X.shape[1] - parts[0][0].shape[1]
        self._put_in(keys, shown.keyframe, keys.reduce(*_sampled(X, colours)), wanted, self._times.stopwatch())
        watch.ends("dense: key objects")

    def _num_past(
        self, layer: VoxelLayer, keyframe: int, part: Part, wanted: dict[int, np.ndarray | None]
    ) -> np.ndarray | None:
        """How many of some earlier keyframes around see past each new point; `None` if there are none around."""
        pose, others = wanted[keyframe], [id for id, at in wanted.items() if at is not None and id != keyframe]
        if pose is None or not others:
            return None
        poses = np.stack([at for id, at in wanted.items() if at is not None and id != keyframe])
        change = between(np.broadcast_to(pose, poses.shape), poses)
        near = np.flatnonzero((np.linalg.norm(change[:, 4:], axis=1) < _NEAR_M) & (angle(change) < _NEAR_RAD))
        if not len(near):
            return None
        # Evenly spread in time: those just before see the person who stands there too.
        chosen = near[np.unique(np.linspace(0, len(near) - 1, _NUM_LOOKS).astype(int))]
        depths = np.zeros((_NUM_LOOKS, *self._small.shape), np.float32)
        for slot, index in enumerate(chosen.tolist()):
            depths[slot] = self._unpacked(self._kept[others[index]])
        leasts = np.stack([self._small.looks(depth).least for depth in depths])
        at = np.tile(IDENTITY, (_NUM_LOOKS, 1))
        at[: len(chosen)] = poses[chosen]
        return layer.past(part, pose, Looks(depths, leasts), at, self._small)

    def _remove(self, movers: Movers) -> None:
        """Take out what a keyframe shows under a mask that has come late."""
        kept = self._kept.get(movers.keyframe)
        if kept is None:
            return
        depth = kept.depth.copy()
        depth[self._small.every(movers.mask)] = 0
        self._kept[movers.keyframe] = kept._replace(depth=depth)
        for layer in self._layers():
            part = layer.parts.get(movers.keyframe)
            if part is not None:
                X_cam = part.X_cam.astype(np.float32) * layer.unit_m
                layer.take_out(movers.keyframe, self._view.under(movers.mask, X_cam))

    def _correct(self, at_most: int, wanted: dict[int, np.ndarray | None]) -> int:
        """Move the points of keyframes that have moved by most; gives how many were."""
        moves = [(distance(self._layer.parts[id].T_world_cam, pose), -id) for id, pose in wanted.items()]
        least = _LEAST_MOVE_VOXELS * self._layer.voxel_m
        chosen = [-id for way, id in sorted(moves, reverse=True)[:at_most] if way > least]
        for id in chosen:
            for layer in self._layers():
                if id in layer.parts:
                    layer.move(id, wanted[id])
        self._moved += len(chosen)
        for layer in self._layers():
            layer.make_room()
        return len(chosen)

    def _wanted(self) -> dict[int, np.ndarray | None]:
        """Where each keyframe kept has to be; `None` if it is in a submap that is not shown, or in no map."""
        wanted: dict[int, np.ndarray | None] = dict.fromkeys(self._kept)
        map, ids = self._map, np.array(list(self._kept), np.int64)
        if map is None or not len(map.ids) or not len(ids):
            return wanted
        numbers, counts = np.unique(map.submap, return_counts=True)
        ids = ids[has(map.ids, ids) | np.isin(ids, map.culled.ids)]
        poses, submaps = poses_of(map, ids)
        shown = submaps == numbers[np.argmax(counts)]
        poses = compose(poses, np.stack([self._kept[id].T_cam_depth for id in ids.tolist()]))
        wanted.update(zip(ids[shown].tolist(), poses[shown], strict=True))
        return wanted

    def _bound(self) -> None:
        """Forget the oldest keyframes while too much is kept of them."""
        limit = self._config.memory_mb * 1e6
        while len(self._kept) > 1 and sum(layer.part_bytes for layer in self._layers()) + self._kept_bytes() > limit:
            oldest = next(iter(self._kept))
            del self._kept[oldest]
            for layer in self._layers():
                if oldest in layer.parts:
                    layer.forget(oldest)
            self._frozen += 1

    def _kept_bytes(self) -> int:
        return sum(kept.depth.nbytes for kept in self._kept.values())

    def _layers(self) -> list[VoxelLayer]:
        return [self._layer] if self._keys is None else [self._layer, self._keys]

    def _packed(self, depth: np.ndarray) -> np.ndarray:
        """What is kept of a depth image of the pixels used, in 65,535 steps up to the farthest depth."""
        small = self._small.of_finer(depth)
        return np.rint(small * np.float32(_DEPTH_COUNTS / self._farthest_m)).astype(np.uint16)

    def _unpacked(self, kept: _Kept) -> np.ndarray:
        return kept.depth.astype(np.float32) * np.float32(self._farthest_m / _DEPTH_COUNTS)


def _sampled(X: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points, evenly thinned out if there are too many."""
    if X.shape[1] <= _KEY_POINTS:
        return X, colours
    chosen = np.linspace(0, X.shape[1] - 1, _KEY_POINTS).astype(np.int64)
    return X[:, chosen], colours[:, chosen]
