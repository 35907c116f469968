"""Derivatives of iteratively found image positions, by the implicit function theorem."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxslam_kernels.types import Mask, Pixels


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def implicit_positions(
    solve: Callable[[Any], tuple[Pixels, Mask, PyTree]],
    slope: Callable[[Pixels, Any], Pixels],
    inputs: PyTree[Array],
) -> tuple[Pixels, Mask, PyTree]:
    """Positions at which a slope vanishes, differentiable whatever iteration found them.

    The derivative is `-(d slope / d position)^-1 (d slope / d inputs)`, forward and reverse; zero for a position that
    did not converge or has a singular system, because no solution is there.

    Args:
        solve: Finds `(positions, converged, others)` from the inputs; never differentiated. `others` get no derivative.
        slope: `(2, n)` slope at positions, zero at a solution; point `i` of it depends on position `i` alone.
        inputs: Whatever both take.
    """
    return solve(inputs)


@implicit_positions.defjvp
def _implicit_positions_jvp(solve: Callable, slope: Callable, primals: tuple, tangents: tuple) -> tuple:
    (inputs,), (change,) = primals, tangents
    position, converged, others = implicit_positions(solve, slope, inputs)
    at_inputs = lambda where: slope(where, inputs)
    unit = lambda axis: jnp.zeros_like(position).at[axis].set(1)
    by_u = jax.jvp(at_inputs, (position,), (unit(0),))[1]
    by_v = jax.jvp(at_inputs, (position,), (unit(1),))[1]
    b = jax.jvp(lambda given: slope(position, given), (inputs,), (change,))[1]
    determinant = by_u[0] * by_v[1] - by_v[0] * by_u[1]
    regular = converged & (jnp.abs(determinant) > 0) & jnp.isfinite(determinant)
    inverse = jnp.where(regular, 1 / jnp.where(regular, determinant, 1), 0)[None, :]
    moved = -inverse * jnp.stack([by_v[1] * b[0] - by_v[0] * b[1], by_u[0] * b[1] - by_u[1] * b[0]])
    moved = jnp.where(regular[None, :], moved, 0)
    still = jax.tree.map(_zero_tangent, (converged, others))
    return (position, converged, others), (moved, *still)


def _zero_tangent(leaf: Array) -> Any:
    if jnp.issubdtype(leaf.dtype, jnp.inexact):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)
