"""The stage beside optical flow: rough depth of a stereo pair, then the mask of the frame, in a worker of its own."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.config.schema import Config
from jaxslam.dynamics.point_mask import mask_around, moving_points
from jaxslam.geometry.se3 import IDENTITY, retract
from jaxslam.geometry.types import Pose
from jaxslam.masks.depth_instances import InstanceFinder
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.worker import Worker, make_worker
from jaxslam.semantics import Detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays, FrameMemory
from jaxslam.sensors.stereo_depth import RoughDepth
from jaxslam.slam.mask_pipeline import FrameMask, MaskPipeline, MaskSource
from jaxslam.tracking.state import TrackOutput
from jaxslam.tracking.step import FlowResult


class MaskStage:
    """Compute stereo depth and mask of each frame while the tracker follows points.

    Flow needs neither, and on two cores masks are ready before flow is. The order of calls for a frame is `begin`,
    `result`, `exclude_moving`, then `frame_tracked` or `frame_lost`, and `submit_for_detection`. The worker writes only
    to buffers of this object; the tracker sees them in what `result` returns, when the worker is idle.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config,
        memory: FrameMemory,
        detector: Detector | None,
        *,
        instances: InstanceFinder | None,
        times: StageTimes,
    ) -> None:
        """Start without a mask.

        Args:
            camera: Camera that takes the frames.
            config: Settings of the run, the detector and the masks.
            memory: Buffers of the frame, of which this stage sets the ignored pixels and the movable objects.
            detector: Detector that looks at every frame; `None` for none.
            instances: Finder of movable objects, where the tracker classifies their motion; `None` where all pixels of
                a mask are ignored.
            times: Record of the duration of every job.
        """
        self._memory, self._instances, self._times = memory, instances, times
        self._reach_px = config.dynamics.reach_px
        self._rough_depth = RoughDepth(camera) if camera.is_stereo else None
        self._pipeline = _mask_pipeline(camera, config, detector, times)
        self._found: FrameMask | None = None
        idle = self._pipeline is None and self._rough_depth is None
        self._worker: Worker[tuple[str, Callable[[], None]], None] = make_worker(
            self._run_job, "jaxslam-masks", deterministic=config.run.in_turn or idle, latency_frames=0, urgent=True
        )

    def compile(self) -> None:
        """Compile all that masks need."""
        if self._pipeline is not None:
            self._pipeline.compile()

    def begin(self, number: int, frame: Frame, arrays: FrameArrays, correction: Float[np.ndarray, "7"]) -> None:
        """Start to compute the depth of a stereo pair and the mask of a frame.

        Args:
            number: Number of the frame.
            frame: The frame.
            arrays: Its arrays; they must not change until `result` returns.
            correction: Correction of the world `(7,)` since the frame before.
        """
        depth = np.asarray(arrays.depth)
        if self._matches_pair(frame):
            assert self._memory.matched_depth is not None
            depth = self._memory.matched_depth
            self._worker.submit(("match pair", partial(self._match_pair, frame, depth)), number)
        self._worker.submit(("masks", partial(self._find_mask, number, frame, arrays, depth, correction)), number)

    def result(self, frame: Frame, arrays: FrameArrays) -> tuple[FrameArrays, FrameMask]:
        """Wait for the worker and return the frame with its depth and its ignored pixels, and its mask.

        Pixels that the caller has masked are ignored in any case.

        Args:
            frame: The frame that `begin` got.
            arrays: Its arrays.

        Raises:
            Exception: Error of a job of the worker.
        """
        self._worker.flush()
        assert self._found is not None
        if self._matches_pair(frame):
            depth: Any = self._memory.matched_depth
            arrays = arrays._replace(depth=depth)
        return self._with_ignored(arrays, self._found, frame.dynamic_mask), self._found

    def exclude_moving(
        self, arrays: FrameArrays, mask: FrameMask, flow: FlowResult, output: TrackOutput
    ) -> tuple[FrameArrays, FrameMask]:
        """Add everything that dynamic cues found moving to the mask, so that the map gets nothing of it.

        Args:
            arrays: Arrays of the frame.
            mask: Its mask.
            flow: Points followed into the frame.
            output: Output of the tracker's step for the frame.
        """
        if self._instances is not None:  # movable objects at rest leave the mask
            mask = mask._replace(mask=np.array(arrays.ignore))
        moving = None if output.moving is None else np.asarray(output.moving)
        points = moving_points(output.cue_results)
        around_points = self._reach_px > 0 and points.any()
        if not around_points and (moving is None or not moving.any()):
            return arrays, mask
        both = mask.mask.copy() if moving is None else mask.mask | moving
        if around_points:
            mask_around(both, np.asarray(flow.uv)[:, points], np.asarray(arrays.depth), self._reach_px)
        mask = mask._replace(mask=both, source=mask.source or MaskSource.CUES)
        return self._memory.ignoring(arrays, mask.mask), mask

    def frame_tracked(
        self,
        number: int,
        time_s: float,
        T_world_cam: Float[np.ndarray, "7"],
        twist: Float[np.ndarray, "6"],
        depth_delay_s: float,
    ) -> None:
        """Compare the depth of a tracked frame with the surfaces seen before, in the worker.

        Args:
            number: Number of the frame.
            time_s: Its time in seconds.
            T_world_cam: `(7,)` pose of the camera when the image of the frame was taken.
            twist: Velocity of the camera in its own axes: translation (m/s), then rotation (rad/s).
            depth_delay_s: Time from the image to the depth of the frame, in seconds.
        """
        if self._pipeline is not None:
            when_depth_was_taken = retract(T_world_cam, twist * depth_delay_s)
            turn_rad_per_s = float(np.linalg.norm(twist[3:]))
            job = partial(self._pipeline.frame_tracked, number, time_s, when_depth_was_taken, turn_rad_per_s)
            self._worker.submit(("masks", job), number)

    def frame_lost(self, number: int) -> None:
        """Forget the surfaces seen before: the pose of a frame is unknown."""
        if self._pipeline is not None:
            self._worker.submit(("masks", partial(self._pipeline.frame_lost, number)), number)

    def submit_for_detection(self, number: int, image: np.ndarray) -> None:
        """Give the frame to the detector if that is idle; see `MaskPipeline.submit_for_detection`."""
        if self._pipeline is not None:
            self._pipeline.submit_for_detection(number, image)

    def close(self) -> None:
        """End the threads."""
        if self._pipeline is not None:
            self._pipeline.close()
        self._worker.close()

    def _run_job(self, job: tuple[str, Callable[[], None]]) -> None:
        """Run a job and record its duration under its stage."""
        stage, work = job
        watch = self._times.stopwatch()
        try:
            work()
        finally:
            watch.ends(stage)

    def _matches_pair(self, frame: Frame) -> bool:
        """Return whether the depth of a frame comes from matching its stereo pair here."""
        return self._rough_depth is not None and frame.depth_m is None

    def _match_pair(self, frame: Frame, depth: np.ndarray) -> None:
        assert self._rough_depth is not None
        assert frame.right is not None
        np.copyto(depth, self._rough_depth.of(frame.image, frame.right))

    def _find_mask(self, number: int, frame: Frame, arrays: FrameArrays, depth: np.ndarray, correction: Pose) -> None:
        given = frame.dynamic_mask
        if self._pipeline is None:
            source = MaskSource.NONE if given is None else MaskSource.CALLER
            self._found = FrameMask(np.asarray(arrays.ignore), source, -1, "")
            return
        if not np.array_equal(correction, IDENTITY):
            self._pipeline.apply_map_correction(correction)
        mask = self._pipeline.mask_frame(number, frame.image, np.asarray(arrays.image), depth)
        if given is not None:
            mask = mask._replace(mask=mask.mask | given, source=mask.source or MaskSource.CALLER)
        self._found = mask

    def _with_ignored(
        self, arrays: FrameArrays, found: FrameMask, given: Bool[np.ndarray, "h w"] | None
    ) -> FrameArrays:
        """Ignore masked pixels; where the tracker classifies movable objects, number those instead."""
        mask = found.mask
        if self._instances is None:
            return self._memory.ignoring(arrays, mask)
        by_detector = mask if given is None else mask & ~given
        objects = self._instances.divided(by_detector, np.asarray(arrays.depth), found.labels, found.age)
        arrays = self._memory.with_movable(arrays, objects.labels)
        return self._memory.ignoring(arrays, objects.rest if given is None else objects.rest | given)


def _mask_pipeline(camera: Camera, config: Config, detector: Detector | None, times: StageTimes) -> MaskPipeline | None:
    """Make the mask pipeline, if a detector looks at every frame or new surfaces count as moving."""
    if detector is None and not config.dynamics.new_surfaces:
        return None
    return MaskPipeline(camera, detector, config, times=times)
