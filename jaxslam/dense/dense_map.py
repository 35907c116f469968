"""The dense map: what keyframes see is put in, and moved when they are; what is seen past is not there any more.

Memory is bounded by the settings: the grids have a fixed size, and what is kept of keyframes is dropped oldest first.
Not safe to be used from several threads at once.
"""

from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.config.schema import DenseConfig
from jaxslam.dense.depth_view import DepthView
from jaxslam.dense.key_objects import Neighbor, object_boxes, points_inside
from jaxslam.dense.keyframe_depths import KeyframeDepths, Poses
from jaxslam.dense.keyframe_poses import distance
from jaxslam.dense.occupancy import Occupancy, occupancy
from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.dense.voxel_layer import VoxelLayer, VoxelPart
from jaxslam.errors import MapFileError
from jaxslam.geometry.se3 import IDENTITY
from jaxslam.map.dynamic_removal import DynamicObservations
from jaxslam.map.types import Map
from jaxslam.runtime.stage_timer import StageTimes, Stopwatch
from jaxslam.semantics import Detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.stereo_depth import DenseDepth

_VOXELS_DEEP = 300
"""Voxels from the camera to the farthest depth believed, if the settings do not give their side."""
_CELL_VOXELS = 2.5
_KEY_SHARE = 0.25
"""Side of the voxels of key objects, in others."""
_MIN_MOVE_VOXELS = 0.25
"""A keyframe that moves a point by less, two meters away, stays where it is."""
_NUM_LOOKS = 4
"""Earlier keyframes that new points are compared with."""
_KEY_POINTS = 131_072
"""Points of key objects in a keyframe and its neighbors, at most."""


class DenseKeyframe(NamedTuple):
    """A keyframe and what it sees, copied.

    Attributes:
        keyframe: Its id.
        image: `(h, w, 3)` RGB or `(h, w)`.
        depth: `(h, w)` meters; of a pair rough.
        pair: Left and right image, gray, of a pair.
        ignore: `(h, w)` where something moves or may.
        T_cam_depth: `(7,)` from where depth was taken, seen from where the image was.
        neighbors: Frames before.
    """

    keyframe: int
    image: np.ndarray
    depth: np.ndarray
    pair: tuple[np.ndarray, np.ndarray] | None
    ignore: np.ndarray
    T_cam_depth: np.ndarray
    neighbors: tuple[Neighbor, ...]


class DepthGlance(NamedTuple):
    """What a frame between keyframes sees, at the size of what is kept.

    Attributes:
        depth: `(h, w)` meters.
        ignore: `(h, w)` where something moves or may.
        T_world_cam: `(7,)` where depth was taken.
    """

    depth: np.ndarray
    ignore: np.ndarray
    T_world_cam: np.ndarray


class DenseFigures(NamedTuple):
    """How the map was made.

    Attributes:
        keyframes: Put in.
        passed_over: Keyframes that were never looked at, because too many waited.
        frozen: Keyframes that are forgotten, whose points move no more.
        moved: Times that the points of a keyframe were moved with it.
        coarsened: Times that voxels became twice as large.
        measured: Pixels with depth to be believed in all keyframes put in, and in all parts of neighbors.
        working_mb: Memory in use, megabytes.
    """

    keyframes: int
    passed_over: int
    frozen: int
    moved: int
    coarsened: int
    measured: int
    working_mb: float


