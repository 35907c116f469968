"""Global bundle adjustment beside tracking: a worker that adjusts a snapshot of the map, of which the newest counts.

In a thread it works between frames. Beside them, on two cores at a lower priority, it made the median frame of the
rendered road 20 ms instead of 15, and the longest 48 ms instead of 25 (AMD EPYC): they share caches and memory.
"""

import logging
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

from jaxslam.map.types import Map
from jaxslam.mapping.global_bundle_adjustment import AdjustedSubmap, adjust_submap
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan
from jaxslam.runtime.worker import Worker

_PATIENCE_S = 0.05
"""Longest time that a thread waits for a frame to end, before each chunk of points: it goes on if frames never end."""
_log = logging.getLogger(__name__)


class AdjustJob(NamedTuple):
    """A job: adjust some submaps.

    Attributes:
        map: The map.
        submaps: Numbers of the submaps.
        number: Number of the job.
    """

    map: Map
    submaps: Sequence[int]
    number: int


class AdjustResult(NamedTuple):
    """Result of an `AdjustJob`.

    Attributes:
        number: Number of the job.
        submaps: The adjusted submaps; none if the job was interrupted.
    """

    number: int
    submaps: tuple[AdjustedSubmap, ...]


class MapAdjuster:
    """Adjusts the newest map that it was given; what it works on ends when a newer one comes, or a newer loop.

    The tracker tells when a frame begins and ends.

    Attributes:
        worker: Does the jobs.
    """

    def __init__(
        self,
        plan: AdjustPlan,
        make: Callable[[Callable[[AdjustJob], AdjustResult]], Worker[AdjustJob, AdjustResult]],
        *,
        in_turn: bool,
    ) -> None:
        """Prepare a worker.

        Args:
            plan: Settings of the adjustment.
            make: Makes the worker, given the function that does a job.
            in_turn: Whether the worker does its jobs in the tracker's thread, and so within frames.
        """
        self._plan, self._newest, self._in_turn = plan, 0, in_turn
        self._between_frames = threading.Event()
        self._between_frames.set()
        self.worker = make(self._adjust)

    def next_job(self, slam_map: Map, submaps: Sequence[int]) -> AdjustJob:
        """Return a job for the worker, which interrupts the one before."""
        self.interrupt()
        return AdjustJob(slam_map, submaps, self._newest)

    def interrupt(self) -> None:
        """End the job at hand within some hundredths of a second, and discard the results of all jobs so far."""
        self._newest += 1

    def frame_begun(self) -> None:
        """Have the worker wait, after the chunk of points at hand."""
        self._between_frames.clear()

    def frame_ended(self) -> None:
        """Let the worker go on."""
        self._between_frames.set()

    def still_wanted(self, results: list[AdjustResult]) -> list[AdjustedSubmap]:
        """Return the adjusted submaps among results of the worker that no newer job or loop has made obsolete."""
        return [submap for result in results if result.number == self._newest for submap in result.submaps]

    def _adjust(self, job: AdjustJob) -> AdjustResult:
        def is_obsolete() -> bool:
            if not self._in_turn:
                self._between_frames.wait(_PATIENCE_S)
            return job.number != self._newest

        found = (adjust_submap(job.map, submap, self._plan, is_obsolete) for submap in job.submaps)
        adjusted = tuple(submap for submap in found if submap is not None)
        for submap in adjusted:
            _log.info(
                "global bundle adjustment of %d keyframes and %d points: cost %.5g before, %.5g after %d steps",
                len(submap.keyframes),
                len(submap.points),
                submap.initial_cost,
                submap.cost,
                submap.num_steps,
            )
        return AdjustResult(job.number, adjusted)
