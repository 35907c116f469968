"""The dense map as a PLY file."""

import os
from typing import TypeAlias

from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.io.ply_file import write_ply_points

PathLike: TypeAlias = str | os.PathLike[str]


def write_points(path: PathLike, cloud: DenseCloud) -> None:
    """Write the points as a binary PLY: place in meters, color, and how many measured points each stands for.

    Raises:
        MapFileError: If the file cannot be written.
    """
    write_ply_points(path, cloud.points, cloud.colors, count=cloud.counts)
