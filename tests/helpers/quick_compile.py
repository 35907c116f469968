"""`jax.jit` for what tests run a few times only."""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import jax
from jax.core import Tracer

quick_compile = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""Compiling is what such tests cost: less than half of it so, and the code LLVM leaves as it is runs as correctly."""


def quick_compile_nested(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`quick_compile` for a function that is also differentiated, batched or called by other compiled functions.

    JAX takes compiler options at the outermost call only: where an argument is traced, the function has none. Other
    options of `jax.jit` hold for both.
    """
    outermost, part = quick_compile(function, **options), jax.jit(function, **options)

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((arguments, named)))
        return (part if traced else outermost)(*arguments, **named)

    return call
