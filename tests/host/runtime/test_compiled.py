"""Compiled functions: what they give, what their options do, and the register of all of them."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.runtime.compiled import compiled, programs
from jaxslam.runtime.compiler_options import FAST_COMPILE, SINGLE_THREAD

ROOT = Path(__file__).resolve().parents[3]
ELSEWHERE = {
    "runtime/compiled.py",
    "runtime/compiler_options.py",
    "runtime/trace_cache.py",
    "benchmark/timing.py",
    "benchmark/compiling/parts.py",
    "learning/fit.py",
}
"""Modules that may call `jax.jit`: what the decorator is made of, benchmarks that compile a function anew, and `fit`,
whose program holds the loss of its caller."""


@compiled(when="first use", static="times")
def repeated(x: jax.Array, times: int) -> jax.Array:
    """Repeat an array."""
    return jnp.tile(x, times)


@compiled(when="first use", donate="total", options=FAST_COMPILE | SINGLE_THREAD)
def added(total: jax.Array, x: jax.Array) -> jax.Array:
    """Add two arrays."""
    return total + x


def program(name: str) -> int:
    (found,) = [entry for entry in programs if entry.name == f"{__name__}.{name}"]
    return found.num_compiled


def test_counts_what_it_compiles() -> None:
    x = np.arange(3.0, dtype=np.float32)
    before = program("repeated")
    for times in (2, 3, 2):
        np.testing.assert_array_equal(repeated(x, times), np.tile(x, times))
    np.testing.assert_array_equal(repeated(x, times=3), np.tile(x, 3))
    assert program("repeated") - before in (2, 3)  # by keyword is another call to JAX


def test_donates() -> None:
    total = jnp.ones(4)
    np.testing.assert_array_equal(added(total, jnp.ones(4)), np.full(4, 2.0))
    with pytest.raises(RuntimeError, match="deleted"):
        np.asarray(total)


def test_keeps_the_name_of_the_function() -> None:
    assert repeated.__name__ == "repeated"
    assert repeated.__doc__ == "Repeat an array."


def test_nothing_else_compiles() -> None:
    """A function that is compiled in another way is in no register, and a warm-up could forget it."""
    found = []
    for path in (ROOT / "jaxslam").rglob("*.py"):
        uses = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)]
        names = {f"{node.value.id}.{node.attr}" for node in uses if isinstance(node.value, ast.Name)}
        if names & {"jax.jit", "eqx.filter_jit"}:
            found.append(path.relative_to(ROOT / "jaxslam").as_posix())
    assert set(found) == ELSEWHERE
