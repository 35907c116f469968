"""Where space is occupied, free and unknown, in cells: log-odds of what rays of depth hit and go through.

Made of the depth images of all keyframes when it is asked for, with the poses they have then; nothing has to be put
right when the map moves. Source: Hornung et al., "OctoMap", Autonomous Robots 2013: a scan counts once in each cell,
and in a cell that it both hits and goes through, the hit counts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxslam.errors import MapFileError
from jaxslam.geometry.so3 import matrices

HIT, MISS = np.float32(np.log(0.7 / 0.3)), np.float32(np.log(0.4 / 0.6))
LEAST, MOST = np.float32(np.log(0.12 / 0.88)), np.float32(np.log(0.97 / 0.03))
"""OctoMap's probabilities of a hit and of a ray that goes through, and its bounds, as log-odds."""
_MAX_CELLS = 2**26
"""Of the box around all that is seen; with more, cells become twice as large."""
_MARGIN_CELLS = 2


class Occupancy(NamedTuple):
    """A box of cells.

    Attributes:
        cell_m: Side of a cell.
        first: `(3,)` number of the first cell along each axis; cell `i` reaches from `i cell_m` to `(i + 1) cell_m`.
        log_odds: `(x, y, z)`; of a cell that is occupied 0 or more, as in OctoMap.
        known: `(x, y, z)` cells that any ray has come to.
    """

    cell_m: float
    first: Int[np.ndarray, "3"]
    log_odds: Float32[np.ndarray, "x y z"]
    known: Bool[np.ndarray, "x y z"]

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Log-odds at points in meters; not a number where nothing is known."""
        index = np.floor(np.asarray(points, np.float64) / self.cell_m).astype(np.int64) - self.first
        inside = np.all((index >= 0) & (index < np.array(self.log_odds.shape)), axis=1)
        x, y, z = np.where(inside[:, None], index, 0).T
        odds = np.where(self.known[x, y, z], self.log_odds[x, y, z], np.float32(np.nan))
        return np.where(inside, odds, np.float32(np.nan))


def occupancy(
    depths: Sequence[np.ndarray], poses: Float[np.ndarray, "k 7"], rays: Float[np.ndarray, "2 n"], cell_m: float
) -> Occupancy:
    """The cells that depth images say something of.

    Args:
        depths: `k` images of `n` pixels, meters, 0 where missing.
        poses: Where each was taken, `T_world_cam`.
        rays: Where the ray of each pixel meets the plane one meter ahead of the camera.
        cell_m: Side of a cell; doubled until the box around all of them has no more than 67 million.

    Raises:
        MapFileError: If there is no depth at all.
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
    """Where the rays end, in the world."""
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
    """Take in one depth image: a step of a cell along each ray, up to the cell before its end."""
    if not ends.shape[1]:
        return
    start = ((center / cell_m) - first).astype(np.float32)[:, None]
    way = ends / np.float32(cell_m) - first.astype(np.float32)[:, None] - start
    length = np.linalg.norm(way, axis=0)
    # Longest first, so that the rays that still go on are always the first ones.
    order = np.argsort(-length)
    way, length = way[:, order], length[order]
    unit = way / np.maximum(length, 1e-6)
    scales = np.array([shape[1] * shape[2], shape[2], 1], np.int64)
    hit = (start + way).astype(np.int64).T @ scales
    free = np.zeros(len(log_odds), bool)
    steps = np.arange(0.5, length[0], 1.0, dtype=np.float32)
    counts = np.searchsorted(-length, -(steps + 1))  # rays longer than that
    for step, count in zip(steps.tolist(), counts.tolist(), strict=True):
        x, y, z = (start + unit[:, :count] * np.float32(step)).astype(np.int64)
        free[x * scales[0] + y * scales[1] + z] = True
    free[hit] = False
    hit, gone = np.unique(hit), np.flatnonzero(free)
    log_odds[hit] = np.minimum(log_odds[hit] + HIT, MOST)
    log_odds[gone] = np.maximum(log_odds[gone] + MISS, LEAST)
    known[hit] = known[gone] = True
