"""Mask of movable objects in every frame: detections propagated to the present, and new surfaces in depth.

The tracker never waits for the detector: while it looks at one frame, the mask of an earlier one is propagated. What
goes wrong in the detector is told with the frame, and tracking goes on.
"""

import enum
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxslam_kernels.image.pyramid import Pyramid, build_pyramid
from jaxtyping import Bool, Float, UInt8

from jaxslam.config.schema import Config
from jaxslam.masks.background_depth import SurfaceMemory
from jaxslam.masks.box_to_mask import dilated
from jaxslam.masks.point_sampling import CornerKind
from jaxslam.masks.propagation import PYRAMID_LEVELS, follow, make_origin, predicted_mask
from jaxslam.runtime.aligned_memory import aligned_array
from jaxslam.runtime.compiled import committed, compiled
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.semantics import Detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.downscale import Downscaler, ImageGrid
from jaxslam.sensors.sensor_model import max_valid_depth
from jaxslam.slam.semantic_thread import DetectedMask, DetectionJob, SemanticThread

_MAX_FRAMES = 30
"""Frames kept for a detector that takes long; what it says of older ones is of no use."""
_TRUSTED_FRAMES = 5
"""Frames after a detection during which what stands still stays in the mask: a person may."""
_DEPTH_FRAMES = 15
"""Frames after one with depth during which the detector waits for the next such frame: depth divides boxes."""

WIDTH_PX = 320
"""Masks are made at about so many columns: one of a third of the image is carried on in 1.5 ms, at 640 in 5.4."""

_pyramid = compiled(when="warm-up")(partial(build_pyramid, num_levels=PYRAMID_LEVELS))


class MaskSource(enum.IntEnum):
    """Origin of the mask of a frame."""

    NONE = 0
    """There is none: nothing found yet, or nothing that looks."""
    DETECTOR = 1
    """What the detector found in this frame or in one it has just finished, carried to this one."""
    PROPAGATED = 2
    """The mask of the frame before, carried on, or left where it was; something in it the detector once found."""
    CALLER = 3
    """The caller's alone."""
    DEPTH = 4
    """What came before surfaces seen earlier, carried on from frame to frame; no detector has seen it."""
    CUES = 5
    """Surfaces of this frame that move by what dynamic cues say of their points, and nothing else."""


class FrameMask(NamedTuple):
    """Mask of a frame.

    Attributes:
        mask: `(h, w)` true where something moves or may.
        source: Origin of the mask.
        age: Frames since the one the detector looked at; 0 for that frame, -1 where it has no part in the mask.
        error: Error of the detector, reported once; empty if there is none.
        labels: `(h', w')` number of the object at each pixel, as in `instance_labels`, at the size of masks and in the
            frame that the detector looked at; `None` if it found nothing since the frame before.
    """

    mask: Bool[np.ndarray, "h w"]
    source: MaskSource
    age: int
    error: str
    labels: UInt8[np.ndarray, "_h _w"] | None = None


class _BufferedFrame:
    """Image and pyramid of a frame, at the size of masks."""

    def __init__(self, gray: np.ndarray) -> None:
        self.gray = gray
        self._pyramid: Pyramid | None = None

    @property
    def pyramid(self) -> Pyramid:
        """Its pyramid; most frames need none, because nothing is in their mask."""
        made = self._pyramid or committed(_pyramid(self.gray))  # as those that `follow` makes
        self._pyramid = made
        return made

    @pyramid.setter
    def pyramid(self, made: Pyramid) -> None:
        self._pyramid = made


