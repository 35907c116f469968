"""Bounding boxes of the blocks of a voxel grid, so that blocks out of view are skipped."""

import numpy as np
from jaxtyping import Float32, Int, Int32

from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import to_local
from jaxslam.geometry.types import Pose


class RowBoxes:
    """A bounding box of the voxels of each block of rows.

    Rows are assigned in the order in which voxels are first seen, so the voxels of a block are close together.
    """

    def __init__(self, capacity: int, block: int) -> None:
        """Create empty boxes.

        Args:
            capacity: Number of rows of the grid.
            block: Number of rows of a block.
        """
        self._block = min(block, capacity)
        count = -(-capacity // self._block)
        self._low, self._high = (np.full((3, count), fill, np.float32) for fill in (np.inf, -np.inf))

    def __len__(self) -> int:
        """Return the number of blocks."""
        return self._low.shape[1]

    def add(self, rows: Int[np.ndarray, " n"], X_world: Float32[np.ndarray, "3 n"]) -> None:
        """Extend the boxes by new rows.

        Args:
            rows: `(n,)` row numbers.
            X_world: `(3, n)` a point in the voxel of each row, meters.
        """
        block = rows // self._block
        for axis, x in enumerate(X_world):
            np.minimum.at(self._low[axis], block, x)
            np.maximum.at(self._high[axis], block, x)

    def clear(self) -> None:
        """Reset all boxes to empty."""
        self._low[:], self._high[:] = np.inf, -np.inf

    def in_view(self, T_world_cam: Pose, view: DepthView, voxel_m: float) -> Int32[np.ndarray, " b"]:
        """Return the blocks that a camera may see some of, up to the farthest valid depth.

        Args:
            T_world_cam: `(7,)` pose of the camera.
            view: Pixels and range of the camera.
            voxel_m: Side of a voxel, meters.
        """
        used = np.flatnonzero(self._low[0] <= self._high[0])
        low, high = self._low[:, used] - voxel_m, self._high[:, used] + voxel_m
        corners = np.stack([np.where(np.array(at)[:, None], high, low) for at in np.ndindex(2, 2, 2)], axis=1)
        x, y, z = to_local(T_world_cam, corners.reshape(3, -1)).reshape(3, 8, -1)
        (left, top), (right, bottom) = view.borders
        beyond = [z <= 0, z > view.farthest_m, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return used[~np.any([side.all(axis=0) for side in beyond], axis=0)].astype(np.int32)
