"""Intersection of rays with solids: the first solid that each ray of a tile of the image meets.

A tile only looks at the solids whose bounds reach into it, in loops of data-dependent length: what is out of sight
costs nothing. Each loop carries one plane of integers, the depth's bits with the index of the solid in the lowest of
them: positive floats are ordered as their bits are, so that the nearest hit is a minimum, one pass over some rows of
the tile a solid.
"""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.datasets.synthetic.culling import NEAR_M, Candidates, Tiling

Plane: TypeAlias = Float[Array, " p"]
Vectors: TypeAlias = tuple[Plane, Plane, Plane]
"""One vector a pixel, one plane a component."""

_NOTHING = np.int32(0x7F000000)


class Shapes(NamedTuple):
    """Every solid as seen from one camera pose: first boxes, of which the first is the room, then capsules.

    Attributes:
        unit_from_cam: Affine maps from camera coordinates to those in which a box is the cube from -1 to 1 and a
            capsule has radius 1 and its axis along z.
        stem: Half length of a capsule's axis in those coordinates; 0 for boxes.
        change: What the maps change by from the first row of the tile to the first row of the one below, with a
            rolling shutter; `None` if all rows are taken at once.
    """

    unit_from_cam: Float[Array, "n 3 4"]
    stem: Float[Array, " n"]
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


def nearest_solid(shapes: Shapes, rays: Rays, candidates: Candidates, tiling: Tiling) -> Int[Array, " p"]:
    """The nearest solid along each ray of a tile, packed: see `unpack`.

    Args:
        shapes: All solids.
        rays: The rays of the tile.
        candidates: What the tile looks at; `begins` is that of the tile alone.
        tiling: Size of the tile.
    """
    mask = _index_mask(shapes)

    def box(which: Int[Array, ""], rays: Rays) -> Int[Array, " p"]:
        enter, leave = _slabs(*_into(shapes, which, rays))
        return _packed(enter, enter < leave, which, mask)

    def capsule(which: Int[Array, ""], rays: Rays) -> Int[Array, " p"]:
        depth, hit = _round(*_into(shapes, which, rays), shapes.stem[which])
        return _packed(depth, hit, which, mask)

    def look_at(
        cast: Callable[[Int[Array, ""], Rays], Int[Array, " p"]],
        rows: int,
        k: Int[Array, ""],
        nearest: Int[Array, " p"],
    ) -> Int[Array, " p"]:
        start = candidates.first_rows[k] * tiling.width
        seen, window = jax.tree.map(
            lambda plane: jax.lax.dynamic_slice(plane, (start,), (rows * tiling.width,)), (nearest, rays)
        )
        closer = jnp.minimum(seen, cast(candidates.solids[k], window))
        return jax.lax.dynamic_update_slice(nearest, closer, (start,))

    _, wall = _slabs(*_into(shapes, 0, rays))
    nearest = _packed(wall, wall > 0.0, jnp.int32(0), mask)
    for group, (cast, rows) in enumerate(product((box, capsule), tiling.windows)):
        begin, end = candidates.begins[group], candidates.begins[group + 1]
        nearest = jax.lax.fori_loop(begin, end, partial(look_at, cast, rows), nearest)
    return nearest


def unpack(shapes: Shapes, packed: Int[Array, " p"]) -> tuple[Plane, Int[Array, " p"]]:
    """Depth, short of the few bits that the index takes, and index of the solid."""
    mask = _index_mask(shapes)
    return jax.lax.bitcast_convert_type(packed & ~mask, jnp.float32), packed & mask


def _index_mask(shapes: Shapes) -> np.int32:
    return np.int32((1 << (shapes.stem.shape[0] - 1).bit_length()) - 1)


def _packed(depth: Plane, hit: Bool[Array, " p"], which: Int[Array, ""], mask: np.int32) -> Int[Array, " p"]:
    bits = jax.lax.bitcast_convert_type(depth, jnp.int32)
    return jnp.where(hit & (depth > NEAR_M), (bits & ~mask) | which, _NOTHING)


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
