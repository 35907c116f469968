"""The point cloud of a dense map."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8


class DenseCloud(NamedTuple):
    """Points of the dense map, one per row, as point cloud libraries take them.

    Attributes:
        points: `(n, 3)` centroids of the voxels in the world, meters.
        colors: `(n, 3)` red, green, and blue of each point, 0 to 255.
        counts: `(n,)` number of measured points in each voxel.
        is_key: `(n,)` mask of the points of key objects, which are at full density and come after the others.
        voxel_m: Side of the voxels of the points that are not of key objects, meters.
    """

    points: Float32[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    counts: Float32[np.ndarray, " n"]
    is_key: Bool[np.ndarray, " n"]
    voxel_m: float

    @property
    def megabytes(self) -> float:
        """Size of the points, colors and counts, megabytes."""
        return (self.points.nbytes + self.colors.nbytes + self.counts.nbytes) / 1e6
