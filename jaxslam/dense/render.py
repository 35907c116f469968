"""Render the dense map without a mesh: each point is drawn as a small square, nearest on top, with the camera's path.

There are two views side by side: from behind and above the camera, and from the top. The map does not know gravity, so
down is the mean direction of the camera's y axis.
"""

import os
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.errors import MapFileError
from jaxslam.geometry.so3 import matrices
from jaxslam.io.atomic_files import write_atomically

PathLike: TypeAlias = str | os.PathLike[str]

_WIDTH, _HEIGHT = 960, 720
_BACKGROUND, _PATH_RGB = 24, (255, 160, 0)
_VIEW = 0.9
"""Tangent of half the horizontal field of view of the perspective view."""
_MAX_SPLAT_PX = 6
_HEADROOM = 0.1
"""Height above the camera, as a share of the extent of the shown part, beyond which points are left out of the top view
because they are a ceiling."""
_NEAREST = 0.03
"""Smallest depth that is drawn, as a share of the extent of the shown part."""


class _Screen(NamedTuple):
    """Points projected into a picture.

    Attributes:
        uv: `(2, n)` image coordinates, pixels.
        depth: `(n,)` depth behind the screen, meters; 0 for points that are not in front of the viewer, and hidden.
        pixel_per_m: `(n,)` scale at each point, pixels per meter.
    """

    uv: np.ndarray
    depth: np.ndarray
    pixel_per_m: np.ndarray


class _Stand(NamedTuple):
    """Pose and size of the shown part of the map.

    Attributes:
        axes: `(3, 3)` rows: unit vectors to the right, down, and ahead, in the world.
        center: `(3,)` center of the shown part in the world, meters.
        extent_m: Half the size of the shown part, meters.
    """

    axes: np.ndarray
    center: np.ndarray
    extent_m: float


def write_picture(path: PathLike, cloud: DenseCloud, T_world_cam: Float[np.ndarray, "k 7"]) -> None:
    """Write a PNG picture of the map with the path of the camera.

    Raises:
        MapFileError: If the file cannot be written.
    """
    png = cv2.imencode(".png", cv2.cvtColor(picture(cloud, T_world_cam), cv2.COLOR_RGB2BGR))[1]
    write_atomically(path, png.tobytes(), MapFileError)


def picture(cloud: DenseCloud, T_world_cam: Float[np.ndarray, "k 7"]) -> UInt8[np.ndarray, "h w 3"]:
    """Render the map from behind the camera and from the top, with the path of the camera.

    Args:
        cloud: Points of the map; it may be empty.
        T_world_cam: `(k, 7)` poses along the path; `k` may be 0.
    """
    stand = _stand(cloud, T_world_cam)
    path = T_world_cam[:, 4:]
    highest = (path @ stand.axes[1]).min() - _HEADROOM * stand.extent_m if len(path) else -np.inf
    below = cloud.points @ stand.axes[1].astype(np.float32) > highest
    views = (
        (cloud, lambda X: _ahead(X, stand)),
        (_part(cloud, below), lambda X: _from_above(X, stand)),
    )
    panels: list[np.ndarray] = []
    for shown, project in views:
        panel = _drawn(project(shown.points), shown)
        _draw_path(panel, project(path))
        panels.append(panel)
    return np.concatenate(panels, axis=1)


def _part(cloud: DenseCloud, which: np.ndarray) -> DenseCloud:
    arrays = cloud.points[which], cloud.colors[which], cloud.counts[which], cloud.is_key[which]
    return DenseCloud(*arrays, cloud.voxel_m)


