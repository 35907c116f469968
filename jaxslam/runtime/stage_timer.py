"""How long each stage of tracking takes, frame by frame, and each job of the threads beside it."""

import time
from array import array
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Float

_Given = TypeVar("_Given")
_Made = TypeVar("_Made")


class StageTimes:
    """Keeps every time: eight bytes a stage and frame, 6 MB an hour at 30 frames a second.

    Any thread may add to it.
    """

    def __init__(self) -> None:
        """Begin with nothing."""
        self._ms: dict[str, array[float]] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Take in how long a stage took."""
        self._ms.setdefault(stage, array("d")).append(1e3 * seconds)

    def timed(self, stage: str, work: Callable[[_Given], _Made]) -> Callable[[_Given], _Made]:
        """The same function, whose every call is a stage; one that raises is one too."""

        def measured(given: _Given) -> _Made:
            began = time.perf_counter()
            try:
                return work(given)
            finally:
                self.add(stage, time.perf_counter() - began)

        return measured

    def stopwatch(self) -> "Stopwatch":
        """A stopwatch that runs from now on."""
        return Stopwatch(self)

    @property
    def ms(self) -> Mapping[str, Float[np.ndarray, " times"]]:
        """Milliseconds of every time a stage was gone through, in the order in which stages were first seen."""
        return {stage: np.array(times) for stage, times in self._ms.items()}


class Stopwatch:
    """Divides the time of one frame among its stages."""

    def __init__(self, times: StageTimes) -> None:
        """Start."""
        self._times, self._since = times, time.perf_counter()

    def ends(self, stage: str) -> None:
        """What was done since the last stage ended was this one."""
        now = time.perf_counter()
        self._times.add(stage, now - self._since)
        self._since = now
