"""Times of two functions that do the same work: one process, one core, taken in turn."""

import functools
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

from jaxslam.xla import prefer_one_thread

prefer_one_thread()  # as XLA does by itself in a process that starts on one core


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
    """Hold every thread of this process on one core; OpenCV gets one thread. Undone afterwards."""
    threads = [int(entry.name) for entry in Path("/proc/self/task").iterdir()]
    before = {thread: os.sched_getaffinity(thread) for thread in threads}
    opencv_threads = cv2.getNumThreads()
    core = max(before[threads[0]])
    try:
        for thread in threads:
            os.sched_setaffinity(thread, {core})
        cv2.setNumThreads(1)
        yield
    finally:
        cv2.setNumThreads(opencv_threads)
        for thread, cores in before.items():
            if Path(f"/proc/self/task/{thread}").exists():
                os.sched_setaffinity(thread, cores)


def compare(ours: Callable[[], Any], theirs: Callable[[], Any], *, rounds: int = 60, warm_up: int = 5) -> Comparison:
    """Call both in turn, `rounds` times each, every thread on one core; JAX results are waited for."""
    for function in (ours, theirs):
        for _ in range(warm_up):
            jax.block_until_ready(function())
    with pinned_to_one_core():
        rows = [(*_milliseconds(ours), *_milliseconds(theirs)) for _ in range(rounds)]
    ours_ms, ours_processor_ms, theirs_ms, theirs_processor_ms = np.array(rows).T
    return Comparison(ours_ms, theirs_ms, ours_processor_ms, theirs_processor_ms)


def compile_seconds(function: Callable[..., Any], *args: Any) -> float:
    """Processor time that tracing and compiling takes for these arguments."""
    began = time.process_time()
    jax.jit(functools.partial(function)).lower(*args).compile()  # a new function: nothing compiled before is found
    return time.process_time() - began


def _milliseconds(function: Callable[[], Any]) -> tuple[float, float]:
    """Of one call: on the wall clock, and of processor time of all threads."""
    began, processor_began = time.perf_counter(), time.process_time()
    jax.block_until_ready(function())
    return (time.perf_counter() - began) * 1e3, (time.process_time() - processor_began) * 1e3
