"""Runs of a suite: planned, spread over processes, and gone on with where they were broken off."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from jaxslam.benchmark.job import Job, finished, run_in_process
from jaxslam.benchmark.suite import Suite
from jaxslam.errors import BenchmarkError
from jaxslam.files import write_atomically
from jaxslam.recordings import found_recordings

RESULTS = "results.json"


class Executor(Protocol):
    """Calls functions elsewhere: `concurrent.futures` has it, and so do clients of Dask."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> "Future[Any]":
        """Call a function, later."""
        ...


def plan(suite: Suite, *, presets: Sequence[str] = (), runs: int | None = None) -> list[Job]:
    """All runs of a suite.

    Args:
        suite: What is run.
        presets: Instead of its own, if there are any.
        runs: How often each, instead of as often as it says.
    """
    variants = suite.variants or {"": ()}
    return [
        Job(clip, preset, variant, (*suite.settings, *settings), seed)
        for clip in suite.sequences
        for preset in presets or suite.presets
        for variant, settings in variants.items()
        for seed in range(suite.runs if runs is None else runs)
    ]


def missing(suite: Suite, root: Path | None) -> list[str]:
    """Names of recordings that are not on this machine."""
    wanted = dict.fromkeys(clip.recording for clip in suite.sequences if clip.recording)
    found = found_recordings(root)
    return [name for name in wanted if name not in found]


def swept(suite: Suite, sweeps: Iterable[str]) -> Suite:
    """The suite with every combination of values as a variant.

    Args:
        suite: What is run.
        sweeps: `key=v1,v2,...` each.

    Raises:
        BenchmarkError: If one is no such text.
    """
    variants = dict(suite.variants) or {"": ()}
    for sweep in sweeps:
        key, found, values = sweep.partition("=")
        if not found or not key or not all(values.split(",")):
            raise BenchmarkError(f"--sweep: expected key=value,value,..., got '{sweep}'")
        short = key.rpartition(".")[2]
        variants = {
            ",".join(filter(None, (name, f"{short}={value}"))): (*settings, f"{key}={value}")
            for name, settings in variants.items()
            for value in values.split(",")
        }
    return replace(suite, variants=variants)


def run_jobs(
    jobs: Sequence[Job],
    out: Path,
    root: Path | None,
    *,
    executor: Executor,
    on_result: Callable[[dict[str, Any]], None],
) -> list[dict[str, Any]]:
    """Run jobs that have not been run to their end, and give the results of all, in order.

    Args:
        jobs: From `plan`.
        out: Folder of the results, each job's in one of its own.
        root: Folder in which recordings are looked for first.
        executor: Where they are run.
        on_result: Called with each result, those of earlier runs first.

    Raises:
        BenchmarkError: If a result of an earlier run is unreadable.
    """
    results: dict[int, dict[str, Any]] = {}
    for index, job in enumerate(jobs):
        earlier = finished(job, out)
        if earlier is not None:
            results[index] = earlier
            on_result(earlier)
    waiting = {
        executor.submit(run_in_process, job, out, root): index for index, job in enumerate(jobs) if index not in results
    }
    for future in as_completed(waiting):
        results[waiting[future]] = result = future.result()
        on_result(result)
    ordered = [results[index] for index in range(len(jobs))]
    write_atomically(out / RESULTS, (json.dumps(ordered, indent=1) + "\n").encode(), BenchmarkError)
    return ordered


@contextmanager
def local(workers: int) -> Iterator[Executor]:
    """So many processes on this machine at a time; what has not begun when it is left is not begun any more."""
    pool = ThreadPoolExecutor(workers)  # threads that wait for processes
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