def _stand(cloud: DenseCloud, T_world_cam: np.ndarray) -> _Stand:
    R = matrices(T_world_cam[:, :4]) if len(T_world_cam) else np.eye(3)[None]
    down = _unit(R[:, :, 1].mean(axis=0), np.array([0.0, 1, 0]))
    ahead = R[:, :, 2].mean(axis=0)
    ahead = _unit(ahead - down * (ahead @ down), np.cross(down, [1.0, 0, 0]))
    axes = np.stack([np.cross(down, ahead), down, ahead])
    points = cloud.points if len(cloud.points) else np.zeros((1, 3))
    local = points @ axes.T
    low, high = np.percentile(local, [2, 98], axis=0)
    if len(T_world_cam):  # on a road, the path starts behind everything that was seen from it
        path = T_world_cam[:, 4:] @ axes.T
        low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    extent_m = float(max(0.5 * (high - low)[[0, 2]].max(), 0.5))
    return _Stand(axes, 0.5 * (low + high) @ axes, extent_m)


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)


def _ahead(X: np.ndarray, stand: _Stand) -> _Screen:
    """Project points in perspective, from behind and above the shown part, looking down by 30 degrees."""
    right, down, ahead = stand.axes
    cos, sin = np.cos(np.pi / 6), np.sin(np.pi / 6)
    axes = np.stack([right, down * cos - ahead * sin, ahead * cos + down * sin])
    eye = stand.center - 1.9 * stand.extent_m * axes[2]
    x, y, z = ((X - eye) @ axes.T).T
    front = z > _NEAREST * stand.extent_m
    seen, depth = np.where(front, z, np.inf), np.where(front, z, 0.0)
    focal = 0.5 * _WIDTH / _VIEW
    return _Screen(np.stack([0.5 * _WIDTH + focal * x / seen, 0.5 * _HEIGHT + focal * y / seen]), depth, focal / seen)


def _from_above(X: np.ndarray, stand: _Stand) -> _Screen:
    """Project points orthographically from the top; the viewing direction of the camera is up in the picture."""
    scale = 0.46 * min(_WIDTH, _HEIGHT) / stand.extent_m
    x, y, z = ((X - stand.center) @ stand.axes.T).T
    uv = np.stack([0.5 * _WIDTH + scale * x, 0.5 * _HEIGHT - scale * z])
    return _Screen(uv, y + 100 * stand.extent_m, np.full(len(X), scale))


def _drawn(screen: _Screen, cloud: DenseCloud) -> UInt8[np.ndarray, "h w 3"]:
    """Draw each point as a square of the projected size of its voxel, the farthest first."""
    panel = np.full((_HEIGHT * _WIDTH, 3), _BACKGROUND, np.uint8)
    order = np.argsort(-screen.depth)
    order = order[screen.depth[order] > 0]
    voxels_m = np.where(cloud.is_key, 0.25, 1.0) * cloud.voxel_m
    side = np.clip(np.ceil(screen.pixel_per_m * voxels_m), 1, _MAX_SPLAT_PX).astype(np.int64)[order]
    column, row = np.clip(np.nan_to_num(screen.uv[:, order]), -1e6, 1e6).astype(np.int64)
    most = int(side.max(initial=1))
    # All pixels of a square have the same order, so the largest index at a pixel is the nearest point.
    steps = np.arange(most) - most // 2
    dv, du = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    covers = np.maximum(np.abs(dv), np.abs(du))[None] * 2 <= side[:, None]
    v, u = row[:, None] + dv, column[:, None] + du
    covers &= (v >= 0) & (v < _HEIGHT) & (u >= 0) & (u < _WIDTH)
    point = np.broadcast_to(np.arange(len(order))[:, None], covers.shape)[covers]
    nearest = np.full(len(panel), -1, np.int64)
    np.maximum.at(nearest, (v * _WIDTH + u)[covers], point)
    some = nearest >= 0
    panel[some] = cloud.colors[order][nearest[some]]
    return panel.reshape(_HEIGHT, _WIDTH, 3)


def _draw_path(panel: UInt8[np.ndarray, "h w 3"], screen: _Screen) -> None:
    line = np.rint(np.clip(screen.uv.T, -1e4, 1e4)).astype(np.int32)[screen.depth > 0]
    if len(line):
        cv2.polylines(panel, [line.reshape(-1, 1, 2)], isClosed=False, color=_PATH_RGB, thickness=2)
        cv2.circle(panel, tuple(line[-1].tolist()), 6, _PATH_RGB, -1)
