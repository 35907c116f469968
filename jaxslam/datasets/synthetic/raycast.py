"""Intersection of rays with solids: the first solid that each ray of a tile of the image meets.

A tile only looks at the solids whose bounds reach into it, in loops of data-dependent length: what is out of sight
costs nothing. Each loop carries one plane of integers, the depth's bits with the index of the solid in the lowest of
them: positive floats are ordered as their bits are, so that the nearest hit is a minimum, one pass over some rows of
the tile a solid.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Plane: TypeAlias = Float[Array, " p"]
Vectors: TypeAlias = tuple[Plane, Plane, Plane]
"""One vector a pixel, one plane a component."""

TILE_HEIGHT, TILE_WIDTH = 60, 80
_WINDOW_ROWS = (10, 30, TILE_HEIGHT)
"""Numbers of rows of a tile that are searched for a solid: the first that holds it. On a road, where most solids are
far away, casting rays takes half as long as with all rows.
"""
_NEAR_M = 0.05
_NOTHING = np.int32(0x7F000000)
_FAR_ROW = np.float32(1e6)


class Shapes(NamedTuple):
    """Every solid as seen from one camera pose: first boxes, of which the first is the room, then capsules.

    Attributes:
        unit_from_cam: Affine maps from camera coordinates to those in which a box is the cube from -1 to 1 and a
            capsule has radius 1 and its axis along z.
        stem: Half length of a capsule's axis in those coordinates; 0 for boxes.
        rows: First row of the picture in which each solid may be, and the row after the last one.
        change: What the maps change by from the first row of the tile to the first row of the one below, with a
            rolling shutter; `None` if all rows are taken at once.
    """

    unit_from_cam: Float[Array, "n 3 4"]
    stem: Float[Array, " n"]
    rows: Int[Array, "2 n"]
    change: Float[Array, "n 3 4"] | None = None


class Rays(NamedTuple):
    """The rays `(x, y, 1)` of a tile.

    Attributes:
        x: First component.
        y: Second component.
        share: Share of the tile's rows above that of the ray.
    """

    x: Plane
    y: Plane
    share: Plane


class InTile(NamedTuple):
    """The solids of one kind that reach into a tile: `indices[:n_reaching]`."""

    indices: Int[Array, "*tiles n"]
    n_reaching: Int[Array, "*tiles"]


def solids_in_tiles(
    corners: Float[Array, "3 c n"], intrinsics: Float[Array, " 4"], rows: int, columns: int
) -> Bool[Array, "tiles n"]:
    """Whether the bounding box of each solid may reach into each tile.

    Args:
        corners: The corners of the bounding boxes in camera coordinates, at one time or several.
        intrinsics: `fx, fy, cx, cy` in pixels.
        rows: Rows of tiles.
        columns: Columns of tiles.
    """
    x, y, z = corners
    fx, fy, cx, cy = intrinsics
    edge_u = jnp.arange(columns + 1, dtype=jnp.float32) * TILE_WIDTH - 0.5 - cx
    edge_v = jnp.arange(rows + 1, dtype=jnp.float32) * TILE_HEIGHT - 0.5 - cy
    across, along = _between(fx * x, z, edge_u), _between(fy * y, z, edge_v)
    ahead = jnp.any(z > _NEAR_M, axis=0)
    return (along[:, None, :] & across[None, :, :] & ahead[None, None, :]).reshape(rows * columns, -1)


def _between(x: Float[Array, "c n"], z: Float[Array, "c n"], edges: Float[Array, " k"]) -> Bool[Array, "j n"]:
    """Between neighboring edges, with a pixel to spare: false where all corners lie beyond the same edge."""
    below = jnp.all(x[None] < (edges[:, None, None] - 1.0) * z[None], axis=1)
    above = jnp.all(x[None] > (edges[:, None, None] + 1.0) * z[None], axis=1)
    return ~below[:-1] & ~above[1:]


def rows_of_solids(corners: Float[Array, "3 c n"], intrinsics: Float[Array, " 4"]) -> Int[Array, "2 n"]:
    """First row of the picture in which each solid may be, and the row after the last one: see `solids_in_tiles`."""
    _, y, z = corners
    v = intrinsics[1] * y / jnp.maximum(z, _NEAR_M) + intrinsics[3]
    # With a pixel to spare; a solid that reaches behind the camera may be anywhere.
    edges = jnp.stack([jnp.min(v, axis=0) - 1.5, jnp.max(v, axis=0) + 2.5])
    anywhere = jnp.array([[-_FAR_ROW], [_FAR_ROW]])
    edges = jnp.where(jnp.all(z > _NEAR_M, axis=0), jnp.clip(edges, -_FAR_ROW, _FAR_ROW), anywhere)
    return jnp.floor(edges).astype(jnp.int32)


def compact(reaches: Bool[Array, "tiles n"], first: int) -> InTile:
    """List the solids that reach into each tile; `first` is the index of the first column."""
    tiles, n = reaches.shape
    # `jnp.cumsum` takes three times as long.
    place = jax.lax.associative_scan(jnp.add, reaches.astype(jnp.int32), axis=1) - 1
    place = jnp.where(reaches, place + n * jnp.arange(tiles, dtype=jnp.int32)[:, None], tiles * n)
    columns = jnp.broadcast_to(jnp.arange(first, first + n, dtype=jnp.int32), reaches.shape)
    indices = jnp.zeros(tiles * n, jnp.int32).at[place.ravel()].set(columns.ravel(), mode="drop", unique_indices=True)
    return InTile(indices.reshape(tiles, n), jnp.sum(reaches, axis=1, dtype=jnp.int32))


def nearest_solid(shapes: Shapes, rays: Rays, boxes: InTile, capsules: InTile, top: Int[Array, ""]) -> Int[Array, " p"]:
    """The nearest solid along each ray of a tile, packed: see `unpack`.

    Args:
        shapes: All solids.
        rays: The rays of the tile.
        boxes: The boxes to look at.
        capsules: The capsules to look at.
        top: Row of the picture at which the tile begins.
    """
    mask = _index_mask(shapes)

    def box(which: Int[Array, ""], rays: Rays) -> Int[Array, " p"]:
        enter, leave = _slabs(*_into(shapes, which, rays))
        return _packed(enter, enter < leave, which, mask)

    def capsule(which: Int[Array, ""], rays: Rays) -> Int[Array, " p"]:
        depth, hit = _round(*_into(shapes, which, rays), shapes.stem[which])
        return _packed(depth, hit, which, mask)

    def look_at(
        solids: InTile,
        cast: Callable[[Int[Array, ""], Rays], Int[Array, " p"]],
        k: Int[Array, ""],
        nearest: Int[Array, " p"],
    ) -> Int[Array, " p"]:
        which = solids.indices[k]
        above, below = jnp.clip(shapes.rows[:, which] - top, 0, TILE_HEIGHT)

        def in_window(rows: int, nearest: Int[Array, " p"]) -> Int[Array, " p"]:
            start = jnp.minimum(above, TILE_HEIGHT - rows) * TILE_WIDTH
            seen, window = jax.tree.map(
                lambda plane: jax.lax.dynamic_slice(plane, (start,), (rows * TILE_WIDTH,)), (nearest, rays)
            )
            return jax.lax.dynamic_update_slice(nearest, jnp.minimum(seen, cast(which, window)), (start,))

        too_small = sum((below - above > rows).astype(jnp.int32) for rows in _WINDOW_ROWS[:-1])
        return jax.lax.switch(too_small, [partial(in_window, rows) for rows in _WINDOW_ROWS], nearest)

    _, wall = _slabs(*_into(shapes, 0, rays))
    nearest = _packed(wall, wall > 0.0, jnp.int32(0), mask)
    nearest = jax.lax.fori_loop(0, boxes.n_reaching, partial(look_at, boxes, box), nearest)
    return jax.lax.fori_loop(0, capsules.n_reaching, partial(look_at, capsules, capsule), nearest)


def unpack(shapes: Shapes, packed: Int[Array, " p"]) -> tuple[Plane, Int[Array, " p"]]:
    """Depth, short of the few bits that the index takes, and index of the solid."""
    mask = _index_mask(shapes)
    return jax.lax.bitcast_convert_type(packed & ~mask, jnp.float32), packed & mask


def _index_mask(shapes: Shapes) -> np.int32:
    return np.int32((1 << (shapes.stem.shape[0] - 1).bit_length()) - 1)


def _packed(depth: Plane, hit: Bool[Array, " p"], which: Int[Array, ""], mask: np.int32) -> Int[Array, " p"]:
    bits = jax.lax.bitcast_convert_type(depth, jnp.int32)
    return jnp.where(hit & (depth > _NEAR_M), (bits & ~mask) | which, _NOTHING)


Origin: TypeAlias = Float[Array, " 3"] | Vectors
"""The one origin of all rays, or that of each."""


def _into(shapes: Shapes, which: Int[Array, ""] | int, rays: Rays) -> tuple[Origin, Vectors]:
    """Origins and directions of rays in the coordinates of a solid."""
    transform = shapes.unit_from_cam[which]
    a, b, c = (_directions(row, rays) for row in transform)
    if shapes.change is None:
        return transform[:, 3], (a, b, c)
    change = shapes.change[which]
    x, y, z = (rays.share * _directions(row, rays) for row in change)
    start_x, start_y, start_z = (
        start + rays.share * moved for start, moved in zip(transform[:, 3], change[:, 3], strict=True)
    )
    return (start_x, start_y, start_z), (a + x, b + y, c + z)


def _directions(row: Float[Array, " 4"], rays: Rays) -> Plane:
    return row[0] * rays.x + row[1] * rays.y + row[2]


def _slabs(origin: Origin, rays: Vectors) -> tuple[Plane, Plane]:
    """Depths at which rays enter and leave the cube from -1 to 1 (slab method, Kay & Kajiya 1986)."""
    inverse = [1.0 / jnp.where(jnp.abs(ray) < 1e-9, 1e-9, ray) for ray in rays]
    middle = [-start * slope for start, slope in zip(origin, inverse, strict=True)]
    x, y, z = (jnp.abs(slope) for slope in inverse)
    enter = jnp.maximum(jnp.maximum(middle[0] - x, middle[1] - y), middle[2] - z)
    leave = jnp.minimum(jnp.minimum(middle[0] + x, middle[1] + y), middle[2] + z)
    return enter, leave


def _round(origin: Origin, rays: Vectors, stem: Float[Array, ""]) -> tuple[Plane, Bool[Array, " p"]]:
    """Depths at which rays enter a capsule of radius 1, and whether they do.

    Distances to the axis are measured from the point of closest approach, which keeps float32 accurate for thin
    limbs far away.
    """
    dx, dy, dz = rays
    ox, oy, oz = origin
    slope = 1.0 / jnp.maximum(dx * dx + dy * dy, 1e-12)
    closest = -(ox * dx + oy * dy) * slope
    rim = 1.0 - (ox + closest * dx) ** 2 - (oy + closest * dy) ** 2
    side = closest - jnp.sqrt(jnp.maximum(rim, 0.0) * slope)
    height = oz + side * dz
    from_cap = oz - jnp.clip(height, -stem, stem)
    slope = 1.0 / (dx * dx + dy * dy + dz * dz)
    closest = -(ox * dx + oy * dy + from_cap * dz) * slope
    ball = 1.0 - (ox + closest * dx) ** 2 - (oy + closest * dy) ** 2 - (from_cap + closest * dz) ** 2
    end = closest - jnp.sqrt(jnp.maximum(ball, 0.0) * slope)
    on_side = jnp.abs(height) <= stem
    return jnp.where(on_side, side, end), (rim > 0.0) & (on_side | (ball > 0.0))
