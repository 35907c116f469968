"""The dense map as it is given out: points with colors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8


class DenseCloud(NamedTuple):
    """Points of the dense map, one a row, as libraries for point clouds take them.

    Attributes:
        points: `(n, 3)` meters in the world, each the centroid of a voxel.
        colors: `(n, 3)` red, green, blue.
        counts: `(n,)` how many measured points each stands for.
        is_key: `(n,)` points of key objects, which are at full density; they come after the others.
        voxel_m: Side of the voxels of the others.
    """

    points: Float32[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    counts: Float32[np.ndarray, " n"]
    is_key: Bool[np.ndarray, " n"]
    voxel_m: float

    @property
    def megabytes(self) -> float:
        """What the points take up."""
        return (self.points.nbytes + self.colors.nbytes + self.counts.nbytes) / 1e6
