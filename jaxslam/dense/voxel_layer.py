"""One voxel grid and the points that each keyframe added to it, so that the points move with their keyframe.

Not thread-safe.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxslam_kernels.depth.voxel_grid import empty_grid
from jaxslam_kernels.depth.voxel_hash import NO_ROW
from jaxtyping import Bool, Float32, Int, Int32, UInt8

from jaxslam.dense.block_bounds import RowBoxes
from jaxslam.dense.depth_view import DepthView, Looks
from jaxslam.dense.voxel_programs import (
    MISS,
    ROWS,
    Cloud,
    all_centroids,
    cloud_size,
    looked,
    num_past,
    put,
    rebuilt,
    reduced,
    taken_out,
)
from jaxslam.geometry.se3 import IDENTITY, transform
from jaxslam.runtime.padding import padded

HIT = np.float32(0.85)
"""Log-odds of a hit, a point of a keyframe in a voxel: a probability of 0.7, as in OctoMap."""
_GONE = -1.0
"""Log-odds of a voxel below which its points are dropped when their keyframe is moved."""
_MAX_PAST = 3
"""Largest number of earlier keyframes seeing through a new point that counts: an object may have been placed there
since."""
_FULL, _STILL_FULL = 0.9, 0.7
"""Shares of voxels in use above which free voxels are removed, and above which, after that, voxels are enlarged."""
_SIZES = 4
"""Number of array sizes to which the points given to `reduce` are padded; the voxel search runs on all of them at
once."""


class VoxelPart(NamedTuple):
    """The points of one keyframe in the grid.

    Attributes:
        X_cam: `(3, m)` int16 coordinates in the camera frame, in units of `VoxelLayer.unit_m`.
        color: `(3, m)` uint8 red, green, and blue of each point.
        counts: `(m,)` float16 number of measured points that each point stands for.
        rows: `(m,)` row of each point in the grid; `NO_ROW` for points that have left the grid.
        T_world_cam: `(7,)` pose of the keyframe with which the points are in the grid; `None` while they are not in it.
    """

    X_cam: np.ndarray
    color: np.ndarray
    counts: np.ndarray
    rows: Int32[np.ndarray, " m"]
    T_world_cam: np.ndarray | None

    @property
    def nbytes(self) -> int:
        """Memory of the points, bytes."""
        return self.X_cam.nbytes + self.color.nbytes + self.counts.nbytes + self.rows.nbytes


class VoxelLayer:
    """A grid of voxels of one size.

    Attributes:
        voxel_m: Side of a voxel, meters; it doubles when the grid is full.
        parts: The points of each keyframe, by keyframe id.
        unit_m: Unit of the coordinates of parts, meters.
    """

    def __init__(self, capacity: int, part_points: int, most_points: int, voxel_m: float, farthest_m: float) -> None:
        """Create an empty grid.

        Args:
            capacity: Largest number of voxels.
            part_points: Largest number of points of a keyframe.
            most_points: Largest number of points given to `reduce`.
            voxel_m: Side of a voxel, meters.
            farthest_m: Largest valid depth, meters.
        """
        self.voxel_m = voxel_m
        self.parts: dict[int, VoxelPart] = {}
        self._capacity, self._part_points, self._cloud_size = capacity, part_points, cloud_size(part_points)
        self._sizes = [-(-most_points * count // _SIZES) for count in range(1, _SIZES + 1)]
        self.unit_m = np.float32(4 * farthest_m / 32767)  # views are up to 150 degrees wide
        self._grid, self._boxes = empty_grid(capacity), RowBoxes(capacity, ROWS)

    def reduce(self, X_cam: Float32[np.ndarray, "3 n"], colors: UInt8[np.ndarray, "3 n"]) -> VoxelPart:
        """Reduce the points of a keyframe to one per voxel in its camera frame.

        Voxels are enlarged until no more than `part_points` points are left.

        Args:
            X_cam: `(3, n)` points in the camera frame, meters.
            colors: `(3, n)` red, green, and blue of each point.
        """
        voxel_m, count = self.voxel_m, X_cam.shape[1]
        size = next(size for size in self._sizes if size >= count)
        X_cam, colors = padded(X_cam, size, axis=1), padded(colors, size, axis=1)
        while True:
            cloud, num = reduced(
                X_cam, colors, np.int32(count), np.float32(voxel_m), self.unit_m, capacity=self._part_points
            )
            num = int(num)
            if num <= self._part_points:
                break
            voxel_m *= 1.05 * np.sqrt(num / self._part_points)  # points of a surface: proportional to 1 / voxel_m^2
        X, color, counts = (np.asarray(array)[..., :num].copy() for array in cloud)
        return VoxelPart(X, color, counts, np.full(num, NO_ROW, np.int32), None)

    def put(
        self, keyframe: int, part: VoxelPart, T_world_cam: np.ndarray, past: Int[np.ndarray, " m"] | None = None
    ) -> None:
        """Add the points of a keyframe to the grid.

        Args:
            keyframe: Id of the keyframe.
            part: Points of the keyframe.
            T_world_cam: `(7,)` pose of the keyframe.
            past: `(m,)` number of earlier keyframes that see through each point.
        """
        evidence = np.full(self._cloud_size, HIT)
        if past is not None:
            evidence[: len(past)] += np.float32(MISS) * np.minimum(past, _MAX_PAST)
        pose, before = T_world_cam.astype(np.float32), int(self._grid.table.num)
        self._grid, rows = put(self._grid, self._cloud(part), evidence, pose, np.float32(self.voxel_m))
        rows = np.array(rows)[: len(part.rows)]
        new = rows >= before
        self._boxes.add(rows[new], transform(pose, part.X_cam[:, new] * self.unit_m))
        self.parts[keyframe] = part._replace(rows=rows, T_world_cam=T_world_cam)

    def take_out(self, keyframe: int, which: Bool[np.ndarray, " m"] | None = None) -> VoxelPart:
        """Remove points of a keyframe from the grid: all for now, or those where `which` is true for good.

        Returns:
            The remaining points of the keyframe.
        """
        part = self.parts[keyframe]
        if part.T_world_cam is None:
            left = part if which is None else _at(part, ~which)
            self.parts[keyframe] = left
            return left
        rows = part.rows if which is None else np.where(which, part.rows, np.int32(NO_ROW))
        rows, evidence = padded(rows, self._cloud_size, fill=NO_ROW), np.full(self._cloud_size, -HIT)
        pose = part.T_world_cam.astype(np.float32)
        self._grid = taken_out(self._grid, rows, self._cloud(part), evidence, pose, np.float32(self.voxel_m))
        left = part._replace(T_world_cam=None) if which is None else _at(part, ~which)
        self.parts[keyframe] = left
        return left

    def move(self, keyframe: int, T_world_cam: np.ndarray | None) -> None:
        """Move the points of a keyframe to a new pose, or out of the grid if it is `None`; drop the carved points."""
        part = self.parts[keyframe]
        if part.T_world_cam is not None:
            odds = np.asarray(self._grid.sums)[np.maximum(part.rows, 0), 7]
            stays = (part.rows != NO_ROW) & (odds > _GONE)
            part = _at(self.take_out(keyframe), stays)
            self.parts[keyframe] = part
        if T_world_cam is not None:
            self.put(keyframe, part, T_world_cam)

    def forget(self, keyframe: int) -> None:
        """Freeze the points of a keyframe: they stay in the grid but can no longer be moved."""
        del self.parts[keyframe]

    def look(self, looks: Looks, T_world_cam: np.ndarray, view: DepthView) -> None:
        """Update the voxels in view of a frame: confirm those that it sees again, carve those that it sees through."""
        blocks = self._boxes.in_view(T_world_cam, view, self.voxel_m)
        count, blocks = np.int32(len(blocks)), padded(blocks, len(self._boxes))
        pose, size = T_world_cam.astype(np.float32), np.float32(self.voxel_m)
        self._grid = looked(self._grid, blocks, count, pose, *looks, view.intrinsics, size)

    def past(
        self, part: VoxelPart, T_world_cam: np.ndarray, looks: Looks, poses: np.ndarray, view: DepthView
    ) -> np.ndarray:
        """Count the depth images that see through each point of a keyframe; `(m,)`.

        Args:
            part: Points of the keyframe.
            T_world_cam: `(7,)` pose of the keyframe.
            looks: `(k, h, w)` depth images.
            poses: `(k, 7)` poses of the depth images.
            view: Pixel grid of the depth images.
        """
        arrays = T_world_cam.astype(np.float32), looks.depth, looks.least, poses.astype(np.float32), view.intrinsics
        counts = num_past(self._cloud(part), *arrays, np.float32(self.voxel_m))
        return np.asarray(counts)[: len(part.counts)]

    def make_room(self) -> None:
        """Remove free voxels if the grid is nearly full; if that is not enough, enlarge the voxels."""
        if int(self._grid.table.num) < _FULL * self._capacity:
            return
        self._rebuild(1)
        while int(self._grid.table.num) >= _STILL_FULL * self._capacity:
            self._rebuild(2)

    def shown(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the points `(n, 3)`, colors `(n, 3)` and counts `(n,)` of all voxels with points that are not free."""
        num = int(self._grid.table.num)
        voxels = all_centroids(self._grid, np.float32(self.voxel_m))
        keep = (np.asarray(voxels.counts)[:num] > 0) & (np.asarray(self._grid.sums)[:num, 7] > 0)
        X, color, count = (np.asarray(array)[..., :num][..., keep] for array in voxels[:3])
        color = np.clip(np.rint(color), 0, 255).astype(np.uint8)
        return np.ascontiguousarray(X.T), np.ascontiguousarray(color.T), count

    def compile(self, view: DepthView, small: DepthView, num_looks: int) -> None:
        """Compile all programs on an empty grid.

        Args:
            view: Pixel grid of new depth images.
            small: Pixel grid of the stored depth images.
            num_looks: Number of stored depth images that new points are compared with.
        """
        parts = [self.reduce(np.full((3, n), np.nan, np.float32), np.zeros((3, n), np.uint8)) for n in self._sizes]
        part = parts[0]
        self.put(NO_ROW, part, IDENTITY)
        self.move(NO_ROW, IDENTITY)
        del self.parts[NO_ROW]
        blank = np.zeros((num_looks, *small.shape), np.float32)
        self.past(part, IDENTITY, Looks(blank, blank), np.tile(IDENTITY, (num_looks, 1)), small)
        for used in (view, small):
            self.look(used.looks(np.zeros(used.shape, np.float32)), IDENTITY, used)
        self.shown()
        # When the grid was full, a thread that had to compile this first took 0.9 s longer.
        voxel_m = np.float32(self.voxel_m)
        jax.block_until_ready(rebuilt(self._grid, voxel_m, voxel_m, self._capacity))

    @property
    def nbytes(self) -> int:
        """Memory in use, bytes: the grid, which has a fixed size, and the points of keyframes."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self._grid)) + self.part_bytes

    @property
    def part_bytes(self) -> int:
        """Memory in use for the points of keyframes, bytes."""
        return sum(part.nbytes for part in self.parts.values())

    def _cloud(self, part: VoxelPart) -> Cloud:
        """Pad a part to the size that programs are compiled for."""
        size = self._cloud_size
        X, color = padded(part.X_cam, size, axis=1), padded(part.color, size, axis=1)
        return Cloud(X, color, padded(part.counts, size), np.int32(len(part.counts)), self.unit_m)  # pyright: ignore[reportArgumentType]

    def _rebuild(self, factor: int) -> None:
        """Rebuild the grid without free voxels, with voxels `factor` times as large."""
        old, self.voxel_m = np.float32(self.voxel_m), self.voxel_m * factor
        self._grid, rows, X = rebuilt(self._grid, old, np.float32(self.voxel_m), self._capacity)
        rows, X = np.asarray(rows), np.asarray(X)
        self._boxes.clear()
        self._boxes.add(rows[rows != NO_ROW], X[:, rows != NO_ROW])
        new = np.append(rows, np.int32(NO_ROW))
        for keyframe, part in self.parts.items():
            if part.T_world_cam is not None:
                self.parts[keyframe] = part._replace(rows=new[part.rows])


def _at(part: VoxelPart, which: Bool[np.ndarray, " m"]) -> VoxelPart:
    return VoxelPart(part.X_cam[:, which], part.color[:, which], part.counts[which], part.rows[which], part.T_world_cam)
