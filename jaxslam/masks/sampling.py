"""Points to follow a mask by: one in every cell, where the picture has most texture.

Source: NGD-SLAM (Zhang, Cheng and Kaess 2025), section III-B.3.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

CELL_PX = 15
_WINDOW_PX = 5
_LEAST_SCORE = 1e-4
"""Smaller eigenvalue of the gradient matrix, of a picture from 0 to 1, below which a random pixel does as well."""
_NOT_MASKED = -1
"""Score of a pixel that is not to be chosen; those of corners are 0 up to rounding, or greater."""


def sample_mask(
    mask: Bool[np.ndarray, "h w"], grey: UInt8[np.ndarray, "h w"], capacity: int, seed: int
) -> Float32[np.ndarray, "2 k"]:
    """A masked pixel of every 15 x 15 cell that has one: the best corner, or where there is none, a random one.

    Only the part of the image around the mask is looked at.

    Args:
        mask: Pixels to choose from.
        grey: The image.
        capacity: Most points; of more cells, that many all over the mask.
        seed: Of the random choice.

    Returns:
        Pixels, row by row of cells.
    """
    region = _whole_cells(mask)
    inside = mask[region]
    if not inside.size:
        return np.zeros((2, 0), np.float32)
    score = _by_cell(np.where(inside, _corners(grey, region), _NOT_MASKED))
    _rank_at_random(score, np.random.default_rng(seed))
    where = score.argmax(axis=1)
    cells = np.flatnonzero(score[np.arange(len(score)), where] > _NOT_MASKED)
    if len(cells) > capacity:
        cells = cells[np.linspace(0, len(cells) - 1, capacity).round().astype(int)]
    row, column = np.divmod(cells, inside.shape[1] // CELL_PX)
    within_row, within_column = np.divmod(where[cells], CELL_PX)
    top, left = (span.start for span in region)
    return np.stack([left + column * CELL_PX + within_column, top + row * CELL_PX + within_row]).astype(np.float32)


def spacing(mask: Bool[np.ndarray, "h w"], capacity: int) -> np.float32:
    """How far the points of `sample_mask` are apart, on average: 1 for those of neighbouring cells."""
    return np.sqrt(np.float32(max(np.count_nonzero(mask) / (capacity * CELL_PX**2), 1)))


def _whole_cells(mask: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of the cells around what is masked; cells that reach past the image do not count."""
    height, width = (side // CELL_PX * CELL_PX for side in mask.shape)
    left, top, width, height = cv2.boundingRect(mask[:height, :width].view(np.uint8))
    return _cells(top, top + height), _cells(left, left + width)


def _cells(begin: int, end: int) -> slice:
    """The pixels of all cells of which some lie between."""
    return slice(begin // CELL_PX * CELL_PX, -(-end // CELL_PX) * CELL_PX)


def _corners(grey: UInt8[np.ndarray, "h w"], region: tuple[slice, slice]) -> Float32[np.ndarray, "_h _w"]:
    """Smaller eigenvalues of the gradient matrix in a part of the image, each from all pixels of its window."""
    rows, columns = (slice(max(span.start - _WINDOW_PX, 0), span.stop + _WINDOW_PX) for span in region)
    score = cv2.cornerMinEigenVal(grey[rows, columns], _WINDOW_PX)
    top, left = region[0].start - rows.start, region[1].start - columns.start
    return score[top:, left:][: region[0].stop - region[0].start, : region[1].stop - region[1].start]


def _rank_at_random(score: Float32[np.ndarray, "cells pixels"], generator: np.random.Generator) -> None:
    """Give masked pixels of cells without texture random scores; drawing them for all cells was a third of the time."""
    best = score.max(axis=1)
    flat = (best > _NOT_MASKED) & (best <= _LEAST_SCORE)
    random = generator.random((np.count_nonzero(flat), score.shape[1]), np.float32)
    score[flat] = np.where(score[flat] > _NOT_MASKED, random * _LEAST_SCORE, _NOT_MASKED)


def _by_cell(image: np.ndarray) -> np.ndarray:
    """`(cells, pixels)` of an image made of whole cells."""
    height, width = image.shape
    cells = image.reshape(height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX)
    return cells.swapaxes(1, 2).reshape(-1, CELL_PX * CELL_PX)
