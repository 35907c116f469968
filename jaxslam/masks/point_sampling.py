"""Points to follow a mask by: one in every cell, where the picture has most texture.

Source: NGD-SLAM (Zhang, Bujanca and Luján 2025), section III-B.3; there, cells have 15 pixels of an image of 640.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

CELL_PX = 8
"""Of an image about 320 pixels wide."""
_WINDOW_PX = 5
_MIN_SCORE = 1e-4
"""Smaller eigenvalue of the gradient matrix, of a picture from 0 to 1, below which a random pixel does as well."""
_TURNS = (0.7548776662, 0.5698402910)
"""Of rows and columns of cells: those whose multiples of these add up to least, whole numbers left out, are all over
the plane (the additive sequence R2: Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018)."""
_NOT_MASKED = -1
"""Score of a pixel that is not to be chosen; those of corners are 0 up to rounding, or greater."""


class SampledPoints(NamedTuple):
    """Points of a mask.

    Attributes:
        uv: `(2, k)` pixels, row by row of cells.
        spacing: How far those of neighboring cells are apart where they are fewest: 1 if every cell has one.
    """

    uv: Float32[np.ndarray, "2 k"]
    spacing: float


def sample_mask(
    mask: Bool[np.ndarray, "h w"], gray: UInt8[np.ndarray, "h w"], capacity: int, seed: int
) -> SampledPoints:
    """A masked pixel of every cell that has one: the best corner, or where there is none, a random one.

    Only the part of the image around the mask is looked at. If there are more cells than points, large pieces of the
    mask give way: in equal shares, somebody far away beside somebody near would have too few to be followed.

    Args:
        mask: Pixels to choose from.
        gray: The image.
        capacity: Most points.
        seed: Of the random choice.
    """
    region = _whole_cells(mask)
    inside = mask[region]
    if not inside.size:
        return SampledPoints(np.zeros((2, 0), np.float32), 1.0)
    score = _by_cell(np.where(inside, _corners(gray, region), _NOT_MASKED))
    _rank_at_random(score, np.random.default_rng(seed))
    where = score.argmax(axis=1)
    cells = np.flatnonzero(score[np.arange(len(score)), where] > _NOT_MASKED)
    cell_row, cell_column = np.divmod(cells, inside.shape[1] // CELL_PX)
    within_row, within_column = np.divmod(where[cells], CELL_PX)
    row, column, spacing = cell_row * CELL_PX + within_row, cell_column * CELL_PX + within_column, 1.0
    if len(cells) > capacity:
        _, piece = cv2.connectedComponents(inside.view(np.uint8), connectivity=4)
        turn = (cell_row * _TURNS[0] + cell_column * _TURNS[1]) % 1
        chosen, spacing = _shared_out(piece[row, column], turn, capacity)
        row, column = row[chosen], column[chosen]
    top, left = (span.start for span in region)
    return SampledPoints(np.stack([left + column, top + row]).astype(np.float32), spacing)


def _shared_out(
    piece: Int[np.ndarray, " cells"], turn: Float[np.ndarray, " cells"], capacity: int
) -> tuple[Int[np.ndarray, " k"], float]:
    """Which cells have a point, by the order of their turns: all of small pieces, of each large one equally many."""
    _, piece, counts = np.unique(piece, return_inverse=True, return_counts=True)
    share, rest = 1, capacity
    for left, count in zip(range(len(counts), 0, -1), np.sort(counts), strict=True):
        share = max(rest // left, 1)
        if count > share:
            break
        rest -= count
    order = np.lexsort((turn, piece))
    rank = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts)
    chosen = order[rank < share][:capacity]
    return np.sort(chosen), float(np.sqrt(counts.max() / share))


def _whole_cells(mask: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of the cells around what is masked; cells that reach past the image do not count."""
    height, width = (side // CELL_PX * CELL_PX for side in mask.shape)
    left, top, width, height = cv2.boundingRect(mask[:height, :width].view(np.uint8))
    return _cells(top, top + height), _cells(left, left + width)


def _cells(begin: int, end: int) -> slice:
    """The pixels of all cells of which some lie between."""
    return slice(begin // CELL_PX * CELL_PX, -(-end // CELL_PX) * CELL_PX)


def _corners(gray: UInt8[np.ndarray, "h w"], region: tuple[slice, slice]) -> Float32[np.ndarray, "_h _w"]:
    """Smaller eigenvalues of the gradient matrix in a part of the image, each from all pixels of its window."""
    rows, columns = (slice(max(span.start - _WINDOW_PX, 0), span.stop + _WINDOW_PX) for span in region)
    score = cv2.cornerMinEigenVal(gray[rows, columns], _WINDOW_PX)
    top, left = region[0].start - rows.start, region[1].start - columns.start
    return score[top:, left:][: region[0].stop - region[0].start, : region[1].stop - region[1].start]


def _rank_at_random(score: Float32[np.ndarray, "cells pixels"], generator: np.random.Generator) -> None:
    """Give masked pixels of cells without texture random scores; drawing them for all cells was a third of the time."""
    best = score.max(axis=1)
    flat = (best > _NOT_MASKED) & (best <= _MIN_SCORE)
    random = generator.random((np.count_nonzero(flat), score.shape[1]), np.float32)
    score[flat] = np.where(score[flat] > _NOT_MASKED, random * _MIN_SCORE, _NOT_MASKED)


def _by_cell(image: np.ndarray) -> np.ndarray:
    """`(cells, pixels)` of an image made of whole cells."""
    height, width = image.shape
    cells = image.reshape(height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX)
    return cells.swapaxes(1, 2).reshape(-1, CELL_PX * CELL_PX)
