"""Record the duration of each tracking stage of each frame, and of each background job."""

import threading
import time
from array import array
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Float

NUM_KEPT = 20_000
"""Number of durations of a stage that are kept at least, so that hours of tracking take no more memory."""
_Given = TypeVar("_Given")
_Made = TypeVar("_Made")


class StageTimes:
    """The latest durations of every stage, some ten minutes of them at 30 frames a second; any thread may add to it."""

    def __init__(self) -> None:
        """Create a record without durations."""
        self._lock = threading.Lock()
        self._ms: dict[str, array[float]] = {}
        self._keyframe_ms: dict[str, array[float]] = {}
        self._of_frame: dict[str, float] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Record that a stage took so many seconds."""
        with self._lock:
            _append(self._ms, stage, 1e3 * seconds)
            self._of_frame[stage] = self._of_frame.get(stage, 0.0) + 1e3 * seconds

    def frame_ends(self, *, is_keyframe: bool) -> None:
        """Assign to a frame what each stage took since the frame before; that of jobs beside too, wherever they ran."""
        with self._lock:
            if is_keyframe:
                for stage, ms in self._of_frame.items():
                    _append(self._keyframe_ms, stage, ms)
            self._of_frame = {}

    def timed(self, stage: str, work: Callable[[_Given], _Made]) -> Callable[[_Given], _Made]:
        """Wrap a function so that the duration of every call, also of one that raises, is recorded under `stage`."""

        def measured(given: _Given) -> _Made:
            began = time.perf_counter()
            try:
                return work(given)
            finally:
                self.add(stage, time.perf_counter() - began)

        return measured

    def stopwatch(self) -> "Stopwatch":
        """Start a stopwatch that records into this object."""
        return Stopwatch(self)

    @property
    def ms(self) -> Mapping[str, Float[np.ndarray, " times"]]:
        """Durations of each stage, milliseconds: at least the latest `NUM_KEPT`, all if there are fewer.

        The stages are in the order of their first record.
        """
        with self._lock:
            return {stage: np.array(times) for stage, times in self._ms.items()}

    @property
    def keyframe_ms(self) -> Mapping[str, Float[np.ndarray, " times"]]:
        """Durations of each stage in frames that became keyframes, milliseconds; as many are kept as of `ms`."""
        with self._lock:
            return {stage: np.array(times) for stage, times in self._keyframe_ms.items()}


def _append(durations: dict[str, "array[float]"], stage: str, ms: float) -> None:
    times = durations.get(stage)
    if times is None:
        times = durations[stage] = array("d")
    times.append(ms)
    if len(times) >= 2 * NUM_KEPT:
        del times[:NUM_KEPT]


class Stopwatch:
    """Stopwatch that divides the time of one frame among its stages."""

    def __init__(self, times: StageTimes) -> None:
        """Start the first stage."""
        self._times, self._since = times, time.perf_counter()

    def ends(self, stage: str) -> None:
        """End the current stage: record the time since the previous stage ended under this name."""
        now = time.perf_counter()
        self._times.add(stage, now - self._since)
        self._since = now
