"""Where things that move are in every frame: a detector in a thread of its own, its masks carried to the present.

The tracker never waits for the detector: while it looks at one frame, the mask of an earlier one is propagated. What
goes wrong in the detector is told with the frame, and tracking goes on.
"""

import enum
import logging
import time
from typing import NamedTuple

import jax
import numpy as np
from jaxslam_kernels.image import Pyramid, build_pyramid
from jaxtyping import Bool, Float

from jaxslam.camera import Camera
from jaxslam.masks.box_mask import dilated, mask_of_detections
from jaxslam.masks.propagation import CAPACITY, Followed, follow, predicted_mask
from jaxslam.masks.sampling import sample_mask
from jaxslam.masks.stillness import without_still_parts
from jaxslam.semantics import Detector
from jaxslam.worker import InlineWorker, Worker, make_worker

_log = logging.getLogger(__name__)

_MOST_FRAMES = 30
"""Frames kept for a detector that takes long; what it says of older ones is of no use."""
_FIRST_WAIT_S = 2.0
"""The first frame waits for its mask: all that the tracker starts with would else be taken for static."""
_TRUSTED_FRAMES = 5
"""Frames after a detection during which what stands still stays in the mask: a person may."""

_pyramid = jax.jit(build_pyramid)


class MaskSource(enum.IntEnum):
    """Where the mask of a frame comes from."""

    NONE = 0
    """There is none: nothing found yet, or no detector."""
    DETECTOR = 1
    """What the detector found in this frame or in one it has just finished, carried to this one."""
    PROPAGATED = 2
    """The mask of the frame before, carried on."""
    CALLER = 3
    """The caller's alone."""


class FrameMask(NamedTuple):
    """What a frame's mask is.

    Attributes:
        mask: `(h, w)` true where something moves or may.
        source: Where it comes from.
        age: Frames since the one the detector looked at; 0 for that frame, -1 where there is none.
        error: What went wrong in the detector, told once; empty if nothing did.
    """

    mask: Bool[np.ndarray, "h w"]
    source: MaskSource
    age: int
    error: str


class _Look(NamedTuple):
    frame: int
    image: np.ndarray
    depth: np.ndarray


class _Found(NamedTuple):
    frame: int
    mask: np.ndarray


class _Seen(NamedTuple):
    """What is kept of a frame."""

    grey: np.ndarray
    pyramid: Pyramid


