"""`Slam`: tracks a camera frame by frame, and maps what it sees."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxslam.config.schema import Config
from jaxslam.datasets import Dataset
from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.map.npz_file import load_map, save_map
from jaxslam.map.types import Map
from jaxslam.masks.depth_instances import InstanceFinder
from jaxslam.runtime.compile_cache import enable_compile_cache
from jaxslam.runtime.platform_choice import warn_unless_cpu
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.threads import bound_threads, shorten_switch_interval
from jaxslam.semantics import Detector
from jaxslam.semantics.checked_detector import CheckedDetector
from jaxslam.semantics.from_config import detector_of, key_detector_of, network_files, why_no_network
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.depth_correction import with_corrected_depth
from jaxslam.sensors.frame import Frame, check_frame
from jaxslam.sensors.frame_arrays import FrameArrays, FrameMemory
from jaxslam.sensors.imu import ImuSheet
from jaxslam.sensors.motion_prior import MotionPrior
from jaxslam.slam.argument_checks import check_arguments, check_prior, warn_of_other_camera
from jaxslam.slam.back_end import BackEnd
from jaxslam.slam.background_consistency import BackgroundConsistency
from jaxslam.slam.call_guard import one_at_a_time, refuse_after_fork
from jaxslam.slam.frame_clock import FrameClock
from jaxslam.slam.frame_records import FrameRecords
from jaxslam.slam.frame_result import FrameResult, Rejected, frame_result
from jaxslam.slam.input_checks import InputChecks
from jaxslam.slam.input_warnings import InputWarnings
from jaxslam.slam.localization_stage import LocalizationStage
from jaxslam.slam.mask_stage import MaskStage
from jaxslam.slam.outside_motion import OutsideMotion
from jaxslam.slam.pose_history import PoseHistory
from jaxslam.slam.pose_uncertainty import PoseUncertainty
from jaxslam.slam.program_compiler import ProgramCompiler
from jaxslam.slam.recording_run import run_recording
from jaxslam.slam.status_log import StatusLog
from jaxslam.slam.tracker import Tracker
from jaxslam.tracking.points import TrackedPoints
from jaxslam.tracking.state import TrackReason, TrackStatus
from jaxslam.trajectory.trajectory import PathLike, Trajectory

_MASKED = 0.95
"""Share of the image under a mask beyond which the mask is the reason for a loss."""


class Slam:
    """Tracks a camera through a scene, frame by frame, and maps it.

    The world frame is the camera frame of the first image, or the frame of the map that it starts with. Calls from
    several threads are serialized. A process made by `fork` cannot use it (`RuntimeError`); one made by `spawn` can.
    With `run.deterministic`, everything runs in the calling thread on a fixed schedule; without it, mapping and loop
    closing run in threads of their own, which `close` (or `with`) ends.

    Attributes:
        camera: Camera that takes the frames.
        config: Settings in effect.
        without_network: Reason why no network segments the frames, as part of a sentence; `None` if one, or a
            `detector`, does.
        networks: Files of the networks that segment the frames, by setting; `None` for one that is missing. It is empty
            with a `detector`.
        dense_mapping: Thread of the dense map; `None` without `dense.enabled`, or with `localize_only`.
        times: Durations of the stages of every frame: `take over` map corrections, `flow`, `wait for mask`, `pose`,
            `match with map`, and `hand over` to mapping and the detector; and of the jobs of other threads: `match
            pair` of a stereo camera, `masks`, `detector`, `mapping`, `places`, `adjustment`, `dense` and its parts. In
            a deterministic run, jobs count towards stages as well: `match pair` in `flow`, `masks` in `flow` and `hand
            over`, the others in `hand over` or `take over`.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        *,
        slam_map: Map | None = None,
        localize_only: bool = False,
        detector: Detector | None = None,
        key_detector: Detector | None = None,
        imu: ImuSheet | None = None,
    ) -> None:
        """Prepare to track a camera; programs are compiled from the first frame on, or in `warm_up`.

        Args:
            camera: Camera that takes the frames.
            config: Settings; those of the default preset if not given.
            slam_map: Map to start with; frames are `LOST` until the place of one is recognized in it.
            localize_only: Track in the map without changing it.
            detector: Detector of movable objects, instead of the network of the settings.
            key_detector: Detector of the objects that the dense map keeps at full density, instead of the network with
                `dense.key_classes`.
            imu: Data sheet of the IMU whose samples come with the frames, with the place of the camera on it, such as
                `imu` of a recording. Its angular rates predict how the camera turns; their bias is estimated.

        Raises:
            TypeError: If an argument has the wrong type, such as the name of a camera or preset.
            ConfigError: If `localize_only` is set without a map.
            MapFileError: If the map is of a camera of another size.
            RuntimeError: In a process made by `fork`.
            MissingModelError: If the network of the settings is not on this machine and `semantics.missing_model` does
                not allow that, as in presets of systems that need one (`ngd`, `rts`, `usd`, `occlusion`). By default
                the default network may be missing: a warning is logged, and geometry alone decides.
            ModelError: If the network of the settings cannot be used.
        """
        refuse_after_fork()
        detectors = {"detector": detector, "key_detector": key_detector}
        check_arguments(camera, config, slam_map, detectors, imu, localize_only=localize_only)
        self.call_lock = threading.RLock()
        self.camera = camera
        self.config = config or Config()
        self._imu = imu
        # An empty map knows no place: with it, no frame would ever be tracked.
        self._start_map, self._localize_only = (
            slam_map if slam_map is not None and len(slam_map.ids) else None,
            localize_only,
        )
        bound_threads(self.config.run.threads)
        if not self.config.run.in_turn:
            shorten_switch_interval()
        warn_unless_cpu()
        enable_compile_cache()
        self._tracker = Tracker(camera, self.config)
        self._detector = _watched(detector or detector_of(self.config.semantics, self.config.run.threads))
        self.without_network = None if self._detector is not None else why_no_network(self.config.semantics)
        self.networks = network_files(self.config.semantics) if detector is None else {}
        self._key_detector = _watched(key_detector or key_detector_of(self.config))
        motion = self._tracker.plan.motion
        self._memory = FrameMemory(camera.height, camera.width, pairs=camera.is_stereo, movable=motion is not None)
        self._instances = None if motion is None else InstanceFinder(camera, motion.num_objects)
        self._programs = ProgramCompiler(self._tracker, camera, waits=self.config.run.in_turn)
        self._begin()

    @classmethod
    def load(
        cls, path: PathLike, camera: Camera | None = None, config: Config | None = None, *, localize_only: bool = False
    ) -> "Slam":
        """Start with a map that `save` wrote.

        Args:
            path: Map file.
            camera: Camera that takes the frames; the camera of the map if not given.
            config: Settings; those of the default preset if not given.
            localize_only: Track in the map without changing it.

        Raises:
            MapFileError: If the file is missing, damaged, of another kind, or of a camera of another size.
        """
        slam_map = load_map(path)
        return cls(camera or slam_map.camera, config, slam_map=slam_map, localize_only=localize_only)

    @one_at_a_time
    def save(self, path: PathLike) -> None:
        """Wait until mapping has caught up, and write the map to a file that `load` reads.

        Raises:
            MapFileError: If it cannot be written; an existing file is then left as it was.
        """
        self.finish()
        save_map(path, self.map)

    @one_at_a_time
    def reset(self) -> None:
        """Forget all frames and the map made of them; the next frame is the first one again."""
        self.close()
        self._begin()

    @one_at_a_time
    def warm_up(self) -> float:
        """Compile every program, or load it from the cache of an earlier run; return `compile_s`.

        If compiling has begun with the first frame, this waits for the rest of it. Later calls do nothing and return
        the same number.

        Raises:
            Exception: Error of compiling; the next call tries again.
        """
        return self._programs.compile_all()

    @one_at_a_time
    def track(self, frame: Frame, prior: MotionPrior | None = None) -> FrameResult:
        """Track one frame.

        The first call compiles what tracking itself needs. All else is compiled in a thread meanwhile: keyframes wait
        for it, frames that are lost or weak stay so, and a map to start with is not looked into. With
        `run.deterministic`, a frame waits for what it needs instead. After `warm_up`, nothing is left to compile, but
        for global bundle adjustment, whose thread compiles when the first loop is closed.

        Args:
            frame: Image with depth, or a stereo pair, of the size of the camera and later than the frame before.
            prior: Motion of the camera since the frame of the last call, from wheel odometry for example. With its
                covariance it is one term of the pose, and optical flow begins from it. Where it is not given, the IMU
                tells how the camera turned, if there is one.

        Returns:
            The pose with its status and covariance. A frame that cannot be tracked, such as a black one, is no error:
            its status is `LOST`.

        Raises:
            FrameError: If the frame does not fit the camera, or is not later than the frame before. The state is
                unchanged; go on with the next frame.
            TypeError: If `prior` is no `MotionPrior`.
            RuntimeError: After `close`, or in a process made by `fork`.
            Exception: Error of a job of mapping or loop closing, or of compiling in the thread.
        """
        check_frame(frame, self.camera.width, self.camera.height, pair=self.camera.is_stereo)
        self._clock.check(frame.timestamp_ns, frame.depth_timestamp_ns)
        check_prior(prior)
        frame = with_corrected_depth(frame, self.camera)
        self._programs.prepare(self._frame)
        began, watch = time.perf_counter(), self.times.stopwatch()
        self._input_checks.look(frame)

        # 1. Take over what mapping and loop closing have corrected since the frame before.
        self._tracker.state, correction = self._back.update(self._tracker.state, self._frame)
        dt_s = self._clock.elapsed_s(frame.timestamp_ns)
        arrays = self._memory.hold(frame, dt_s, depth_follows=frame.depth_m is None and self.camera.is_stereo)
        watch.ends("take over")

        # 2. Optical flow; beside it, a worker computes the stereo depth and the mask.
        self._masks.begin(self._frame, frame, arrays, correction)
        measured = self._outside_motion.of_frame(frame, prior, dt_s)
        flow = self._tracker.follow(arrays, measured=measured)
        watch.ends("flow")

        # 3. Mask: ignore pixels of movable objects.
        arrays, mask = self._masks.result(frame, arrays)
        watch.ends("wait for mask")

        # 4. Pose: dynamic cues, RANSAC PnP and refinement.
        output = self._tracker.advance(arrays, flow, self._back.wishes)
        watch.ends("pose")

        # 5. Match features of a lost frame with the last one, or relocalize it; match a weak one with the local map.
        outside = None
        if int(output.status) == TrackStatus.LOST:
            outside = None if measured is None else np.asarray(flow.predicted.wxyz_xyz, np.float64)
            again = self._localization.track_again(arrays, flow, measured)
            flow, output = again or (flow, output)
        if int(output.status) != TrackStatus.LOST:  # cues go by a wrong motion while the pose is not known
            arrays, mask = self._masks.exclude_moving(arrays, mask, flow, output)
        output, num_matched, recognized = self._localization.localize(arrays, output, dt_s, outside)
        lost = int(output.status) == TrackStatus.LOST
        share = None if lost else self._back.update_occlusion(arrays, output)
        watch.ends("match with map")

        # 6. Hand over: keyframe to the map, frame to the dense map and the detector.
        self._back.hand_over(frame, arrays, output, self._frame, recognized)
        mask = mask._replace(error=mask.error or self._back.latest_error())
        result = frame_result(frame.timestamp_ns, output, correction, num_matched, mask, share)
        result = self._in_submap(result)
        if self._background is not None:
            result = self._background.check(result, arrays, output, self._back.map.next_point)
        self._clock.advance(frame.timestamp_ns)
        result = self._recorded(result, dt_s, arrays)
        covariance = self._uncertainty.of_pose(result, output, self._tracker.state.keyframes)
        self._masks.submit_for_detection(self._frame, frame.image)
        self._frame += 1
        self._back.dispatch_jobs()
        watch.ends("hand over")
        self.times.frame_ends(is_keyframe=result.is_keyframe)
        track_ms = (time.perf_counter() - began) * 1e3
        return replace(result, covariance=covariance, track_ms=track_ms, warnings=self._warnings.taken())

    def run(
        self, dataset: Dataset, on_frame: Callable[[Frame | None, FrameResult | Rejected], None] | None = None
    ) -> FrameRecords:
        """Track a whole recording.

        A frame that cannot be read or does not fit is reported as `Rejected`, and the run goes on. With `run.realtime`,
        frames that come while another one is tracked are reported so too, with the status `DROPPED`.

        Args:
            dataset: Recording of this camera.
            on_frame: Function called after every frame, for progress and pictures; the frame is `None` if it could not
                be read.

        Returns:
            One record per frame: its result without arrays.

        Raises:
            DatasetError: If `dataset` is not a recording, or is one of another camera.
        """
        return run_recording(self, dataset, on_frame)

    @one_at_a_time
    def finish(self) -> None:
        """Wait for mapping, loop closing and a detector of keyframes, so that `map` and `trajectory` are complete."""
        self._programs.finish()
        self._tracker.recover()  # from a step that Ctrl-C ended
        self._tracker.state = self._back.finish(self._tracker.state)

    @one_at_a_time
    def adjust_map(self) -> None:
        """Adjust all keyframes and points of the map together (global bundle adjustment), and wait until that is done.

        After a loop, this happens by itself, beside tracking (`mapping.global_adjustment`). Mapping catches up first,
        as in `finish`, and what is not compiled yet is compiled. The first keyframe of each submap stays where it is;
        `trajectory` moves with the keyframes, and the next result has the `correction`.

        Raises:
            RuntimeError: With `localize_only`, which leaves the map unchanged, or after `close`.
            Exception: Error of compiling, or of a job of mapping.
        """
        if self._localize_only:
            raise RuntimeError("adjust_map: the map stays as it is with localize_only")
        self._back.check_open()
        self._programs.compile_all()
        self.finish()
        self._tracker.state = self._back.adjust_map(self._tracker.state)

    def close(self) -> None:
        """End the threads, within two seconds; before another frame can be tracked, call `reset`.

        A program that is being compiled cannot be interrupted: its thread, and a process that ends, end after it.
        """
        self._programs.stop()
        self._back.close()
        self._masks.close()

    def __enter__(self) -> "Slam":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def map(self) -> Map:
        """The current map; it is immutable, and mapping replaces it by another one."""
        return self._back.map

    @property
    def points(self) -> TrackedPoints:
        """The points of the tracker after the latest frame; their arrays are only valid until the next one."""
        return self._tracker.state.points

    @property
    def compile_s(self) -> float:
        """Time from when compiling began until all programs, or those so far, were ready, seconds.

        Before the first frame, it is that of all programs if `warm_up` was called. Else it is that of tracking at
        first, and the time of the thread is added when all are ready.
        """
        return self._programs.seconds

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the input so far, one sentence each."""
        return self._warnings.all

    @property
    def dense(self) -> DenseCloud | None:
        """The current dense map: points, colors and counts; `None` without `dense.enabled`."""
        return None if self.dense_mapping is None else self.dense_mapping.cloud()

    @property
    def loops_closed(self) -> int:
        """Number of loops closed so far, including those that merged two submaps."""
        return self._back.loops_closed

    @property
    def removed_by_semantics(self) -> int:
        """Number of map points removed so far because a detector found them on a movable object.

        0 unless `semantics.frames` is `keyframes`.
        """
        return self._back.removed_by_semantics

    @property
    def keyframes_passed_over(self) -> int:
        """Number of keyframes so far that the detector skipped because too many waited for it."""
        return self._back.keyframes_passed_over

    @property
    def online_trajectory(self) -> Trajectory:
        """Poses in the map's frame as `track` returned them; lost frames and other submaps are left out."""
        return self._history.online()

    @property
    def trajectory(self) -> Trajectory:
        """Poses in the map's frame as known now: each moves with the keyframe that it was tracked from.

        Poses in submaps that are not linked to the map's frame are left out; `trajectories` has them.
        """
        nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 7)))
        return self.trajectories.get(self.map.world_submap, nothing)

    @property
    @one_at_a_time
    def trajectories(self) -> dict[int, Trajectory]:
        """All poses as known now, each in the frame of its submap, by the number of the submap."""
        return self._history.by_submap(self._back.keyframe_pose, self._back.keyframe_submap)

    def _begin(self) -> None:
        self.times = StageTimes()
        self._warnings = InputWarnings()
        if self._detector is not None:
            self._detector.begin()
        self._input_checks = InputChecks(self.camera, self._warnings, self._detector, has_imu=self._imu is not None)
        if self._start_map is not None:
            warn_of_other_camera(self._start_map.camera, self.camera, self._warnings)
        every = self._detector if self.config.semantics.frames == "every" else None
        sensor = self._tracker.params.sensor
        self._back = BackEnd(
            self.camera,
            sensor,
            self._tracker.plan,
            self.config,
            self._start_map,
            localize_only=self._localize_only,
            detector=self._detector if every is None else None,
            key_detector=self._key_detector,
            times=self.times,
        )
        self.dense_mapping = self._back.dense
        self._masks = MaskStage(
            self.camera,
            self.config,
            self._memory,
            every,
            instances=self._instances,
            times=self.times,
        )
        self._programs.use(self._masks, self._back)
        self._tracker.begin(await_relocalization=self._start_map is not None)
        self._localization = LocalizationStage(
            self._tracker, self._back, self._programs, self.config, localize_only=self._localize_only
        )
        self._outside_motion = OutsideMotion(self._imu if self.config.track.gyro else None)
        self._frame = 0
        self._clock = FrameClock(self.camera.fps, self._warnings)
        self._background = None
        if not self.camera.is_stereo:
            self._background = BackgroundConsistency(self.camera, sensor, self.config.track.min_inliers)
        self._uncertainty = PoseUncertainty(self.camera, sensor, self.config.track.pixel_sigma)
        self._history = PoseHistory()
        self._status_log = StatusLog()

    def _in_submap(self, tracked: FrameResult) -> FrameResult:
        """Return the result with the submap of its pose, and log what changed."""
        submap = self._back.submap_now
        if tracked.status == TrackStatus.LOST and tracked.dynamic_mask.mean() > _MASKED:
            tracked = replace(tracked, reason=TrackReason.MASKED.text)
        tracked = replace(tracked, submap=submap, in_map_frame=submap == self.map.world_submap)
        self._status_log.look(self._frame, tracked, self._localization.lost_s)
        return tracked

    def _recorded(self, tracked: FrameResult, dt_s: float, arrays: FrameArrays) -> FrameResult:
        """Record the result, and return it as `track` does."""
        if tracked.status == TrackStatus.LOST:
            self._localization.frame_lost(dt_s, tracked.correction)
            self._masks.frame_lost(self._frame)
            predicts = self.config.run.on_loss == "predict"
            return replace(tracked, T_world_cam=self._localization.predicted()) if predicts else tracked
        time_s = self._clock.continuous_ns(tracked.timestamp_ns) * 1e-9
        depth_delay_s = float(arrays.depth_delay_s)
        is_ok = tracked.status == TrackStatus.OK
        self._outside_motion.frame_tracked(tracked.twist, tracked.covariance, is_ok=is_ok)
        self._masks.frame_tracked(self._frame, time_s, tracked.T_world_cam, tracked.twist, depth_delay_s)
        self._localization.frame_tracked(tracked.T_world_cam, tracked.twist)
        self._memory.keep()
        anchored = self._back.anchor(tracked.T_world_cam)
        self._back.frame_tracked(tracked, anchored, arrays, self._frame)
        self._history.add(tracked.timestamp_ns, tracked.T_world_cam, anchored, in_map_frame=tracked.in_map_frame)
        return tracked


def _watched(detector: Detector | None) -> CheckedDetector | None:
    return None if detector is None else CheckedDetector(detector)
