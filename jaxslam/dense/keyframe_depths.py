"""What is kept of the depth of keyframes: small images, packed, and where each was taken."""

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from jaxslam.dense.depth_view import DepthView, Looks
from jaxslam.dense.keyframe_poses import poses_of
from jaxslam.geometry.se3 import IDENTITY, angle, between, compose
from jaxslam.map.types import Map, has

Poses: TypeAlias = Mapping[int, np.ndarray | None]
"""Where the depth of each keyframe was taken, `(7,)`; `None` if the keyframe is in a submap that is not shown, or in no
map."""
_NEAR_M, _NEAR_RAD = 1.5, 0.6
"""Keyframes so near, and turned by so little, see the same."""
_COUNTS = 65535


class _StoredDepth(NamedTuple):
    """Of a keyframe.

    Attributes:
        depth: `(h, w)` parts of the farthest depth.
        T_cam_depth: `(7,)` from where depth was taken, seen from where the image was.
    """

    depth: UInt16[np.ndarray, "h w"]
    T_cam_depth: Float[np.ndarray, "7"]


class KeyframeDepths:
    """Depth images of keyframes, the oldest first."""

    def __init__(self, view: DepthView) -> None:
        """Keep the pixels of a view, which is half of that of the images given."""
        self._view, self._kept = view, dict[int, _StoredDepth]()

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, keyframe: int, depth: Float32[np.ndarray, "_h _w"], T_cam_depth: Float[np.ndarray, "7"]) -> None:
        """Keep every second pixel of a depth image, in 65,535 steps up to the farthest depth."""
        small = self._view.of_finer(depth)
        self._kept[keyframe] = _StoredDepth(
            np.rint(small * np.float32(_COUNTS / self._view.farthest_m)).astype(np.uint16), T_cam_depth
        )

    def remove_under(self, keyframe: int, mask: Bool[np.ndarray, "h w"]) -> bool:
        """Forget the depth under a mask of the whole image; gives whether the keyframe is kept."""
        kept = self._kept.get(keyframe)
        if kept is None:
            return False
        depth = kept.depth.copy()
        depth[self._view.every(mask)] = 0
        self._kept[keyframe] = kept._replace(depth=depth)
        return True

    def forget_oldest(self) -> int:
        """Forget the oldest keyframe; gives its id."""
        oldest = next(iter(self._kept))
        del self._kept[oldest]
        return oldest

    def poses(self, slam_map: Map | None) -> Poses:
        """Where each keyframe is in the submap with most keyframes."""
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
        """Depth, meters, and poses of all that have one."""
        there = [(self._meters(id), pose) for id, pose in poses.items() if pose is not None]
        return [depth for depth, _ in there], [pose for _, pose in there]

    def around(self, keyframe: int, poses: Poses, count: int) -> tuple[Looks, Float[np.ndarray, "k 7"]] | None:
        """Some other keyframes that see the same: `k` images, blank if there are fewer; `None` if there are none."""
        pose = poses[keyframe]
        others = [(id, at) for id, at in poses.items() if at is not None and id != keyframe]
        if pose is None or not others:
            return None
        there = np.stack([at for _, at in others])
        change = between(np.broadcast_to(pose, there.shape), there)
        near = np.flatnonzero((np.linalg.norm(change[:, 4:], axis=1) < _NEAR_M) & (angle(change) < _NEAR_RAD))
        if not len(near):
            return None
        # Evenly spread in time: those just before see the person who stands there too.
        chosen = near[np.unique(np.linspace(0, len(near) - 1, count).astype(int))]
        depths = np.zeros((count, *self._view.shape), np.float32)
        for slot, index in enumerate(chosen.tolist()):
            depths[slot] = self._meters(others[index][0])
        at = np.tile(IDENTITY, (count, 1))
        at[: len(chosen)] = there[chosen]
        return Looks(depths, np.stack([self._view.looks(depth).least for depth in depths])), at

    def any_seen(self, poses: Poses) -> bool:
        """Whether one that has a pose has depth."""
        return any(kept.depth.any() and poses[id] is not None for id, kept in self._kept.items())

    @property
    def nbytes(self) -> int:
        """What they take up."""
        return sum(kept.depth.nbytes for kept in self._kept.values())

    def _meters(self, keyframe: int) -> Float32[np.ndarray, "h w"]:
        return self._kept[keyframe].depth.astype(np.float32) * np.float32(self._view.farthest_m / _COUNTS)
