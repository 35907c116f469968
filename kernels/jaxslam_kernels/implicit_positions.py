"""Derivatives of iteratively found image positions, by the implicit function theorem."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxslam_kernels.derivative_rules import custom_jvp
from jaxslam_kernels.types import Mask, Pixels

Measures = PyTree[Float[Array, " n"]]


class ConvergedPositions(NamedTuple):
    """Result of a search for positions.

    Attributes:
        positions: `(2, n)` final positions, finite.
        converged: `(n,)` true for positions that are solutions.
        measures: Further measures of the positions, any number of arrays `(n,)`.
    """

    positions: Pixels
    converged: Mask
    measures: Measures


@partial(custom_jvp, nondiff_argnums=(0, 1))
def implicit_positions(
    solve: Callable[[Any], ConvergedPositions],
    explain: Callable[[Pixels, Any], tuple[Pixels, Measures]],
    inputs: PyTree[Array],
) -> ConvergedPositions:
    """Find positions at which a slope vanishes, differentiable regardless of the iteration that found them.

    The derivative of a position is `-(d slope / d position)^-1 (d slope / d inputs)`, forward and reverse; a measure
    changes with the inputs and with its position. Both are zero for a point that did not converge, or whose system is
    singular to working precision: no solution is there. The functions must close over nothing that is traced.

    Args:
        solve: The search; never differentiated.
        explain: The slope at positions, `(2, n)` and zero at a solution, and the measures there, as plain
            differentiable functions; those of a point depend on its own position alone. A measure that is to have no
            derivative is a constant here.
        inputs: Arguments of both functions. Values that are not finite are replaced by 0 for the derivative; a point
            that depends on one must not count as converged.
    """
    return solve(inputs)


@implicit_positions.defjvp
def _implicit_positions_jvp(
    solve: Callable, explain: Callable, primals: tuple, tangents: tuple
) -> tuple[ConvergedPositions, ConvergedPositions]:
    (inputs,), (change,) = primals, tangents
    found = implicit_positions(solve, explain, inputs)
    position, finite_inputs = found.positions, jax.tree.map(_finite, inputs)

    def along(axis: int) -> tuple[Pixels, Measures]:
        unit = jnp.zeros_like(position).at[axis].set(1)
        return jax.jvp(lambda moved: explain(moved, finite_inputs), (position,), (unit,))[1]

    ((uu, vu), by_u), ((uv, vv), by_v) = along(0), along(1)
    (u, v), by_inputs = jax.jvp(partial(explain, position), (finite_inputs,), (change,))[1]

    determinant = uu * vv - uv * vu
    magnitude = jnp.square(uu) + jnp.square(uv) + jnp.square(vu) + jnp.square(vv)
    regular = found.converged & (jnp.abs(determinant) > 10 * jnp.finfo(position.dtype).eps * magnitude)
    inverse = jnp.where(regular, 1 / jnp.where(regular, determinant, 1), 0)
    du, dv = -inverse * (vv * u - uv * v), -inverse * (uu * v - vu * u)
    total = lambda given, along_u, along_v: jnp.where(regular, given + along_u * du + along_v * dv, 0)
    measures = jax.tree.map(total, by_inputs, by_u, by_v)
    not_differentiable = np.zeros(found.converged.shape, jax.dtypes.float0)
    return found, ConvergedPositions(jnp.stack([du, dv]), not_differentiable, measures)  # pyright: ignore[reportArgumentType]


def _finite(leaf: Array) -> Array:
    return jnp.where(jnp.isfinite(leaf), leaf, 0) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf
