"""Sparse symmetric systems of a graph: conjugate gradients, preconditioned by a block-tridiagonal Cholesky factor.

The nodes, in a given order, are cut into groups of fixed size. The factor is that of the matrix without the coupling
of groups that are not neighbors; their diagonal stays, so it is positive definite whatever is left out. Where the
order brings every edge within neighboring groups the factor is exact and one iteration is enough; otherwise it is an
incomplete factor. The order is data and the size of a group is static, so nothing recompiles when the graph grows.

Source: Golub and Van Loan, "Matrix Computations", 2013, sections 4.5.1 and 11.5; Cuthill and McKee, "Reducing the
Bandwidth of Sparse Symmetric Matrices", 1969, for the order.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from jaxslam_kernels.types import Scalar

Vector = Float[Array, "k d"]


class GraphMatrix(NamedTuple):
    """A symmetric matrix of `d x d` blocks, one a node and one an edge.

    Attributes:
        diagonal: `(k, d, d)` blocks of the nodes.
        coupling: `(e, d, d)` blocks in the row of an edge's source and the column of its target.
        source: `(e,)` index of the source.
        target: `(e,)` index of the target.
    """

    diagonal: Float[Array, "k d d"]
    coupling: Float[Array, "e d d"]
    source: Int[Array, " e"]
    target: Int[Array, " e"]


class BandFactor(NamedTuple):
    """Cholesky factor of the block-tridiagonal part.

    Attributes:
        corner: `(groups, b, b)` lower triangles on the diagonal.
        below: `(groups, b, b)` blocks left of them; the first is zero.
        rank: `(k,)` place of every node in the order.
    """

    corner: Float[Array, "groups b b"]
    below: Float[Array, "groups b b"]
    rank: Int[Array, " k"]


def multiply(matrix: GraphMatrix, x: Vector) -> Vector:
    """The product with a vector."""
    y = jnp.einsum("kij,kj->ki", matrix.diagonal, x)
    y = y.at[matrix.source].add(jnp.einsum("mij,mj->mi", matrix.coupling, x[matrix.target]))
    return y.at[matrix.target].add(jnp.einsum("mij,mi->mj", matrix.coupling, x[matrix.source]))


def factorize(matrix: GraphMatrix, rank: Int[Array, " k"], group_size: int) -> BandFactor:
    """Factorizes the part that couples neighboring groups.

    Args:
        matrix: Positive definite, a Gauss-Newton matrix with a positive damping.
        rank: `(k,)` place of every node in the order.
        group_size: Nodes in a group, static.
    """
    k, d, _ = matrix.diagonal.shape
    groups = -(-k // group_size)
    dtype = matrix.diagonal.dtype
    shape = (groups, group_size, d, group_size, d)
    group, slot = rank // group_size, rank % group_size
    row_group, column_group = group[matrix.source], group[matrix.target]
    row_slot, column_slot = slot[matrix.source], slot[matrix.target]
    transposed = matrix.coupling.swapaxes(1, 2)

    def only(condition: Array, blocks: Array) -> Array:
        return jnp.where(condition[:, None, None], blocks, 0.0)

    same = row_group == column_group
    filler = jnp.arange(k, groups * group_size)  # slots without a node: ones on the diagonal
    corner = jnp.zeros(shape, dtype).at[group, slot, :, slot, :].add(matrix.diagonal)
    corner = corner.at[filler // group_size, filler % group_size, :, filler % group_size, :].set(
        jnp.eye(d, dtype=dtype)
    )
    corner = corner.at[row_group, row_slot, :, column_slot, :].add(only(same, matrix.coupling))
    corner = corner.at[row_group, column_slot, :, row_slot, :].add(only(same, transposed))
    below = jnp.zeros(shape, dtype)
    below = below.at[row_group, row_slot, :, column_slot, :].add(only(row_group == column_group + 1, matrix.coupling))
    below = below.at[column_group, column_slot, :, row_slot, :].add(only(column_group == row_group + 1, transposed))
    size = group_size * d
    return BandFactor(*_factorize(corner.reshape(groups, size, size), below.reshape(groups, size, size)), rank)


def _factorize(corner: Array, below: Array) -> tuple[Array, Array]:
    def step(previous: Array, blocks: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        diagonal, coupling = blocks
        left = solve_triangular(previous, coupling.T, lower=True).T
        lower = jnp.linalg.cholesky(diagonal - left @ left.T, symmetrize_input=False)
        return lower, (lower, left)

    return lax.scan(step, jnp.eye(corner.shape[1], dtype=corner.dtype), (corner, below))[1]


def solve_factor(factor: BandFactor, right: Vector) -> Vector:
    """The solution with the factor alone."""
    d = right.shape[1]
    groups, size, _ = factor.corner.shape
    ordered = jnp.zeros((groups * (size // d), d), right.dtype).at[factor.rank].set(right).reshape(groups, size)

    def forward(previous: Array, blocks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, left, b = blocks
        y = solve_triangular(lower, b - left @ previous, lower=True)
        return y, y

    def backward(carry: Array, blocks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, left, y = blocks
        x = solve_triangular(lower, y - carry, lower=True, trans=1)
        return left.T @ x, x

    zero = jnp.zeros(size, right.dtype)
    _, y = lax.scan(forward, zero, (factor.corner, factor.below, ordered))
    _, x = lax.scan(backward, zero, (factor.corner, factor.below, y), reverse=True)
    return x.reshape(-1, d)[factor.rank]


class _Search(NamedTuple):
    x: Vector
    residual: Vector
    direction: Vector
    slope: Scalar  # residual times preconditioned residual
    steps: Int[Array, ""]
    failed: Array


def conjugate_gradients(
    multiply_by: Callable[[Vector], Vector],
    precondition: Callable[[Vector], Vector],
    right: Vector,
    *,
    tolerance: float,
    max_steps: int,
) -> tuple[Vector, Int[Array, ""]]:
    """Solves a positive definite system, and counts the iterations.

    Ends when the residual in the metric of the preconditioner has fallen by `tolerance`, or when the matrix turns out
    not to be positive definite; the last good iterate is returned.
    """
    z = precondition(right)
    first = jnp.sum(right * z)
    start = _Search(jnp.zeros_like(right), right, z, first, jnp.zeros((), jnp.int32), ~jnp.isfinite(first))

    def go_on(s: _Search) -> Array:
        return ~s.failed & (s.slope > tolerance**2 * first) & (s.steps < max_steps)

    def step(s: _Search) -> _Search:
        image = multiply_by(s.direction)
        curvature = jnp.sum(s.direction * image)
        good = curvature > 0
        length = jnp.where(good, s.slope / jnp.where(good, curvature, 1.0), 0.0)
        residual = s.residual - length * image
        z = precondition(residual)
        slope = jnp.sum(residual * z)
        good = good & jnp.isfinite(slope)
        direction = z + slope / s.slope * s.direction
        new = _Search(s.x + length * s.direction, residual, direction, slope, s.steps + 1, ~good)
        kept = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, s)
        return kept._replace(failed=~good)

    end = lax.while_loop(go_on, step, start)
    return end.x, end.steps
