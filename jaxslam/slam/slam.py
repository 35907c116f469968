"""`Slam`: what a robot calls with every frame, and what runs a whole recording."""

import gc
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config.schema import Config
from jaxslam.datasets import Dataset, prefetch
from jaxslam.datasets.realtime import in_real_time
from jaxslam.dense.coverage import SeenArea
from jaxslam.dense.dense_map import DenseMap
from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.dynamics.point_mask import mask_around, moving_points
from jaxslam.errors import DatasetError, FrameError, JaxSlamError
from jaxslam.geometry.se3 import IDENTITY, compose, retract
from jaxslam.map.npz_file import load_map, save_map
from jaxslam.map.types import Map
from jaxslam.masks.depth_instances import InstanceFinder
from jaxslam.runtime.compile_cache import FAST_COMPILE, SINGLE_THREAD, enable_compile_cache
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.trace_cache import cached_trace
from jaxslam.runtime.worker import Worker, make_worker
from jaxslam.semantics import Detector
from jaxslam.semantics.checked_detector import CheckedDetector
from jaxslam.semantics.from_config import detector_of, key_detector_of, why_no_network
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame, check_frame
from jaxslam.sensors.frame_arrays import FrameArrays, FrameMemory
from jaxslam.sensors.stereo_depth import RoughDepth
from jaxslam.slam.argument_checks import check_arguments, check_recording, warn_of_other_camera
from jaxslam.slam.back_end import BackEnd, LocalizedPose
from jaxslam.slam.background_consistency import BackgroundConsistency
from jaxslam.slam.call_guard import one_at_a_time, refuse_after_fork
from jaxslam.slam.dense_thread import DenseMapping
from jaxslam.slam.frame_clock import FrameClock
from jaxslam.slam.frame_result import FrameRecord, FrameResult, Rejected, frame_result
from jaxslam.slam.input_checks import InputChecks
from jaxslam.slam.input_warnings import InputWarnings
from jaxslam.slam.mask_pipeline import FrameMask, MaskPipeline, MaskSource
from jaxslam.slam.tracker_map_sync import AnchoredPose
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.from_config import track_params, track_plan, with_dense_keyframes
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackReason, TrackState, TrackStatus
from jaxslam.tracking.step import FlowResult, follow_points, init_state, track_followed
from jaxslam.trajectory.trajectory import PathLike, Trajectory

_log = logging.getLogger(__name__)

_NEVER = 1e6
"""Frames of loss: fewer than those a fresh state counts, which starts at once."""
_PATIENT_S = 0.5
"""Seconds from one keyframe to the next for want of points, while mapping is behind. With the preset `ngd` at the rate
of the camera there was one every tenth of a second, and the threads held each other up."""
_ALL_IS_NEW = 2.0
"""More than the whole of a keyframe's points: a frame that shows them all is kept too."""
_MASKED = 0.95
"""Share of the picture under a mask beyond which that is why a frame is lost."""
_PREDICTED_S = 1.0
"""Longest time for which a constant velocity is believed."""

_new_state = jax.jit(cached_trace(init_state), static_argnames=("height", "width", "plan"))
"""One program instead of some fifty."""


_follow_points = jax.jit(cached_trace(follow_points), static_argnames="plan", compiler_options=SINGLE_THREAD)


@partial(jax.jit, static_argnames="plan", donate_argnums=0, compiler_options=FAST_COMPILE)
@cached_trace
def _track_followed(
    state: TrackState, frame: FrameArrays, followed: FlowResult, params: TrackParams, plan: TrackPlan
) -> tuple[TrackState, TrackOutput]:
    return track_followed(state, frame, followed, params, plan)


