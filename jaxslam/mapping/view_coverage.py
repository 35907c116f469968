"""What keyframes of the map show of what the camera sees."""

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

    def num_views(self, slam_map: Map, T_world_cam: Pose, submap: int) -> int:
        """Count the keyframes of a map that show the view of a camera.

        Args:
            slam_map: The map.
            T_world_cam: `(7,)` pose of the camera.
            submap: Number of the submap that it is in.
        """
        if slam_map is not self._map:
            self._take(slam_map)
        apart_m = np.linalg.norm(slam_map.T_world_cam[:, 4:] - T_world_cam[4:], axis=1)
        near = np.flatnonzero((slam_map.submap == submap) & (apart_m < self._reach_m))
        if not len(near):
            return 0
        T_world_keyframe = slam_map.T_world_cam[near]
        position = T_world_keyframe[:, 4:, None]
        X_world = matrices(T_world_keyframe[:, :4]) @ self._X_cam[near] + position
        X_world, then = (
            np.moveaxis(np.broadcast_to(of, X_world.shape), 1, 0).reshape(3, -1) for of in (X_world, position)
        )
        seen = in_view(slam_map.camera, T_world_cam, X_world) & seen_alike(X_world, then, T_world_cam[4:, None])
        return int((seen.reshape(len(near), _NUM_SAMPLES).mean(axis=1) >= self._at_least).sum())

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


def in_view(camera: Camera, T_world_cam: Pose, X_world: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, " n"]:
    """Tell which points are in the image of a camera, not at its margin."""
    X = to_local(T_world_cam, X_world)
    uv = camera.project(np.stack([X[0], X[1], np.where(X[2] > 0, X[2], np.inf)]))
    size = np.array([[camera.width], [camera.height]])
    return (X[2] > 0) & ((uv > _MARGIN_PX) & (uv < size - _MARGIN_PX)).all(axis=0)


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
    far, near = np.linalg.norm(was, axis=0), np.linalg.norm(is_now, axis=0)
    alike = (was * is_now).sum(axis=0) > _MAX_TURN * near * far
    return alike & (far > _SCALES[0] * near) & (far < _SCALES[1] * near)
