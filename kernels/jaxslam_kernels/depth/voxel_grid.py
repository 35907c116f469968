"""Points merged into voxels: centroid, color and count of each, of one cloud or of a grid that grows and shrinks.

The grid holds sums, so that it is linear: what a keyframe has added is taken out again exactly where it went in, and
added elsewhere, when the keyframe is moved. Source of the filter: Rusu and Cousins, "3D is here: Point Cloud Library",
2011 (`VoxelGrid`), as RTS-SLAM (2026, section 3.5) uses it; of the evidence: Hornung et al., "OctoMap", 2013.
"""

from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxslam_kernels.checks import checked
from jaxslam_kernels.depth.voxel_hash import (
    NO_ROW,
    HashTable,
    Rows,
    empty_table,
    find_rows,
    key_corners,
    voxel_keys,
)
from jaxslam_kernels.types import Code, Mask, Points, Scalar, Weights

Colors: TypeAlias = Float[Array, "3 n"]
"""Red, green and blue, 0 to 255."""

MAX_LOG_ODDS, MIN_LOG_ODDS = 3.5, -2.0
"""Bounds of what a voxel remembers: probabilities of 0.97 and 0.12, OctoMap's."""


class Voxels(NamedTuple):
    """Points, one a voxel.

    Attributes:
        X: `(3, m)` centroids, meters; 0 where there is no voxel.
        color: `(3, m)` their mean colors.
        counts: `(m,)` points in each; 0 where there is no voxel.
        num: Voxels that the cloud has; those beyond `m` are left out.
    """

    X: Points
    color: Colors
    counts: Weights
    num: Code


class VoxelGrid(NamedTuple):
    """Sums over the points in each voxel, a row each.

    Attributes:
        table: Hash table from voxels to rows.
        sums: `(c, 8)` of the ways from its corner, in voxels; of colors; of counts; and last, no sum, how sure it is
            that there is something (log-odds, bounded): a voxel with less than 0 is free. A row lies together, against
            the custom of kernels: rows are visited in no order, and each visit is to one place in memory then.
    """

    table: HashTable
    sums: Float[Array, "c 8"]

    @property
    def log_odds(self) -> Float[Array, " c"]:
        """`(c,)` of each row."""
        return self.sums[:, 7]


@checked
def reduced_cloud(X: Points, color: Colors, mask: Mask, voxel_m: Scalar, *, capacity: int) -> Voxels:
    """One point for each voxel that has any: the centroid of its points, their mean color, their number.

    In the order in which the voxels first come. Differentiable in the points and colors; which voxel a point is in
    is a constant.

    Args:
        X: `(3, n)` meters.
        color: `(3, n)`.
        mask: `(n,)` points that count, if they are finite and not too far away (see `voxel_keys`).
        voxel_m: Side of a voxel.
        capacity: Voxels at most, `m`; static.
    """
    keys, inside = voxel_keys(X, voxel_m)
    usable = mask & inside
    table, rows, left_out = find_rows(empty_table(capacity, X.shape[1]), keys, usable)
    corner = key_corners(keys, voxel_m)
    row = jnp.where(rows < 0, capacity, rows)
    # Missing points may be NaN, and 0 times NaN would be the gradient.
    offset = jnp.where(usable[None], X - corner, 0)
    figures = jnp.concatenate([offset, color, usable[None].astype(X.dtype)])
    sums = jnp.zeros((capacity, 7), X.dtype).at[row].add(figures.T, mode="drop").T
    some = (sums[6] > 0)[None]
    share = 1 / jnp.maximum(sums[6], 1)[None]
    centroid = jnp.where(some, key_corners(table.keys, voxel_m) + sums[:3] * share, 0)
    return Voxels(centroid, sums[3:6] * share, sums[6], table.num + left_out)


@checked
def empty_grid(capacity: int, dtype: DTypeLike = jnp.float32) -> VoxelGrid:
    """A grid for so many voxels, without any."""
    return VoxelGrid(empty_table(capacity), jnp.zeros((capacity, 8), dtype))


