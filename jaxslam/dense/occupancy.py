"""Occupancy grid: log-odds of occupied, free and unknown cells from the rays of depth images.

It is computed on request from the depth images of all keyframes with their poses of that moment, so corrections of the
map need no update. Source: Hornung et al., "OctoMap", Autonomous Robots 2013: a scan counts once in each cell, and in
a cell with both hits and misses the hit counts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxslam.errors import MapFileError
from jaxslam.geometry.so3 import matrices

HIT, MISS = np.float32(np.log(0.7 / 0.3)), np.float32(np.log(0.4 / 0.6))
LEAST, MOST = np.float32(np.log(0.12 / 0.88)), np.float32(np.log(0.97 / 0.03))
"""OctoMap's clamping bounds, log-odds; `HIT` and `MISS` above are its log-odds of a hit and of a miss."""
_MAX_CELLS = 2**26
"""Largest number of cells in the bounding box of the measured space; above it, the side of a cell is doubled."""
_MARGIN_CELLS = 2


class Occupancy(NamedTuple):
    """An axis-aligned grid of cells in the world.

    Attributes:
        cell_m: Side of a cell, meters.
        first: `(3,)` index of the first cell along each axis; cell `i` extends from `i cell_m` to `(i + 1) cell_m`.
        log_odds: `(x, y, z)` log-odds of occupancy; 0 or more in an occupied cell, as in OctoMap.
        known: `(x, y, z)` mask of the cells that a ray has reached.
    """

    cell_m: float
    first: Int[np.ndarray, "3"]
    log_odds: Float32[np.ndarray, "x y z"]
    known: Bool[np.ndarray, "x y z"]

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Look up the log-odds at `(n, 3)` world points in meters; NaN in unknown cells."""
        index = np.floor(np.asarray(points, np.float64) / self.cell_m).astype(np.int64) - self.first
        inside = np.all((index >= 0) & (index < np.array(self.log_odds.shape)), axis=1)
        x, y, z = np.where(inside[:, None], index, 0).T
        odds = np.where(self.known[x, y, z], self.log_odds[x, y, z], np.float32(np.nan))
        return np.where(inside, odds, np.float32(np.nan))


def occupancy(
    depths: Sequence[np.ndarray], poses: Float[np.ndarray, "k 7"], rays: Float[np.ndarray, "2 n"], cell_m: float
) -> Occupancy:
    """Compute the occupancy grid of some depth images.

    Args:
        depths: `k` depth images of `n` pixels, meters; 0 where depth is missing.
        poses: `(k, 7)` poses `T_world_cam` of the images.
        rays: `(2, n)` normalized image coordinates of the pixels.
        cell_m: Side of a cell, meters; it is doubled until the grid has at most 67 million cells.

    Raises:
        MapFileError: If no image has depth.
    """
    ahead = np.concatenate([rays, np.ones_like(rays[:1])]).astype(np.float32)
    ends = [_ends(depth, pose, ahead) for depth, pose in zip(depths, poses, strict=True)]
    reached = [np.concatenate([end, pose[4:, None]], axis=1) for end, pose in zip(ends, poses, strict=True)]
    if not sum(end.shape[1] for end in ends):
        raise MapFileError("octree: expected depth of at least one keyframe, got none")
    low, high = (np.stack([bound(points, axis=1) for points in reached]) for bound in (np.min, np.max))
    while True:
        first = np.floor(low.min(axis=0) / cell_m).astype(np.int64) - _MARGIN_CELLS
        shape = np.floor(high.max(axis=0) / cell_m).astype(np.int64) - first + 1 + _MARGIN_CELLS
        if np.prod(shape.astype(np.float64)) <= _MAX_CELLS:
            break
        cell_m *= 2
    log_odds, known = np.zeros(np.prod(shape), np.float32), np.zeros(np.prod(shape), bool)
    for end, pose in zip(ends, poses, strict=True):
        _add_scan(log_odds, known, end, pose[4:], first, shape, cell_m)
    return Occupancy(cell_m, first, log_odds.reshape(shape), known.reshape(shape))


def _ends(depth: np.ndarray, pose: np.ndarray, ahead: np.ndarray) -> Float32[np.ndarray, "3 m"]:
    """Return the end points of the rays with depth, in the world, meters."""
    flat = depth.reshape(-1)
    seen = flat > 0
    return (matrices(pose[:4]) @ (ahead[:, seen] * flat[seen]) + pose[4:, None]).astype(np.float32)


def _add_scan(
    log_odds: np.ndarray,
    known: np.ndarray,
    ends: np.ndarray,
    center: np.ndarray,
    first: np.ndarray,
    shape: np.ndarray,
    cell_m: float,
) -> None:
    """Add one depth image to the grid, stepping along each ray by the side of a cell.

    Args:
        log_odds: `(x y z)` log-odds of all cells, updated in place.
        known: `(x y z)` mask of the known cells, updated in place.
        ends: `(3, m)` end points of the rays in the world, meters.
        center: `(3,)` position of the camera in the world, meters.
        first: `(3,)` index of the first cell along each axis.
        shape: `(3,)` number of cells along each axis.
        cell_m: Side of a cell, meters.
    """
    if not ends.shape[1]:
        return
    start = ((center / cell_m) - first).astype(np.float32)[:, None]
    way = ends / np.float32(cell_m) - first.astype(np.float32)[:, None] - start
    length = np.linalg.norm(way, axis=0)
    # Longest first, so that the rays that have not ended yet are always the first ones.
    order = np.argsort(-length)
    way, length = way[:, order], length[order]
    unit = way / np.maximum(length, 1e-6)
    scales = np.array([shape[1] * shape[2], shape[2], 1], np.int64)
    hit = (start + way).astype(np.int64).T @ scales
    free = np.zeros(len(log_odds), bool)
    steps = np.arange(0.5, length[0], 1.0, dtype=np.float32)
    counts = np.searchsorted(-length, -(steps + 1))  # number of rays longer than the step
    for step, count in zip(steps.tolist(), counts.tolist(), strict=True):
        x, y, z = (start + unit[:, :count] * np.float32(step)).astype(np.int64)
        free[x * scales[0] + y * scales[1] + z] = True
    free[hit] = False
    hit, gone = np.unique(hit), np.flatnonzero(free)
    log_odds[hit] = np.minimum(log_odds[hit] + HIT, MOST)
    log_odds[gone] = np.maximum(log_odds[gone] + MISS, LEAST)
    known[hit] = known[gone] = True
