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


def sample_mask(
    mask: Bool[np.ndarray, "h w"], grey: UInt8[np.ndarray, "h w"], capacity: int, seed: int
) -> Float32[np.ndarray, "2 k"]:
    """A masked pixel of every 15 x 15 cell that has one: the best corner, or where there is none, a random one.

    Args:
        mask: Pixels to choose from.
        grey: The image.
        capacity: Most points; of more cells, those with the best corners.
        seed: Of the random choice.

    Returns:
        Pixels, row by row of cells.
    """
    height, width = (side // CELL_PX * CELL_PX for side in mask.shape)
    inside = mask[:height, :width]
    if not inside.any():
        return np.zeros((2, 0), np.float32)
    score = np.zeros(mask.shape, np.float32)
    rows, columns = (slice(max(span[0] - _WINDOW_PX, 0), span[-1] + _WINDOW_PX + 1) for span in _extent(inside))
    score[rows, columns] = cv2.cornerMinEigenVal(grey[rows, columns], _WINDOW_PX)
    score = score[:height, :width]
    random = np.random.default_rng(seed).random(inside.shape, np.float32) * _LEAST_SCORE
    ranked = _by_cell(np.where(inside, np.where(score > _LEAST_SCORE, score, random), -1))
    best, where = ranked.max(axis=1), ranked.argmax(axis=1)
    cells = np.flatnonzero(best >= 0)
    if len(cells) > capacity:
        cells = np.sort(cells[np.argsort(-best[cells], kind="stable")[:capacity]])
    row, column = np.divmod(cells, width // CELL_PX)
    within_row, within_column = np.divmod(where[cells], CELL_PX)
    return np.stack([column * CELL_PX + within_column, row * CELL_PX + within_row]).astype(np.float32)


def _extent(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns that have a masked pixel."""
    return np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))


def _by_cell(image: np.ndarray) -> np.ndarray:
    """`(cells, pixels)` of an image made of whole cells."""
    height, width = image.shape
    cells = image.reshape(height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX)
    return cells.swapaxes(1, 2).reshape(-1, CELL_PX * CELL_PX)