@checked
def with_cloud(
    grid: VoxelGrid, X: Points, color: Colors, count: Weights, evidence: Weights, voxel_m: Scalar
) -> tuple[VoxelGrid, Rows]:
    """The grid with the points of a cloud in it.

    Args:
        grid: The grid.
        X: `(3, n)` meters in the world.
        color: `(3, n)`.
        count: `(n,)` what each counts; 0 for no point.
        evidence: `(n,)` log-odds that each adds to its voxel.
        voxel_m: Side of a voxel.

    Returns:
        The grid and the row of each point; `NO_ROW` where there is none, or no room left.
    """
    keys, inside = voxel_keys(X, voxel_m)
    table, rows, _ = find_rows(grid.table, keys, inside & (count > 0))
    return changed(grid._replace(table=table), rows, X, color, count, evidence, voxel_m), rows


@checked
def changed(
    grid: VoxelGrid, rows: Rows, X: Points, color: Colors, count: Weights, evidence: Weights, voxel_m: Scalar
) -> VoxelGrid:
    """The grid with points added to rows that are known; with negative counts they are taken out.

    Args:
        grid: The grid.
        rows: `(n,)` of the points; nothing happens to those of `NO_ROW`.
        X: `(3, n)` meters in the world, inside the voxels of the rows.
        color: `(3, n)`.
        count: `(n,)` what each counts.
        evidence: `(n,)` log-odds that each adds.
        voxel_m: Side of a voxel.
    """
    capacity = len(grid.sums)
    known = rows != NO_ROW
    row = jnp.where(known, rows, capacity)
    corner = key_corners(grid.table.keys[:, jnp.maximum(rows, 0)], voxel_m)
    offset = jnp.where(known[None], X - corner, 0) / voxel_m
    figures = jnp.concatenate([offset * count[None], color * count[None], count[None], evidence[None]])
    return grid._replace(sums=_bounded(grid.sums.at[row].add(figures.T, mode="drop"), row))


@checked
def weighed(grid: VoxelGrid, start: Code, evidence: Weights) -> VoxelGrid:
    """The grid with log-odds `(n,)` added to the rows from `start` on; there must be as many."""
    old = lax.dynamic_slice(grid.sums, (start, jnp.full_like(start, 7)), (len(evidence), 1))
    new = jnp.clip(old + evidence[:, None], MIN_LOG_ODDS, MAX_LOG_ODDS)
    return grid._replace(sums=lax.dynamic_update_slice(grid.sums, new, (start, jnp.full_like(start, 7))))


@checked
def centroids(grid: VoxelGrid, start: Code, voxel_m: Scalar, *, size: int) -> Voxels:
    """The points of `size` rows from `start` on, whatever their log-odds; there must be as many.

    One of which nothing is left has a count of 0.
    """
    zero = jnp.zeros_like(start)
    sums = lax.dynamic_slice(grid.sums, (start, zero), (size, 8)).T
    keys = lax.dynamic_slice(grid.table.keys, (zero, start), (2, size))
    some = sums[6] > 0.5  # what is taken out again leaves rounding behind
    share = jnp.where(some, 1 / jnp.where(some, sums[6], 1), 0)[None]
    X = key_corners(keys, voxel_m) + sums[:3] * share * voxel_m
    return Voxels(jnp.where(some[None], X, 0), sums[3:6] * share, jnp.where(some, sums[6], 0), grid.table.num)


def _bounded(sums: Float[Array, "c 8"], rows: Rows) -> Float[Array, "c 8"]:
    """Sums whose log-odds, in the rows that have changed, are within bounds."""
    odds = sums[jnp.minimum(rows, len(sums) - 1), 7]
    return sums.at[rows, 7].set(jnp.clip(odds, MIN_LOG_ODDS, MAX_LOG_ODDS), mode="drop")
