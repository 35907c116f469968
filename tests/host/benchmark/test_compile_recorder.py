"""Programs recorded while JAX compiles them: names, times and texts."""

import threading
import time

import jax
import numpy as np

from jaxslam.benchmark.compiling.hlo_text import module_name
from jaxslam.benchmark.compiling.recorder import _Thread, recorded

X = np.ones(7, np.float32)


def test_every_program_once() -> None:
    """In order and with its text, that of a thread too; what is compiled already, or later, is not there."""

    def _first(x: jax.Array) -> jax.Array:
        return x * x

    def second(x: jax.Array) -> jax.Array:
        return x + x

    first, other = jax.jit(_first), jax.jit(second)
    jax.jit(lambda x: x - x)(X)
    with recorded() as programs:
        first(X)
        first(X)
        beside = threading.Thread(target=other, args=(X,))
        beside.start()
        beside.join()
    jax.jit(lambda x: x / x)(X)
    assert [program.name for program in programs] == ["first", "second"]
    assert [module_name(program.text) for program in programs] == ["jit__first", "jit_second"]
    for program in programs:
        assert min(program.trace_s, program.lower_s, program.compile_s) > 0
        assert program.peak_mb > 20
    assert "multiply" in programs[0].text
    assert "multiply" not in programs[1].text


def test_seconds_are_taken_apart() -> None:
    """A slow trace is a trace; of a program that is compiled in it, nothing but its trace is counted there."""

    def slow(x: jax.Array) -> jax.Array:
        time.sleep(0.2)
        with jax.ensure_compile_time_eval():
            inner = jax.jit(quick)(X)
        time.sleep(0.2)
        return x + inner

    def quick(x: jax.Array) -> jax.Array:
        time.sleep(0.1)
        return x * 3

    began = time.perf_counter()
    with recorded() as programs:
        jax.jit(slow)(X)
    elapsed_s = time.perf_counter() - began
    assert [program.name for program in programs] == ["quick", "slow"]
    inner, outer = programs
    assert outer.trace_s >= 0.5
    assert min(inner.lower_s, inner.compile_s, outer.lower_s, outer.compile_s) > 0
    assert sum(one.trace_s + one.lower_s + one.compile_s for one in programs) <= elapsed_s


def test_inner_intervals_are_not_counted_twice() -> None:
    thread = _Thread()
    thread.add("jaxpr_trace_duration", "inner", 0.0)
    thread.add("jaxpr_to_mlir_module_duration", "inner", 0.0)
    time.sleep(0.05)
    thread.add("jaxpr_trace_duration", "outer", 10.0)
    taken = thread.take("outer")
    assert taken == {"trace_s": 10.0, "lower_s": 0, "compile_s": 0}
    assert thread.take("outer") == {"trace_s": 0, "lower_s": 0, "compile_s": 0}
