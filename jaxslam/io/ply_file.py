"""PLY files: colored points with further numbers for each."""

import os

import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.errors import MapFileError
from jaxslam.io.atomic_files import write_atomically

_PLACES = tuple((axis, "<f4") for axis in "xyz")
_COLORS = tuple((channel, "u1") for channel in ("red", "green", "blue"))
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply_points(
    path: str | os.PathLike[str],
    points: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"],
    **numbers: np.ndarray,
) -> None:
    """Write colored points as a binary PLY file.

    Args:
        path: The file to write. It appears whole or not at all.
        points: `(n, 3)` coordinates, meters.
        colors: `(n, 3)` RGB.
        **numbers: One further property of the points by name, `(n,)`. All are stored as 32-bit floats, because COLMAP
            reads no integers.

    Raises:
        MapFileError: If the file cannot be written.
    """
    vertex = np.dtype([*_PLACES, *_COLORS, *((name, "<f4") for name in numbers)])
    vertices = np.zeros(len(points), vertex)
    for name, values in zip(vertex.names or (), (*points.T, *colors.T, *numbers.values()), strict=True):
        vertices[name] = values
    properties = [f"property {_PLY_TYPES[vertex[name].str]} {name}" for name in vertex.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header\n"]
    write_atomically(path, "\n".join(header).encode() + vertices.tobytes(), MapFileError)
