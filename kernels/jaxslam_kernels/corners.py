"""Corners to track, spread over the image: the best one of every grid cell."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.types import Image, Mask, Pixels


class Corners(NamedTuple):
    """The best corner of every cell, row by row.

    Attributes:
        points: `(2, c)` pixel coordinates.
        score: `(c,)` smaller eigenvalue of the mean gradient matrix; 0 where the cell offers no corner.
    """

    points: Pixels
    score: Float[Array, " c"]


def corner_score(image: Image) -> Image:
    """Smaller eigenvalue of the gradient matrix averaged over 5x5 pixels; 0 within 4 pixels of the edge.

    Source: Shi and Tomasi, Good Features to Track, CVPR 1994.
    """
    padded = jnp.pad(image, 1, mode="edge")
    gu = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    gv = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    uu, uv, vv = (_box_mean(product) for product in (gu * gu, gu * gv, gv * gv))
    spread = jnp.sqrt(jnp.square(uu - vv) + 4 * jnp.square(uv) + jnp.finfo(uu.dtype).tiny)
    return jnp.pad(((uu + vv - spread) / 2)[4:-4, 4:-4], 4)


def _box_mean(image: Image) -> Image:
    padded = jnp.pad(image, 2, mode="edge")
    height, width = image.shape
    rows = sum((padded[tap : tap + height] for tap in range(5)), start=jnp.zeros((), image.dtype))
    total = sum((rows[:, tap : tap + width] for tap in range(5)), start=jnp.zeros((), image.dtype))
    return total / 25


def grid_corners(score: Image, allowed: Bool[Array, "h w"], *, cell: int) -> Corners:
    """The pixel of highest score in every `cell` x `cell` square of a score image.

    Args:
        score: From `corner_score`. Rows and columns past the last whole cell are left out.
        allowed: Where a corner may be.
        cell: Side of a cell in pixels, static.
    """
    rows, columns = score.shape[0] // cell, score.shape[1] // cell
    usable = jnp.where(allowed & jnp.isfinite(score), score, 0)[: rows * cell, : columns * cell]
    cells = usable.reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = jnp.argmax(cells, axis=1)
    index = jnp.arange(rows * columns)
    u = index % columns * cell + best % cell
    v = index // columns * cell + best // cell
    top = jnp.max(cells, axis=1)
    return Corners(jnp.stack([u, v]).astype(score.dtype), lax.stop_gradient(jnp.maximum(top, 0)))


def occupied_cells(points: Pixels, valid: Mask, shape: tuple[int, int], *, cell: int) -> Bool[Array, " c"]:
    """Which cells of the grid of `grid_corners` already hold one of the valid `points`; `shape` is `(h, w)`."""
    rows, columns = shape[0] // cell, shape[1] // cell
    column, row = jnp.floor(jnp.where(valid[None, :], points, -1) / cell).astype(jnp.int32)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    index = jnp.where(inside, row * columns + column, rows * columns)
    return jnp.zeros(rows * columns, bool).at[index].set(True, mode="drop")
