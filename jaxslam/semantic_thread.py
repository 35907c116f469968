"""The detector in a thread of its own: one frame in, one mask out, and the tracker never waits.

Frames that come while it looks at one are not for it; so it always looks at the newest. In a deterministic run it is
called in turn, and its masks come a fixed number of frames later.
"""

import logging
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.masks.box_mask import mask_of_detections
from jaxslam.masks.propagation import MaskAt
from jaxslam.semantics import Detector
from jaxslam.worker import InlineWorker, Worker, make_worker

_log = logging.getLogger(__name__)

_PATIENCE_S = 2.0
"""Longest wait for the mask of a frame that has to wait."""


class _Look(NamedTuple):
    frame: int
    image: np.ndarray
    depth: np.ndarray


class SemanticThread:
    """Looks at one frame after the other.

    Attributes:
        looking_at: The frame it has not finished; `None` if it is idle.
    """

    def __init__(self, detector: Detector, *, deterministic: bool, latency_frames: int) -> None:
        """Begin idle.

        Args:
            detector: What looks.
            deterministic: Have it look in turn, its masks `latency_frames` later; else in a thread.
            latency_frames: 0 has every frame wait for its mask, in a thread too.
        """
        self.looking_at: int | None = None
        self._detector = detector
        self._all_wait, self._begun, self._said = latency_frames == 0, False, ""
        self._worker: Worker[_Look, MaskAt] = make_worker(
            self._look, "jaxslam-semantics", deterministic=deterministic, latency_frames=latency_frames
        )

    def of_frame(self, frame: int, image: np.ndarray, depth: Float[np.ndarray, "h w"]) -> tuple[MaskAt | None, str]:
        """The newest mask there is by a frame, if it is newer than the last one, and what went wrong; told once.

        If the detector is idle, it begins with this frame. The first one of all waits for its mask: whatever the
        tracker starts with would else be taken for static.

        Args:
            frame: Its number.
            image: `(h, w, 3)` RGB or `(h, w)`; copied.
            depth: Metres; copied.
        """
        found, error = self._newest(frame)
        if self.looking_at is None:
            self._offer(frame, image, depth)
            if self._all_wait or not self._begun:
                later, failed = self._awaited(frame)
                found, error = later or found, failed or error
        self._begun = True
        return found, error

    def close(self) -> None:
        """End the thread."""
        self._worker.close()

    def _look(self, job: _Look) -> MaskAt:
        return MaskAt(job.frame, mask_of_detections(self._detector(job.image), job.depth, dilate_px=0))

    def _offer(self, frame: int, image: np.ndarray, depth: np.ndarray) -> None:
        rgb = image.copy() if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        self._worker.offer(_Look(frame, rgb, depth.copy()), frame)
        self.looking_at = frame

    def _newest(self, frame: int) -> tuple[MaskAt | None, str]:
        try:
            done = self._worker.take(frame)
        except Exception as error:
            self.looking_at = None
            return None, self._told(f"{type(error).__name__}: {error}")
        if not done:
            return None, ""
        self.looking_at = None
        return done[-1], ""

    def _told(self, error: str) -> str:
        """What went wrong; in the log only if it is not what went wrong before."""
        if error != self._said:
            _log.warning("detector failed: %s", error)
        self._said = error
        return error

    def _awaited(self, frame: int) -> tuple[MaskAt | None, str]:
        """The mask of this very frame, if it comes in time."""
        until_s = time.monotonic() + _PATIENCE_S
        inline = isinstance(self._worker, InlineWorker)
        while True:
            # The schedule of a deterministic run is in frames: this one is as if it came later.
            found, error = self._newest(np.iinfo(np.int64).max if inline else frame)
            if found is not None or error or time.monotonic() > until_s:
                return found, error
            time.sleep(0.001)
