"""The detector in a thread of its own: one frame in, one mask out, and the tracker never waits.

Frames that come while it looks at one are not for it; so it always looks at the newest. In a deterministic run it is
called in turn, and its masks come a fixed number of frames later.
"""

import logging
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxslam.config.schema import Config
from jaxslam.masks.box_to_mask import instance_labels, mask_of_detections, reduced_detections
from jaxslam.masks.point_sampling import CornerKind
from jaxslam.masks.propagation import TrackedMask, make_origin
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.worker import InlineWorker, Worker, make_worker
from jaxslam.semantics import Detector
from jaxslam.sensors.downscale import Downscaler

_log = logging.getLogger(__name__)

_PATIENCE_S = 2.0
"""Longest wait for the mask of a frame that has to wait."""


class DetectionJob(NamedTuple):
    """A frame for the detector.

    Attributes:
        frame: Its number.
        image: `(h, w, 3)` RGB or `(h, w)`.
        gray: `(h', w')` uint8, of the size of masks.
        depth: `(h', w')` meters.
    """

    frame: int
    image: np.ndarray
    gray: np.ndarray
    depth: np.ndarray


class DetectedMask(NamedTuple):
    """Result of the detector.

    Attributes:
        frame: The frame it looked at.
        origin: The mask, and the points it is followed by.
        labels: `(h', w')` number of the object at each pixel, as in `instance_labels`; `None` for a mask that is
            carried on, and where the motion of objects is not classified.
    """

    frame: int
    origin: TrackedMask
    labels: UInt8[np.ndarray, "_h _w"] | None = None


class ErrorLog:
    """Errors of a detector: returned every time, and logged when they change."""

    def __init__(self) -> None:
        """Begin with nothing wrong."""
        self._said = ""

    def report(self, error: str) -> str:
        """Log a detector error when it changes, and return it."""
        if error != self._said:
            _log.warning("detector failed: %s", error)
        self._said = error
        return error


def rgb_copy(image: np.ndarray) -> np.ndarray:
    """`(h, w, 3)` of `(h, w, 3)` or of gray `(h, w)`, as a detector takes it; a copy."""
    return image.copy() if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


class SemanticThread:
    """Looks at one frame after the other.

    Attributes:
        looking_at: The frame it has not finished; `None` if it is idle.
    """

    def __init__(
        self,
        detector: Detector,
        reduced: Downscaler,
        config: Config,
        times: StageTimes | None = None,
    ) -> None:
        """Begin idle.

        Args:
            detector: Detector of movable objects.
            reduced: The size of masks.
            config: Settings in effect. A deterministic run has masks `semantics.latency_frames` later; others use a
                thread. With 0, every frame waits for its mask, in a thread too.
            times: Record of the duration of every detection.
        """
        self.looking_at: int | None = None
        self._offered: int | None = None
        self._detector, self._reduced, self._seed = detector, reduced, config.run.seed
        self._focal_px, self._numbers_objects = float(reduced.raster.intrinsics.fx), config.dynamics.motion.enabled
        latency_frames = config.semantics.latency_frames
        self._corners: CornerKind = config.semantics.mask_corners
        self._all_wait, self._begun, self._failures = latency_frames == 0, False, ErrorLog()
        self._worker: Worker[DetectionJob, DetectedMask] = make_worker(
            (times or StageTimes()).timed("detector", self._look),
            "jaxslam-semantics",
            deterministic=config.run.in_turn,
            latency_frames=latency_frames,
        )

    def newest(self, seen: DetectionJob, *, looks: bool = True) -> tuple[DetectedMask | None, str]:
        """The newest mask there is by a frame, if it is newer than the last one, and what went wrong; told once.

        The first frame of all waits for its mask: whatever the tracker starts with would else be taken for static.

        Args:
            seen: The frame.
            looks: Whether the detector may look at the frame if it has to wait for its mask.
        """
        found, error = self._newest(seen.frame)
        if looks and (self._all_wait or not self._begun):
            self.submit(seen)
            later, failed = self._awaited(seen.frame)
            found, error = later or found, failed or error
        self._begun |= looks
        return found, error

    def submit(self, seen: DetectionJob) -> None:
        """Have it look at a frame, if it is idle and has not yet; image and depth are copied."""
        if self.looking_at is None and seen.frame != self._offered:
            self._worker.submit(seen._replace(image=rgb_copy(seen.image), depth=seen.depth.copy()), seen.frame)
            self.looking_at = self._offered = seen.frame

    def close(self) -> None:
        """End the thread."""
        self._worker.close()

    def _look(self, job: DetectionJob) -> DetectedMask:
        found, focal_px = reduced_detections(self._detector(job.image), self._reduced), self._focal_px
        mask = mask_of_detections(found, job.depth, focal_px, dilate_px=0)
        labels = instance_labels(found, job.depth, focal_px) if self._numbers_objects else None
        return DetectedMask(job.frame, make_origin(mask, job.gray, self._seed + job.frame, self._corners), labels)

    def _newest(self, frame: int) -> tuple[DetectedMask | None, str]:
        try:
            done = self._worker.collect(frame)
        except Exception as error:
            self.looking_at = None
            return None, self._failures.report(f"{type(error).__name__}: {error}")
        if not done:
            return None, ""
        self.looking_at = None
        return done[-1], ""

    def _awaited(self, frame: int) -> tuple[DetectedMask | None, str]:
        """The mask of this very frame, if it comes in time."""
        until_s = time.monotonic() + _PATIENCE_S
        inline = isinstance(self._worker, InlineWorker)
        while True:
            # The schedule of a deterministic run is in frames: this one is as if it came later.
            found, error = self._newest(np.iinfo(np.int64).max if inline else frame)
            if found is not None or error or time.monotonic() > until_s:
                return found, error
            time.sleep(0.001)