class Slam:
    """Tracks a camera through a scene, frame by frame, and maps it.

    The world is the camera's place at the first frame, or that of the map it starts with. Methods called from several
    threads wait for each other; in a process made by `fork` they are an error, use `spawn`. With `run.deterministic`
    everything happens in the calling thread, on a fixed schedule; without it, mapping and loop closing have threads of
    their own, and `close` (or `with`) ends them.

    Attributes:
        camera: That takes the frames.
        config: Settings in effect.
        without_network: Why no network looks at frames, as a part of a sentence; `None` if one or a `detector` does.
        dense_mapping: What makes the dense map; `None` without `dense.enabled`.
        compile_s: Seconds that compiling took.
        times: Of the stages of every frame: `take over` what mapping has done, `flow`, `wait for mask`, `pose`,
            `match with map`, `hand over` to mapping and the detector; and of the jobs beside them: `match pair` of a
            stereo camera, `masks`, `detector`, `mapping`, `places`, `dense` and its parts. In a deterministic run those
            are parts of stages: `match pair` in `flow`, `masks` there and in `hand over`, the others in `hand over` or
            `take over`.
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
    ) -> None:
        """Prepare for frames of a camera. Compiling happens at the first frame or in `warm_up`.

        Args:
            camera: That takes the frames.
            config: Settings; the default preset if not given.
            slam_map: To start with: the first frame is `LOST` until its place is recognized.
            localize_only: Leave the map as it is.
            detector: Finds what may move, instead of the network of the settings.
            key_detector: Finds what a dense map has at full density, instead of the network with `dense.key_classes`.

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
        check_arguments(camera, config, slam_map, detectors, localize_only=localize_only)
        self.call_lock = threading.RLock()
        self.camera = camera
        self.config = config or Config()
        self.compile_s = 0.0
        # An empty map knows no place: with it, no frame would ever be tracked.
        self._start_map, self._localize_only = (
            slam_map if slam_map is not None and len(slam_map.ids) else None,
            localize_only,
        )
        params = track_params(camera, with_dense_keyframes(self.config))._replace(restart_after=jnp.float32(_NEVER))
        self._params = with_cue_params(params, self.config.dynamics)
        # ORB-SLAM's local mapping does not accept keyframes either while it is busy.
        patient = max(_PATIENT_S, self.config.track.keyframe_weak_after_s)
        self._patient_params = self._params._replace(keyframe_weak_after_s=jnp.float32(patient))
        self._eager_params = self._params._replace(keyframe_below=jnp.float32(_ALL_IS_NEW))
        self._plan = with_cues(track_plan(self.config.track), self.config.dynamics, pairs=camera.is_stereo)
        self._detector = _watched(detector or detector_of(self.config.semantics))
        self.without_network = None if self._detector is not None else why_no_network(self.config.semantics)
        self._key_detector = _watched(key_detector or key_detector_of(self.config))
        self._rough_depth = RoughDepth(camera) if camera.is_stereo else None
        motion = self._plan.motion
        self._memory = FrameMemory(camera.height, camera.width, pairs=camera.is_stereo, movable=motion is not None)
        self._objects = None if motion is None else InstanceFinder(camera, motion.num_objects)
        self._ready = False
        enable_compile_cache()
        self._begin()

    @classmethod
    def load(
        cls, path: PathLike, camera: Camera | None = None, config: Config | None = None, *, localize_only: bool = False
    ) -> "Slam":
        """Start with the map in a file that `save` wrote.

        Args:
            path: The file.
            camera: That takes the frames; the one that made the map if not given.
            config: Settings.
            localize_only: Leave the map as it is.

        Raises:
            MapFileError: If the file is missing, damaged, of another kind, or of a camera of another size.
        """
        slam_map = load_map(path)
        return cls(camera or slam_map.camera, config, slam_map=slam_map, localize_only=localize_only)

    @one_at_a_time
    def save(self, path: PathLike) -> None:
        """Write the map, with all that was handed over to it, to a file that `load` reads.

        Raises:
            MapFileError: If it cannot be written; a file that was there before is as it was.
        """
        self.finish()
        save_map(path, self.map)

    @one_at_a_time
    def reset(self) -> None:
        """Forget everything since the beginning; the next frame starts anew."""
        self.close()
        self._begin()

    @one_at_a_time
    def warm_up(self) -> float:
        """Compile all that is needed, or load it from the cache of an earlier run; gives the seconds it took, once."""
        if not self._ready:
            began = time.perf_counter()
            shape = (self.camera.height, self.camera.width)
            black = np.zeros(shape, np.uint8)
            pair = black if self.camera.is_stereo else None
            nothing = self._memory.hold(Frame(0, black, np.zeros(shape, np.float32), right=pair), 0.0)
            # In two threads: traced anew it took 5.9 s instead of 7.4 from XLA's cache, 31 instead of 34 without.
            with ThreadPoolExecutor(1, thread_name_prefix="jaxslam-compile") as beside:
                back_end = beside.submit(self._back.compile, nothing, self._fresh_state())
                state = self._fresh_state()
                followed = _follow_points(state, nothing, self._params, self._plan)
                jax.block_until_ready(_track_followed(state, nothing, followed, self._params, self._plan))
                if self._masks is not None:
                    self._masks.compile()
                back_end.result()
            self.compile_s = time.perf_counter() - began
            self._ready = True
        return self.compile_s

    @one_at_a_time
    def track(self, frame: Frame) -> FrameResult:
        """Track one frame.

        Args:
            frame: Image and depth of the camera's size, later than the frame before.

        Returns:
            The pose and what it is worth. A frame without anything to track, such as a black one, is no error: its
            status is `LOST`.

        Raises:
            FrameError: If the frame does not fit the camera, or its time is not later than the last one's. Nothing
                has happened then; go on with the next frame.
            RuntimeError: After `close`.
            Exception: What went wrong in a thread of the map, if something did.
        """
        check_frame(frame, self.camera.width, self.camera.height, pair=self.camera.is_stereo)
        self._clock.check(frame.timestamp_ns, frame.depth_timestamp_ns)
        self.warm_up()
        began, watch = time.perf_counter(), self.times.stopwatch()
        self._watch.look(frame)
        self._state, correction = self._back.update(self._state, self._frame)
        dt_s = self._clock.elapsed_s(frame.timestamp_ns)
        arrays = self._memory.hold(frame, dt_s, depth_follows=frame.depth_m is None)
        watch.ends("take over")
        # Neither needs the other, and on two cores masks are ready before flow is; so is the rough depth of a pair.
        if frame.depth_m is None:
            self._beside.submit(("match pair", partial(self._match_pair, frame)), self._frame)
        self._beside.submit(("masks", partial(self._mask_of, frame, arrays, correction)), self._frame)
        followed = _follow_points(self._state, arrays, self._params, self._plan)
        watch.ends("flow")
        mask: FrameMask = self._beside.flush()[-1]
        mask = mask._replace(error=mask.error or self._back.latest_error())
        arrays = self._masked(arrays, mask.mask, frame.dynamic_mask)
        watch.ends("wait for mask")
        output, placed, num_matched = self._advance(arrays, followed), None, 0
        arrays, mask = self._without_movers(arrays, mask, followed, output)
        watch.ends("pose")
        if int(output.status) == TrackStatus.LOST:
            output, placed = self._relocalize(arrays, output, dt_s)
            num_matched = 0 if placed is None else placed.num_matched
        elif self._needs_map_match(output):
            self._state, output, num_matched = self._back.match_local_map(self._state, arrays, output)
        share = None if int(output.status) == TrackStatus.LOST else self._back.update_occlusion(arrays, output)
        watch.ends("match with map")
        if output.keyframe:
            anchored = None if placed is None else placed.anchored
            self._back.insert_keyframe(frame.timestamp_ns, frame.image, arrays, output, self._frame, anchored)
        if self.dense_mapping is not None and int(output.status) != TrackStatus.LOST:
            self.dense_mapping.frame_tracked(self._frame, frame.image, arrays, output)
        tracked = self._in_submap(frame_result(frame.timestamp_ns, output, correction, num_matched, mask, share))
        tracked = self._with_background_check(tracked, arrays)
        self._clock.advance(frame.timestamp_ns)
        tracked = self._recorded(tracked, dt_s, float(arrays.depth_delay_s))
        if self._masks is not None:
            self._masks.submit_for_detection(self._frame, frame.image)
        self._frame += 1
        watch.ends("hand over")
        return replace(tracked, track_ms=(time.perf_counter() - began) * 1e3, warnings=self._warnings.taken())

    def run(
        self, dataset: Dataset, on_frame: Callable[[Frame | None, FrameResult | Rejected], None] | None = None
    ) -> list[FrameRecord]:
        """Track a whole recording.

        A frame that cannot be read or does not fit is reported as `Rejected`, and the run goes on. With `run.realtime`,
        so are frames that come late, with the status `DROPPED`.

        Args:
            dataset: The recording; its camera must be this one.
            on_frame: Called after every frame, for progress and pictures; the frame is `None` if it was unreadable.

        Raises:
            DatasetError: If it is no recording, or one of another camera.
        """
        check_recording(dataset, self.camera)
        self.warm_up()
        records: list[FrameRecord] = []
        with _no_old_garbage():
            for timestamp_ns, frame in zip(dataset.timestamps_ns, _frames_of(dataset, self.config), strict=True):
                result = self._tracked_or_rejected(int(timestamp_ns), frame)
                records.append(FrameRecord.of(result))
                if on_frame is not None:
                    on_frame(frame if isinstance(frame, Frame) else None, result)
        self.finish()
        return records

    @one_at_a_time
    def finish(self) -> None:
        """Wait until mapping has caught up, so that `map` and `trajectory` hold all that was seen.

        So has a detector that looks at keyframes alone, then.
        """
        if any(leaf.is_deleted() for leaf in jax.tree.leaves(self._state)):  # a step that Ctrl-C ended took it along
            self._state = _awaiting_relocalization(self._fresh_state())
        self._state = self._back.finish(self._state)

    def close(self) -> None:
        """End the threads, in two seconds at most; nothing can be tracked after that but from a `reset`."""
        self._back.close()
        if self._masks is not None:
            self._masks.close()
        self._beside.close()

    def __enter__(self) -> "Slam":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def map(self) -> Map:
        """The map as it is now; it never changes, the next one is another."""
        return self._back.map

    @property
    def warnings(self) -> tuple[str, ...]:
        """What looks wrong about the input so far, a sentence each."""
        return self._warnings.all

    @property
    def dense(self) -> DenseCloud | None:
        """The dense map as it is now: points, colors and counts; `None` without `dense.enabled`."""
        return None if self.dense_mapping is None else self.dense_mapping.cloud()

    @property
    def loops_closed(self) -> int:
        """Loops closed so far, submaps that became one included."""
        return self._back.loops_closed

    @property
    def removed_by_semantics(self) -> int:
        """Points removed from the map so far because a keyframe saw them where something may move.

        With `semantics.frames: keyframes`, as the next one.
        """
        return self._back.removed_by_semantics

    @property
    def keyframes_passed_over(self) -> int:
        """Keyframes so far that the detector had no time for: too many waited."""
        return self._back.keyframes_passed_over

    @property
    def online_trajectory(self) -> Trajectory:
        """Every pose that was in the map's frame when it was given out, as it was; frames that were lost have none."""
        return _in_order([(given.timestamp_ns, given.T_world_cam) for given in self._given if given.in_map_frame])

    @property
    def trajectory(self) -> Trajectory:
        """Every pose in the map's frame as it is known now: from where its keyframe is, as it was tracked.

        Poses in submaps that nothing links to it are left out; `trajectories` has them.
        """
        return self.trajectories.get(self.map.world_submap) or _in_order([])

    @property
    @one_at_a_time
    def trajectories(self) -> dict[int, Trajectory]:
        """Every pose as it is known now, in the frame of the submap it is in, by the number of the submap."""
        by_submap: dict[int, list[tuple[int, np.ndarray]]] = {}
        for given in self._given:
            pose = given.timestamp_ns, self._back.pose(given.anchored)
            by_submap.setdefault(self._back.submap_of(given.anchored), []).append(pose)
        return {submap: _in_order(by_submap[submap]) for submap in sorted(by_submap)}

    def _begin(self) -> None:
        self.times = StageTimes()
        self._warnings = InputWarnings()
        if self._detector is not None:
            self._detector.begin()
        self._watch = InputChecks(self.camera, self._warnings, self._detector)
        if self._start_map is not None:
            warn_of_other_camera(self._start_map.camera, self.camera, self._warnings)
        run, semantics, dynamics = self.config.run, self.config.semantics, self.config.dynamics
        every = self._detector if semantics.frames == "every" else None
        self.dense_mapping = self._new_dense_mapping()
        self._back = BackEnd(
            self.camera,
            self._params.sensor,
            self._plan,
            self.config,
            self._start_map,
            localize_only=self._localize_only,
            detector=self._detector if every is None else None,
            dense=self.dense_mapping,
            times=self.times,
        )
        self._masks = (
            None
            if every is None and not dynamics.new_surfaces
            else MaskPipeline(
                self.camera,
                every,
                deterministic=run.in_turn,
                latency_frames=semantics.latency_frames,
                propagate=semantics.propagate,
                new_surfaces=dynamics.new_surfaces,
                farthest_m=float(self._params.sensor.max_depth_m),
                dilate_px=semantics.dilate_px,
                seed=run.seed,
                times=self.times,
            )
        )
        self._beside: Worker[tuple[str, Callable[[], Any]], Any] = make_worker(
            self._do_beside,
            "jaxslam-masks",
            # Without either there is nothing to do beside flow.
            deterministic=run.in_turn or (self._masks is None and self._rough_depth is None),
            latency_frames=0,
            urgent=True,
        )
        self._state = self._fresh_state()
        if self._start_map is not None:
            self._state = _awaiting_relocalization(self._state)
        self._frame = self._unrecognized = 0
        self._clock = FrameClock(self.camera.fps, self._warnings)
        limits = float(self._params.sensor.min_depth_m), float(self._params.sensor.max_depth_m)
        self._background = None if self.camera.is_stereo else BackgroundConsistency(self.camera, *limits)
        self._last_pose, self._last_twist, self._lost_s = np.array(IDENTITY), np.zeros(6), 0.0
        self._given: list[_RecordedPose] = []
        self._status = TrackStatus.OK

    def _new_dense_mapping(self) -> DenseMapping | None:
        """What makes the dense map, if the settings ask for one and the map may grow."""
        if not self.config.dense.enabled or self._localize_only:
            return None
        dense_map = DenseMap(
            self.camera,
            self.config.dense,
            nearest_m=float(self._params.sensor.min_depth_m),
            farthest_m=float(self._params.sensor.max_depth_m),
            key_detector=self._key_detector,
            times=self.times,
        )
        seen = SeenArea(self.camera, float(self._params.sensor.min_depth_m), float(self._params.sensor.max_depth_m))
        return DenseMapping(dense_map, seen, self.config.dense, deterministic=self.config.run.in_turn)

    def _fresh_state(self) -> TrackState:
        state = _new_state(self.camera.height, self.camera.width, self._plan, seed=self.config.run.seed)
        # Committed from the beginning, as after any `cached_trace`: else all is compiled again when the first one is.
        return jax.device_put(state, *state.twist.devices())

    def _tracked_or_rejected(self, timestamp_ns: int, frame: Frame | JaxSlamError | None) -> FrameResult | Rejected:
        if frame is None:
            late = FrameError("the next frame was there before there was time for this one")
            return Rejected(timestamp_ns, late, TrackStatus.DROPPED)
        try:
            if not isinstance(frame, JaxSlamError):
                return self.track(frame)
            error = frame
        except FrameError as unfit:
            error = unfit
        _log.warning("frame at %d ns rejected: %s", timestamp_ns, error)
        return Rejected(timestamp_ns, error)

    def _do_beside(self, job: tuple[str, Callable[[], Any]]) -> Any:
        """A job of a stage, with the time it takes."""
        stage, work = job
        watch = self.times.stopwatch()
        try:
            return work()
        finally:
            watch.ends(stage)

    def _match_pair(self, frame: Frame) -> None:
        """Rough depth of a pair into the arrays held."""
        assert self._rough_depth is not None
        assert frame.right is not None
        self._memory.hold_depth(self._rough_depth.of(frame.image, frame.right))

    def _mask_of(self, frame: Frame, arrays: FrameArrays, correction: np.ndarray) -> FrameMask:
        """What of a frame is to be left out because it may move."""
        given = frame.dynamic_mask
        if self._masks is None:
            source = MaskSource.NONE if given is None else MaskSource.CALLER
            return FrameMask(np.asarray(arrays.ignore), source, -1, "")
        if not np.array_equal(correction, IDENTITY):
            self._masks.apply_map_correction(correction)
        gray, depth = np.asarray(arrays.image), np.asarray(arrays.depth)
        mask = self._masks.mask_frame(self._frame, frame.image, gray, depth)
        if given is not None:
            mask = mask._replace(mask=mask.mask | given, source=mask.source or MaskSource.CALLER)
        return mask

    def _masked(self, arrays: FrameArrays, mask: np.ndarray, given: np.ndarray | None) -> FrameArrays:
        """The frame without what may move; or with it, divided into things, if the tracker judges them.

        What the caller has masked is left out in any case.
        """
        if self._objects is None:
            return self._memory.ignoring(arrays, mask)
        objects = self._objects.divided(mask if given is None else mask & ~given, np.asarray(arrays.depth))
        arrays = self._memory.with_movable(arrays, objects.labels)
        return self._memory.ignoring(arrays, objects.rest if given is None else objects.rest | given)

    def _advance(self, arrays: FrameArrays, followed: FlowResult) -> TrackOutput:
        params = self._params
        if self._back.is_behind:
            params = self._patient_params
        elif self.dense_mapping is not None and self.dense_mapping.wants_keyframe:
            params = self._eager_params
        self._state, output = _track_followed(self._state, arrays, followed, params, self._plan)
        return jax.tree.map(np.asarray, output)  # as `device_get`, in a tenth of its time

    def _without_movers(
        self, arrays: FrameArrays, mask: FrameMask, followed: FlowResult, output: TrackOutput
    ) -> tuple[FrameArrays, FrameMask]:
        """The frame and its mask with what is said to move, regions, things and points: the map gets nothing of it."""
        if self._objects is not None:  # what may move and stands still is out of the mask
            mask = mask._replace(mask=np.array(arrays.ignore))
        moving = None if output.moving is None else np.asarray(output.moving)
        points, reach_px = moving_points(output.cue_results), self.config.dynamics.reach_px
        if reach_px and points.any():
            around = mask_around(np.asarray(followed.uv)[:, points], np.asarray(arrays.depth), reach_px)
            moving = around if moving is None else moving | around
        if moving is None or not moving.any():
            return arrays, mask
        mask = mask._replace(mask=mask.mask | moving, source=mask.source or MaskSource.CUES)
        return self._memory.ignoring(arrays, mask.mask), mask

    def _needs_map_match(self, output: TrackOutput) -> bool:
        """Whether a frame that was tracked is matched with the map too."""
        status, frames = int(output.status), self.config.track.match_map
        chosen = frames == "always" or (frames == "keyframes" and bool(output.keyframe))
        return status == TrackStatus.WEAK or (chosen and status != TrackStatus.STARTED)

    def _relocalize(
        self, arrays: FrameArrays, lost: TrackOutput, dt_s: float
    ) -> tuple[TrackOutput, LocalizedPose | None]:
        """The frame once more, from where the map shows it; or from the pose held, if the settings say so."""
        lost_s = self._lost_s + dt_s
        predicted = (
            retract(self._last_pose, self._last_twist * lost_s) if self._given and lost_s < _PREDICTED_S else None
        )
        placed, unknown = self._back.relocalize(arrays, predicted)
        self._unrecognized += unknown
        if placed is not None:
            self._state = self._back.reset_at_pose(self._state, placed.anchored)
        elif self._may_begin_submap and self._unrecognized > self.config.track.restart_after:
            self._state = self._back.start_submap(self._state, np.asarray(lost.T_world_cam.wxyz_xyz))
        elif unknown and len(self.map.ids) and (self._status == TrackStatus.LOST or not self._given):
            # Nothing was followed into the frame: that is not why.
            return lost._replace(reason=np.int32(TrackReason.PLACE_NOT_IN_MAP)), None
        else:
            return lost, None
        output = self._advance(arrays, _follow_points(self._state, arrays, self._params, self._plan))
        if int(output.status) != TrackStatus.STARTED:
            self._state = _awaiting_relocalization(self._state)  # not to start by itself
        if placed is None:
            return output, None
        # If nothing here has a depth from which to go on, what the map shows is a pose all the same.
        covariance = placed.covariance.astype(np.float32)
        return output._replace(status=TrackStatus.RELOCALIZED, reason=lost.reason, covariance=covariance), placed

    @property
    def _may_begin_submap(self) -> bool:
        """Whether a place that is not in the map may become a part of it."""
        known = bool(self._given or len(self.map.ids))  # else the tracker starts by itself
        return known and self.config.run.on_loss == "submap" and not self._localize_only

    def _in_submap(self, tracked: FrameResult) -> FrameResult:
        """The result with the submap that its pose is in; changes of its status go to the log, once each."""
        submap = self._back.submap_now
        if tracked.status == TrackStatus.LOST and tracked.dynamic_mask.mean() > _MASKED:
            tracked = replace(tracked, reason=TrackReason.MASKED.text)
        before, self._status = self._status, tracked.status
        if tracked.status == TrackStatus.LOST and before != TrackStatus.LOST:
            _log.info("frame %d: lost: %s", self._frame, tracked.reason)
        elif tracked.status == TrackStatus.RELOCALIZED:
            _log.info("frame %d: relocalized in submap %d after %.2f s", self._frame, submap, self._lost_s)
        elif tracked.status == TrackStatus.STARTED:
            _log.info("frame %d: submap %d begins", self._frame, submap)
        return replace(tracked, submap=submap, in_map_frame=submap == self.map.world_submap)

    def _with_background_check(self, tracked: FrameResult, arrays: FrameArrays) -> FrameResult:
        """The result with what the background says of its pose, where too little has depth to have a vote there."""
        if self._background is None or tracked.status == TrackStatus.LOST:
            return tracked
        if tracked.status in (TrackStatus.STARTED, TrackStatus.RELOCALIZED):
            self._background.forget()
        gray, depth, ignore = np.asarray(arrays.image), np.asarray(arrays.depth), np.asarray(arrays.ignore)
        doubt = self._background.look(gray, depth, ignore, tracked.T_world_cam, tracked.correction)
        if not doubt.unsure_m:
            return tracked
        covariance = tracked.covariance + np.diag(np.repeat(np.array([doubt.unsure_m**2, 0], np.float32), 3))
        if not doubt.is_weak or tracked.status != TrackStatus.OK:
            return replace(tracked, covariance=covariance)
        return replace(tracked, covariance=covariance, status=TrackStatus.WEAK, reason=TrackReason.UNCONFIRMED.text)

    def _recorded(self, tracked: FrameResult, dt_s: float, depth_delay_s: float) -> FrameResult:
        """The result as it is given out, and remembered."""
        if tracked.status == TrackStatus.LOST:
            self._lost_s += dt_s
            self._last_pose = compose(tracked.correction, self._last_pose)
            if self._masks is not None:
                self._beside.submit(("masks", partial(self._masks.frame_lost, self._frame)), self._frame)
            if self.config.run.on_loss == "predict":
                ahead_s = min(self._lost_s, _PREDICTED_S)
                tracked = replace(tracked, T_world_cam=retract(self._last_pose, self._last_twist * ahead_s))
            return tracked
        if self._masks is not None:
            pose = retract(tracked.T_world_cam, tracked.twist * depth_delay_s)
            when = self._frame, self._clock.continuous_ns(tracked.timestamp_ns) * 1e-9
            moved_on = partial(self._masks.frame_tracked, *when, pose, _turn(tracked.twist))
            self._beside.submit(("masks", moved_on), self._frame)
        self._unrecognized, self._lost_s = 0, 0.0
        self._last_pose, self._last_twist = tracked.T_world_cam, tracked.twist
        self._back.localize(tracked.T_world_cam, self._frame)
        anchored = self._back.anchor(tracked.T_world_cam)
        self._given.append(_RecordedPose(tracked.timestamp_ns, tracked.T_world_cam, anchored, tracked.in_map_frame))
        return tracked