class DynamicMasks:
    """Makes the mask of every frame."""

    def __init__(
        self,
        camera: Camera,
        detector: Detector,
        *,
        deterministic: bool,
        latency_frames: int,
        propagate: bool = True,
        dilate_px: int = 2,
        seed: int = 0,
    ) -> None:
        """Start with no mask.

        Args:
            camera: That takes the frames.
            detector: Finds what may move.
            deterministic: Run it in turn, its result `latency_frames` later; else in a thread.
            latency_frames: 0 has every frame wait for its own mask.
            propagate: Carry masks on from frame to frame; without it, an old mask is used where it was.
            dilate_px: How far a mask reaches beyond what was found.
            seed: Of random choices.
        """
        self._camera, self._detector = camera, detector
        self._propagate, self._dilate_px, self._seed = propagate, dilate_px, seed
        self._wait = latency_frames == 0
        self._worker: Worker[_Look, _Found] = make_worker(
            self._look, "jaxslam-semantics", deterministic=deterministic, latency_frames=latency_frames
        )
        self._seen: dict[int, _Seen] = {}
        self._looking_at: int | None = None
        self._detected_in = -1
        self._begun = False
        self._mask = np.zeros((camera.height, camera.width), bool)
        self._followed: Followed | None = None
        self._poses: dict[int, np.ndarray] = {}

    def compile(self) -> None:
        """Compile all that masks need."""
        blank = np.zeros((self._camera.height, self._camera.width), np.uint8)
        pyramid = _pyramid(blank)
        followed = follow([pyramid, pyramid], np.zeros((2, 1), np.float32))
        predicted_mask(blank.view(bool), followed, blank.astype(np.float32))

    def of_frame(self, frame: int, image: np.ndarray, grey: np.ndarray, depth: Float[np.ndarray, "h w"]) -> FrameMask:
        """The mask of the next frame.

        Args:
            frame: Its number.
            image: `(h, w, 3)` RGB or `(h, w)`.
            grey: `(h, w)` uint8; copied.
            depth: Metres.
        """
        kept = grey.copy()
        self._seen[frame] = _Seen(kept, _pyramid(kept))
        found, error = self._newest(frame)
        if self._looking_at is None:
            self._offer(frame, image, depth)
            if self._wait or not self._begun:
                later, failed = self._awaited(frame)
                found, error = later or found, failed or error
        self._begun = True
        source = self._carry(frame, found, depth)
        self._forget(frame)
        age = frame - self._detected_in if self._detected_in >= 0 and source != MaskSource.NONE else -1
        return FrameMask(dilated(self._mask, self._dilate_px), source, age, error)

    def tracked(self, frame: int, T_world_cam: np.ndarray, depth: Float[np.ndarray, "h w"]) -> None:
        """Take in where the camera was: what stands still under a mask that is only carried on leaves it."""
        self._poses[frame] = T_world_cam
        before = self._poses.get(frame - 1)
        if self._followed is None or before is None or frame - self._detected_in <= _TRUSTED_FRAMES:
            return
        self._mask = without_still_parts(self._mask, self._followed, depth, before, T_world_cam, self._camera)

    def close(self) -> None:
        """End the thread."""
        self._worker.close()

    def _look(self, job: _Look) -> _Found:
        return _Found(job.frame, mask_of_detections(self._detector(job.image), job.depth, dilate_px=0))

    def _offer(self, frame: int, image: np.ndarray, depth: np.ndarray) -> None:
        rgb = image.copy() if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        self._worker.offer(_Look(frame, rgb, depth.copy()), frame)
        self._looking_at = frame

    def _newest(self, frame: int) -> tuple[_Found | None, str]:
        """What the detector has finished, and what went wrong in it."""
        try:
            done = self._worker.take(frame)
        except Exception as error:
            self._looking_at = None
            _log.warning("detector failed: %s", error)
            return None, f"{type(error).__name__}: {error}"
        if not done:
            return None, ""
        self._looking_at = None
        return done[-1], ""

    def _awaited(self, frame: int) -> tuple[_Found | None, str]:
        """The mask of this very frame, if it comes in time."""
        until_s = time.monotonic() + _FIRST_WAIT_S
        # The schedule of a deterministic run is in frames: this one is as if it came later.
        due = frame if not isinstance(self._worker, InlineWorker) else frame + _MOST_FRAMES
        while True:
            found, error = self._newest(due)
            if found is not None or error or time.monotonic() > until_s:
                return found, error
            time.sleep(0.001)

    def _carry(self, frame: int, found: _Found | None, depth: np.ndarray) -> MaskSource:
        """Bring the mask to this frame, from where the detector has looked or from the frame before."""
        self._followed = None
        if found is not None and found.frame in self._seen and (found.mask.any() or not self._propagate):
            self._detected_in = found.frame
            self._mask = self._carried(found.mask, found.frame, frame, depth)
            return MaskSource.DETECTOR
        if found is not None and self._detected_in < 0:
            self._detected_in = found.frame  # nothing was there: nothing to carry on
        if not self._mask.any():
            return MaskSource.NONE
        self._mask = self._carried(self._mask, frame - 1, frame, depth)
        return MaskSource.PROPAGATED

    def _carried(self, mask: np.ndarray, since: int, frame: int, depth: np.ndarray) -> np.ndarray:
        if since == frame or not self._propagate or since not in self._seen:
            return mask
        sampled = sample_mask(mask, self._seen[since].grey, CAPACITY, self._seed + frame)
        pyramids = [self._seen[between].pyramid for between in range(since, frame + 1)]
        self._followed = follow(pyramids, sampled)
        return predicted_mask(mask, self._followed, depth)

    def _forget(self, frame: int) -> None:
        """Drop what no mask can come from any more."""
        oldest = frame if self._looking_at is None else max(self._looking_at, frame - _MOST_FRAMES)
        for kept, first in ((self._seen, oldest), (self._poses, frame - 1)):
            for old in [number for number in kept if number < first]:
                del kept[old]
