"""The times of kernels and of what they are compared with, one row a size and device."""

import math
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxslam.benchmark.kernels.case import Case, Problem
from jaxslam.benchmark.timing import call_times, compare, compiled

_WARM_UP, _MAX_S = 2, 5.0


def devices() -> list[Any]:
    """JAX's devices to measure on: the processor, and what JAX prefers if that is something else."""
    processor, preferred = jax.devices("cpu")[0], jax.devices()[0]
    return [processor] if preferred.platform == "cpu" else [processor, preferred]


def measure(case: Case, size: int, device: Any, rounds: int) -> dict[str, Any]:
    """One row: calls of ours on a device and of theirs on the processor in turn, every thread on one core.

    Args:
        case: Case to measure.
        size: One of its sizes.
        device: JAX's, where ours computes; its arrays are there already.
        rounds: Maximum number of calls of each; fewer, but at least 5, where a round takes long.

    Returns:
        Times in milliseconds, medians and all of them, and how far the two results are apart. Figures of theirs are
        `None` where the other library is not installed.
    """
    with jax.default_device(device):  # of what works on the host
        return _row(case, size, device, rounds)


def _row(case: Case, size: int, device: Any, rounds: int) -> dict[str, Any]:
    problem, absent = case.problem(size), case.missing()
    arguments = jax.device_put(problem.arguments, device)
    program, compile_s = _program(problem, arguments)
    limits = {"rounds": rounds, "warm_up": _WARM_UP, "most_s": _MAX_S}
    row: dict[str, Any] = {
        "kernel": case.name,
        "size": size,
        "label": case.label(size),
        "backend": device.platform,
        "device": device.device_kind,
        "compile_s": compile_s,
    }
    if absent is not None:
        ours = call_times(lambda: program(*arguments), **limits)
        return row | _times("ours", ours) | _NOTHING | {"problem": f"{absent} is not installed"}
    comparison = compare(lambda: program(*arguments), problem.theirs, prepare=problem.prepare, **limits)
    difference = _difference(problem, program(*arguments))
    return {
        **row,
        **_times("ours", comparison.ours_ms),
        **_times("theirs", comparison.theirs_ms),
        "ratio": comparison.ratio,
        "processor_ratio": comparison.processor_ratio,
        "difference": difference,
        "agrees": difference is not None and difference <= case.limit,
        "problem": None,
    }


def _program(problem: Problem, arguments: tuple[Any, ...]) -> tuple[Callable[..., Any], float]:
    """Ours, ready to be called, and the processor time that compiling took."""
    if problem.compile is None:
        return compiled(problem.ours, *arguments)
    began = time.process_time()
    problem.compile()
    return problem.ours, time.process_time() - began


def _difference(problem: Problem, ours: Any) -> float | None:
    """Return the distance between both results; `None` if one of them found nothing."""
    difference = problem.difference(ours, problem.theirs(*problem.prepare()))
    return difference if math.isfinite(difference) else None


def _times(side: str, times_ms: np.ndarray) -> dict[str, Any]:
    return {
        f"{side}_ms": float(np.median(times_ms)),
        f"{side}_p95_ms": float(np.percentile(times_ms, 95)),
        f"{side}_min_ms": float(times_ms.min()),
        f"{side}_times_ms": times_ms.tolist(),
    }


_NOTHING: dict[str, Any] = {
    **dict.fromkeys(("theirs_ms", "theirs_p95_ms", "theirs_min_ms", "theirs_times_ms")),
    **dict.fromkeys(("ratio", "processor_ratio", "difference", "agrees")),
}
"""What a row holds of another library that is not there."""
