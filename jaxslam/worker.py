"""Work that is done beside tracking: in a thread of its own, or in turn on a fixed schedule. One interface for both.

The tracker offers jobs and takes results; it never waits for either, but when it asks to (`drain`).
"""

import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

_Job = TypeVar("_Job")
_Job_contra = TypeVar("_Job_contra", contravariant=True)
_Result = TypeVar("_Result")
_CLOSE_S = 2.0
"""Longest wait for the job at hand when a thread is closed."""


class Worker(Protocol[_Job_contra, _Result]):
    """Does jobs one after the other."""

    def offer(self, job: _Job_contra, frame: int) -> None:
        """Give it a job, in frame number `frame`."""
        ...

    def take(self, frame: int) -> list[_Result]:
        """The results that are there by frame number `frame`, in the order of their jobs, each given out once.

        Raises:
            Exception: What a job raised, here and once; the jobs after it are done nevertheless.
        """
        ...

    def drain(self) -> list[_Result]:
        """Wait for all jobs, and take their results; raises as `take` does."""
        ...

    def close(self) -> None:
        """End it, with the jobs not yet begun. Safe to call twice."""
        ...


class InlineWorker(Generic[_Job, _Result]):
    """Does each job at once, and hands its result over a fixed number of frames later: the same on every machine."""

    def __init__(self, work: Callable[[_Job], _Result], latency_frames: int) -> None:
        """Do jobs by calling `work`."""
        self._work, self._latency = work, latency_frames
        self._outcomes: deque[tuple[int, _Result | Exception]] = deque()

    def offer(self, job: _Job, frame: int) -> None:
        """Do it."""
        try:
            outcome = self._work(job)
        except Exception as error:
            outcome = error
        self._outcomes.append((frame + self._latency, outcome))

    def take(self, frame: int) -> list[_Result]:
        """The results whose frame has come."""
        due: deque[_Result | Exception] = deque()
        while self._outcomes and self._outcomes[0][0] <= frame:
            due.append(self._outcomes.popleft()[1])
        try:
            return _results(due)
        finally:
            self._outcomes.extendleft((frame, outcome) for outcome in reversed(due))

    def drain(self) -> list[_Result]:
        """All results."""
        return self.take(max((frame for frame, _ in self._outcomes), default=0))

    def close(self) -> None:
        """Nothing runs."""


class ThreadWorker(Generic[_Job, _Result]):
    """Does jobs in a thread."""

    def __init__(self, work: Callable[[_Job], _Result], name: str) -> None:
        """Do jobs by calling `work` in a thread of this name, started with the first job."""
        self._work, self._name = work, name
        self._jobs: queue.Queue[_Job | None] = queue.Queue()
        self._outcomes: deque[_Result | Exception] = deque()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def offer(self, job: _Job, frame: int) -> None:
        """Queue it."""
        del frame
        if self._closing.is_set():
            raise RuntimeError(f"{self._name} is closed")
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()
        self._jobs.put(job)

    def take(self, frame: int) -> list[_Result]:
        """What is done."""
        del frame
        return _results(self._outcomes)

    def drain(self) -> list[_Result]:
        """Wait until nothing is left to do."""
        self._jobs.join()
        return self.take(0)

    def close(self) -> None:
        """Wait for the job at hand, for two seconds at most."""
        self._closing.set()
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                if not self._closing.is_set():
                    self._outcomes.append(self._work(job))
            except Exception as error:
                self._outcomes.append(error)
            finally:
                self._jobs.task_done()
        self._jobs.task_done()


def _results(outcomes: "deque[_Result | Exception]") -> list[_Result]:
    """Results from the left up to an error, which is raised once nothing stands before it."""
    taken: list[_Result] = []
    while outcomes:
        if isinstance(outcomes[0], Exception):
            if taken:
                break
            raise outcomes.popleft()  # type: ignore[misc]
        taken.append(outcomes.popleft())  # type: ignore[arg-type]
    return taken
