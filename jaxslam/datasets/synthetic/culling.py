"""The choice of what each tile of a picture looks at: the solids whose bounds reach into it, and in which of its rows.

It is made once for all moments of an exposure, so that what is out of sight costs nothing in any of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

NEAR_M = 0.05
"""Depth before which nothing is seen."""
_TILE_HEIGHT, _TILE_WIDTH = 60, 80
_WINDOW_ROWS = (10, 30)
_FAR_ROW = np.float32(1e6)
_MIN_CAPACITY = 1 << 14


class Tiling(NamedTuple):
    """A picture cut into tiles, the last of which may reach beyond it.

    Attributes:
        rows: Number of tiles below each other.
        columns: Number of tiles side by side.
        height: Rows of pixels of a tile.
        width: Columns of pixels of a tile.
    """

    rows: int
    columns: int
    height: int
    width: int

    @classmethod
    def of(cls, height: int, width: int) -> "Tiling":
        """Tiles of 80 pixels a row and up to 60 rows, as many as reach just to the end of a picture of this size.

        Rows of 77 pixels, sixteen tiles of which would fit 1226 pixels better, took 36 ms of processor time for a view
        of a road instead of 20: XLA's vectors do not divide them.
        """
        rows = -(-height // _TILE_HEIGHT)
        return cls(rows, -(-width // _TILE_WIDTH), -(-height // rows), _TILE_WIDTH)

    @property
    def windows(self) -> tuple[int, ...]:
        """Numbers of rows of a tile that are searched for a solid: the first that holds it.

        On a road, where most solids are far away, casting rays takes half as long as with all rows.
        """
        return (*(rows for rows in _WINDOW_ROWS if rows < self.height), self.height)


class Candidates(NamedTuple):
    """Solids that each tile looks at: a list of those of the first tile, the second, and so on.

    Those of a tile are in groups: boxes in each of `Tiling.windows`, then capsules in each.

    Attributes:
        solids: Their indices; 0 beyond the last one.
        first_rows: First row of the tile in which each is searched.
        begins: Places in the list at which the groups of each tile begin, and at which the last one ends.
    """

    solids: Int[Array, " k"]
    first_rows: Int[Array, " k"]
    begins: Int[Array, "tiles groups"]


def solids_in_tiles(
    corners: Float[Array, "r 3 c n"], intrinsics: Float[Array, " 4"], tiling: Tiling
) -> Bool[Array, "tiles n"]:
    """Tell which solids may reach into which tiles, by their bounding boxes.

    Args:
        corners: The corners of the bounding boxes in camera coordinates, at one time or several: once, or for each row
            of tiles.
        intrinsics: `fx, fy, cx, cy` in pixels.
        tiling: The tiles.
    """
    fx, fy, cx, cy = intrinsics
    edge_u = jnp.arange(tiling.columns + 1, dtype=jnp.float32) * tiling.width - 0.5 - cx
    edge_v = jnp.arange(tiling.rows + 1, dtype=jnp.float32) * tiling.height - 0.5 - cy

    def across(corners: Float[Array, "3 c n"]) -> Bool[Array, "columns n"]:
        x, _, z = corners
        return _between(fx * x, z, edge_u) & jnp.any(z > NEAR_M, axis=0)[None]

    def along(corners: Float[Array, "3 c n"], edges: Float[Array, " 2"]) -> Bool[Array, "1 n"]:
        _, y, z = corners
        return _between(fy * y, z, edges)

    once = corners.shape[0] == 1
    edges = jnp.stack([edge_v[:-1], edge_v[1:]], axis=1)
    in_rows = jax.vmap(along, in_axes=(None if once else 0, 0))(corners[0] if once else corners, edges)
    return (in_rows & jax.vmap(across)(corners)).reshape(tiling.rows * tiling.columns, -1)


def _between(x: Float[Array, "c n"], z: Float[Array, "c n"], edges: Float[Array, " k"]) -> Bool[Array, "j n"]:
    """Between neighboring edges, with a pixel to spare: false where all corners lie beyond the same edge."""
    below = jnp.all(x[None] < (edges[:, None, None] - 1.0) * z[None], axis=1)
    above = jnp.all(x[None] > (edges[:, None, None] + 1.0) * z[None], axis=1)
    return ~below[:-1] & ~above[1:]


def rows_of_solids(corners: Float[Array, "3 c n"], intrinsics: Float[Array, " 4"]) -> Int[Array, "2 n"]:
    """First row of the picture in which each solid may be, and the row after the last one: see `solids_in_tiles`."""
    _, y, z = corners
    v = intrinsics[1] * y / jnp.maximum(z, NEAR_M) + intrinsics[3]
    # With a pixel to spare; a solid that reaches behind the camera may be anywhere.
    edges = jnp.stack([jnp.min(v, axis=0) - 1.5, jnp.max(v, axis=0) + 2.5])
    anywhere = jnp.array([[-_FAR_ROW], [_FAR_ROW]])
    edges = jnp.where(jnp.all(z > NEAR_M, axis=0), jnp.clip(edges, -_FAR_ROW, _FAR_ROW), anywhere)
    return jnp.floor(edges).astype(jnp.int32)


def list_candidates(reaches: np.ndarray, rows: np.ndarray, num_boxes: int, tiling: Tiling) -> Candidates:
    """List the solids that reach into each tile.

    Args:
        reaches: Which solids reach into which tiles, `(tiles, n)` bool.
        rows: First row of the picture in which each solid may be, and the row after the last one, `(r, 2, n)`: once,
            or for each row of tiles.
        num_boxes: Number of boxes; all other solids are capsules.
        tiling: The tiles.
    """
    # In NumPy: of all pairs of a tile and a solid, only some in a hundred are left.
    tiles, solids = np.nonzero(reaches)
    tile_rows = tiles // tiling.columns
    in_picture = rows[tile_rows if len(rows) > 1 else 0, :, solids].T
    above, below = np.clip(in_picture - tile_rows * tiling.height, 0, tiling.height)
    windows = np.array(tiling.windows)
    window = np.searchsorted(windows[:-1], below - above)
    per_tile = 2 * len(windows)
    groups = per_tile * tiles + len(windows) * (solids >= num_boxes) + window
    order = np.argsort(groups, kind="stable")
    begins: Any = np.searchsorted(groups[order], np.arange(len(reaches) * per_tile + 1)).astype(np.int32)
    first_of_tile = per_tile * np.arange(len(reaches))[:, None]
    listed: Any = np.zeros((2, _capacity(len(solids))), np.int32)
    listed[0, : len(solids)] = solids[order]
    listed[1, : len(solids)] = np.minimum(above, tiling.height - windows[window])[order]
    return Candidates(listed[0], listed[1], begins[first_of_tile + np.arange(per_tile + 1)])


def _capacity(count: int) -> int:
    """Length of a list: each new one is compiled."""
    return max(_MIN_CAPACITY, 1 << max(count - 1, 0).bit_length())
