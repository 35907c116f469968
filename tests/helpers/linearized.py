"""Derivatives of a solver by both modes, at one and the same solution."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def differentiate(function: Callable[[Any], tuple[Any, Any]], inputs: Any, direction: Any = None) -> tuple:
    """Evaluate a function, its gradient by reverse mode and its change along a direction by forward mode.

    Both are of one linearization. Two calls of a solver are two programs: rounding may end their iterations a
    tolerance of the solver apart, and the derivatives at two solutions differ by as much (5e-8, on a CPU without
    AVX-512), which would hide an error of the derivative itself.

    Args:
        function: Function of `inputs` that returns what to differentiate, a scalar or a tuple that begins with one,
            and any other result.
        inputs: Tree of floating-point arrays.
        direction: Tree of the same shapes; `None` for no change.

    Returns:
        The other result, the gradient of the scalar, and the change of what to differentiate or `None`.
    """
    value, change_along, result = jax.linearize(function, inputs, has_aux=True)
    first, *others = jax.tree.leaves(value)
    of_first = jax.tree.unflatten(jax.tree.structure(value), [jnp.ones_like(first), *map(jnp.zeros_like, others)])
    (gradient,) = jax.linear_transpose(change_along, inputs)(of_first)
    return result, gradient, None if direction is None else change_along(direction)
