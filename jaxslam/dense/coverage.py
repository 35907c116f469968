"""Share of a frame's view that keyframes cover, from which keyframes for the dense map are chosen.

The tracker decides by counting points: while it sees the points of its keyframes, it makes no new keyframe, even if
much else has come into view. A camera that moves backward may see twice as much without a new keyframe, and the dense
map gets none of it: after backing away from a room for two seconds it held 84 % of the room instead of 99 %.
"""

from collections import deque

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import between, transform
from jaxslam.sensors.camera import Camera

_COLUMNS = 32
"""Columns of the pixel grid that is checked."""
_MAX = 32
"""Number of the newest keyframes that count; a place seen only before them counts as not covered."""
_MIN_PIXELS = 24
"""Fewest pixels with valid depth for an answer."""


class SeenArea:
    """The poses of the newest keyframes, and the share of a frame that they cover; occluded points count as covered."""

    def __init__(self, camera: Camera, nearest_m: float, farthest_m: float) -> None:
        """Start without keyframes.

        Args:
            camera: Camera of the frames.
            nearest_m: Smallest valid depth, meters.
            farthest_m: Largest valid depth, meters.
        """
        self._view = DepthView(camera, max(1, camera.width // _COLUMNS), farthest_m, nearest_m)
        half = 0.5 / np.array([self._view.intrinsics.fx, self._view.intrinsics.fy], np.float64)
        self._least, self._most = self._view.rays.min(axis=1) - half, self._view.rays.max(axis=1) + half
        self._keyframes: deque[np.ndarray] = deque(maxlen=_MAX)

    def add(self, T_world_cam: Float[np.ndarray, "7"]) -> None:
        """Add the `(7,)` pose of a keyframe."""
        self._keyframes.append(T_world_cam)

    def share(
        self, depth: Float[np.ndarray, "h w"], ignore: Bool[np.ndarray, "h w"], T_world_cam: Float[np.ndarray, "7"]
    ) -> float:
        """Return the share of a frame that any of the keyframes covers, 0 to 1; 1 if too few pixels have valid depth.

        Args:
            depth: `(h, w)` depth image, meters; 0 where depth is missing.
            ignore: `(h, w)` mask of the pixels that are dynamic or may be.
            T_world_cam: `(7,)` pose of the frame.
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
