"""Record every program that JAX compiles: its times, the memory up to then, and its optimized HLO.

JAX reports the times of each program by its public events (`jax.monitoring`), and the client of XLA holds the program
itself, so that what is recorded is what jaxslam compiles, called in its own way; nothing is compiled twice or replaced.
"""

import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import jax
from jax.extend.backend import get_backend

from jaxslam.runtime.machine import peak_rss_mb

_PREFIX = "/jax/core/compile/"
_TRACE, _LOWER, _COMPILE = "jaxpr_trace_duration", "jaxpr_to_mlir_module_duration", "backend_compile_duration"
_KINDS: tuple[str, ...] = (_TRACE, _LOWER, _COMPILE)


@dataclass(frozen=True)
class CompiledProgram:
    """A program that was compiled.

    Attributes:
        name: Name of the function, without the underscores before it.
        trace_s: Seconds in which JAX traced Python; writing and reading the trace for jaxslam's cache are in it.
        lower_s: Seconds in which JAX made StableHLO of the trace.
        compile_s: Seconds in which XLA compiled it.
        peak_mb: Largest resident memory of the process until the program was compiled, megabytes.
        text: Optimized HLO.
    """

    name: str
    trace_s: float
    lower_s: float
    compile_s: float
    peak_mb: float
    text: str


@dataclass
class _Interval:
    """Something that JAX did.

    Attributes:
        name: Name of the function for which it was done.
        began_s: Beginning on the clock of `time.perf_counter`, seconds.
        length_s: Length in seconds.
        seconds: Seconds of each kind of work that no program has taken yet, with the intervals inside.
    """

    name: str
    began_s: float
    length_s: float
    seconds: dict[str, float]


@dataclass
class _Thread:
    """The intervals of one thread.

    Attributes:
        outermost: Intervals that lie in no other one so far.
    """

    outermost: list[_Interval] = field(default_factory=list)

    def add(self, kind: str, name: str, length_s: float) -> None:
        """Add an interval that ends now. A trace may hold intervals of all kinds, each reported before it."""
        began_s, own_s = time.perf_counter() - length_s, length_s
        seconds = dict.fromkeys(_KINDS, 0.0)
        while self.outermost and self.outermost[-1].began_s >= began_s:
            inside = self.outermost.pop()
            own_s -= inside.length_s
            _add(seconds, inside.seconds)
        seconds[kind] += max(own_s, 0.0)
        self.outermost.append(_Interval(name, began_s, length_s, seconds))

    def take(self, name: str) -> dict[str, float]:
        """Return the seconds that went into the program of this name, and count them for no other one."""
        seconds = dict.fromkeys(_KINDS, 0.0)
        for interval in self.outermost:
            if interval.name == name:
                _add(seconds, interval.seconds)
                interval.seconds = {}
        return {"trace_s": seconds[_TRACE], "lower_s": seconds[_LOWER], "compile_s": seconds[_COMPILE]}


def _add(seconds: dict[str, float], more: dict[str, float]) -> None:
    """Add seconds of some kinds of work to those of all."""
    for kind, value in more.items():
        seconds[kind] += value


@contextmanager
def recorded() -> Iterator[list[CompiledProgram]]:
    """Record the programs that are compiled in this context.

    Programs may be compiled in several threads, one at a time. JAX's cache on the disk should be off: what is loaded
    from it counts as compiled.

    Returns:
        The programs in the order in which they were compiled; the list is filled when the context ends.

    Raises:
        RuntimeError: When the context ends, if JAX has reported a program that XLA's client does not hold.
    """
    known: list[Any] = get_backend().live_executables()
    threads: defaultdict[int, _Thread] = defaultdict(_Thread)
    kept: list[tuple[Any, dict[str, Any]]] = []

    def on_event(event: str, duration_secs: float, **details: str | int) -> None:
        kind, thread = event.removeprefix(_PREFIX), threads[threading.get_ident()]
        if kind not in _KINDS:
            return
        name = str(details.get("fun_name")).removeprefix("jit(").removesuffix(")")
        thread.add(kind, name, duration_secs)
        if kind != _COMPILE:
            return
        figures = {"name": name.lstrip("_"), **thread.take(name), "peak_mb": peak_rss_mb()}
        new = [one for one in get_backend().live_executables() if not any(one is other for other in known)]
        known.extend(new)
        kept.append((new[0] if new else None, figures))

    programs: list[CompiledProgram] = []
    jax.monitoring.register_event_duration_secs_listener(on_event)
    try:
        yield programs
    finally:
        jax.monitoring.unregister_event_duration_listener(on_event)
    lost = [figures["name"] for one, figures in kept if one is None]
    if lost:
        raise RuntimeError(f"expected XLA's client to hold what was compiled, it does not: {', '.join(lost)}")
    # Not before: texts are as long as a dozen megabytes, which would count as memory of the programs after them.
    programs.extend(CompiledProgram(**figures, text=one.hlo_modules()[0].to_string()) for one, figures in kept)
