"""Times of two functions that do the same work: one process, one core, taken in turn.

XLA should compute in one thread too: `jaxslam.runtime.threads.prefer_one_thread()` before the first array.
"""

import functools
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

_MIN_ROUNDS = 5


@dataclass(frozen=True)
class Comparison:
    """Milliseconds a call of both sides, on the wall clock and of processor time, and their ratios."""

    ours_ms: np.ndarray
    theirs_ms: np.ndarray
    ours_processor_ms: np.ndarray
    theirs_processor_ms: np.ndarray

    @property
    def ratio(self) -> float:
        """Median of ours over median of theirs."""
        return float(np.median(self.ours_ms) / np.median(self.theirs_ms))

    @property
    def processor_ratio(self) -> float:
        """The same of processor time, which other processes on the machine disturb less."""
        return float(np.median(self.ours_processor_ms) / np.median(self.theirs_processor_ms))

    def __str__(self) -> str:
        sides = [
            f"{name} median {np.median(times):.3f} ms, p95 {np.percentile(times, 95):.3f} ms, min {times.min():.3f} ms"
            for name, times in (("ours", self.ours_ms), ("theirs", self.theirs_ms))
        ]
        return f"{'; '.join(sides)}; ratio {self.ratio:.3f}, of processor time {self.processor_ratio:.3f}"


@contextmanager
def pinned_to_one_core() -> Iterator[None]:
    """Hold every thread of this process on one core; OpenCV gets one thread. Undone afterwards.

    Where threads cannot be held, as on macOS, only OpenCV gets one thread.
    """
    before = _cores_of_threads()
    opencv_threads = cv2.getNumThreads()
    of_the_first = next(iter(before.values()), set())
    try:
        for thread in before:
            _hold(thread, {max(of_the_first)})
        cv2.setNumThreads(1)
        yield
    finally:
        cv2.setNumThreads(opencv_threads)
        for thread in _cores_of_threads():  # one that was begun meanwhile gets the cores of the first
            _hold(thread, before.get(thread, of_the_first))


def compare(
    ours: Callable[[], Any],
    theirs: Callable[..., Any],
    *,
    rounds: int = 60,
    warm_up: int = 5,
    prepare: Callable[[], tuple[Any, ...]] = tuple,
    most_s: float = math.inf,
) -> Comparison:
    """Call both in turn, `rounds` times each, every thread on one core; JAX results are waited for.

    Args:
        ours: Function of the first side.
        theirs: Function of the second side.
        rounds: Number of timings of each side.
        warm_up: Number of calls of each side before the timings.
        prepare: Function that makes the arguments of each call of theirs, not timed; for solvers that change their
            problem.
        most_s: After so many seconds no further round is begun, but of the first few.
    """
    for _ in range(warm_up):
        jax.block_until_ready(ours())
    for _ in range(warm_up):
        jax.block_until_ready(theirs(*prepare()))
    with pinned_to_one_core():
        rows = [
            (*_milliseconds(ours), *_milliseconds(functools.partial(theirs, *prepare())))
            for _ in _rounds(rounds, most_s)
        ]
    ours_ms, ours_processor_ms, theirs_ms, theirs_processor_ms = np.array(rows).T
    return Comparison(ours_ms, theirs_ms, ours_processor_ms, theirs_processor_ms)


def call_times(
    function: Callable[[], Any], *, rounds: int = 60, warm_up: int = 5, most_s: float = math.inf
) -> np.ndarray:
    """Milliseconds of each call on the wall clock, taken as `compare` does, where there is nothing to compare with."""
    for _ in range(warm_up):
        jax.block_until_ready(function())
    with pinned_to_one_core():
        return np.array([_milliseconds(function)[0] for _ in _rounds(rounds, most_s)])


def compile_seconds(function: Callable[..., Any], *args: Any) -> float:
    """Processor time that tracing and compiling takes for these arguments."""
    return compiled(function, *args)[1]


def compiled(function: Callable[..., Any], *args: Any) -> tuple[Callable[..., Any], float]:
    """The program for these arguments, on the device they are on, and the processor time that making it took."""
    began = time.process_time()
    program = jax.jit(functools.partial(function)).lower(*args).compile()  # a new function: none made before is found
    return program, time.process_time() - began


def _rounds(rounds: int, most_s: float) -> Iterator[int]:
    """The numbers of the rounds for which there is time."""
    began = time.perf_counter()
    for number in range(rounds):
        if number >= _MIN_ROUNDS and time.perf_counter() - began > most_s:
            return
        yield number


def _cores_of_threads() -> dict[int, set[int]]:
    """The cores on which each thread of this process may run, the first thread first; none where that is not known."""
    folder, cores = Path("/proc/self/task"), {}
    for thread in sorted(int(entry.name) for entry in folder.iterdir()) if folder.is_dir() else ():
        with suppress(ProcessLookupError):  # it has just ended
            cores[thread] = os.sched_getaffinity(thread)
    return cores


def _hold(thread: int, cores: set[int]) -> None:
    with suppress(ProcessLookupError):  # it has just ended
        os.sched_setaffinity(thread, cores)


def _milliseconds(function: Callable[[], Any]) -> tuple[float, float]:
    """Times of one call: wall clock, and processor time of all threads."""
    began, processor_began = time.perf_counter(), time.process_time()
    jax.block_until_ready(function())
    return (time.perf_counter() - began) * 1e3, (time.process_time() - processor_began) * 1e3
