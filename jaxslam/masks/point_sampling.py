"""Sample the points by which a mask is tracked: the best corner of every cell.

Source: NGD-SLAM (Zhang, Bujanca and Luján 2025), section III-C.3, with cells of 15 pixels in an image 640 pixels wide.
"""

from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

CELL_PX = 8
"""Side of a cell in an image about 320 pixels wide, pixels."""
CornerKind = Literal["shi-tomasi", "fast"]
_WINDOW_PX = 5
_MIN_SCORE = 1e-4
"""Smaller eigenvalue of the structure tensor, for gray values from 0 to 1, below which a random pixel is as good."""
_FAST_THRESHOLD = 20
"""Difference of gray values that makes a FAST corner: ORB-SLAM3's first threshold; NGD-SLAM gives none."""
_TURNS = (0.7548776662, 0.5698402910)
"""Factors of the row and the column of a cell. The cells with the smallest fractional parts of the sum are spread
evenly over the image (the additive sequence R2: Roberts, "The unreasonable effectiveness of quasirandom sequences",
2018)."""
_NOT_MASKED = -1
"""Score of a pixel outside the mask; the scores of others are 0, up to rounding, or greater."""


class SampledPoints(NamedTuple):
    """Points of a mask.

    Attributes:
        uv: `(2, k)` positions of the points, row by row of cells, pixels.
        spacing: Spacing of the points in the most thinned component of the mask, in cells: 1 if every cell has a point.
    """

    uv: Float32[np.ndarray, "2 k"]
    spacing: float


def sample_mask(
    mask: Bool[np.ndarray, "h w"],
    gray: UInt8[np.ndarray, "h w"],
    capacity: int,
    seed: int,
    corners: CornerKind = "shi-tomasi",
) -> SampledPoints:
    """Sample one masked pixel in every cell that has one: the best corner or, without a corner, a random pixel.

    Only the part of the image around the mask is processed. If there are more cells than `capacity`, the large
    components of the mask are thinned; if all were thinned alike, a person far away next to one nearby would have too
    few points to be tracked.

    Args:
        mask: `(h, w)` mask of the pixels to choose from.
        gray: `(h, w)` gray image.
        capacity: Largest number of points.
        seed: Seed of the random choice.
        corners: Score of a corner: the smaller eigenvalue of Shi and Tomasi, or that of FAST (Rosten and Drummond,
            ECCV 2006), which the paper uses.
    """
    region = _whole_cells(mask)
    inside = mask[region]
    if not inside.size:
        return SampledPoints(np.zeros((2, 0), np.float32), 1.0)
    score = _by_cell(np.where(inside, _corner_score(gray, region, corners), _NOT_MASKED))
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
    """Choose cells in the order of their turns: all cells of small components, and equally many of each large one."""
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
    """Return the rows and columns of the whole cells around the masked pixels."""
    height, width = (side // CELL_PX * CELL_PX for side in mask.shape)
    left, top, width, height = cv2.boundingRect(mask[:height, :width].view(np.uint8))
    return _cells(top, top + height), _cells(left, left + width)


def _cells(begin: int, end: int) -> slice:
    """Round an interval of pixels outward to whole cells."""
    return slice(begin // CELL_PX * CELL_PX, -(-end // CELL_PX) * CELL_PX)


def _corner_score(
    gray: UInt8[np.ndarray, "h w"], region: tuple[slice, slice], corners: CornerKind
) -> Float32[np.ndarray, "_h _w"]:
    """Return the corner scores of a part of the image, with complete windows."""
    rows, columns = (slice(max(span.start - _WINDOW_PX, 0), span.stop + _WINDOW_PX) for span in region)
    part = gray[rows, columns]
    score = cv2.cornerMinEigenVal(part, _WINDOW_PX) if corners == "shi-tomasi" else _fast_score(part)
    top, left = region[0].start - rows.start, region[1].start - columns.start
    return score[top:, left:][: region[0].stop - region[0].start, : region[1].stop - region[1].start]


def _fast_score(gray: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return the scores of FAST corners that are the best within a pixel, and 0 elsewhere."""
    found = cv2.FastFeatureDetector.create(_FAST_THRESHOLD).detect(gray)
    score = np.zeros(gray.shape, np.float32)
    if found:
        column, row = np.array(cv2.KeyPoint.convert(found)).astype(int).T
        score[row, column] = [corner.response for corner in found]
    return score


def _rank_at_random(score: Float32[np.ndarray, "cells pixels"], generator: np.random.Generator) -> None:
    """Give masked pixels of cells without texture random scores; drawing them for all cells was a third of the time."""
    best = score.max(axis=1)
    flat = (best > _NOT_MASKED) & (best <= _MIN_SCORE)
    random = generator.random((np.count_nonzero(flat), score.shape[1]), np.float32)
    score[flat] = np.where(score[flat] > _NOT_MASKED, random * _MIN_SCORE, _NOT_MASKED)


def _by_cell(image: np.ndarray) -> np.ndarray:
    """Reshape an image of whole cells to `(cells, pixels)`."""
    height, width = image.shape
    cells = image.reshape(height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX)
    return cells.swapaxes(1, 2).reshape(-1, CELL_PX * CELL_PX)
