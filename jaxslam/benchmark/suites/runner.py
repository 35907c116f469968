"""Runs of a suite: planned, spread over processes, and gone on with where they were broken off."""

import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from jaxslam.benchmark.suites.job import Job, run_in_process, stored
from jaxslam.benchmark.suites.provenance import changes, identities
from jaxslam.datasets.catalog import found_recordings

_MAX_REASONS = 4
_ROOMS = ".rooms"
"""Frames of rendered rooms, as long as there are runs that need them."""


class Executor(Protocol):
    """Place where runs are made: this machine, `local`, or others, `cluster`."""

    @property
    def recordings(self) -> Collection[str]:
        """Names of the recordings that are there."""
        ...

    def identities(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        """Return the inputs of jobs where they would be run now: `provenance.identities`."""
        ...

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, dict[str, Any]]]:
        """Run jobs, each in a process of its own, and give their figures as they end; files go below `out`, here."""
        ...


def run_jobs(
    jobs: Sequence[Job],
    out: Path,
    *,
    executor: Executor,
    on_result: Callable[[dict[str, Any]], None],
    on_stale: Callable[[Job, str], None],
) -> None:
    """Run jobs that have not been run to their end, and those whose results would be others now.

    Args:
        jobs: From `plan`.
        out: Folder of the results, each job's in one of its own.
        executor: Executor that runs them.
        on_result: Called with each result, those of earlier runs first.
        on_stale: Called with each job that is run anew, and why, before any is run.

    Raises:
        BenchmarkError: If a result of an earlier run is unreadable, or there is nobody any more to run the others.
    """
    there = {job: found for job in jobs if (found := stored(job, out)) is not None}
    same = [job for job, (_, different) in there.items() if not different]
    for job, now in zip(same, executor.identities(same), strict=True):
        there[job][1].extend(changes(there[job][0], now))
    for job, (result, different) in there.items():
        if different:
            on_stale(job, "; ".join(different[:_MAX_REASONS]) + (" ..." if len(different) > _MAX_REASONS else ""))
        else:
            on_result(result)
    for _, result in executor.run([job for job in jobs if job not in there or there[job][1]], out):
        on_result(result)


@contextmanager
def local(workers: int, root: Path | None) -> Iterator[Executor]:
    """Processes on this machine; what has not begun when it is left is not begun any more.

    Args:
        workers: Number of runs at a time.
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

    def identities(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        return identities(jobs, self.root)

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
