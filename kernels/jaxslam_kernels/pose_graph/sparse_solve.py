"""Sparse symmetric systems of a graph, solved on the host by SciPy's SuperLU, from inside compiled code.

For graphs whose band is wide in any order: a minimum-degree order of the nodes keeps the factor sparse, which XLA
cannot express without compiling for each structure. It is pure, batches one by one and blocks no other thread of
Python while it factorizes; it has no derivative of its own.

Source: Li, "An Overview of SuperLU", 2005; Liu, "Modification of the Minimum-Degree Algorithm by Multiple
Elimination", 1985, for the order.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxslam_kernels.pose_graph.block_tridiagonal_cg import GraphMatrix, Vector

_PIECE = 2**14  # words, 64 kB
_SYMMETRIC: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


def solve_on_host(matrix: GraphMatrix, right: Vector) -> Vector:
    """The solution, computed in double precision; not finite where the matrix is not, or is singular."""
    # As words: in the thread that calls back, JAX rounds to single precision whatever `enable_x64` says here.
    arrays = [lax.bitcast_convert_type(values, jnp.uint32) for values in (matrix.diagonal, matrix.coupling, right)]
    arrays += [index.astype(jnp.uint32) for index in (matrix.source, matrix.target)]
    shapes = tuple(array.shape for array in arrays)
    solve = partial(_solve_words, shapes, np.dtype(right.dtype))
    pieces = [_pieces(array.ravel()) for array in arrays]
    result = jax.ShapeDtypeStruct(shapes[2], jnp.uint32)
    found = jax.pure_callback(solve, result, pieces, vmap_method="sequential")
    return lax.bitcast_convert_type(found, right.dtype)


def _pieces(words: Array) -> list[Array]:
    """JAX copies what it hands to a callback here and now only up to 100 kB; more is left to XLA's threads.

    With one thread, which is the one that calls back, that copy never comes.
    """
    return jnp.split(words, list(range(_PIECE, words.size, _PIECE)))


def _solve_words(shapes: tuple[tuple[int, ...], ...], dtype: np.dtype, pieces: list[list[Any]]) -> np.ndarray:
    arrays = [np.concatenate(p).reshape(shape) for p, shape in zip(pieces, shapes, strict=True)]
    diagonal, coupling, right = (_numbers(words, dtype) for words in arrays[:3])
    source, target = (index.astype(np.int32) for index in arrays[3:])
    found = solve_blocks(diagonal, coupling, right, source, target)
    return np.ascontiguousarray(found).view(np.uint32).reshape(shapes[2])


def _numbers(words: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Words back to numbers; a double has two, along a last axis of their own."""
    numbers = words.view(dtype)
    return numbers[..., 0] if dtype.itemsize > words.itemsize else numbers


def solve_blocks(
    diagonal: np.ndarray, coupling: np.ndarray, right: np.ndarray, source: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Solve a sparse symmetric system of NumPy arrays in double precision, for callers that are on the host already.

    Args:
        diagonal: `(k, d, d)` symmetric block of each node.
        coupling: `(e, d, d)` block of each edge, rows of the source and columns of the target.
        right: `(k, d)` right-hand side.
        source: `(e,)` index of each edge's first node.
        target: `(e,)` index of its second node.

    Returns:
        `(k, d)` solution, in the precision of `right`; NaN where the matrix is not finite or is singular.
    """
    from scipy.sparse.linalg import splu  # noqa: PLC0415 - only for graphs, on the host

    if not all(np.isfinite(values).all() for values in (diagonal, coupling, right)):
        return np.full_like(right, np.nan)
    used = coupling.any(axis=(1, 2))
    coupling, source, target = coupling[used], source[used], target[used]
    order = _elimination_order(source, target, len(diagonal))
    place = np.argsort(order)
    sparse = _assemble(diagonal[order], coupling, place[source], place[target])
    try:
        factor = splu(sparse, permc_spec="NATURAL", **_SYMMETRIC)
    except RuntimeError:  # exactly singular, which LAPACK's Cholesky factor shows in the same way
        return np.full_like(right, np.nan)
    return factor.solve(right[order].astype(np.float64).ravel()).reshape(right.shape)[place].astype(right.dtype)


def _elimination_order(source: np.ndarray, target: np.ndarray, num_nodes: int) -> np.ndarray:
    """Minimum degree, by nodes: SuperLU finds it on its way to factorizing any matrix of this structure."""
    from scipy.sparse import coo_array  # noqa: PLC0415 - only for graphs, on the host
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    nodes = np.arange(num_nodes)
    rows, columns = np.concatenate([nodes, source, target]), np.concatenate([nodes, target, source])
    degree = np.bincount(rows, minlength=num_nodes)
    values = np.where(rows == columns, 1.0 + degree[rows], -1.0)
    pattern = coo_array((values, (rows, columns)), shape=(num_nodes, num_nodes)).tocsc()
    return np.argsort(splu(pattern, permc_spec="MMD_AT_PLUS_A", **_SYMMETRIC).perm_c)


def _assemble(diagonal: np.ndarray, coupling: np.ndarray, source: np.ndarray, target: np.ndarray) -> Any:
    from scipy.sparse import coo_array  # noqa: PLC0415 - only for graphs, on the host

    k, d, _ = diagonal.shape
    nodes = np.arange(k)
    blocks = np.concatenate([diagonal, coupling, coupling.swapaxes(1, 2)]).astype(np.float64)
    rows, columns = np.concatenate([nodes, source, target]), np.concatenate([nodes, target, source])
    within = np.arange(d)
    row = np.broadcast_to((d * rows)[:, None, None] + within[:, None], blocks.shape)
    column = np.broadcast_to((d * columns)[:, None, None] + within, blocks.shape)
    return coo_array((blocks.ravel(), (row.ravel(), column.ravel())), shape=(k * d, k * d)).tocsc()
