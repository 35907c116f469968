"""From points that move to pixels: what is near such a point and as far away moves with it.

Cues judge the points that are followed. The map is made of other features, and people look at pictures.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.dynamics.cue import CueResult

_DEPTH_STEP, _DEPTH_STEP_M = 0.05, 0.05
"""Largest difference of depth on one surface: a share of depth, and meters besides."""


def moving_points(verdicts: Sequence[CueResult]) -> Bool[np.ndarray, " n"]:
    """`(n,)` the points of which cues know that they rather move, by the product of their weights."""
    weight, known = 1.0, np.zeros((), bool)
    for verdict in verdicts:
        weight, known = weight * np.asarray(verdict.weight), known | np.asarray(verdict.known)
    return known & (weight < 0.5)


def mask_around(
    uv: Float[np.ndarray, "2 n"], depth: Float[np.ndarray, "h w"], reach_px: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels around some points that are as far away as they are, or whose depth is missing.

    Args:
        uv: Pixels; what is outside the image is left out.
        depth: Meters, 0 where missing.
        reach_px: How far around, in rows and in columns.
    """
    height, width = depth.shape
    mask = np.zeros(depth.shape, bool)
    at = np.round(uv[:, np.isfinite(uv).all(axis=0)]).astype(int)
    u, v = at[:, (at[0] >= 0) & (at[1] >= 0) & (at[0] < width) & (at[1] < height)]
    there = depth[v, u]
    steps = np.arange(-reach_px, reach_px + 1)
    rows = np.clip(v[:, None] + steps, 0, height - 1)[:, :, None]
    columns = np.clip(u[:, None] + steps, 0, width - 1)[:, None, :]
    around, center = depth[rows, columns], there[:, None, None]
    alike = np.abs(around - center) <= _DEPTH_STEP * center + _DEPTH_STEP_M
    which, row, column = np.nonzero(alike | (center <= 0) | (around <= 0))
    mask[rows[which, row, 0], columns[which, 0, column]] = True
    return mask
