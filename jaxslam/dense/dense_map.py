"""Dense map: the depth of keyframes in voxels that move with corrections and are carved by later depth images.

Memory is bounded by the settings: the grids have a fixed size, and the stored keyframes are dropped oldest first.
Not thread-safe.
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
"""Number of voxels from the camera to the farthest valid depth, if the settings do not give the side of a voxel."""
_CELL_VOXELS = 2.5
"""Side of an occupancy cell, in voxels, if the settings do not give it."""
_KEY_SHARE = 0.25
"""Side of the voxels of key objects, as a share of the side of other voxels."""
_MIN_MOVE_VOXELS = 0.25
"""Smallest correction of a keyframe that moves its points: the displacement of a point two meters away, in voxels."""
_NUM_LOOKS = 4
"""Number of earlier keyframes that new points are compared with."""
_KEY_POINTS = 131_072
"""Largest number of points of key objects in a keyframe and its neighbors."""


class DenseKeyframe(NamedTuple):
    """The images of one keyframe, copied.

    Attributes:
        keyframe: Id of the keyframe.
        image: `(h, w, 3)` RGB or `(h, w)` gray image.
        depth: `(h, w)` depth image, meters; rough for a stereo pair.
        pair: Left and right gray images of a stereo pair; `None` for a depth camera.
        ignore: `(h, w)` mask of the pixels that are dynamic or may be.
        T_cam_depth: `(7,)` transform from the camera at the time of the depth to the camera at the time of the image.
        neighbors: Frames shortly before the keyframe.
    """

    keyframe: int
    image: np.ndarray
    depth: np.ndarray
    pair: tuple[np.ndarray, np.ndarray] | None
    ignore: np.ndarray
    T_cam_depth: np.ndarray
    neighbors: tuple[Neighbor, ...]


class DepthGlance(NamedTuple):
    """The reduced depth image of a frame between keyframes.

    Attributes:
        depth: `(h, w)` depth at the size of stored keyframes, meters.
        ignore: `(h, w)` mask of the pixels that are dynamic or may be.
        T_world_cam: `(7,)` pose of the camera at the time of the depth.
    """

    depth: np.ndarray
    ignore: np.ndarray
    T_world_cam: np.ndarray


class DenseFigures(NamedTuple):
    """Statistics of a dense map.

    Attributes:
        keyframes: Number of keyframes added.
        passed_over: Number of keyframes skipped because too many waited.
        frozen: Number of keyframes dropped from memory, whose points no longer move with corrections.
        moved: Number of times that the points of a keyframe were moved with it.
        coarsened: Number of times that the side of the voxels was doubled.
        measured: Number of pixels with valid depth in all added keyframes, and of points from their neighbors.
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
    """The points of keyframes in voxels, at the poses that the sparse map gives the keyframes.

    Attributes:
        sparse: The sparse map with the poses of the keyframes; the owner replaces it after a correction.
        has_keys: Whether key objects are stored at full density.
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
        """Create an empty map.

        Args:
            camera: Camera of the frames.
            config: Settings of the dense map.
            nearest_m: Smallest valid depth, meters.
            farthest_m: Largest valid depth, meters.
            key_detector: Detector of key objects; `None` for a map without key objects.
            times: Record of the stage durations.
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
        """Compile all programs of the dense map."""
        for layer in self._layers:
            layer.compile(self._view, self._small, _NUM_LOOKS)

    def look_of(self, depth: np.ndarray, ignore: np.ndarray, T_world_cam: np.ndarray) -> DepthGlance:
        """Reduce a whole depth image to the copy that `look` needs; callable from any thread."""
        return DepthGlance(self._small.every(depth).copy(), self._small.every(ignore).copy(), T_world_cam)

    def add(self, shown: DenseKeyframe) -> None:
        """Add the points of a keyframe."""
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
        """Update the voxels with a frame between keyframes: carve the voxels that it sees through."""
        watch = self._times.stopwatch()
        self._see_past(self._small.cleaned(seen.depth, seen.ignore), seen.T_world_cam, self._small)
        watch.ends("dense: look")

    def remove(self, movers: DynamicObservations) -> None:
        """Remove the points of a keyframe under a mask that arrived after the keyframe was added."""
        if not self._kept.remove_under(movers.keyframe, movers.mask):
            return
        for layer in self._layers:
            part = layer.parts.get(movers.keyframe)
            if part is not None:
                X_cam = part.X_cam.astype(np.float32) * layer.unit_m
                layer.take_out(movers.keyframe, self._view.under(movers.mask, X_cam))

    def correct(self) -> None:
        """Move the points of the few keyframes whose poses have changed most."""
        self._move(self._kept.poses(self.sparse), self._config.corrections)

    def correct_all(self) -> None:
        """Move the points of all keyframes to the poses of the sparse map."""
        poses = self._kept.poses(self.sparse)
        while self._move(poses, len(poses)):
            pass  # moving may have coarsened the voxels

    def cloud(self) -> DenseCloud:
        """Return the current points in the submap with most keyframes."""
        shown = [layer.shown() for layer in self._layers]
        points, colors, counts = (np.concatenate(column) for column in zip(*shown, strict=True))
        is_key = np.arange(len(points)) >= len(shown[0][0])
        return DenseCloud(points, colors, counts, is_key, self._layer.voxel_m)

    def depths(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the stored depth images of keyframes and their poses, the input of `cells`."""
        return self._kept.shown(self._kept.poses(self.sparse))

    def cells(self, depths: list[np.ndarray], poses: list[np.ndarray]) -> Occupancy:
        """Compute the occupancy grid from depth images and their poses; callable from any thread.

        Raises:
            MapFileError: If there are no depth images.
        """
        if not depths:
            raise MapFileError("octree: expected at least one keyframe with depth in the dense map, got none")
        return occupancy(depths, np.stack(poses), self._small.rays, self._cell_m)

    @property
    def sees_anything(self) -> bool:
        """Whether a stored keyframe has valid depth."""
        return self._kept.any_seen(self._kept.poses(self.sparse))

    def figures(self, passed_over: int) -> DenseFigures:
        """Return the statistics so far; `passed_over` keyframes were never given to the map."""
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
        """Add the points of a keyframe to a layer."""
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
        """Update the voxels of all layers with a depth image: confirm or carve the voxels in view."""
        looks = view.looks(depth)
        for layer in self._layers:
            layer.look(looks, pose, view)

    def _num_believed(self, depth: np.ndarray, ignore: np.ndarray) -> int:
        """Count the pixels with valid depth in a whole depth image: the points of a map without voxels."""
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
        """Add the key objects found in a keyframe, with points from the keyframe and its neighbors."""
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
        """Move the points of at most `at_most` keyframes, the most displaced first; return the number moved."""
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
        """Drop the oldest stored keyframes until memory is within the limit."""
        limit = self._config.memory_mb * 1e6
        while len(self._kept) > 1 and sum(layer.part_bytes for layer in self._layers) + self._kept.nbytes > limit:
            oldest = self._kept.forget_oldest()
            for layer in self._layers:
                if oldest in layer.parts:
                    layer.forget(oldest)
            self._frozen += 1


def _sampled(X: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Subsample points and colors evenly if there are too many."""
    if X.shape[1] <= _KEY_POINTS:
        return X, colors
    chosen = np.linspace(0, X.shape[1] - 1, _KEY_POINTS).astype(np.int64)
    return X[:, chosen], colors[:, chosen]
