"""Work that is done beside tracking: in a thread of its own, or in turn on a fixed schedule. One interface for both.

The tracker offers jobs and takes results; it never waits for either, but when it asks to (`flush`). A worker that is
held keeps its jobs until `begin`: what they need may still have to be compiled.
"""

import atexit
import os
import queue
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

_Job = TypeVar("_Job")
_Job_contra = TypeVar("_Job_contra", contravariant=True)
_Result = TypeVar("_Result")
_NICENESS = 10
_CLOSE_S = 1.8
"""Longest wait for the jobs at hand when threads are closed."""


class _Failed(NamedTuple):
    """Outcome of a job that raised."""

    error: BaseException


class Worker(Protocol[_Job_contra, _Result]):
    """Does jobs one after the other."""

    @property
    def num_waiting(self) -> int:
        """Number of jobs that have not begun."""
        ...

    @property
    def num_dropped(self) -> int:
        """Number of jobs that were dropped before they began, because more than `max_waiting` waited."""
        ...

    def begin(self) -> None:
        """Begin with the jobs that wait, if it was held; safe to call twice."""
        ...

    def is_due(self, frame: int) -> bool:
        """Tell whether a result must be there by frame number `frame`; no thread owes one."""
        ...

    def submit(self, job: _Job_contra, frame: int) -> None:
        """Give it a job, in frame number `frame`.

        Raises:
            RuntimeError: If it is closed.
        """
        ...

    def collect(self, frame: int) -> list[_Result]:
        """The results that are there by frame number `frame`, in the order of their jobs, each given out once.

        Raises:
            Exception: Error of a job, raised here and once; later jobs are done nevertheless.
        """
        ...

    def flush(self) -> list[_Result]:
        """Wait for all jobs unless it is held or closed, and take their results; raises as `collect` does."""
        ...

    def stop(self) -> None:
        """Take no more jobs and forget those not yet begun, without waiting; what is done can still be taken."""
        ...

    def close(self, within_s: float = _CLOSE_S) -> None:
        """`stop`, and wait for the job at hand, for so many seconds at most. Safe to call twice."""
        ...


def close_all(workers: Iterable[Worker[Any, Any]], within_s: float = _CLOSE_S) -> None:
    """Close workers in so many seconds together, whatever they are doing."""
    until_s = time.monotonic() + within_s
    workers = list(workers)
    for worker in workers:
        worker.stop()
    for worker in workers:
        worker.close(max(until_s - time.monotonic(), 0.0))


class InlineWorker(Generic[_Job, _Result]):
    """Does each job at once, and hands its result over a fixed number of frames later: the same on every machine.

    One that is held does its jobs, in their order, when it begins; their results come at the same frames.
    """

    def __init__(self, work: Callable[[_Job], _Result], name: str, latency_frames: int, *, held: bool = False) -> None:
        """Prepare to do jobs in the caller's thread.

        Args:
            work: Function that does a job and returns its result.
            name: Name of the worker.
            latency_frames: Number of frames after which a result is returned.
            held: Whether jobs wait until `begin`.
        """
        self._work, self._name, self._latency = work, name, latency_frames
        self._outcomes: deque[tuple[int, _Result | _Failed]] = deque()
        self._waiting: deque[tuple[_Job, int]] = deque()
        self._held, self._stopped = held, False

    @property
    def num_waiting(self) -> int:
        """Always 0, as decisions of a deterministic run may not depend on when it began."""
        return 0

    @property
    def num_dropped(self) -> int:
        """Always 0: no job waits."""
        return 0

    def begin(self) -> None:
        """Do the jobs that wait."""
        self._held = False
        while self._waiting:
            self._do(*self._waiting.popleft())

    def is_due(self, frame: int) -> bool:
        """Tell whether the first result is due, be it there or not."""
        if self._outcomes:
            return self._outcomes[0][0] <= frame
        return bool(self._waiting) and self._waiting[0][1] + self._latency <= frame

    def submit(self, job: _Job, frame: int) -> None:
        """Do it, or keep it until `begin`."""
        if self._stopped:
            raise RuntimeError(f"{self._name} is closed")
        if self._held:
            self._waiting.append((job, frame))
        else:
            self._do(job, frame)

    def _do(self, job: _Job, frame: int) -> None:
        outcome: _Result | _Failed
        try:
            outcome = self._work(job)
        except Exception as error:
            outcome = _Failed(error)
        self._outcomes.append((frame + self._latency, outcome))

    def collect(self, frame: int) -> list[_Result]:
        """The results whose frame has come."""
        due: deque[_Result | _Failed] = deque()
        while self._outcomes and self._outcomes[0][0] <= frame:
            due.append(self._outcomes.popleft()[1])
        try:
            return _results(due)
        finally:
            self._outcomes.extendleft((frame, outcome) for outcome in reversed(due))

    def flush(self) -> list[_Result]:
        """All results."""
        return self.collect(max((frame for frame, _ in self._outcomes), default=0))

    def stop(self) -> None:
        """Nothing runs."""
        self._stopped = True
        self._waiting.clear()

    def close(self, within_s: float = _CLOSE_S) -> None:
        """Nothing runs."""
        del within_s
        self.stop()


