"""Stored depth images of keyframes: reduced, 16-bit, each with its pose."""

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from jaxslam.dense.depth_view import DepthView, Looks
from jaxslam.dense.keyframe_poses import poses_of
from jaxslam.geometry.se3 import IDENTITY, angle, between, compose
from jaxslam.map.point_records import has
from jaxslam.map.types import Map

Poses: TypeAlias = Mapping[int, np.ndarray | None]
"""The `(7,)` pose of the depth of each keyframe, by keyframe id. A pose is `None` if the keyframe is not in the map or
in a submap that is not shown."""
_NEAR_REACH, _NEAR_RAD = 0.25, 0.6
"""Largest distance (as a share of the farthest valid depth) and rotation (radians) between keyframes with overlapping
views."""
_COUNTS = 65535
"""Number of quantization steps of the depth."""


class _StoredDepth(NamedTuple):
    """The stored depth of one keyframe.

    Attributes:
        depth: `(h, w)` depth in units of 1/65535 of the farthest valid depth; 0 where it is missing.
        T_cam_depth: `(7,)` transform from the camera at the time of the depth to the camera at the time of the image.
    """

    depth: UInt16[np.ndarray, "h w"]
    T_cam_depth: Float[np.ndarray, "7"]


class KeyframeDepths:
    """The stored depth images of keyframes, oldest first."""

    def __init__(self, view: DepthView) -> None:
        """Store depth on the grid of `view`, which has half the resolution of the images given to `add`."""
        self._view, self._kept = view, dict[int, _StoredDepth]()

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, keyframe: int, depth: Float32[np.ndarray, "_h _w"], T_cam_depth: Float[np.ndarray, "7"]) -> None:
        """Store every second pixel of a depth image, in 65,535 steps up to the farthest valid depth.

        Args:
            keyframe: Id of the keyframe.
            depth: `(_h, _w)` depth image, meters; 0 where it is missing.
            T_cam_depth: `(7,)` transform from the camera at the time of the depth to the camera at the time of the
                image.
        """
        small = self._view.of_finer(depth)
        self._kept[keyframe] = _StoredDepth(
            np.rint(small * np.float32(_COUNTS / self._view.farthest_m)).astype(np.uint16), T_cam_depth
        )

    def remove_under(self, keyframe: int, mask: Bool[np.ndarray, "h w"]) -> bool:
        """Erase the depth of a keyframe under a mask of the whole image; return whether the keyframe is stored."""
        kept = self._kept.get(keyframe)
        if kept is None:
            return False
        depth = kept.depth.copy()
        depth[self._view.every(mask)] = 0
        self._kept[keyframe] = kept._replace(depth=depth)
        return True

    def forget_oldest(self) -> int:
        """Drop the oldest keyframe, and return its id."""
        oldest = next(iter(self._kept))
        del self._kept[oldest]
        return oldest

    def poses(self, slam_map: Map | None) -> Poses:
        """Return the pose of each stored keyframe in the submap with most keyframes."""
        poses: dict[int, np.ndarray | None] = dict.fromkeys(self._kept)
        ids = np.array(list(self._kept), np.int64)
        if slam_map is None or not len(slam_map.ids) or not len(ids):
            return poses
        numbers, counts = np.unique(slam_map.submap, return_counts=True)
        ids = ids[has(slam_map.ids, ids) | np.isin(ids, slam_map.culled.ids)]
        in_map, submaps = poses_of(slam_map, ids)
        shown = submaps == numbers[np.argmax(counts)]
        in_map = compose(in_map, np.stack([self._kept[id].T_cam_depth for id in ids.tolist()]))
        poses.update(zip(ids[shown].tolist(), in_map[shown], strict=True))
        return poses

    def shown(self, poses: Poses) -> tuple[list[Float32[np.ndarray, "h w"]], list[np.ndarray]]:
        """Return the depth images (meters) and poses of all keyframes that have a pose."""
        there = [(self._meters(id), pose) for id, pose in poses.items() if pose is not None]
        return [depth for depth, _ in there], [pose for _, pose in there]

    def around(self, keyframe: int, poses: Poses, count: int) -> tuple[Looks, Float[np.ndarray, "k 7"]] | None:
        """Return some other keyframes with an overlapping view; `None` if there are none.

        Args:
            keyframe: Id of the keyframe.
            poses: Poses of all stored keyframes.
            count: Number `k` of depth images to return; the images beyond those found are blank.
        """
        pose = poses[keyframe]
        others = [(id, at) for id, at in poses.items() if at is not None and id != keyframe]
        if pose is None or not others:
            return None
        there = np.stack([at for _, at in others])
        change = between(np.broadcast_to(pose, there.shape), there)
        near_m = _NEAR_REACH * self._view.farthest_m
        near = np.flatnonzero((np.linalg.norm(change[:, 4:], axis=1) < near_m) & (angle(change) < _NEAR_RAD))
        if not len(near):
            return None
        # Evenly spaced in time: the keyframes just before would show the same person at the same place.
        chosen = near[np.unique(np.linspace(0, len(near) - 1, count).astype(int))]
        depths = np.zeros((count, *self._view.shape), np.float32)
        for slot, index in enumerate(chosen.tolist()):
            depths[slot] = self._meters(others[index][0])
        at = np.tile(IDENTITY, (count, 1))
        at[: len(chosen)] = there[chosen]
        return Looks(depths, np.stack([self._view.looks(depth).least for depth in depths])), at

    def any_seen(self, poses: Poses) -> bool:
        """Return whether any keyframe with a pose has valid depth."""
        return any(kept.depth.any() and poses[id] is not None for id, kept in self._kept.items())

    @property
    def nbytes(self) -> int:
        """Memory of the stored depth images, bytes."""
        return sum(kept.depth.nbytes for kept in self._kept.values())

    def _meters(self, keyframe: int) -> Float32[np.ndarray, "h w"]:
        return self._kept[keyframe].depth.astype(np.float32) * np.float32(self._view.farthest_m / _COUNTS)
