"""The dense map as a PLY file."""

import os
from typing import TypeAlias

import numpy as np

from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.errors import MapFileError
from jaxslam.io.atomic_files import write_atomically

PathLike: TypeAlias = str | os.PathLike[str]

_VERTEX = np.dtype(
    [*((axis, "<f4") for axis in "xyz"), *((channel, "u1") for channel in ("red", "green", "blue")), ("count", "<f4")]
)
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_points(path: PathLike, cloud: DenseCloud) -> None:
    """Write the points as a binary PLY: place in meters, color, and how many measured points each stands for.

    Raises:
        MapFileError: If the file cannot be written.
    """
    vertices = np.zeros(len(cloud.points), _VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = cloud.points.T
    vertices["red"], vertices["green"], vertices["blue"] = cloud.colors.T
    vertices["count"] = cloud.counts
    properties = [f"property {_PLY_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header\n"]
    write_atomically(path, "\n".join(header).encode() + vertices.tobytes(), MapFileError)
