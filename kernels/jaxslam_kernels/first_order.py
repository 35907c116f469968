"""Derivative rules that are right once and not twice: asking for a second derivative raises instead of being wrong.

A rule by the implicit function theorem holds the optimum constant. Its result is the exact first derivative, but the
derivative of that result would leave out how the optimum moves. So a rule takes its primal inputs through
`first_order`, the identity, whose own derivative is an error.
"""

from functools import partial
from typing import NoReturn, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

Tree = TypeVar("Tree")


def first_order(tree: Tree, kernel: str) -> Tree:
    """The primal inputs of a derivative rule, unchanged; differentiating them raises.

    Only what carries a derivative itself raises: a second derivative by something that the kernel does not depend on
    still works. First derivatives do not notice.

    Args:
        tree: The primal inputs, any pytree of arrays.
        kernel: The function that the error names, such as "refine_pose".

    Raises:
        NotImplementedError: While tracing, where the result of the rule is differentiated by `tree`.
    """
    guard = lambda leaf: _guarded(kernel, leaf) if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact) else leaf
    return jax.tree.map(guard, tree)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _guarded(kernel: str, leaf: Array) -> Array:
    del kernel
    return leaf


@_guarded.defjvp
def _guarded_jvp(kernel: str, primals: tuple, tangents: tuple) -> NoReturn:
    del primals, tangents
    raise NotImplementedError(
        f"second derivatives of {kernel} are not implemented: its derivative holds the optimum constant; "
        "differentiate once, or take finite differences of the gradient"
    )
