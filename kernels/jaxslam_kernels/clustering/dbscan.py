"""Density-based clusters (DBSCAN) with fixed shapes: groups of points that lie close together, and noise.

A point with enough neighbors is a core point; core points within the radius of each other belong together, however
long the chain between them; other points within the radius of a core point are the border of its cluster; what is
left is noise. All pairs of points are looked at, `O(n²)`, for hundreds of points.

Source: Ester, Kriegel, Sander and Xu, "A density-based algorithm for discovering clusters in large spatial databases
with noise", KDD 1996, definitions 1 to 6. There, a border point in reach of several clusters belongs to the one that
is visited first; here, to the one of the nearest core point, so that the order of the points does not matter.
Connected parts: Shiloach and Vishkin, "An O(log n) parallel connectivity algorithm", 1982, with minima as labels.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import Mask, Scalar


class Clusters(NamedTuple):
    """Result of a clustering.

    Attributes:
        label: `(n,)` cluster of each point, from 0 to `num - 1` in the order of the clusters' first points; -1
            for noise and for points that do not count.
        core: `(n,)` true for points that have at least `min_points` neighbors, themselves included, within the radius.
        num: Number of clusters.
    """

    label: Int[Array, " n"]
    core: Bool[Array, " n"]
    num: Int[Array, ""]


@checked
def dbscan(
    points: Float[Array, "d n"], mask: Mask, *, radius: Scalar | float, min_points: Int[Array, ""] | int
) -> Clusters:
    """Clusters of points by density.

    A choice, constant for a derivative: labels are whole numbers and nothing in the result has a gradient.

    Args:
        points: `(d, n)` coordinates in any unit, pixels or meters; d of 1 or more.
        mask: `(n,)` which of them count. One that is not finite does not count either.
        radius: Maximum distance of neighbors, in the unit of the points, traced. Infinite: all points are
            neighbors. Negative or NaN: none are, and all is noise.
        min_points: Number of neighbors, the point included, that make a core point, traced. Below 1 it counts as 1.

    Returns:
        `Clusters`. A border point equally near to several core points, up to rounding, belongs to the first of them.
    """
    points = lax.stop_gradient(points)
    counts = mask & jnp.isfinite(points).all(axis=0)
    squared = _squared_distances(jnp.where(counts[None, :], points, 0))
    limit = _squared_radius(lax.stop_gradient(jnp.asarray(radius, points.dtype)))
    near = (squared <= limit) & counts[:, None] & counts[None, :]
    enough = jnp.maximum(jnp.asarray(min_points, jnp.int32), 1)
    core = counts & (near.sum(axis=0, dtype=jnp.int32) >= enough)
    nearest, distance = _nearest_core(squared, core)
    member = counts & (distance <= limit) & core.any()
    index = jnp.arange(counts.shape[0], dtype=jnp.int32)
    root = _connected(near, core)[jnp.where(member & ~core, nearest, index)]
    label, num = _number(root, member)
    return Clusters(label, core, num)


def _squared_distances(points: Float[Array, "d n"]) -> Float[Array, "n n"]:
    """By differences, not by inner products, which cancel far from the origin."""
    rows = [jnp.square(x[:, None] - x[None, :]) for x in points]
    return sum(rows[1:], start=rows[0])


def _squared_radius(radius: Scalar) -> Scalar:
    """A number below every squared distance if the radius is negative or NaN."""
    return jnp.where(radius >= 0, jnp.square(radius), -1)


def _nearest_core(squared: Float[Array, "n n"], core: Mask) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Index of and squared distance to the nearest core point; index n - 1 and infinity where there is none.

    Two minima instead of argmin, which XLA does not vectorize: a tenth of the time. It computes the distances anew for
    each, perhaps rounded differently, hence the tolerance.
    """
    n = core.shape[0]
    distance = jnp.min(jnp.where(core[:, None], squared, jnp.inf), axis=0, initial=jnp.inf)
    bound = distance * (1 + 4 * float(jnp.finfo(squared.dtype).eps))
    index = jnp.arange(n, dtype=jnp.int32)
    reached = core[:, None] & (squared <= bound[None, :])
    return jnp.min(jnp.where(reached, index[:, None], n - 1), axis=0, initial=n - 1), distance


def _connected(near: Bool[Array, "n n"], core: Mask) -> Int[Array, " n"]:
    """The same index for all core points of a cluster, that of one of them; for other points their own.

    Labels fall to the least of the neighbors' until they rest. The root of a tree falls too, and ways to the root
    are halved, so that a chain takes steps with the logarithm of its length.
    """
    n = core.shape[0]

    def spread(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        offered = jnp.where(core, labels, n)
        least = jnp.min(jnp.where(near, offered[:, None], n), axis=0, initial=n)
        least = jnp.where(core, least, labels)
        new = jnp.minimum(labels.at[labels].min(least), least)
        new = new[new]
        return new, (new != labels).any()

    labels = jnp.arange(n, dtype=jnp.int32)
    return lax.while_loop(lambda state: state[1], spread, (labels, core.any()))[0]


def _number(root: Int[Array, " n"], member: Mask) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """Clusters counted in the order of their first points, and how many there are."""
    n = root.shape[0]
    index = jnp.arange(n, dtype=jnp.int32)
    first = jnp.full(n, n, jnp.int32).at[root].min(index)[root]
    starts = member & (first == index)
    number = jnp.cumsum(starts, dtype=jnp.int32) - 1
    return jnp.where(member, number[first], -1), starts.sum(dtype=jnp.int32)
