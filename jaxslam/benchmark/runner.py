"""Runs of a suite: planned, spread over processes, and gone on with where they were broken off."""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from jaxslam.benchmark.job import Job, finished, run_in_process
from jaxslam.benchmark.suite import Suite
from jaxslam.errors import BenchmarkError
from jaxslam.files import write_atomically
from jaxslam.recordings import found_recordings

RESULTS = "results.json"
_ROOMS = ".rooms"
"""Frames of rendered rooms, as long as there are runs that need them."""


class Executor(Protocol):
    """Where runs are made: on this machine, `local`, or on others, `cluster`."""

    @property
    def recordings(self) -> Collection[str]:
        """Names of the recordings that are there."""
        ...

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, dict[str, Any]]]:
        """Run jobs, each in a process of its own, and give their figures as they end; files go below `out`, here."""
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


def missing(suite: Suite, found: Collection[str]) -> dict[str, str]:
    """Recordings that are not there, by name, and how to get them.

    Args:
        suite: What is run.
        found: Names of the recordings that are there.
    """
    names = [clip.recording for clip in suite.sequences if clip.recording and clip.recording not in found]
    return {name: f"not there; to get it: jaxslam data get {name}" for name in names}


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
    *,
    executor: Executor,
    on_result: Callable[[dict[str, Any]], None],
) -> list[dict[str, Any]]:
    """Run jobs that have not been run to their end, and give the results of all, in order.

    Args:
        jobs: From `plan`.
        out: Folder of the results, each job's in one of its own.
        executor: Where they are run.
        on_result: Called with each result, those of earlier runs first.

    Raises:
        BenchmarkError: If a result of an earlier run is unreadable, or there is nobody any more to run the others.
    """
    results: dict[Job, dict[str, Any]] = {}
    for job in jobs:
        earlier = finished(job, out)
        if earlier is not None:
            results[job] = earlier
            on_result(earlier)
    for job, result in executor.run([job for job in jobs if job not in results], out):
        results[job] = result
        on_result(result)
    ordered = [results[job] for job in jobs]
    write_atomically(out / RESULTS, (json.dumps(ordered, indent=1) + "\n").encode(), BenchmarkError)
    return ordered


@contextmanager
def local(workers: int, root: Path | None) -> Iterator[Executor]:
    """Processes on this machine; what has not begun when it is left is not begun any more.

    Args:
        workers: How many at a time.
        root: Folder in which recordings are looked for first.

    Raises:
        DatasetError: If a folder to look for recordings in is none.
    """
    pool = ThreadPoolExecutor(workers)  # threads that wait for processes
    try:
        yield _Local(pool, root, found_recordings(root).keys())
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


@dataclass(frozen=True)
class _Local:
    pool: ThreadPoolExecutor
    root: Path | None
    recordings: Collection[str]

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, dict[str, Any]]]:
        rooms = out / _ROOMS
        shutil.rmtree(rooms, ignore_errors=True)  # of a suite that was killed
        # Every preset before the next seed: processes that compile the same at the same time each do all of it.
        place = {name: number for number, name in enumerate(dict.fromkeys(job.clip.name for job in jobs))}
        in_turn = sorted(jobs, key=lambda job: (place[job.clip.name], job.seed))
        waiting = {self.pool.submit(run_in_process, job, out, self.root, rooms): job for job in in_turn}
        runs_left = Counter(job.clip.name for job in jobs)
        try:
            for future in as_completed(waiting):
                job = waiting[future]
                runs_left[job.clip.name] -= 1
                if not runs_left[job.clip.name]:  # 0.3 GB for two seconds of a room
                    shutil.rmtree(rooms / job.clip.name, ignore_errors=True)
                yield job, future.result()
        finally:
            shutil.rmtree(rooms, ignore_errors=True)
