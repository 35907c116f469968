"""Where things that move are in every frame: what a detector finds, carried to the present, and what depth shows.

The tracker never waits for the detector: while it looks at one frame, the mask of an earlier one is propagated. What
goes wrong in the detector is told with the frame, and tracking goes on.
"""

import enum
import math
from typing import NamedTuple

import jax
import numpy as np
from jaxslam_kernels.image import Pyramid, build_pyramid
from jaxtyping import Bool, Float

from jaxslam.camera import Camera
from jaxslam.masks.box_mask import dilated
from jaxslam.masks.propagation import CAPACITY, MaskAt, follow, predicted_mask
from jaxslam.masks.sampling import sample_mask
from jaxslam.masks.surfaces import SurfaceMemory
from jaxslam.semantic_thread import SemanticThread
from jaxslam.semantics import Detector

_MOST_FRAMES = 30
"""Frames kept for a detector that takes long; what it says of older ones is of no use."""
_TRUSTED_FRAMES = 5
"""Frames after a detection during which what stands still stays in the mask: a person may."""

_pyramid = jax.jit(build_pyramid)


class MaskSource(enum.IntEnum):
    """Where the mask of a frame comes from."""

    NONE = 0
    """There is none: nothing found yet, or nothing that looks."""
    DETECTOR = 1
    """What the detector found in this frame or in one it has just finished, carried to this one."""
    PROPAGATED = 2
    """The mask of the frame before, carried on; something in it was once found by the detector."""
    CALLER = 3
    """The caller's alone."""
    DEPTH = 4
    """What came before surfaces seen earlier, carried on from frame to frame; no detector has seen it."""


class FrameMask(NamedTuple):
    """What a frame's mask is.

    Attributes:
        mask: `(h, w)` true where something moves or may.
        source: Where it comes from.
        age: Frames since the one the detector looked at; 0 for that frame, -1 where it has no part in the mask.
        error: What went wrong in the detector, told once; empty if nothing did.
    """

    mask: Bool[np.ndarray, "h w"]
    source: MaskSource
    age: int
    error: str


class _Seen:
    """What is kept of a frame."""

    def __init__(self, grey: np.ndarray) -> None:
        self.grey = grey.copy()
        self._pyramid: Pyramid | None = None

    @property
    def pyramid(self) -> Pyramid:
        """Its pyramid; most frames need none, because nothing is in their mask."""
        made = self._pyramid or _pyramid(self.grey)
        self._pyramid = made
        return made