def _watched(detector: Detector | None) -> CheckedDetector | None:
    return None if detector is None else CheckedDetector(detector)


class _RecordedPose(NamedTuple):
    """A pose that was given out.

    Attributes:
        timestamp_ns: Time of its frame.
        T_world_cam: `(7,)` as it was given out.
        anchored: The same tied to a keyframe, with which it moves.
        in_map_frame: As of `FrameResult`.
    """

    timestamp_ns: int
    T_world_cam: np.ndarray
    anchored: AnchoredPose
    in_map_frame: bool


def _in_order(stamped: Sequence[tuple[int, np.ndarray]]) -> Trajectory:
    """Poses with their stamps as a trajectory; of a clock that was set back, in the order of time all the same."""
    times_ns = np.array([time_ns for time_ns, _ in stamped], np.int64)
    poses = np.array([pose for _, pose in stamped]).reshape(-1, 7)
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    order = np.argsort(times_ns, kind="stable")
    return Trajectory(times_ns[order], poses[order])


@contextmanager
def _no_old_garbage() -> Iterator[None]:
    """Have the garbage collector leave alone what was there before: to look through it all takes 0.3 s of a frame."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _awaiting_relocalization(state: TrackState) -> TrackState:
    """A state that waits for its place to be recognized instead of starting by itself."""
    # Where the others are: with `jnp.zeros`, which is on no device for certain, the step was compiled anew.
    return state._replace(lost_frames=jax.device_put(np.int32(0), *state.twist.devices()))


def _turn(twist: np.ndarray) -> float:
    """Angular speed, rad/s."""
    return float(np.linalg.norm(twist[3:]))


class _ErrorsAsValues:
    """A recording whose unreadable frames are errors as values."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame | JaxSlamError:
        try:
            frame: object = self._dataset[index]
        except (DatasetError, FrameError) as error:
            return error
        if not isinstance(frame, Frame):
            return DatasetError(f"frame {index}: expected a jaxslam.Frame, got {type(frame).__name__}")
        return frame


def _frames_of(dataset: Dataset, config: Config) -> Iterator[Frame | JaxSlamError | None]:
    """Every frame, or why there is none: it cannot be read, or it came late (`None`)."""
    frames = prefetch(_ErrorsAsValues(dataset), ahead=config.run.prefetch_frames)
    return in_real_time(frames, dataset.timestamps_ns) if config.run.realtime else frames
