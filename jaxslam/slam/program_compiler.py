"""Compiling beside tracking: a tracker begins when its own programs are ready, and the back end's follow in a thread.

Both at once would hold each other up, on two cores and in Python: see `ProgramCompiler`.
"""

import atexit
import os
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import numpy as np

from jaxslam.runtime.compiled import before_each_program
from jaxslam.runtime.freed_memory import return_freed_memory
from jaxslam.runtime.worker import ThreadWorker
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameMemory
from jaxslam.slam.back_end import BackEnd
from jaxslam.slam.mask_stage import MaskStage
from jaxslam.slam.tracker import Tracker

_Step: TypeAlias = Callable[[], None]
"""Compiles some programs. What was compiled before, in this process, takes it no time."""

_CLOSED = "the tracker was closed while it compiled; Slam.reset() begins anew"
_process, _exits = os.getpid(), threading.Event()
_ONE_AT_A_TIME = threading.Lock()
"""Held during a step: two threads would compile the same program twice, as after `reset` or for two equal cameras."""


class ProgramCompiler:
    """Compiles all programs of a `Slam`, and lets the workers of the back end begin when theirs are ready.

    From an empty cache the first pose comes 7 s after the call, not 16 s as with all programs compiled before it (TUM
    `fr1_rpy`, two cores of an AMD EPYC). The tracker's thread calls the methods, but for `stop`; workers begin in it
    too, so that what is ready does not change in the middle of a frame.
    """

    def __init__(self, tracker: Tracker, camera: Camera, *, waits: bool) -> None:
        """Begin with nothing compiled; `use` comes next.

        Args:
            tracker: The tracker.
            camera: Camera that takes the frames.
            waits: Whether a frame waits for what it needs, so that results do not depend on how long compiling takes.
        """
        self._tracker, self._waits = tracker, waits
        shape = (camera.height, camera.width)
        black = np.zeros(shape, np.uint8)
        blank = Frame(0, black, np.zeros(shape, np.float32), right=black if camera.is_stereo else None)
        movable = tracker.plan.motion is not None
        self._blank = FrameMemory(*shape, pairs=camera.is_stereo, movable=movable).hold(blank, 0.0)
        self._worker: ThreadWorker[_Step, float] | None = None
        self._tracks = self._is_complete = self._can_map = False
        self._stopped = threading.Event()
        self._num_first = self._num_steps = self._num_done = 0
        self._alone_s = 0.0
        """Time from which on only the thread compiles."""
        self.seconds = 0.0

    def use(self, masks: MaskStage, back_end: BackEnd) -> None:
        """Compile for these from now on; for earlier ones, the thread ends after the program at hand."""
        self.stop()
        self._masks, self._back = masks, back_end
        self._worker, self._stopped, self._can_map = None, threading.Event(), False

    def prepare(self, frame: int) -> None:
        """Compile what frames need at least, have the thread begin with the rest, and take over what it has done.

        Args:
            frame: Number of the frame to come; if it has to have results of the back end, this waits for the thread.

        Raises:
            Exception: Error of the thread; the next call tries again.
        """
        if self._stopped.is_set():
            return
        self._compile_tracker()
        self._start()
        self._take(wait=self._waits and not self._can_map and self._back.is_due(frame))

    def can_map(self) -> bool:
        """Tell whether frames can be localized in the map; where a frame waits for what it needs, wait until they can.

        Raises:
            Exception: Error of the thread.
        """
        if self._waits and not self._can_map:
            self._take(wait=True)
        return self._can_map

    def compile_all(self) -> float:
        """Compile everything, and wait for the thread; return `seconds`.

        Raises:
            Exception: Error of compiling; the next call tries again.
        """
        if not self._is_complete:
            if self._stopped.is_set():
                self._worker, self._stopped = None, threading.Event()
            self._start()  # at once: here nothing is gained by the tracker being ready first
            self._compile_tracker()
            self._take(wait=True)
        return self.seconds

    def finish(self) -> None:
        """Wait for the thread, unless nothing has been tracked or it was stopped.

        Raises:
            Exception: Error of the thread; the next call tries again.
        """
        if self._tracks and not self._stopped.is_set():
            self._start()
            self._take(wait=True)

    def stop(self) -> None:
        """Have the thread end after the program at hand, without waiting for it; from any thread.

        The compiler cannot be interrupted. A process that ends meanwhile waits for that program, for some seconds.
        """
        self._stopped.set()
        if self._worker is not None:
            self._worker.stop()

    def _compile_tracker(self) -> None:
        if self._tracks:
            return
        began = time.perf_counter()
        self._tracker.compile(self._blank)
        self._masks.compile()
        self._alone_s = time.perf_counter()
        self.seconds += self._alone_s - began
        self._tracks = True

    def _start(self) -> None:
        """Start the thread, unless it has been."""
        if self._worker is not None or self._is_complete:
            return
        self._alone_s = time.perf_counter()
        first, last = self._back.programs(self._blank, self._tracker.fresh_state())
        steps = (*first, *last, return_freed_memory)
        self._num_first, self._num_steps, self._num_done = len(first), len(steps), 0
        self._worker = ThreadWorker(partial(_do_step, stopped=self._stopped), "jaxslam-compile")
        for step in steps:
            self._worker.submit(step, 0)

    def _take(self, *, wait: bool) -> None:
        """Take over the steps that the thread has done, wait for all if asked to, and let workers begin."""
        worker = self._worker
        if worker is not None:
            try:
                ended = worker.flush() if wait else []
                while more := worker.collect(0):  # an error is raised once nothing stands before it
                    ended += more
            except BaseException:
                worker.stop()
                self._worker = None
                raise
            self._num_done += len(ended)
            if self._num_done == self._num_steps:
                self._is_complete = True
                self.seconds += max(ended[-1] - self._alone_s, 0.0)
                worker.close()  # nothing is left to do: the thread ends at once
                self._worker = None
        if wait and not self._is_complete:
            raise RuntimeError(_CLOSED)
        self._let_begin()

    def _let_begin(self) -> None:
        if self._is_complete and self._back.dense is not None:
            self._back.dense.begin()
        # A deterministic run has all or nothing: what is in the dense map may not depend on the time either.
        enough = self._is_complete or (not self._waits and self._num_done >= self._num_first > 0)
        if enough and not self._can_map:
            self._back.begin()
            self._can_map = True


@atexit.register
def _wait_for_program() -> None:
    """Wait for the program at hand and let none begin any more: an interpreter that ends within one is aborted.

    When XLA comes back to Python there, the thread is ended in the middle of C++ (exit code 134).
    """
    _exits.set()
    if os.getpid() == _process:  # one that was forked has no such thread, but maybe a lock that it held
        _ONE_AT_A_TIME.acquire()


def _do_step(step: _Step, stopped: threading.Event) -> float:
    """Do a step, and return the time at its end.

    Raises:
        RuntimeError: If the tracker was closed, or the process ends; no further program is compiled then.
    """

    def check() -> None:
        if stopped.is_set() or _exits.is_set():
            raise RuntimeError(_CLOSED)

    with _ONE_AT_A_TIME, before_each_program(check):
        step()
    return time.perf_counter()
