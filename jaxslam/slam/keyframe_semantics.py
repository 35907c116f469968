"""The detector on keyframes alone, in a thread of its own: what may move leaves keyframe and map when it is found.

Source: Ji, Wang and Xie, "Towards Real-time Semantic RGB-D SLAM in Dynamic Environments" (TRS-SLAM), 2021, section
III-A. Nobody waits for it: until a keyframe has been looked at, it is taken as it is.
"""

import logging
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.config.schema import Config
from jaxslam.map.dynamic_removal import DynamicObservations, under
from jaxslam.mapping.local_mapping import TrackedObservations
from jaxslam.masks.box_to_mask import dilated, mask_of_detections, reduced_detections
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.worker import Worker, make_worker
from jaxslam.semantics import Detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.downscale import Downscaler, ImageGrid
from jaxslam.slam.mask_pipeline import WIDTH_PX
from jaxslam.slam.semantic_thread import ErrorLog, rgb_copy

_log = logging.getLogger(__name__)

_MAX_WAITING = 32
"""Keyframes that wait for the detector. A late mask still cleans the map, so few would do harm; so many are 40 MB at
640x480, and ten seconds of a tracker that makes three a second. When more come, the one that has waited longest is
never looked at: the tracker is done with it, and what others see of the same objects is removed with them."""


class _KeyframeImage(NamedTuple):
    """A keyframe for the detector, its own copy.

    Attributes:
        keyframe: Its id, or `NONE`.
        image: `(h, w, 3)` RGB.
        depth: `(h', w')` meters, at the size of masks.
        id: `(n,)` the tracker's numbers of the points it saw,
        uv_raw: `(2, n)` and where, pixels.
    """

    keyframe: int
    image: np.ndarray
    depth: np.ndarray
    id: np.ndarray
    uv_raw: np.ndarray


class KeyframeSemantics:
    """Looks at one keyframe after the other, in their order.

    Attributes:
        worker: The worker that runs the detector.
    """

    def __init__(
        self,
        camera: Camera,
        detector: Detector,
        config: Config,
        times: StageTimes | None = None,
    ) -> None:
        """Begin idle.

        Args:
            camera: Camera that takes the frames.
            detector: Detector of movable objects.
            config: Settings in effect: masks are dilated by `semantics.dilate_px`. A deterministic run has results
                `semantics.latency_frames` later, or with the next frame if that is 0; others use a thread.
            times: Record of the duration of every detection.
        """
        self._detector, self._dilate_px = detector, config.semantics.dilate_px
        self._reduced, self._failures = Downscaler(ImageGrid.of(camera), WIDTH_PX), ErrorLog()
        self._has_warned = False
        self.worker: Worker[_KeyframeImage, DynamicObservations] = make_worker(
            (times or StageTimes()).timed("detector", self._look),
            "jaxslam-semantics",
            deterministic=config.run.in_turn,
            latency_frames=config.semantics.latency_frames,
            max_waiting=_MAX_WAITING,
        )

    @property
    def num_passed_over(self) -> int:
        """Number of keyframes that the detector never looked at, because too many waited."""
        return self.worker.num_dropped

    def submit(
        self, keyframe: int, image: np.ndarray, depth: Float[np.ndarray, "h w"], tracks: TrackedObservations, frame: int
    ) -> None:
        """Have it look at a keyframe.

        Args:
            keyframe: Its id; `NONE` if it does not go into the map.
            image: `(h, w, 3)` RGB or `(h, w)`; copied.
            depth: Meters; copied.
            tracks: Points that the tracker saw in it.
            frame: Number of the frame.
        """
        seen = tracks.weight > 0
        points = tracks.id[seen].astype(np.int64), tracks.uv_raw[:, seen]
        own_copy = _KeyframeImage(keyframe, rgb_copy(image), self._reduced.every(depth).copy(), *points)
        self.worker.submit(own_copy, frame)
        if self.num_passed_over and not self._has_warned:
            self._has_warned = True
            _log.warning("the detector is slow: keyframes that waited too long are not looked at")

    def collect(self, frame: int) -> tuple[list[DynamicObservations], str]:
        """Return the results that are ready by a frame, in the order of the keyframes, and the last error, once."""
        return self._collected(lambda: self.worker.collect(frame))

    def flush(self) -> tuple[list[DynamicObservations], str]:
        """The same once all keyframes have been looked at; it waits for that, unless it is closed."""
        return self._collected(self.worker.flush)

    def _look(self, shown: _KeyframeImage) -> DynamicObservations:
        found = reduced_detections(self._detector(shown.image), self._reduced)
        small = mask_of_detections(found, shown.depth, float(self._reduced.raster.intrinsics.fx), dilate_px=0)
        mask = dilated(self._reduced.whole(small), self._dilate_px)
        return DynamicObservations(shown.keyframe, mask, shown.id[under(mask, shown.uv_raw)])

    def _collected(self, take: Callable[[], list[DynamicObservations]]) -> tuple[list[DynamicObservations], str]:
        found: list[DynamicObservations] = []
        error = ""
        while True:
            try:
                done = take()
            except Exception as wrong:  # whatever a network raises: tracking goes on without it
                error = self._failures.report(f"{type(wrong).__name__}: {wrong}")
                continue
            if not done:
                return found, error
            found += done
