"""What keyframes of the map show of what the camera sees."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.geometry.se3 import to_local
from jaxslam.geometry.so3 import matrices
from jaxslam.geometry.types import Pose
from jaxslam.map.point_records import has, rows
from jaxslam.map.types import Map
from jaxslam.sensors.camera import Camera

_NUM_SAMPLES = 32
"""Number of points by which a keyframe is judged."""
_MAX_TURN = 0.7
"""Cosine of the largest angle between the directions from which a point was and is seen."""
_SCALES = (0.5, 2.0)
"""Bounds on the ratio of the earlier to the current distance of a point."""
_MARGIN_PX = 8


class _Samples(NamedTuple):
    """Samples of the keyframes near a camera: the same from frame to frame, while map and keyframes are.

    Attributes:
        near: `(k,)` mask of the keyframes of the map that they belong to.
        X_world: `(3, n)` positions of the samples, meters.
        seen_from: `(3, n)` position from which each was seen, meters.
    """

    near: Bool[np.ndarray, " k"]
    X_world: Float[np.ndarray, "3 n"]
    seen_from: Float[np.ndarray, "3 n"]


class ViewCoverage:
    """Counts the keyframes of a map that show what the camera sees: whether another one there would be news.

    A keyframe is judged by some of the points that it observed when it was new, relative to where it is now. So a new
    map costs what its new keyframes do, and a frame what the keyframes around do.
    """

    def __init__(self, at_least: float) -> None:
        """Start without a map.

        Args:
            at_least: Smallest share of its points that a keyframe that shows a view has in it, seen alike.
        """
        self._at_least = at_least
        self._map: Map | None = None
        self._ids = np.zeros(0, np.int64)
        self._X_cam = np.zeros((0, 3, _NUM_SAMPLES))
        self._reach_m = np.zeros(0)
        self._samples: _Samples | None = None

    def num_views(self, slam_map: Map, T_world_cam: Pose, submap: int) -> int:
        """Count the keyframes of a map that show the view of a camera.

        Args:
            slam_map: The map.
            T_world_cam: `(7,)` pose of the camera.
            submap: Number of the submap that it is in.
        """
        if slam_map is not self._map:
            self._take(slam_map)
        apart_m2 = _squared_norm((slam_map.T_world_cam[:, 4:] - T_world_cam[4:]).T)
        near = (slam_map.submap == submap) & (apart_m2 < np.square(self._reach_m))
        if not near.any():
            return 0
        if self._samples is None or not np.array_equal(near, self._samples.near):
            self._samples = self._samples_of(slam_map, near)
        X_world, then = self._samples.X_world, self._samples.seen_from
        seen = in_view(slam_map.camera, T_world_cam, X_world) & seen_alike(X_world, then, T_world_cam[4:, None])
        num_seen = seen.reshape(-1, _NUM_SAMPLES).sum(axis=1)
        return int(np.count_nonzero(num_seen >= self._at_least * _NUM_SAMPLES))

    def _samples_of(self, slam_map: Map, near: Bool[np.ndarray, " k"]) -> "_Samples":
        """Return the samples of some keyframes in the world."""
        T_world_keyframe = slam_map.T_world_cam[near]
        X_world = matrices(T_world_keyframe[:, :4]) @ self._X_cam[near] + T_world_keyframe[:, 4:, None]
        seen_from = T_world_keyframe[:, 4:].T.repeat(_NUM_SAMPLES, axis=1)
        return _Samples(near, X_world.transpose(1, 0, 2).reshape(3, -1), seen_from)

    def _take(self, slam_map: Map) -> None:
        """Sample the keyframes of a map that are new."""
        known = has(self._ids, slam_map.ids)
        row = rows(self._ids, slam_map.ids[known])
        X_cam, reach_m = np.zeros((len(known), 3, _NUM_SAMPLES)), np.zeros(len(known))
        X_cam[known], reach_m[known] = self._X_cam[row], self._reach_m[row]
        for new in np.flatnonzero(~known):
            near = slam_map.around(slam_map.ids[[new]])
            points = near.observations.point[near.observations.keyframe == slam_map.ids[new]]
            if len(points):
                some = points[np.arange(_NUM_SAMPLES) * len(points) // _NUM_SAMPLES]
                X_world = near.points.X_world[:, rows(near.points.ids, some)]
                X_cam[new] = to_local(slam_map.T_world_cam[new], X_world)
                reach_m[new] = np.median(np.linalg.norm(X_cam[new], axis=0))
        self._map, self._ids, self._X_cam, self._reach_m = slam_map, slam_map.ids, X_cam, reach_m
        self._samples = None


def in_view(camera: Camera, T_world_cam: Pose, X_world: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, " n"]:
    """Tell which points are in the image of a camera, not at its margin."""
    X = to_local(T_world_cam, X_world)
    in_front = X[2] > 0
    X[2, ~in_front] = np.inf
    u, v = camera.project(X)
    right, low = camera.width - _MARGIN_PX, camera.height - _MARGIN_PX
    return in_front & (u > _MARGIN_PX) & (u < right) & (v > _MARGIN_PX) & (v < low)


def seen_alike(
    X_world: Float[np.ndarray, "3 n"], then: Float[np.ndarray, "3 n"], now: Float[np.ndarray, "3 1"]
) -> Bool[np.ndarray, " n"]:
    """Tell which points are seen from about the same direction and distance from two positions of the camera.

    Args:
        X_world: Positions of the points, meters.
        then: Position from which each of them was seen, meters.
        now: Present position of the camera, meters.
    """
    was, is_now = X_world - then, X_world - now
    far2, near2 = _squared_norm(was), _squared_norm(is_now)
    alike = np.einsum("in,in->n", was, is_now) > _MAX_TURN * np.sqrt(far2 * near2)
    return alike & (far2 > _SCALES[0] ** 2 * near2) & (far2 < _SCALES[1] ** 2 * near2)


def _squared_norm(vectors: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    return np.einsum("in,in->n", vectors, vectors)
