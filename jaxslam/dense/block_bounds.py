"""Where in space the rows of a grid are, block by block, so that those out of view need no look."""

import numpy as np
from jaxtyping import Float32, Int, Int32

from jaxslam.dense.depth_view import DepthView
from jaxslam.geometry.se3 import to_local


class RowBoxes:
    """A box around the voxels of each block of rows.

    Rows are given in the order in which voxels are first seen, so that those of a block lie together.
    """

    def __init__(self, capacity: int, block: int) -> None:
        """Of a grid of so many rows, without any."""
        self._block = min(block, capacity)
        count = -(-capacity // self._block)
        self._low, self._high = (np.full((3, count), fill, np.float32) for fill in (np.inf, -np.inf))

    def __len__(self) -> int:
        """Blocks."""
        return self._low.shape[1]

    def add(self, rows: Int[np.ndarray, " n"], X_world: Float32[np.ndarray, "3 n"]) -> None:
        """Take in new rows by a point in the voxel of each."""
        block = rows // self._block
        for axis, x in enumerate(X_world):
            np.minimum.at(self._low[axis], block, x)
            np.maximum.at(self._high[axis], block, x)

    def clear(self) -> None:
        """Forget all."""
        self._low[:], self._high[:] = np.inf, -np.inf

    def in_view(self, T_world_cam: np.ndarray, view: DepthView, voxel_m: float) -> Int32[np.ndarray, " b"]:
        """Blocks of which a camera may see something, up to the farthest depth believed."""
        used = np.flatnonzero(self._low[0] <= self._high[0])
        low, high = self._low[:, used] - voxel_m, self._high[:, used] + voxel_m
        corners = np.stack([np.where(np.array(at)[:, None], high, low) for at in np.ndindex(2, 2, 2)], axis=1)
        x, y, z = to_local(T_world_cam, corners.reshape(3, -1)).reshape(3, 8, -1)
        (left, top), (right, bottom) = view.borders
        beyond = [z <= 0, z > view.farthest_m, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return used[~np.any([side.all(axis=0) for side in beyond], axis=0)].astype(np.int32)