class ThreadWorker(Generic[_Job, _Result]):
    """Does jobs in a thread.

    Between jobs the thread holds nothing but the queue: a worker that nobody holds is collected, and its thread ends.
    Those left when the interpreter ends are closed first: a thread stopped within compiled code ends the process badly.
    """

    def __init__(
        self,
        work: Callable[[_Job], _Result],
        name: str,
        *,
        urgent: bool = False,
        max_waiting: int | None = None,
        may_drop: Callable[[_Job], bool] | None = None,
        held: bool = False,
    ) -> None:
        """Prepare a thread, which starts with the first job.

        Args:
            work: Function that does a job and returns its result.
            name: Name of the thread.
            urgent: Whether the thread runs at normal priority; otherwise it runs at a lower one.
            max_waiting: Number of droppable jobs that may wait. When one more is submitted, the oldest of them is
                dropped. `None` for no limit.
            may_drop: Whether a job may be dropped; every job by default. Other jobs do not count towards `max_waiting`.
            held: Whether jobs wait until `begin`.
        """
        if max_waiting is not None and max_waiting < 1:
            raise ValueError(f"max_waiting: expected at least 1, got {max_waiting}")
        self._work, self._name, self._urgent = work, name, urgent
        self._max_waiting, self._may_drop, self._num_dropped = max_waiting, may_drop, 0
        self._jobs: queue.Queue[tuple[Callable[[Any], Any], Any] | None] = queue.Queue()
        self._outcomes: deque[_Result | _Failed] = deque()
        self._begun, self._stopped = threading.Event(), threading.Event()
        if not held:
            self._begun.set()
        self._thread: threading.Thread | None = None

    @property
    def num_waiting(self) -> int:
        """Number of jobs that have not begun."""
        return self._jobs.qsize()

    @property
    def num_dropped(self) -> int:
        """Number of jobs that were dropped before they began."""
        return self._num_dropped

    def begin(self) -> None:
        """The thread goes on to the first job."""
        self._begun.set()

    def is_due(self, frame: int) -> bool:
        """Never."""
        del frame
        return False

    def submit(self, job: _Job, frame: int) -> None:
        """Queue it; drop the oldest droppable job if too many wait."""
        del frame
        if self._stopped.is_set():
            raise RuntimeError(f"{self._name} is closed")
        if self._thread is None:
            arguments = (self._jobs, self._outcomes, self._begun, self._stopped, self._urgent)
            self._thread = threading.Thread(target=_serve, args=arguments, name=self._name, daemon=True)
            self._thread.start()
            _running.add(self)
            weakref.finalize(self, _stop, self._jobs, self._begun, self._stopped).atexit = False
        if self._max_waiting is not None and self._is_droppable(job):
            self._drop_oldest(self._max_waiting)
        self._jobs.put((self._work, job))

    def collect(self, frame: int) -> list[_Result]:
        """Return the results of finished jobs."""
        del frame
        return _results(self._outcomes)

    def flush(self) -> list[_Result]:
        """Wait until nothing is left to do."""
        if self._begun.is_set() and not self._stopped.is_set():
            self._jobs.join()
        return self.collect(0)

    def stop(self) -> None:
        """The thread ends after the job at hand."""
        _stop(self._jobs, self._begun, self._stopped)

    def close(self, within_s: float = _CLOSE_S) -> None:
        """The thread is left to itself if its job takes longer; what comes of that can be taken."""
        self.stop()
        if self._thread is not None:
            self._thread.join(within_s)

    def _is_droppable(self, job: _Job) -> bool:
        return self._may_drop is None or self._may_drop(job)

    def _drop_oldest(self, max_waiting: int) -> None:
        """Make room for one more droppable job; a job that has begun is no longer in the queue."""
        with self._jobs.mutex:
            waiting = self._jobs.queue
            droppable = [i for i, entry in enumerate(waiting) if entry is not None and self._is_droppable(entry[1])]
            if len(droppable) < max_waiting:
                return
            del waiting[droppable[0]]
            self._num_dropped += 1
        self._jobs.task_done()  # `flush` waits until every job is done or dropped


