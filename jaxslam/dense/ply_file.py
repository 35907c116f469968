"""Write the dense map as a PLY file."""

import os
from typing import TypeAlias

from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.io.ply_file import write_ply_points

PathLike: TypeAlias = str | os.PathLike[str]


def write_points(path: PathLike, cloud: DenseCloud) -> None:
    """Write the points as a binary PLY file: position in meters, color, and number of measured points.

    Raises:
        MapFileError: If the file cannot be written.
    """
    write_ply_points(path, cloud.points, cloud.colors, count=cloud.counts)