class DenseMap:
    """Points of keyframes, in voxels, at the poses that the sparse map gives the keyframes.

    Attributes:
        sparse: Where keyframes are; to be replaced when they have moved.
        has_keys: Whether key objects are kept at full density.
    """

    def __init__(
        self,
        camera: Camera,
        config: DenseConfig,
        *,
        nearest_m: float,
        farthest_m: float,
        key_detector: Detector | None = None,
        times: StageTimes | None = None,
    ) -> None:
        """Begin empty.

        Args:
            camera: That takes the frames.
            config: Settings.
            nearest_m: Nearest depth believed.
            farthest_m: Farthest.
            key_detector: Finds key objects.
            times: Where to keep how long it takes.
        """
        self.sparse: Map | None = None
        self._config, self._farthest_m, self._times = config, farthest_m, times or StageTimes()
        self._view = DepthView(camera, config.pixel_step, farthest_m, nearest_m)
        self._small = self._view.halved()
        voxel_m = config.voxel_m or farthest_m / _VOXELS_DEEP
        self._first_voxel_m, self._cell_m = voxel_m, config.cell_m or _CELL_VOXELS * voxel_m
        most = self._view.rays.shape[1]
        self._layer = VoxelLayer(config.max_points, config.keyframe_points, most, voxel_m, farthest_m)
        self._keys: VoxelLayer | None = None
        if key_detector is not None:
            fine_m = _KEY_SHARE * voxel_m
            self._keys = VoxelLayer(config.key_points, config.keyframe_points, _KEY_POINTS, fine_m, farthest_m)
            self._whole = DepthView(camera, 1, farthest_m, nearest_m)
        self.has_keys = key_detector is not None
        self._layers = [self._layer] if self._keys is None else [self._layer, self._keys]
        self._stereo = DenseDepth(camera) if camera.is_stereo else None
        self._key_detector = key_detector
        self._kept = KeyframeDepths(self._small)
        self._put = self._frozen = self._moved = self._measured = 0

    def compile(self) -> None:
        """Compile all that is needed."""
        for layer in self._layers:
            layer.compile(self._view, self._small, _NUM_LOOKS)

    def look_of(self, depth: np.ndarray, ignore: np.ndarray, T_world_cam: np.ndarray) -> DepthGlance:
        """What `look` needs of a whole depth image, copied; from any thread."""
        return DepthGlance(self._small.every(depth).copy(), self._small.every(ignore).copy(), T_world_cam)

    def add(self, shown: DenseKeyframe) -> None:
        """Put in what a keyframe sees."""
        whole, watch = shown.depth, self._times.stopwatch()
        if shown.pair is not None and self._stereo is not None:
            whole = self._stereo.of(*shown.pair)
            watch.ends("dense: match pair")
        total = self._times.stopwatch()
        depth = self._view.depth(whole, shown.ignore)
        part = self._layer.reduce(*self._view.cloud(depth, shown.image))
        watch.ends("dense: reduce")
        self._kept.add(shown.keyframe, depth, shown.T_cam_depth)
        poses = self._kept.poses(self.sparse)
        pose = poses[shown.keyframe]
        if shown.pair is not None and self._config.carve and pose is not None:
            self._see_past(depth, pose, self._view)
            watch.ends("dense: carve")
        self._put_in(self._layer, shown.keyframe, part, poses, watch)
        self._put += 1
        self._move(poses, self._config.corrections)
        self._bound()
        watch.ends("dense: move")
        total.ends("dense")
        self._measured += self._num_believed(whole, shown.ignore)
        if self._keys is not None and pose is not None:
            self._add_keys(self._keys, shown, whole, depth, poses, watch)

    def look(self, seen: DepthGlance) -> None:
        """Take in what a frame between keyframes sees past."""
        watch = self._times.stopwatch()
        self._see_past(self._small.cleaned(seen.depth, seen.ignore), seen.T_world_cam, self._small)
        watch.ends("dense: look")

    def remove(self, movers: DynamicObservations) -> None:
        """Take out what a keyframe shows under a mask that has come late."""
        if not self._kept.remove_under(movers.keyframe, movers.mask):
            return
        for layer in self._layers:
            part = layer.parts.get(movers.keyframe)
            if part is not None:
                X_cam = part.X_cam.astype(np.float32) * layer.unit_m
                layer.take_out(movers.keyframe, self._view.under(movers.mask, X_cam))

    def correct(self) -> None:
        """Move the points of some keyframes that have moved, those that have moved by most."""
        self._move(self._kept.poses(self.sparse), self._config.corrections)

    def correct_all(self) -> None:
        """Move the points of all keyframes to where the sparse map has them."""
        poses = self._kept.poses(self.sparse)
        while self._move(poses, len(poses)):
            pass  # voxels may have become larger

    def cloud(self) -> DenseCloud:
        """The points as they are now, in the submap with most keyframes."""
        shown = [layer.shown() for layer in self._layers]
        points, colors, counts = (np.concatenate(column) for column in zip(*shown, strict=True))
        is_key = np.arange(len(points)) >= len(shown[0][0])
        return DenseCloud(points, colors, counts, is_key, self._layer.voxel_m)

    def depths(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Depth of the keyframes that are kept, and where it was taken, for `cells`."""
        return self._kept.shown(self._kept.poses(self.sparse))

    def cells(self, depths: list[np.ndarray], poses: list[np.ndarray]) -> Occupancy:
        """What is occupied and free, by depth images and their poses; from any thread.

        Raises:
            MapFileError: If there is none yet.
        """
        if not depths:
            raise MapFileError("octree: expected at least one keyframe with depth in the dense map, got none")
        return occupancy(depths, np.stack(poses), self._small.rays, self._cell_m)

    @property
    def sees_anything(self) -> bool:
        """Whether a keyframe that is kept has depth."""
        return self._kept.any_seen(self._kept.poses(self.sparse))

    def figures(self, passed_over: int) -> DenseFigures:
        """How the map was made so far; so many keyframes were never given to it."""
        return DenseFigures(
            keyframes=self._put,
            passed_over=passed_over,
            frozen=self._frozen,
            moved=self._moved,
            coarsened=round(np.log2(self._layer.voxel_m / self._first_voxel_m)),
            measured=self._measured,
            working_mb=(sum(layer.nbytes for layer in self._layers) + self._kept.nbytes) / 1e6,
        )

    def _put_in(self, layer: VoxelLayer, keyframe: int, part: VoxelPart, poses: Poses, watch: Stopwatch) -> None:
        """Put the points of a keyframe into a layer."""
        pose, past = poses[keyframe], None
        if pose is None:
            layer.parts[keyframe] = part
            return
        if self._config.carve:
            around = self._kept.around(keyframe, poses, _NUM_LOOKS)
            past = None if around is None else layer.past(part, pose, *around, self._small)
            watch.ends("dense: compare")
        layer.put(keyframe, part, pose, past)
        layer.make_room()
        watch.ends("dense: put in")

    def _see_past(self, depth: np.ndarray, pose: np.ndarray, view: DepthView) -> None:
        """Take in which voxels of all layers a depth image sees again, and which it sees past."""
        looks = view.looks(depth)
        for layer in self._layers:
            layer.look(looks, pose, view)

    def _num_believed(self, depth: np.ndarray, ignore: np.ndarray) -> int:
        """Pixels of a whole depth image that a map without voxels would hold."""
        good = cv2.inRange(depth, np.array([1e-6]), np.array([self._farthest_m])).view(bool)
        return int(np.count_nonzero(good & ~ignore))

    def _add_keys(
        self,
        keys: VoxelLayer,
        shown: DenseKeyframe,
        whole: np.ndarray,
        depth: np.ndarray,
        poses: Poses,
        watch: Stopwatch,
    ) -> None:
        """Put in the key objects that the network sees in a keyframe, from it and from its neighbors."""
        assert self._key_detector is not None
        image = shown.image if shown.image.ndim == 3 else np.repeat(shown.image[..., None], 3, axis=2)
        found = self._key_detector(image)
        watch.ends("dense: find key objects")
        own = Neighbor(shown.image, whole, shown.ignore, IDENTITY)
        boxes = object_boxes(found, depth, self._view)
        parts = [points_inside(boxes, frame, self._whole) for frame in (own, *shown.neighbors)]
        X, colors = (np.concatenate(column, axis=1) for column in zip(*parts, strict=True))
        self._measured += X.shape[1] - parts[0][0].shape[1]
        self._put_in(keys, shown.keyframe, keys.reduce(*_sampled(X, colors)), poses, self._times.stopwatch())
        watch.ends("dense: key objects")

    def _move(self, poses: Poses, at_most: int) -> int:
        """Move the points of keyframes that have moved by most; gives how many were."""
        moves = [(distance(self._layer.parts[id].T_world_cam, pose), -id) for id, pose in poses.items()]
        least = _MIN_MOVE_VOXELS * self._layer.voxel_m
        chosen = [-id for way, id in sorted(moves, reverse=True)[:at_most] if way > least]
        for id in chosen:
            for layer in self._layers:
                if id in layer.parts:
                    layer.move(id, poses[id])
        self._moved += len(chosen)
        for layer in self._layers:
            layer.make_room()
        return len(chosen)

    def _bound(self) -> None:
        """Forget the oldest keyframes while too much is kept of them."""
        limit = self._config.memory_mb * 1e6
        while len(self._kept) > 1 and sum(layer.part_bytes for layer in self._layers) + self._kept.nbytes > limit:
            oldest = self._kept.forget_oldest()
            for layer in self._layers:
                if oldest in layer.parts:
                    layer.forget(oldest)
            self._frozen += 1


def _sampled(X: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points, evenly thinned out if there are too many."""
    if X.shape[1] <= _KEY_POINTS:
        return X, colors
    chosen = np.linspace(0, X.shape[1] - 1, _KEY_POINTS).astype(np.int64)
    return X[:, chosen], colors[:, chosen]
