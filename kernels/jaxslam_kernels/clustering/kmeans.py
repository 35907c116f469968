"""K-means clusters with fixed shapes: every point belongs to the nearest of a fixed number of centers.

Lloyd's iterations from centers drawn by greedy k-means++, or from given ones such as those of the last frame. Sources:
Lloyd, "Least squares quantization in PCM", 1982; Arthur and Vassilvitskii, "k-means++: the advantages of careful
seeding", SODA 2007, where section 7 proposes the greedy form: several draws for each center, the best of them kept.

Layout: distances are taken by differences, a center at a time, into a running minimum. XLA makes one pass over the
points of that, several times as fast as a matrix product of centers and points with its minimum, which writes `k n`
numbers, and nothing cancels. Sums are added up point by point, faster than by a product with one-hot labels.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import Mask, Scalar

_DRAWS = 3  # so many for each center, as in OpenCV


class KMeans(NamedTuple):
    """Points and the centers they belong to.

    Attributes:
        label: `(n,)` the nearest center of each point, the first of equally near ones; -1 for points that do not count.
        centers: `(d, k)` the centers, in the unit of the points.
        cost: Sum of the squared distances of points to their centers.
        counts: `(k,)` how many points belong to each center. A center with none is not worth anything: with
            `usable=counts > 0` it is drawn anew in the next call.
    """

    label: Int[Array, " n"]
    centers: Float[Array, "d k"]
    cost: Scalar
    counts: Int[Array, " k"]


@checked
def kmeans(
    key: Key[Array, ""],
    points: Float[Array, "d n"],
    mask: Mask,
    *,
    num_clusters: int,
    num_steps: int,
    initial: Float[Array, "d k"] | None = None,
    usable: Bool[Array, " k"] | None = None,
) -> KMeans:
    """Clusters of points around centers.

    A step gives each point to its nearest center and moves each center to the mean of its points; one without points
    stays where it is. Labels and cost belong to the centers after the last step.

    Labels are choices, constant for a derivative, and so is where the search begins. Centers are the means of the
    points that had their labels before the last step and carry a gradient as such, and so does the cost. A center
    without points then, or after no step at all, has none.

    Args:
        key: Random key; the same key gives the same answer for the same points in the same order.
        points: `(d, n)` coordinates in any unit; d of 1 or more.
        mask: `(n,)` which of them count. One that is not finite does not count either, nor one with a coordinate
            beyond the fourth root of the largest number (4e9 in single precision), whose squares might overflow.
        num_clusters: Number of centers, static. All of them are written out in the program: dozens, not thousands.
        num_steps: Number of steps, static.
        initial: `(d, k)` where to begin; `None` to draw all centers from the points.
        usable: `(k,)` which of the initial centers to begin with; the others are drawn. One that is not finite is
            drawn in any case. `None`: all.

    Returns:
        `KMeans`; everything in it is finite. With fewer different points than centers, some centers coincide, and all
        but the first of those have no points. With no points, centers that had to be drawn are zero.
    """
    _check(points, num_clusters, num_steps, initial)
    counts = mask & _in_range(points)
    origin = lax.stop_gradient(_mean(points, counts))  # far from zero, sums would be rounded more
    points = jnp.where(counts[None, :], points - origin[:, None], 0)
    fixed = lax.stop_gradient(points)
    begin, usable = _given(initial, usable, origin, num_clusters)
    centers = lax.cond(usable.all(), lambda: begin, lambda: _seed(key, fixed, counts, begin, usable))
    before, (label, _) = _lloyd(fixed, counts, centers, num_steps)
    # What the last step ends with, once more for the gradient.
    centers = _means(_with_ones(points), before.label, before.centers)
    cost = jnp.square(points - centers[:, jnp.maximum(label, 0)]).sum(axis=0, where=counts).sum()
    num = jnp.zeros(num_clusters, jnp.int32).at[_or_dropped(label, num_clusters)].add(1, mode="drop")
    placed = usable | counts.any()
    return KMeans(label, jnp.where(placed[None, :], centers + origin[:, None], 0), cost, num)


def _check(points: Array, num_clusters: int, num_steps: int, initial: Array | None) -> None:
    if num_clusters < 1 or num_steps < 0:
        raise ValueError(
            f"num_clusters of 1 or more and num_steps of 0 or more expected, got {num_clusters, num_steps}"
        )
    expected = (points.shape[0], num_clusters)
    if initial is not None and initial.shape != expected:
        raise ValueError(f"initial: {expected} expected, a column a center, got {initial.shape}")


def _in_range(points: Float[Array, "d n"]) -> Bool[Array, " n"]:
    """False for NaN too."""
    limit = float(jnp.finfo(points.dtype).max) ** 0.25
    return (jnp.abs(lax.stop_gradient(points)) < limit).all(axis=0)


def _mean(points: Float[Array, "d n"], counts: Mask) -> Float[Array, " d"]:
    total = jnp.where(counts[None, :], points, 0).sum(axis=1)
    return total / jnp.maximum(counts.sum(dtype=jnp.int32), 1).astype(points.dtype)


def _given(
    initial: Float[Array, "d k"] | None, usable: Bool[Array, " k"] | None, origin: Float[Array, " d"], num: int
) -> tuple[Float[Array, "d k"], Bool[Array, " k"]]:
    """Centers to begin with, from the origin, zero where there is none; and where there is one."""
    if initial is None:
        return jnp.zeros((origin.shape[0], num), origin.dtype), jnp.zeros(num, bool)
    initial = lax.stop_gradient(initial)
    usable = _in_range(initial) if usable is None else usable & _in_range(initial)
    return jnp.where(usable[None, :], initial - origin[:, None], 0), usable


class _Labeled(NamedTuple):
    """Labels of points, -1 for none, and the centers they stand for."""

    label: Int[Array, " n"]
    centers: Float[Array, "d k"]


def _lloyd(
    points: Float[Array, "d n"], counts: Mask, centers: Float[Array, "d k"], num_steps: int
) -> tuple[_Labeled, _Labeled]:
    """Run all steps; return labels and centers before and after the last one.

    The loop runs once more than there are steps, the first time without labels, which leaves all centers in place. The
    labels are then computed in a single place of the program, inside a loop, from which XLA does not move them.
    Otherwise it computes them again for every use, which takes longer than ten steps.
    """
    rows = _with_ones(points)

    def step(_: Array, state: tuple[_Labeled, _Labeled]) -> tuple[_Labeled, _Labeled]:
        before = state[1]
        moved = _means(rows, before.label, before.centers)
        return before, _Labeled(jnp.where(counts, nearest_centers(points, moved), -1), moved)

    nothing = _Labeled(jnp.full(counts.shape, -1, jnp.int32), centers)
    return lax.fori_loop(0, num_steps + 1, step, (nothing, nothing))


def _with_ones(points: Float[Array, "d n"]) -> Float[Array, "n d_1"]:
    """The points and a one, a row each: XLA adds whole rows faster than columns."""
    return jnp.concatenate([points, jnp.ones_like(points[:1])]).T


def _means(rows: Float[Array, "n d_1"], label: Int[Array, " n"], centers: Float[Array, "d k"]) -> Float[Array, "d k"]:
    """Each center at the mean of its points, of rows `_with_ones`, or where it was if it has none."""
    dim, num = centers.shape
    sums = jnp.zeros((num, dim + 1), rows.dtype).at[_or_dropped(label, num)].add(rows, mode="drop").T
    return jnp.where(sums[dim:] > 0, sums[:dim] / jnp.maximum(sums[dim:], 1), centers)


@checked
def nearest_centers(points: Float[Array, "d n"], centers: Float[Array, "d k"]) -> Int[Array, " n"]:
    """Return the `(n,)` index of the nearest center of each point, the first of equally near ones.

    A center that is not finite is the nearest of no point; the index is 0 where there is no other.

    Written out for each center, which keeps the smallest distance in a register: 0.17 ms for three times 19,200 points
    and 24 centers, where a loop over the centers takes 1.2 ms, and a reduction over an axis of centers 1.8.
    """
    squared = jnp.full(points.shape[1:], jnp.inf, points.dtype)
    label = jnp.zeros(points.shape[1:], jnp.int32)
    for k in range(centers.shape[1]):
        distance = _squared_distances(points, centers[:, k : k + 1])[0]
        nearer = distance < squared
        label, squared = jnp.where(nearer, k, label), jnp.where(nearer, distance, squared)
    return label


def _squared_distances(points: Float[Array, " d *n"], centers: Float[Array, "d k"]) -> Float[Array, " k *n"]:
    """Squared distances of all points to each center."""
    behind = (slice(None), *(None,) * (points.ndim - 1))
    # Coordinate by coordinate: a sum over their axis is a loop inside the loop over points, ten times as slow.
    squares = [jnp.square(x[None] - c[behind]) for x, c in zip(points, centers, strict=True)]
    return sum(squares[1:], start=squares[0])


def _seed(
    key: Key[Array, ""],
    points: Float[Array, "d n"],
    counts: Mask,
    begin: Float[Array, "d k"],
    usable: Bool[Array, " k"],
) -> Float[Array, "d k"]:
    """Centers that are not usable drawn one after the other, each a point by its squared distance to the nearest one.

    Of `_DRAWS` points that one is taken which brings the points nearest to their centers. Points lie in a square, so
    that a draw chooses one of its rows and then one in the row: sums along the way, of all points in turn, would take
    longer than the distances.
    """
    tiles, inside = _square(points, counts)
    squared = jnp.full(inside.shape, jnp.inf, points.dtype)
    for k in range(usable.size):  # written out: a reduction over an axis of centers takes 1.7 ms
        center = jnp.where(usable[k], begin[:, k : k + 1], jnp.inf)
        squared = jnp.minimum(squared, _squared_distances(tiles, center)[0])

    def draw(squared: Array, uniform: Array) -> tuple[Array, Array]:
        row, column = jax.vmap(_draw, (0, None, None))(uniform, squared, inside)
        drawn = tiles[:, row, column]
        left = jnp.minimum(squared[None], _squared_distances(tiles, drawn)).sum(axis=(1, 2))
        center = drawn[:, jnp.argmin(left)]
        return jnp.minimum(squared, _squared_distances(tiles, center[:, None])[0]), center

    def next_center(squared: Array, one: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        uniform, given, keep = one
        return lax.cond(keep, lambda: (squared, given), lambda: draw(squared, uniform))

    uniform = jax.random.uniform(key, (usable.size, _DRAWS), points.dtype)
    return lax.scan(next_center, jnp.where(inside, squared, 0), (uniform, begin.T, usable))[1].T


def _square(points: Float[Array, "d n"], counts: Mask) -> tuple[Float[Array, "d r c"], Bool[Array, "r c"]]:
    """Points in about as many rows as columns, filled up with some that do not count; one of them at least."""
    dim, n = points.shape
    columns = max(math.isqrt(n), 1)
    rows = max(-(-n // columns), 1)
    more = rows * columns - n
    tiles = jnp.pad(points, ((0, 0), (0, more))).reshape(dim, rows, columns)
    return tiles, jnp.pad(counts, (0, more)).reshape(rows, columns)


def _draw(
    uniform: Scalar, squared: Float[Array, "r c"], inside: Bool[Array, "r c"]
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Row and column of a point in proportion to its squared distance; each is as likely as any if all are 0 or inf."""
    weights = jnp.where(jnp.isfinite(squared), squared, 0)
    in_rows = weights.sum(axis=1)
    all_alike = in_rows.sum() <= 0
    ones = inside.astype(squared.dtype)
    in_rows = jnp.where(all_alike, ones.sum(axis=1), in_rows)
    row, left = _pick(uniform * in_rows.sum(), in_rows)
    column, _ = _pick(left, jnp.where(all_alike, ones[row], weights[row]))
    return row, column


def _pick(target: Scalar, weights: Float[Array, " n"]) -> tuple[Int[Array, ""], Scalar]:
    """Find the weight at a target of the cumulative sum of weights, and the distance from where that weight begins.

    Never on a weight of zero as long as another is positive, however the sums are rounded.
    """
    ends = jnp.cumsum(weights)
    hit = (weights > 0) & (ends > target)
    index = jnp.where(hit.any(), jnp.argmax(hit), jnp.argmax(weights))
    return index, target - (ends[index] - weights[index])


def _or_dropped(label: Int[Array, " n"], num: int) -> Int[Array, " n"]:
    """Labels with an index past the end, instead of -1, which would be the last one's."""
    return jnp.where(label < 0, num, label)
