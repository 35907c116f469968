"""Workers: order, latency, errors, and closing in time; a thread and a fixed schedule give the same."""

import gc
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from jaxslam.runtime.worker import InlineWorker, ThreadWorker, close_all

LATENCY = 3
EVER = 10**6
"""A frame by which everything is there."""

AnyWorker = InlineWorker[int, int] | ThreadWorker[int, int]
Make = Callable[[Callable[[int], int]], AnyWorker]


class WrongError(Exception):
    """What the jobs of these tests raise."""


def double(job: int) -> int:
    """Twice the job; odd hundreds are wrong."""
    if job >= 100:
        raise WrongError(f"job {job}")
    return 2 * job


@pytest.fixture(params=["inline", "thread"])
def make(request: pytest.FixtureRequest) -> Iterator[Make]:
    made: list[AnyWorker] = []

    def worker(work: Callable[[int], int]) -> AnyWorker:
        inline = request.param == "inline"
        made.append(InlineWorker(work, "test", LATENCY) if inline else ThreadWorker(work, "test"))
        return made[-1]

    yield worker
    close_all(made)


def everything(worker: AnyWorker) -> list[int | str]:
    """All that comes out of a worker, results and messages of errors, until nothing does."""
    found: list[int | str] = []
    while True:
        try:
            results = worker.flush()
        except WrongError as error:
            found.append(str(error))
            continue
        if not results:
            return found
        found += results


def eventually(condition: Callable[[], bool], within_s: float = 5.0) -> bool:
    until_s = time.monotonic() + within_s
    while not condition() and time.monotonic() < until_s:
        time.sleep(0.005)
    return condition()


class TestResults:
    def test_in_order_once(self, make: Make) -> None:
        worker = make(double)
        for job in range(50):
            worker.submit(job, job)
        assert worker.flush() == [2 * job for job in range(50)]
        assert worker.flush() == worker.collect(EVER) == []

    def test_latency(self) -> None:
        worker = InlineWorker(double, "test", LATENCY)
        worker.submit(1, 10)
        worker.submit(2, 12)
        assert [worker.collect(frame) for frame in range(10, 17)] == [[], [], [], [2], [], [4], []]

    def test_thread_is_not_waited_for(self) -> None:
        gate = threading.Event()
        worker = ThreadWorker(lambda job: job if gate.wait(10) else -1, "test")
        worker.submit(1, 0)
        assert worker.collect(EVER) == []
        gate.set()
        assert worker.flush() == [1]
        worker.close()

    def test_drain_of_nothing(self, make: Make) -> None:
        assert make(double).flush() == []


class TestErrors:
    @pytest.mark.parametrize("jobs", [[100], [1, 101, 2], [102, 103, 1], [1, 2, 104], [1, 105, 106, 2, 107]])
    def test_come_once_in_their_place(self, make: Make, jobs: list[int]) -> None:
        worker = make(double)
        for job in jobs:
            worker.submit(job, 0)
        assert everything(worker) == [f"job {job}" if job >= 100 else 2 * job for job in jobs]

    def test_take_loses_nothing(self) -> None:
        """An error in the middle of what is due: first what came before, then the error, then the rest."""
        worker = InlineWorker(double, "test", LATENCY)
        for job in (1, 100, 2):
            worker.submit(job, 0)
        worker.submit(3, 1)
        assert worker.collect(3) == [2]
        with pytest.raises(WrongError, match="job 100"):
            worker.collect(3)
        assert worker.collect(3) == [4]
        assert worker.collect(4) == [6]

    def test_the_thread_lives_on(self) -> None:
        """Even after what is no `Exception`."""

        def leave(job: int) -> int:
            return sys.exit(job) if job else 7

        worker = ThreadWorker(leave, "test")
        worker.submit(3, 0)
        worker.submit(0, 0)
        with pytest.raises(SystemExit):
            worker.flush()
        assert worker.flush() == [7]
        worker.close()


class TestDropping:
    def held(self, **options: Any) -> tuple[ThreadWorker[int, int], threading.Event]:
        """A worker whose first job, 0, has begun and waits for the event."""
        begun, gate = threading.Event(), threading.Event()

        def work(job: int) -> int:
            begun.set()
            assert gate.wait(10)
            return job

        worker = ThreadWorker(work, "test", **options)
        worker.submit(0, 0)
        assert begun.wait(10)
        return worker, gate

    def test_the_oldest_waiting_job_is_dropped(self) -> None:
        worker, gate = self.held(max_waiting=2)
        for job in range(1, 6):
            worker.submit(job, 0)
        assert (worker.num_waiting, worker.num_dropped) == (2, 3)
        gate.set()
        assert worker.flush() == [0, 4, 5]
        worker.close()

    def test_only_jobs_that_may_be_dropped_are(self) -> None:
        """Odd jobs are kept, and do not count towards the limit."""
        worker, gate = self.held(max_waiting=2, may_drop=lambda job: job % 2 == 0)
        for job in range(1, 9):
            worker.submit(job, 0)
        assert worker.num_dropped == 2
        gate.set()
        assert worker.flush() == [0, 1, 3, 5, 6, 7, 8]
        worker.close()

    def test_nothing_is_dropped_without_a_limit(self) -> None:
        worker, gate = self.held()
        for job in range(1, 100):
            worker.submit(job, 0)
        gate.set()
        assert worker.flush() == list(range(100))
        assert worker.num_dropped == 0
        worker.close()

    def test_a_limit_of_0_is_refused(self) -> None:
        with pytest.raises(ValueError, match="max_waiting: expected at least 1, got 0"):
            ThreadWorker(double, "test", max_waiting=0)


