"""How much of what a frame sees is in the picture of a keyframe.

The tracker counts points: while it sees all those of its keyframes, it makes no other one, however much has come into
the picture beside them. A camera that draws back sees twice as much and has no new keyframe, and the dense map nothing
of it: of a room that was backed away from for two seconds it had 84 % instead of 99 %.
"""

from collections import deque

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import between, transform
from jaxslam.sensors.camera import Camera

_COLUMNS = 32
"""Of pixels that are looked at."""
_MAX = 32
"""Keyframes, the newest ones; a place that was seen before those is seen anew."""
_MIN_PIXELS = 24
"""With depth; with fewer, nothing is said."""


class SeenArea:
    """The places of keyframes, and how much of a frame they show. What hides behind something counts as shown."""

    def __init__(self, camera: Camera, nearest_m: float, farthest_m: float) -> None:
        """Begin without keyframes.

        Args:
            camera: That takes the frames.
            nearest_m: Nearest depth believed.
            farthest_m: Farthest.
        """
        self._view = DepthView(camera, max(1, camera.width // _COLUMNS), farthest_m, nearest_m)
        half = 0.5 / np.array([self._view.intrinsics.fx, self._view.intrinsics.fy], np.float64)
        self._least, self._most = self._view.rays.min(axis=1) - half, self._view.rays.max(axis=1) + half
        self._keyframes: deque[np.ndarray] = deque(maxlen=_MAX)

    def add(self, T_world_cam: Float[np.ndarray, "7"]) -> None:
        """Take in the pose of a keyframe."""
        self._keyframes.append(T_world_cam)

    def share(
        self, depth: Float[np.ndarray, "h w"], ignore: Bool[np.ndarray, "h w"], T_world_cam: Float[np.ndarray, "7"]
    ) -> float:
        """How much of a frame any of the keyframes shows, 0 to 1; 1 where there is too little depth to say.

        Args:
            depth: Meters; 0 where missing.
            ignore: Where something moves or may.
            T_world_cam: Where the frame was taken.
        """
        small = np.ascontiguousarray(self._view.every(depth), np.float32)
        usable = np.flatnonzero(self._view.is_believed(small, self._view.every(ignore)))
        if len(usable) < _MIN_PIXELS:
            return 1.0
        X = self._view.points(small, usable).astype(np.float64)
        shown = np.zeros(len(usable), bool)
        for keyframe in reversed(self._keyframes):
            there = transform(between(keyframe, T_world_cam), X[:, ~shown])
            xy = there[:2] / np.maximum(there[2], self._view.nearest_m)
            inside = (xy > self._least[:, None]) & (xy < self._most[:, None])
            shown[~shown] = inside.all(axis=0) & (there[2] > self._view.nearest_m)
            if shown.all():
                break
        return float(shown.mean())
