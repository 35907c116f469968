"""Corners to track, spread over the image: the best one of every grid cell."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import Image, Mask, Pixels

_WINDOW = 5
_EDGE = 4


class Corners(NamedTuple):
    """The best corner of every cell, row by row.

    Attributes:
        points: `(2, c)` pixel coordinates, whole numbers; the top-left pixel of a cell that offers no corner.
        score: `(c,)` smaller eigenvalue of the mean gradient matrix; 0 where the cell offers no corner.
    """

    points: Pixels
    score: Float[Array, " c"]


@checked
def corner_score(image: Image) -> Image:
    """Smaller eigenvalue of the gradient matrix averaged over 5x5 pixels, in squared intensity a squared pixel.

    Zero within 4 pixels of the edge, and where the window or the pixels next to it hold something that is not a
    number. At equal eigenvalues, where the smaller one has no derivative, that of their mean is given.

    Source: Shi and Tomasi, Good Features to Track, CVPR 1994.
    """
    if min(image.shape) <= 2 * _EDGE:
        return jnp.zeros_like(image)
    gu = (image[2:-2, 3:-1] - image[2:-2, 1:-3]) / 2
    gv = (image[3:-1, 2:-2] - image[1:-3, 2:-2]) / 2
    known = jnp.isfinite(gu) & jnp.isfinite(gv)
    gu, gv = jnp.where(known, gu, 0), jnp.where(known, gv, 0)
    uu, uv, vv = (_window_mean(product) for product in (jnp.where(known, gu * gu, jnp.nan), gu * gv, gv * gv))
    known = jnp.isfinite(uu + vv)
    uu, uv, vv = (jnp.where(known, mean, 0) for mean in (uu, uv, vv))
    spread = jnp.sqrt(jnp.square(uu - vv) + 4 * jnp.square(uv) + jnp.finfo(uu.dtype).tiny)
    return jnp.pad(jnp.where(known, (uu + vv - spread) / 2, 0), _EDGE)


def _window_mean(image: Image) -> Float[Array, "_h _w"]:
    """Mean over the window around every pixel at which it fits into the image."""
    total = image
    for window in ((_WINDOW, 1), (1, _WINDOW)):
        total = lax.reduce_window(total, image.dtype.type(0), lax.add, window, (1, 1), "VALID")
    return total / _WINDOW**2


@checked
def grid_corners(score: Image, allowed: Bool[Array, "h w"], *, cell: int) -> Corners:
    """Find the pixel of highest score in every `cell` x `cell` square of a score image.

    Among equal scores it is the first in reading order. This choice is a constant for differentiation: neither points
    nor scores have a derivative.

    Args:
        score: From `corner_score`; a score that is not a number counts as 0. Rows and columns past the last whole
            cell are left out.
        allowed: `(h, w)` true for pixels that may be a corner.
        cell: Side of a cell in pixels, static.
    """
    rows, columns = score.shape[0] // cell, score.shape[1] // cell
    usable = jnp.where(allowed & jnp.isfinite(score), score, 0)[: rows * cell, : columns * cell]
    # Down the columns, then along the rows, without argmax, which XLA does not vectorize: a tenth of the time.
    strips = usable.reshape(rows, cell, columns * cell)
    top = jnp.max(strips, axis=1)
    down = jnp.min(jnp.where(strips == top[:, None], jnp.arange(cell)[None, :, None], cell), axis=1)
    top, down = top.reshape(rows * columns, cell), down.reshape(rows * columns, cell)
    score_of_cell = jnp.max(top, axis=1)
    offset = jnp.where(top == score_of_cell[:, None], down * cell + jnp.arange(cell)[None, :], cell * cell)
    best, index = jnp.min(offset, axis=1), jnp.arange(rows * columns)
    u = index % columns * cell + best % cell
    v = index // columns * cell + best // cell
    return Corners(jnp.stack([u, v]).astype(score.dtype), lax.stop_gradient(jnp.maximum(score_of_cell, 0)))


@checked
def occupied_cells(points: Pixels, valid: Mask, shape: tuple[int, int], *, cell: int) -> Bool[Array, " c"]:
    """Tell which cells of the grid of `grid_corners` already hold a valid point.

    Args:
        points: `(2, n)` pixel coordinates; one outside the grid or not a number is in no cell.
        valid: `(n,)` true for points that count.
        shape: Height and width of the score image, static.
        cell: Side of a cell in pixels, static; cell `k` of a row spans coordinates from `k * cell` to the next.
    """
    rows, columns = shape[0] // cell, shape[1] // cell
    u, v = points
    inside = valid & (u >= 0) & (u < columns * cell) & (v >= 0) & (v < rows * cell)
    column, row = jnp.floor(jnp.where(inside[None, :], points, 0) / cell).astype(jnp.int32)
    index = jnp.where(inside, row * columns + column, rows * columns)
    return jnp.zeros(rows * columns, bool).at[index].set(True, mode="drop")
