"""Cells of feature maps, in which dense detectors place their boxes."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from jaxslam.semantics.onnx_signature import ImageInput


class Grid(NamedTuple):
    """Cells of several feature maps, one map after the other, each row by row.

    Attributes:
        cells: `(a, 2)` column and row of each in its map.
        stride: `(a, 1)` pixels of the input from one cell to the next.
    """

    cells: Float32[np.ndarray, "a 2"]
    stride: Float32[np.ndarray, "a 1"]


def map_sizes(image: ImageInput, strides: tuple[int, ...]) -> list[tuple[int, int]]:
    """Columns and rows of each feature map."""
    return [(math.ceil(image.width / stride), math.ceil(image.height / stride)) for stride in strides]


def num_cells(image: ImageInput, strides: tuple[int, ...]) -> int:
    """Total number of anchors."""
    return sum(columns * rows for columns, rows in map_sizes(image, strides))


def grid(image: ImageInput, strides: tuple[int, ...]) -> Grid:
    """The cells for an input."""
    sizes = map_sizes(image, strides)
    cells = [np.stack(np.meshgrid(np.arange(c), np.arange(r)), axis=-1).reshape(-1, 2) for c, r in sizes]
    stride = [np.full((c * r, 1), s, np.float32) for (c, r), s in zip(sizes, strides, strict=True)]
    return Grid(np.concatenate(cells).astype(np.float32), np.concatenate(stride))


def corners(centers: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """`(n, 4)` left, top, right, bottom of boxes given by `(n, 2)` center and `(n, 2)` width and height."""
    return np.concatenate([centers - sizes / 2, centers + sizes / 2], axis=1)