class DynamicMasks:
    """Makes the mask of every frame."""

    def __init__(
        self,
        camera: Camera,
        detector: Detector | None,
        *,
        deterministic: bool,
        latency_frames: int,
        propagate: bool = True,
        newcomers: bool = True,
        farthest_m: float = math.inf,
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
            newcomers: Add what has come before surfaces seen earlier.
            farthest_m: Depth beyond says nothing of those.
            dilate_px: How far a mask reaches beyond what was found.
            seed: Of random choices.
        """
        self._propagate, self._newcomers, self._dilate_px, self._seed = propagate, newcomers, dilate_px, seed
        self._semantics = (
            None
            if detector is None
            else SemanticThread(detector, deterministic=deterministic, latency_frames=latency_frames)
        )
        self._surfaces = SurfaceMemory(camera, farthest_m)
        self._seen: dict[int, _Seen] = {}
        self._detected_in: int | None = None
        self._mask = np.zeros((camera.height, camera.width), bool)

    def compile(self) -> None:
        """Compile all that masks need."""
        blank = np.zeros(self._mask.shape, np.uint8)
        pyramid = _pyramid(blank)
        followed = follow([pyramid, pyramid], np.zeros((2, 1), np.float32))
        predicted_mask(blank.view(bool), followed, blank.astype(np.float32))
        self._surfaces.compile()

    def of_frame(
        self,
        frame: int,
        time_s: float,
        image: np.ndarray,
        grey: np.ndarray,
        depth: Float[np.ndarray, "h w"],
        T_world_cam: Float[np.ndarray, "7"] | None,
        turn_rad_per_s: float,
    ) -> FrameMask:
        """The mask of the next frame.

        Args:
            frame: Its number.
            time_s: Its time.
            image: `(h, w, 3)` RGB or `(h, w)`.
            grey: `(h, w)` uint8; copied.
            depth: Metres.
            T_world_cam: Where the camera is thought to be when the depth is taken, `None` if that is too uncertain,
            turn_rad_per_s: and how fast it turns.
        """
        self._seen[frame] = _Seen(grey)
        found, error = (None, "") if self._semantics is None else self._semantics.of_frame(frame, image, depth)
        source, carried = self._carry(frame, found, depth)
        seen = self._surfaces.compare(time_s, T_world_cam, turn_rad_per_s, depth, carried)
        if carried is not None and self._propagate:
            # While nothing is detected, what only stands there may never have been part of an object.
            lately = self._detected_in is not None and frame - self._detected_in <= _TRUSTED_FRAMES
            self._mask = self._surfaces.without(self._mask, seen.outside if lately else seen.outside | seen.still)
        if self._newcomers:
            self._mask = self._surfaces.with_newcomers(self._mask, seen)
        self._forget(frame)
        return self._told(frame, source, error)

    def tracked(self, frame: int, time_s: float, T_world_cam: Float[np.ndarray, "7"], turn_rad_per_s: float) -> None:
        """Take in where the camera was when the depth of the frame was taken, and how fast it turned."""
        self._surfaces.remember(frame, time_s, T_world_cam, turn_rad_per_s, self._mask)

    def corrected(self, T_new_old: Float[np.ndarray, "7"]) -> None:
        """Take in that the world was moved."""
        self._surfaces.correct(T_new_old)

    def lost(self) -> None:
        """Take in that nobody knows where the camera is."""
        self._surfaces.forget()

    def close(self) -> None:
        """End the thread."""
        if self._semantics is not None:
            self._semantics.close()

    def _carry(self, frame: int, found: MaskAt | None, depth: np.ndarray) -> tuple[MaskSource, MaskAt | None]:
        """Bring the mask to this frame, from where the detector has looked or from the frame before; and what from."""
        if found is not None and found.frame in self._seen and (found.mask.any() or not self._propagate):
            self._detected_in = found.frame
            self._mask = self._carried(found, frame, depth)
            return MaskSource.DETECTOR, found if found.frame != frame else None
        if not self._mask.any():
            return MaskSource.DEPTH, None
        before = MaskAt(frame - 1, self._mask)
        self._mask = self._carried(before, frame, depth)
        return MaskSource.DEPTH if self._detected_in is None else MaskSource.PROPAGATED, before

    def _carried(self, found: MaskAt, frame: int, depth: np.ndarray) -> np.ndarray:
        if found.frame == frame or not self._propagate or found.frame not in self._seen:
            return found.mask
        sampled = sample_mask(found.mask, self._seen[found.frame].grey, CAPACITY, self._seed + frame)
        pyramids = [self._seen[between].pyramid for between in range(found.frame, frame + 1)]
        return predicted_mask(found.mask, follow(pyramids, sampled), depth)

    def _told(self, frame: int, source: MaskSource, error: str) -> FrameMask:
        """The mask as it is used. Of one that is empty, nothing is carried on."""
        if not self._mask.any():
            self._detected_in, source = None, MaskSource.NONE
        age = -1 if self._detected_in is None else frame - self._detected_in
        return FrameMask(dilated(self._mask, self._dilate_px), source, age, error)

    def _forget(self, frame: int) -> None:
        """Drop what no mask can come from any more."""
        looking_at = None if self._semantics is None else self._semantics.looking_at
        oldest = frame if looking_at is None else max(looking_at, frame - _MOST_FRAMES)
        for old in [number for number in self._seen if number < oldest]:
            del self._seen[old]
