"""Windows of an image around many points: cutting, sampling, gradients. The inner loops of `lk_flow`.

A patch is a flat row with a stride of `side + 3` pixels, so that bilinear sampling is four shifted reads of one
contiguous row, which XLA vectorizes. Columns past the window hold neighboring pixels that nobody asked for; the
gradient there is zero, so that they drop out of every sum.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.types import Pixels

T = TypeVar("T")


class Window(NamedTuple):
    """A square window and the layout of its patches; static.

    Attributes:
        side: Side in pixels, odd.
    """

    side: int

    @property
    def half(self) -> int:
        """Pixels on either side of the middle one."""
        return self.side // 2

    @property
    def stride(self) -> int:
        """Pixels from one row of a patch to the next."""
        return self.side + 3

    @property
    def length(self) -> int:
        """Pixels in a flat patch."""
        return self.side * self.stride

    @property
    def border(self) -> int:
        """Padding an image needs, for points up to two pixels outside it."""
        return self.half + 6

    def offsets(self) -> tuple[Int[Array, " l"], Int[Array, " l"]]:
        """Column and row of every pixel of a flat patch relative to the middle of the window."""
        index = jnp.arange(self.length)
        return index % self.stride - self.half, index // self.stride - self.half

    def columns(self) -> Bool[Array, " l"]:
        """Tell which pixels of a flat patch belong to the window."""
        return self.offsets()[0] <= self.half


def bounds(level: Float[Array, "h w"], border: int) -> tuple[Float[Array, "2 1"], Float[Array, "2 1"]]:
    """Lowest and highest coordinates in a padded level that lie in the image."""
    height, width = level.shape
    high = jnp.array([[width - 2 * border - 1], [height - 2 * border - 1]], level.dtype)
    return jnp.zeros_like(high), high


def hold(position: Pixels, level: Float[Array, "h w"], border: int) -> Pixels:
    """Positions moved to where patches can be cut: at most two pixels outside the image."""
    low, high = bounds(level, border)
    return jnp.clip(position, low - 2, high + 2)


def corner(position: Pixels, border: int, reach: int) -> tuple[Int[Array, "2 n"], Pixels]:
    """Integer top-left corner in a padded level of the patch that reaches `reach` to the left, and the fraction."""
    whole = jnp.floor(position)
    return whole.astype(jnp.int32) + (border - reach), position - whole


def cut(level: Float[Array, "h w"], corner: Int[Array, "2 n"], rows: int, columns: int) -> Float[Array, "n r c"]:
    """Patches with the given corners."""
    return jax.vmap(lambda c: lax.dynamic_slice(level, (c[1], c[0]), (rows, columns)), in_axes=1)(corner)


def bilinear(flat: Float[Array, "n l"], fraction: Pixels, stride: int, length: int) -> Float[Array, "n m"]:
    """Samples at `fraction` right of and below each of the first `length` pixels of flat patches."""
    u, v = fraction[0][:, None], fraction[1][:, None]

    def shift(offset: int) -> Float[Array, "n m"]:
        return flat[:, offset : offset + length]

    upper = (1 - u) * (1 - v) * shift(0) + u * (1 - v) * shift(1)
    return upper + (1 - u) * v * shift(stride) + u * v * shift(stride + 1)


def gradients(patch: Float[Array, "n l"], window: Window) -> Float[Array, "n 2 m"]:
    """Scharr gradients, per pixel, of flat patches that have a margin of one pixel around the window."""
    stride, length = window.stride, window.length

    def shift(row: int, column: int) -> Float[Array, "n m"]:
        start = row * stride + column
        return patch[:, start : start + length]

    def vertical(column: int) -> Float[Array, "n m"]:
        return 3 * shift(0, column) + 10 * shift(1, column) + 3 * shift(2, column)

    def horizontal(row: int) -> Float[Array, "n m"]:
        return 3 * shift(row, 0) + 10 * shift(row, 1) + 3 * shift(row, 2)

    return jnp.stack([vertical(2) - vertical(0), horizontal(2) - horizontal(0)], axis=1) / 32


def in_image(position: Pixels, level: Float[Array, "h w"], border: int, window: Window) -> Bool[Array, "n l"]:
    """Tell which pixels of the flat patches around `position` belong to the window and lie in the image."""
    _, high = bounds(level, border)
    columns, rows = window.offsets()
    u = position[0][:, None] + columns.astype(position.dtype)[None, :]
    v = position[1][:, None] + rows.astype(position.dtype)[None, :]
    return window.columns()[None, :] & (u >= 0) & (u <= high[0, 0]) & (v >= 0) & (v <= high[1, 0])


def flattened(cut: Float[Array, "n r c"]) -> Float[Array, "n rc"]:
    """Every patch as one flat row; also where there are none, of which JAX cannot tell a missing size."""
    return cut.reshape(cut.shape[0], cut.shape[1] * cut.shape[2])
