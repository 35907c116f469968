"""Grow moving points into a mask: pixels near such a point at a similar depth move with it.

Cues classify tracked points only. The map is made of other features, and people look at images.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.dynamics.cue import CueResult

_DEPTH_STEP = 0.075
"""Largest depth difference within one surface, as a share of the depth."""


def moving_points(verdicts: Sequence[CueResult]) -> Bool[np.ndarray, " n"]:
    """Return `(n,)` the points that the cues classify as more likely moving, by the product of their weights."""
    weight, known = 1.0, np.zeros((), bool)
    for verdict in verdicts:
        weight, known = weight * np.asarray(verdict.weight), known | np.asarray(verdict.known)
    return known & (weight < 0.5)


def mask_around(
    mask: Bool[np.ndarray, "h w"], uv: Float[np.ndarray, "2 n"], depth: Float[np.ndarray, "h w"], reach_px: int
) -> None:
    """Mask the pixels around some points that have a similar depth, or whose depth is missing.

    Args:
        mask: `(h, w)` mask in which they are set, contiguous.
        uv: Pixel positions; those outside the image are ignored.
        depth: Depth image in meters; 0 or NaN where missing.
        reach_px: Half the side of the square around each point, in pixels.
    """
    height, width = depth.shape
    at = np.round(uv[:, np.isfinite(uv).all(axis=0)]).astype(np.int32)
    u, v = at[:, (at[0] >= 0) & (at[1] >= 0) & (at[0] < width) & (at[1] < height)]
    steps = np.arange(-reach_px, reach_px + 1, dtype=np.int32)
    rows = np.clip(v[:, None] + steps, 0, height - 1)[:, :, None]
    columns = np.clip(u[:, None] + steps, 0, width - 1)[:, None, :]
    # Flat indices once for reading and writing: half the time of two indices and `nonzero`.
    pixels = rows * width + columns
    around, center = depth.reshape(-1)[pixels], depth[v, u][:, None, None]
    alike = np.abs(around - center) <= _DEPTH_STEP * center
    mask.reshape(-1)[pixels[alike | ~(center > 0) | ~(around > 0)]] = True
