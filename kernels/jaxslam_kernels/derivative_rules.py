"""Derivative rules of any order for what a solver found, and for what only a derivative sees."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

T = TypeVar("T")


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def implicit_shift(
    slope: Callable[[Any, Any, Any], Any], solve: Callable[[Any, Any, Any], Any], like: T, optimum: Any, inputs: Any
) -> T:
    """Return zeros whose derivatives are those of the step from the optimum that a solver found to the true one.

    At the optimum the slope g of the cost vanishes whatever the inputs θ are, so the step ξ from the optimum that was
    found changes by `dξ = -(∂g/∂ξ)⁻¹ (∂g/∂θ) dθ`. Both derivatives of g are taken at this very step, so that the rule
    can be differentiated again, forward and reverse: higher derivatives are right as well, where the linear systems
    are. `slope` and `solve` must close over nothing that is traced.

    Args:
        slope: `slope(step, optimum, inputs)`, the gradient of the cost a step away from the optimum, of the structure
            of the step. Steps may be coordinates of any smooth kind; what uses the result must use the same.
        solve: `solve(optimum, inputs, right)`, the solution of `(∂g/∂ξ) x = right` at a step of zero, linear in
            `right`. The matrix is symmetric there. What nothing determines is to be zero.
        like: Any step, for its structure and types.
        optimum: Optimum that was found, a constant.
        inputs: Inputs of the cost.
    """
    del slope, solve, optimum, inputs
    return jax.tree.map(jnp.zeros_like, like)


@implicit_shift.defjvp
def _implicit_shift_jvp(slope: Callable, solve: Callable, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    like, optimum, inputs = primals
    optimum = lax.stop_gradient(optimum)
    step = implicit_shift(slope, solve, like, optimum, inputs)
    _, change = jax.jvp(partial(slope, step, optimum), (inputs,), (tangents[2],))
    constant = lax.stop_gradient(inputs)

    def multiply(direction: Any) -> Any:
        return jax.jvp(lambda step: slope(step, optimum, inputs), (step,), (direction,))[1]

    def solution(_: Callable, right: Any) -> Any:
        return solve(optimum, constant, right)

    # Symmetric where it is solved; its derivatives are not, in coordinates that are curved.
    moved = lax.custom_linear_solve(multiply, change, solution, transpose_solve=solution)
    return step, jax.tree.map(jnp.negative, moved)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def only_derivative(function: Callable[..., T], like: T, *arguments: Any) -> T:
    """Return zeros with the derivatives of a function, which is traced and computed for those only.

    Args:
        function: Function whose value is zero at the arguments; it must close over nothing that is traced.
        like: Any value of the function, for its structure and types.
        arguments: Its arguments, pytrees of arrays.
    """
    del function, arguments
    return jax.tree.map(jnp.zeros_like, like)


@only_derivative.defjvp
def _only_derivative_jvp(function: Callable, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    return only_derivative(function, *primals), jax.jvp(function, primals[1:], tangents[1:])[1]