class TestHeld:
    """Until `begin`, jobs wait."""

    def test_inline_results_come_at_the_same_frames(self) -> None:
        done: list[int] = []
        worker: AnyWorker = InlineWorker(lambda job: done.append(job) or double(job), "test", LATENCY, held=True)
        for frame in range(3):
            worker.submit(frame, frame)
        assert (done, worker.num_waiting, worker.flush()) == ([], 0, [])
        assert [worker.is_due(frame) for frame in (LATENCY - 1, LATENCY)] == [False, True]
        worker.begin()
        worker.begin()
        assert done == [0, 1, 2]
        assert [worker.is_due(frame) for frame in (LATENCY - 1, LATENCY)] == [False, True]
        assert worker.collect(LATENCY) == [0]
        assert worker.collect(LATENCY + 2) == [2, 4]
        worker.submit(7, 7)
        assert done == [0, 1, 2, 7]

    def test_inline_errors_come_at_their_frames(self) -> None:
        worker = InlineWorker(double, "test", LATENCY, held=True)
        worker.submit(100, 0)
        worker.begin()
        assert worker.collect(LATENCY - 1) == []
        with pytest.raises(WrongError, match="job 100"):
            worker.collect(LATENCY)

    def test_a_thread_waits(self) -> None:
        done: list[int] = []
        work: Callable[[int], int] = lambda job: done.append(job) or double(job)
        worker = ThreadWorker(work, "test", max_waiting=2, held=True)
        for job in range(4):
            worker.submit(job, 0)
        assert (worker.num_waiting, worker.num_dropped, worker.flush(), worker.is_due(100)) == (2, 2, [], False)
        worker.begin()
        assert worker.flush() == [4, 6]
        assert done == [2, 3]
        worker.close()

    @pytest.mark.parametrize("inline", [True, False])
    def test_closed_before_it_begins(self, *, inline: bool) -> None:
        done: list[int] = []
        work = lambda job: done.append(job) or job
        worker = InlineWorker(work, "held", 0, held=True) if inline else ThreadWorker(work, "held", held=True)
        worker.submit(1, 0)
        began = time.monotonic()
        worker.close()
        worker.begin()
        assert worker.flush() == done == []
        assert time.monotonic() - began < 1
        assert all(thread.name != "held" for thread in threading.enumerate())


class TestClose:
    def test_twice(self, make: Make) -> None:
        worker = make(double)
        worker.submit(1, 0)
        worker.close()
        worker.close()
        assert set(worker.flush()) <= {2}  # the thread may not have begun
        assert worker.flush() == []

    def test_before_the_first_job(self, make: Make) -> None:
        worker = make(double)
        worker.close()
        assert worker.flush() == []

    def test_offering_after_it_is_an_error(self, make: Make) -> None:
        worker = make(double)
        worker.close()
        with pytest.raises(RuntimeError, match="test is closed"):
            worker.submit(1, 0)

    def test_what_is_done_can_be_taken(self, make: Make) -> None:
        done: list[int] = []
        worker = make(lambda job: done.append(job) or double(job))
        worker.submit(1, 0)
        worker.submit(100, 0)
        assert eventually(lambda: len(done) == 2)
        worker.close()
        assert everything(worker) == [2, "job 100"]

    def test_jobs_not_begun_are_forgotten(self) -> None:
        begun, gate = [], threading.Event()
        worker = ThreadWorker(lambda job: (begun.append(job), gate.wait(10), job)[-1], "test")
        for job in range(5):
            worker.submit(job, 0)
        assert eventually(lambda: begun == [0])
        worker.stop()
        gate.set()
        worker.close()
        assert begun == [0]
        assert everything(worker) == [0]

    def test_in_two_seconds(self) -> None:
        """Three workers together, each with a job that takes longer; none is waited for again by `flush`."""
        begun: list[float] = []
        work = lambda seconds: (begun.append(seconds), time.sleep(seconds))[0]
        workers = [ThreadWorker(work, f"slow-{number}") for number in range(3)]
        for worker in workers:
            worker.submit(4.0, 0)
            worker.submit(4.0, 0)
        assert eventually(lambda: len(begun) == 3)
        began = time.monotonic()
        close_all(workers)
        assert all(worker.flush() == [] for worker in workers)
        assert 1.5 < time.monotonic() - began < 2.0
        slow = [thread for thread in threading.enumerate() if thread.name.startswith("slow-")]
        assert len(slow) == 3
        assert all(thread.daemon for thread in slow)


class TestThread:
    def test_ends_when_nobody_holds_the_worker(self) -> None:
        class Owner:
            """Holds a worker that calls it: a circle, as the back end is."""

            def __init__(self) -> None:
                self.worker = ThreadWorker(self.work, "owned")
                self.worker.submit(1, 0)
                self.worker.flush()

            def work(self, job: int) -> int:
                return job

        owner = Owner()
        gone = weakref.ref(owner)
        assert any(thread.name == "owned" for thread in threading.enumerate())
        del owner
        assert eventually(lambda: gc.collect() >= 0 and gone() is None)
        assert eventually(lambda: all(thread.name != "owned" for thread in threading.enumerate()))

    @pytest.mark.parametrize(("seconds", "least", "most"), [(0.5, 0.4, 15.0), (60.0, 1.5, 15.0)])
    def test_interpreter_ends(self, seconds: float, least: float, most: float) -> None:
        """It waits for the job at hand, two seconds at most."""
        script = (
            "import time; from jaxslam.runtime.worker import ThreadWorker\n"
            f"worker = ThreadWorker(time.sleep, 'left'); worker.submit({seconds}, 0); worker.submit({seconds}, 0)\n"
            "time.sleep(0.05); print('end', flush=True)"
        )
        with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "end\n"
            began = time.monotonic()
            assert process.wait(timeout=60) == 0
        assert least < time.monotonic() - began < most
