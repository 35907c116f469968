"""Derivative rules of any order: of any function, of what a solver found, and of what only a derivative sees."""

from collections.abc import Callable, Sequence
from functools import partial, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

P = ParamSpec("P")
T = TypeVar("T")
_Leaves = Sequence[Any]


class custom_jvp(Generic[P, T]):  # noqa: N801 (named as that of JAX)
    """`jax.custom_jvp` whose rule survives a second derivative through `lax.scan`.

    Where a scan is differentiated in reverse, JAX moves what is the same in every iteration out of the loop. It takes
    the body apart for that, and of a function with a rule only the function is left in the loop (jax 0.10.2,
    `JaxprTrace.process_custom_jvp_call`). The gradient is right; its derivatives are wrong, silently. Here, the
    function is a primitive, which nothing takes apart.

    It is used as `jax.custom_jvp` is. For higher derivatives, the rule has to call the function for the value. Both
    must close over nothing that is traced.
    """

    def __init__(self, function: Callable[P, T], nondiff_argnums: tuple[int, ...] = ()) -> None:
        update_wrapper(self, function)
        self._function: Callable[..., T] = function
        self._static = nondiff_argnums
        self._rule: Callable[..., tuple[T, Any]] | None = None

    def defjvp(self, rule: Callable[..., tuple[T, Any]]) -> Callable[..., tuple[T, Any]]:
        """Set the rule, a function of the static arguments, the others, and their changes: the value and its change."""
        self._rule = rule
        return rule

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> T:
        """Call the function.

        Raises:
            TypeError: If an argument is given by name, or there is no rule.
        """
        if named or self._rule is None:
            problem = f"got {', '.join(named)} by name" if named else "and a rule given by `defjvp`, which is missing"
            raise TypeError(f"{getattr(self, '__name__', self)}: expected arguments by position, {problem}")
        traced = tuple(argument for place, argument in enumerate(arguments) if place not in self._static)
        leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, traced))
        rule = partial(self._rule, *(arguments[place] for place in self._static))

        def function(*leaves: Any) -> T:
            rest = iter(tree.unflatten(leaves))
            return self._function(*(a if place in self._static else next(rest) for place, a in enumerate(arguments)))

        def rule_of_leaves(leaves: _Leaves, changes: _Leaves) -> tuple[_Leaves, _Leaves]:
            value, change = rule(tree.unflatten(leaves), tree.unflatten(_with_others(leaves, changes)))
            value, change = jax.tree.leaves(value), jax.tree.leaves(change)
            return value, [after for before, after in zip(value, change, strict=True) if _has_change(before)]

        jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*leaves)
        found = _call_p.bind(*leaves, call=_Call(jaxpr, rule_of_leaves))
        return jax.tree.unflatten(jax.tree.structure(shapes), found)


class _Call:
    """A function of arrays and its rule. Changes are only given of leaves that can have one: see `_has_change`."""

    def __init__(self, jaxpr: ClosedJaxpr, rule: Callable[[_Leaves, _Leaves], tuple[_Leaves, _Leaves]]) -> None:
        self.jaxpr, self.rule, self.function = jaxpr, rule, jaxpr_as_fun(jaxpr)

    def batched(self, size: int, axes: Sequence[int | None], leaves: _Leaves) -> "_Call":
        """The call for a batch, along the given axes of its arguments; the batch is the first axis of the results."""
        changing = [axis for axis, leaf in zip(axes, leaves, strict=True) if _has_change(leaf)]
        function = jax.vmap(self.function, in_axes=tuple(axes), axis_size=size)
        rule = jax.vmap(self.rule, in_axes=(list(axes), changing), axis_size=size)
        return _Call(jax.make_jaxpr(function)(*leaves), rule)


def _has_change(leaf: Any) -> bool:
    """Tell whether an array has a tangent that can differ from zero."""
    return jnp.issubdtype(jax.typeof(leaf).dtype, jnp.inexact)


def _with_others(leaves: _Leaves, changes: _Leaves) -> list[Any]:
    """The changes of all leaves, those of integers and the like included."""
    rest = iter(changes)
    return [next(rest) if _has_change(leaf) else np.zeros(jax.typeof(leaf).shape, jax.dtypes.float0) for leaf in leaves]


_call_p = Primitive("call_with_rule")
_call_p.multiple_results = True
_call_p.def_impl(lambda *leaves, call: call.function(*leaves))
_call_p.def_abstract_eval(lambda *_, call: call.jaxpr.out_avals)


def _lower(context: Any, *leaves: Any, call: _Call) -> Any:
    return mlir.lower_fun(call.function, multiple_results=True)(context, *leaves)


def _differentiate(leaves: _Leaves, changes: _Leaves, *, call: _Call) -> tuple[_Leaves, _Leaves]:
    changing = [ad.instantiate_zeros(change) for leaf, change in zip(leaves, changes, strict=True) if _has_change(leaf)]
    value, change = call.rule([jnp.asarray(leaf) for leaf in leaves], changing)  # constants come as those of NumPy
    rest = iter(change)
    return value, [next(rest) if _has_change(leaf) else ad.Zero(jax.typeof(leaf).to_tangent_aval()) for leaf in value]


def _batch(leaves: _Leaves, axes: Sequence[int | None], *, call: _Call) -> tuple[_Leaves, list[int]]:
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    batched = call.batched(size, axes, leaves)
    return _call_p.bind(*leaves, call=batched), [0] * len(batched.jaxpr.out_avals)


mlir.register_lowering(_call_p, _lower)
ad.primitive_jvps[_call_p] = _differentiate
batching.primitive_batchers[_call_p] = _batch


@partial(custom_jvp, nondiff_argnums=(0, 1))
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


@partial(custom_jvp, nondiff_argnums=(0,))
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