def make_worker(
    work: Callable[[_Job], _Result],
    name: str,
    *,
    deterministic: bool,
    latency_frames: int,
    urgent: bool = False,
    max_waiting: int | None = None,
    may_drop: Callable[[_Job], bool] | None = None,
    held: bool = False,
) -> Worker[_Job, _Result]:
    """Return an `InlineWorker` for a deterministic run, else a `ThreadWorker`.

    Args:
        work: Function that does a job and returns its result.
        name: Name of the worker and of its thread.
        deterministic: Whether the run is deterministic.
        latency_frames: Number of frames after which an `InlineWorker` returns a result.
        urgent: Whether a thread runs at normal priority.
        max_waiting: Number of droppable jobs that may wait for a thread; `None` for no limit.
        may_drop: Whether a job may be dropped; every job by default.
        held: Whether jobs wait until `begin`.
    """
    if deterministic:
        return InlineWorker(work, name, latency_frames, held=held)
    return ThreadWorker(work, name, urgent=urgent, max_waiting=max_waiting, may_drop=may_drop, held=held)


_running: "weakref.WeakSet[ThreadWorker[Any, Any]]" = weakref.WeakSet()


@atexit.register
def _close_running() -> None:
    close_all(_running)


def _stop(jobs: "queue.Queue[Any]", begun: threading.Event, stopped: threading.Event) -> None:
    if not stopped.is_set():
        stopped.set()  # before a thread that was held goes on
        jobs.put(None)
        begun.set()


def _serve(
    jobs: "queue.Queue[Any]",
    outcomes: "deque[Any]",
    begun: threading.Event,
    stopped: threading.Event,
    urgent: bool,
) -> None:
    """Do jobs until there comes none, from `begun` on; those that come after a stop are not done."""
    if not urgent:
        step_back()
    begun.wait()
    while (entry := jobs.get()) is not None:
        work, job = entry
        try:
            if not stopped.is_set():
                outcomes.append(work(job))
        except BaseException as error:  # handed to the caller, whatever it is
            outcomes.append(_Failed(error))
        finally:
            jobs.task_done()
        del entry, work, job  # so that nothing is held while waiting for the next one


def step_back() -> None:
    """Lower the priority of the calling thread, so that the tracker goes first.

    With two cores, p95 of a frame is 1.7 times OpenCV's optical flow then, not 2.4. Only Linux has priorities of
    threads; elsewhere this does nothing.
    """
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)


def _results(outcomes: "deque[_Result | _Failed]") -> list[_Result]:
    """Results from the left up to an error, which is raised once nothing stands before it."""
    taken: list[_Result] = []
    while outcomes:
        first = outcomes[0]
        if isinstance(first, _Failed):
            if taken:
                break
            outcomes.popleft()
            raise first.error
        taken.append(first)
        outcomes.popleft()
    return taken
