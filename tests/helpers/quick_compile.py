"""`jax.jit` for what tests run a few times only."""

from functools import partial

import jax

quick_compile = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""Compiling is what such tests cost: less than half of it so, and the code LLVM leaves as it is runs as correctly."""