class MaskPipeline:
    """Makes the mask of every frame."""

    def __init__(
        self,
        camera: Camera,
        detector: Detector | None,
        config: Config,
        *,
        times: StageTimes | None = None,
    ) -> None:
        """Start with no mask.

        Args:
            camera: Camera that takes the frames, whose largest valid depth bounds what is compared.
            detector: Detector of movable objects; `None` for none.
            config: Settings of the run, the detector and the masks, of which `dynamics.new_surfaces` adds what has
                come before surfaces seen earlier.
            times: Record of the duration of every detection.
        """
        self._propagate, self._new_surfaces = config.semantics.propagate, config.dynamics.new_surfaces
        self._dilate_px, self._seed = config.semantics.dilate_px, config.run.seed
        self._corners: CornerKind = config.semantics.mask_corners
        self._reduced = Downscaler(ImageGrid.of(camera), WIDTH_PX)
        self._semantics = None if detector is None else SemanticThread(detector, self._reduced, config, times)
        self._farthest_m = max_valid_depth(camera, config.track)
        self._surfaces = SurfaceMemory(self._reduced.raster, self._farthest_m)
        self._seen: dict[int, _BufferedFrame] = {}
        self._next: DetectedMask | None = None
        self._carried_from: tuple[int, np.ndarray] | None = None
        self._detected_in: int | None = None
        self._depth, self._level = (aligned_array(self._reduced.raster.shape, np.float32) for _ in range(2))
        self._level[:] = 1  # stands for the depth of a frame without any
        self._has_depth, self._depth_in = False, -_DEPTH_FRAMES
        self._mask = np.zeros(self._reduced.raster.shape, bool)

    def compile(self) -> None:
        """Compile all that masks need."""
        blank = np.zeros(self._mask.shape, np.uint8)
        pyramid = _BufferedFrame(blank).pyramid
        origin = make_origin(blank.view(bool), blank, 0)
        follow(origin, [pyramid] * 2, blank, blank.astype(np.float32))
        self._surfaces.compile()

    def mask_frame(self, frame: int, image: np.ndarray, gray: np.ndarray, depth: Float[np.ndarray, "h w"]) -> FrameMask:
        """The mask of the next frame.

        Args:
            frame: Its number.
            image: `(h, w, 3)` RGB or `(h, w)`.
            gray: `(h, w)` uint8; copied.
            depth: Meters; copied. A frame without any depth keeps the mask of the one before, moved by optical flow.
        """
        self._seen[frame] = _BufferedFrame(self._reduced.mean(gray))
        np.copyto(self._depth, self._reduced.every(depth))
        self._has_depth = bool((self._depth > 0).any())
        if self._has_depth:
            self._depth_in = frame
        found, error = None, ""
        if self._semantics is not None:
            found, error = self._semantics.newest(self._shown(frame, image), looks=self._detects_in(frame))
        source = self._update_mask(frame, found)
        self._forget(frame)
        if not self._mask.any():  # and so nothing is carried on
            self._detected_in, source = None, MaskSource.NONE
        age = -1 if self._detected_in is None else frame - self._detected_in
        labels = found.labels if found is not None and source is MaskSource.DETECTOR else None
        return FrameMask(dilated(self._reduced.whole(self._mask), self._dilate_px), source, age, error, labels)

    def frame_tracked(
        self, frame: int, time_s: float, T_world_cam: Float[np.ndarray, "7"], turn_rad_per_s: float
    ) -> None:
        """Put the mask right before it is carried on to the next frame, now that it is known where the camera was.

        What stood outside the mask before leaves it, and new_surfaces are added.

        Args:
            frame: Number of the last frame, which was tracked.
            time_s: Its time.
            T_world_cam: `(7,)` pose of the camera when the depth of the frame was taken.
            turn_rad_per_s: Angular speed of the camera.
        """
        if self._has_depth:
            self._correct_by_depth(frame, time_s, T_world_cam, turn_rad_per_s)
        self._prepare(frame + 1)

    def _correct_by_depth(
        self, frame: int, time_s: float, T_world_cam: Float[np.ndarray, "7"], turn_rad_per_s: float
    ) -> None:
        """Compare the depth of the last frame with that of earlier ones, correct its mask by it, and store both."""
        seen = self._surfaces.compare(time_s, T_world_cam, turn_rad_per_s, self._depth, self._carried_from)
        if self._carried_from is not None and self._propagate:
            if self._detected_in is not None and frame - self._detected_in <= _TRUSTED_FRAMES:
                self._mask = self._surfaces.without(self._mask, seen.outside)
            else:
                # While nothing is detected, what only stands there may never have been part of an object, unless it
                # has appeared lately; and what has appeared is part of one as a whole.
                self._mask = self._surfaces.without(self._mask, (seen.outside | seen.still) & ~seen.appeared)
                self._mask = self._surfaces.with_lost_parts(self._mask, seen)
        if self._new_surfaces:
            self._mask = self._surfaces.with_new_surfaces(self._mask, seen)
        self._surfaces.remember(frame, time_s, T_world_cam, turn_rad_per_s, self._mask)

    def frame_lost(self, frame: int) -> None:
        """Take in that nobody knows where the camera was in the last frame."""
        self._surfaces.forget()
        self._prepare(frame + 1)

    def submit_for_detection(self, frame: int, image: np.ndarray) -> None:
        """Have the detector look at the frame that was made the mask of last, if it is idle.

        To be called when the frame has been tracked: until the next one there is time, and a network that runs beside
        the tracker on two cores costs it a sixth of its speed (YOLOX-nano on Bonn `crowd`: 7.1 ms a step, not 5.9).

        Args:
            frame: Its number.
            image: `(h, w, 3)` RGB or `(h, w)`; copied.
        """
        if self._semantics is not None and self._detects_in(frame):
            self._semantics.submit(self._shown(frame, image))

    def apply_map_correction(self, T_new_old: Float[np.ndarray, "7"]) -> None:
        """Take in that the world was moved."""
        self._surfaces.correct(T_new_old)

    def close(self) -> None:
        """End the thread."""
        if self._semantics is not None:
            self._semantics.close()

    def _detects_in(self, frame: int) -> bool:
        """Return whether the detector may look at a frame: it has depth, or there has been none for a while."""
        return self._has_depth or frame - self._depth_in >= _DEPTH_FRAMES

    def _shown(self, frame: int, image: np.ndarray) -> DetectionJob:
        return DetectionJob(frame, image, self._seen[frame].gray, self._depth)

    def _update_mask(self, frame: int, found: DetectedMask | None) -> MaskSource:
        """Bring the mask to this frame, from where the detector has looked or from the frame before."""
        prepared, self._next, self._carried_from = self._next, None, None
        if found is not None and found.frame in self._seen and (found.origin.mask.any() or not self._propagate):
            self._detected_in = found.frame
            self._mask = self._carried(found, frame)
            if found.frame != frame:
                self._carried_from = found.frame, found.origin.mask
            return MaskSource.DETECTOR
        if self._mask.any():
            self._carried_from = frame - 1, self._mask
            origin = prepared or self._detected_now(frame)
            if origin is not None:
                self._mask = self._carried(origin, frame)
        return MaskSource.DEPTH if self._detected_in is None else MaskSource.PROPAGATED

    def _prepare(self, frame: int) -> None:
        """Choose the points by which the mask is carried on to a frame, the next one.

        A detector as fast as the camera will have looked by then; else it is done when that comes.
        """
        if self._detected_in != frame - 2:
            self._next = self._detected_now(frame)

    def _detected_now(self, frame: int) -> DetectedMask | None:
        """The mask as it is carried on to a frame, if it can be."""
        before = self._seen.get(frame - 1)
        if before is None or not self._propagate or not self._mask.any():
            return None
        return DetectedMask(frame - 1, make_origin(self._mask, before.gray, self._seed + frame, self._corners))

    def _carried(self, found: DetectedMask, frame: int) -> np.ndarray:
        if found.frame == frame or not self._propagate:
            return found.origin.mask
        pyramids = [self._seen[between].pyramid for between in range(found.frame, frame)]
        now = self._seen[frame]
        depth = self._depth if self._has_depth else None
        now.pyramid, followed = follow(found.origin, pyramids, now.gray, self._level if depth is None else depth)
        return predicted_mask(found.origin, followed, depth, self._farthest_m)

    def _forget(self, frame: int) -> None:
        """Drop what no mask can come from any more."""
        looking_at = None if self._semantics is None else self._semantics.looking_at
        oldest = frame if looking_at is None else max(looking_at, frame - _MAX_FRAMES)
        for old in [number for number in self._seen if number < oldest]:
            del self._seen[old]
