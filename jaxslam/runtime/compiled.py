"""The one way in which jaxslam compiles a function: `jax.jit` with its options, the trace cache, and a register."""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial, update_wrapper, wraps
from typing import Any, Literal, TypeAlias, TypeVar, cast

import jax

from jaxslam.runtime.compiler_options import SINGLE_THREAD, known_options
from jaxslam.runtime.garbage import collector_paused
from jaxslam.runtime.trace_cache import cached_trace

R = TypeVar("R")

When: TypeAlias = Literal["warm-up", "first use"]
"""When a program is compiled: by `Slam.warm_up`, so that no frame waits for it, or when it is called first."""


@dataclass
class Program:
    """An entry of the register of compiled functions.

    Attributes:
        name: Module and name of the function.
        when: Time at which it is compiled.
        num_compiled: Number of combinations of shapes, types and static arguments for which it was compiled in this
            process.
    """

    name: str
    when: When
    num_compiled: int = 0


programs: list[Program] = []
"""Every compiled function of the modules imported so far. A test reads it: a program for `warm-up` that `Slam.warm_up`
leaves out would stop a robot for seconds in the middle of a run."""


def committed(arrays: R) -> R:
    """Return arrays in a pytree, at least one, as results of programs from the disk are: committed to their device.

    A program that takes some of both kinds would be compiled for each.
    """
    return jax.device_put(arrays, *jax.tree.leaves(arrays)[0].devices())


def lower(program: Callable[..., Any], *args: Any) -> None:
    """Trace and lower a program for arguments, so that calling it with such ones only has to compile it.

    Args:
        program: What `compiled` has returned.
        args: Its arguments; none of them is donated.
    """
    cast(Any, program).lower(*args)


class _ThreadHook(threading.local):
    """Function that a thread calls before each program that it compiles."""

    before_each: Callable[[], None] = staticmethod(lambda: None)


_this_thread = _ThreadHook()


@contextmanager
def before_each_program(call: Callable[[], None]) -> Iterator[None]:
    """Call a function before each program that this thread compiles; its error ends that.

    The compiler cannot be interrupted within a program, but a process that ends need not wait for more than one.
    """
    _this_thread.before_each = call
    try:
        yield
    finally:
        del _this_thread.before_each


class _WithOptions:
    """A function that goes to `jax.jit` when it is called first: on import, XLA cannot be asked for its options."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, bool | str], jit: Callable[..., Any]):
        update_wrapper(self, function)
        self._function, self._options, self._jit = function, options, jit
        self._jitted: Any = None
        self._lock = threading.Lock()

    def _program(self) -> Any:
        if self._jitted is None:
            with self._lock:  # two threads would compile it twice
                if self._jitted is None:
                    options = known_options(self._options)
                    self._jitted = self._jit(self._function, compiler_options=options or None)
        return self._jitted

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._program()(*args, **kwargs)

    def lower(self, *args: Any, **kwargs: Any) -> Any:
        return self._program().lower(*args, **kwargs)


def compiled(
    *,
    when: When,
    static: str | Sequence[str] = (),
    donate: str | Sequence[str] = (),
    options: Mapping[str, bool | str] | None = None,
) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Compile a pure function of arrays, and keep its trace on the disk for later starts.

    What is compiled takes NumPy arrays as well as JAX arrays.

    Args:
        when: Time at which it is compiled. `Slam.warm_up` must call every program marked `warm-up`; a test checks it.
        static: Names of the arguments that are no arrays: each value is compiled by itself.
        donate: Names of the arguments whose memory the result may take over; the caller must not use them again.
        options: Compiler options, sets of `jaxslam.runtime.compiler_options`. A program for the warm-up runs beside
            those of other threads, and so has `SINGLE_THREAD` in any case.
    """

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        inner: Any = function.func if isinstance(function, partial) else function
        program = Program(f"{inner.__module__}.{inner.__qualname__}", when)
        programs.append(program)
        cached = cached_trace(function)

        @wraps(inner)
        def traced(*args: Any, **kwargs: Any) -> R:
            _this_thread.before_each()
            program.num_compiled += 1  # `jax.jit` calls this once for each combination that it compiles
            with collector_paused():
                return cached(*args, **kwargs)

        chosen = {**(SINGLE_THREAD if when == "warm-up" else {}), **(options or {})}
        jit: Any = partial(jax.jit, static_argnames=static or None, donate_argnames=donate or None)
        jitted: Any = _WithOptions(traced, chosen, jit) if chosen else jit(traced)
        return jitted

    return decorate
