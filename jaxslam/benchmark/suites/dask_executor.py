"""Runs of a suite on a Dask cluster: no disk is shared, what a run leaves behind is sent back with its figures.

`dask scheduler` and, on each machine, `dask worker HOST:PORT --nthreads 1` start one, in environments with the same
jaxslam. A worker makes as many runs at a time as it has threads; times are only worth something if that is one, and
if it is the only worker of its machine. Recordings and networks lie on the machines of the workers.
"""

import concurrent.futures
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from jaxslam.benchmark.suites.job import RESULT, Job, failed, run_in_process
from jaxslam.benchmark.suites.provenance import identities
from jaxslam.benchmark.suites.runner import Executor
from jaxslam.datasets.catalog import found_recordings
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.results.run_results import RESULT_FILES

try:
    from distributed import Client, Future, KilledWorker, as_completed, get_worker
    from distributed.comm.addressing import get_address_host
except ImportError as missing:
    raise BenchmarkError(f"distributed cannot be imported ({missing}): pip install 'jaxslam[cluster]'") from missing

_GONE = "--executor: the scheduler is gone; --resume goes on with the runs that have been made"
_PATIENCE_S = 5.0
"""For a scheduler to answer, and for its first worker."""


@contextmanager
def cluster(scheduler: str, root: Path | None) -> Iterator[Executor]:
    """The workers of a Dask cluster; what has not begun when it is left is not begun any more.

    If a worker dies, others repeat what it was running. A run that has killed several is one that failed. Workers that
    come later are given runs too, but only of what was found on a machine when it began.

    Args:
        scheduler: `HOST:PORT`.
        root: Folder on the machines of the workers in which recordings are looked for first; an absolute path.

    Raises:
        BenchmarkError: If no scheduler answers, there are no workers, or one of them has no jaxslam or no such `root`.
    """
    client = _client(scheduler)
    try:
        yield _Cluster(client, root, _hosts_with_recordings(client, root))
    finally:
        client.close()


@dataclass(frozen=True)
class _Cluster:
    """A cluster as an executor.

    Attributes:
        client: Client of its scheduler.
        root: Folder in which to look for recordings first.
        recordings: Hosts that have them, by name; `None` for all hosts, also those that come later.
    """

    client: Client
    root: Path | None
    recordings: Mapping[str, list[str] | None]

    def identities(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        by_recording: dict[str, list[Job]] = {}
        for job in jobs:
            by_recording.setdefault(job.clip.recording, []).append(job)
        futures = {name: self._submitted(identities, of_it, name) for name, of_it in by_recording.items()}
        found = {}
        for name, of_it in by_recording.items():
            found |= dict(zip(of_it, self._result(futures[name]), strict=True))
        return [found[job] for job in jobs]

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, dict[str, Any]]]:
        waiting = {self._submitted(run_and_pack, job, job.clip.recording): job for job in jobs}
        for future in as_completed(list(waiting), loop=self.client.loop):
            job = waiting.pop(future)  # with the last reference to it, workers forget its files
            yield job, _received(future, job, out)

    def _submitted(self, function: Callable[..., Any], what: Any, recording: str) -> Future:
        """Have a worker call a function of jobs and of `root`, where their recording is."""
        return self.client.submit(function, what, self.root, workers=self.recordings.get(recording), pure=False)

    @staticmethod
    def _result(future: Future) -> Any:
        try:
            return future.result()
        except concurrent.futures.CancelledError:
            raise BenchmarkError(_GONE) from None
        except Exception as problem:
            raise BenchmarkError(f"--executor: {_words(problem)}") from None


def run_and_pack(job: Job, root: Path | None) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Run a job in a process of its own, for a worker, and keep nothing of it.

    Returns:
        Its figures as `run_in_process` gives them, and its files by name.
    """
    # Dask clears this folder, even after a worker that was killed.
    with tempfile.TemporaryDirectory(prefix="jaxslam-", dir=get_worker().local_directory) as out:
        result = run_in_process(job, Path(out), root)
        if result["status"] != "done":
            result["problem"] += f" (on {socket.gethostname()})"
        folder = Path(out) / job.folder
        return result, {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def _client(scheduler: str) -> Client:
    """Dask itself waits for ever for somebody who takes the call and says nothing, such as its own dashboard."""
    made: concurrent.futures.Future[Client] = concurrent.futures.Future()

    def make() -> None:
        try:
            made.set_result(Client(scheduler, timeout=_PATIENCE_S, set_as_default=False))
        except Exception as problem:
            made.set_exception(problem)

    threading.Thread(target=make, name="jaxslam-dask", daemon=True).start()
    try:
        return made.result(timeout=1.5 * _PATIENCE_S)
    except (OSError, ImportError) as problem:
        raise BenchmarkError(
            f"--executor: expected a Dask scheduler at {scheduler}, none answers: {_words(problem)}"
        ) from None


def _hosts_with_recordings(client: Client, root: Path | None) -> dict[str, list[str] | None]:
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except TimeoutError:
        raise BenchmarkError("--executor: expected a Dask cluster with workers, there are none") from None
    found: dict[str, set[str]] = {}
    workers = cast("dict[str, list[str] | Exception]", client.run(_recordings_here, root, on_error="return"))
    for worker, names in workers.items():
        if isinstance(names, Exception):
            raise BenchmarkError(f"{worker}: {_words(names)}")
        for name in names:
            found.setdefault(name, set()).add(get_address_host(worker))
    everywhere = {get_address_host(worker) for worker in workers}
    return {name: None if hosts == everywhere else sorted(hosts) for name, hosts in found.items()}


def _recordings_here(root: Path | None) -> list[str]:
    return list(found_recordings(root))


def _received(future: Future, job: Job, out: Path) -> dict[str, Any]:
    """The figures of a job that has ended, its files written."""
    try:
        result, files = future.result()
    except concurrent.futures.CancelledError:
        raise BenchmarkError(_GONE) from None
    except Exception as problem:  # of whatever kind: it happened to this run, the others go on
        return failed(job, _words(problem))
    write_files(out / job.folder, files)
    return result


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Put the files of a run in the place of those of an earlier one; the one that says that all are there is the last.

    Raises:
        BenchmarkError: If one cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (RESULT, *RESULT_FILES):
        if name == RESULT or name not in files:
            (folder / name).unlink(missing_ok=True)
    for name in sorted(files, key=lambda name: name == RESULT):
        write_atomically(folder / name, files[name], BenchmarkError)


def _words(problem: Exception) -> str:
    """One line about what happened on another machine."""
    if isinstance(problem, KilledWorker):
        return (
            f"workers that died while they had it: {problem.allowed_failures + 1}, last {problem.last_worker.address}"
        )
    first = (str(problem).strip().splitlines() or ["nothing was said"])[0]
    return f"{type(problem).__name__}: {first}"
