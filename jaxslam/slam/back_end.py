"""The back end: mapping, loop closing, reloading of keyframes, and a detector that runs on keyframes only.

It runs in threads, or on a fixed schedule. The tracker hands over keyframes and takes results that are ready; it never
waits. Until programs are compiled, jobs wait. Results are exchanged in the tracker's thread, in `update`: jobs and
results are immutable, so that threads share nothing but their queues and the place index, which has a lock.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float

from jaxslam.config.schema import Config
from jaxslam.features.view_matching import compile_view_matching
from jaxslam.geometry.se3 import IDENTITY, compose
from jaxslam.geometry.types import Pose
from jaxslam.loop_closing.essential_graph import GraphCompiler
from jaxslam.loop_closing.loop_detector import LoopClosing, LoopClosure
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.map.dynamic_removal import DynamicObservations
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map, empty_map
from jaxslam.mapping.local_mapping import mapping_plan
from jaxslam.mapping.occlusion_states import PointStates
from jaxslam.mapping.vanished_points import FrameDepth
from jaxslam.mapping.view_coverage import ViewCoverage
from jaxslam.runtime.preload import import_scipy
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.worker import Worker, close_all, make_worker
from jaxslam.semantics import Detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays, own_copy
from jaxslam.sensors.sensor_model import SensorModel
from jaxslam.slam.dense_thread import dense_mapping_of
from jaxslam.slam.frame_localizer import FrameLocalizer
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.keyframe_semantics import KeyframeSemantics
from jaxslam.slam.map_adjuster import AdjustResult, MapAdjuster
from jaxslam.slam.map_changes import MapChanges
from jaxslam.slam.map_jobs import MapJob, MapUpdate, MapWriter, PointRemoval
from jaxslam.slam.place_jobs import IndexUpdate, LoopSearch, PlaceJob, PlaceResult, PlaceSearch, Reload
from jaxslam.slam.reload_queue import ReloadQueue
from jaxslam.slam.tracker import KeyframeDemand, MapWishes
from jaxslam.slam.tracker_map_sync import AnchoredPose, TrackerMapSync, pose_of, tracks_of
from jaxslam.tracking.from_config import with_dense_keyframes
from jaxslam.tracking.state import TrackOutput, TrackPlan, TrackState, TrackStatus

_RELOAD_EVERY = 10
"""Number of frames after which keyframes of the surroundings are requested again."""
_SLOW_TURN = 10
"""Factor on `mapping.latency_frames` after which a deterministic run has the result of global bundle adjustment."""
_Step: TypeAlias = Callable[[], None]
_Job = TypeVar("_Job")
_Result = TypeVar("_Result")
_MAX_ON_THE_WAY = 2
"""Number of keyframes: one that mapping works on, and one whose result waits for the next `update`."""


class BackEnd:
    """Owns the map and the threads that change it.

    Attributes:
        dense: Thread of the dense map; `None` without `dense.enabled`, or with `localize_only`.
        localizer: Tells where a frame was taken by the features it shares with the last one and with the map.
    """

    def __init__(
        self,
        camera: Camera,
        sensor: SensorModel,
        plan: TrackPlan,
        config: Config,
        slam_map: Map | None = None,
        *,
        localize_only: bool = False,
        detector: Detector | None = None,
        key_detector: Detector | None = None,
        times: StageTimes | None = None,
    ) -> None:
        """Start with a map, which is empty by default.

        Args:
            camera: Camera that takes the frames.
            sensor: Camera with its depth noise.
            plan: Static settings of the tracker.
            config: Settings.
            slam_map: Map to start with.
            localize_only: Leave the map unchanged.
            detector: Detector of movable objects that runs on keyframes only; `None` for none.
            key_detector: Detector of objects that the dense map keeps at full density; `None` for none.
            times: Record of the duration of every job.
        """
        self._times = times or StageTimes()
        self._sensor, self._track_plan, self._plan = sensor, plan, mapping_plan(camera, config)
        self._config, self._localize_only = config, localize_only
        start = (empty_map(camera) if slam_map is None else slam_map).in_blocks()
        self._writer = MapWriter(camera, sensor, self._plan, start)
        self._index = PlaceIndex.from_map(start)
        loops = LoopClosing(self._index, sensor, self._plan.features)
        self._searches = PlaceSearch(loops, plan)
        self._to_mapping: Worker[MapJob, MapUpdate] = self._worker(self._writer.do, "mapping", 1)
        self._to_places: Worker[PlaceJob, PlaceResult] = self._worker(self._searches.do, "places", 2)
        make_adjuster = lambda work: self._worker(work, "adjustment", _SLOW_TURN)
        self._adjuster = MapAdjuster(self._plan.adjust, make_adjuster, in_turn=config.run.in_turn)
        self._semantics = None if detector is None else KeyframeSemantics(camera, detector, config, self._times)
        has_dense = config.dense.enabled and not localize_only
        self.dense = dense_mapping_of(camera, sensor, config, key_detector, self._times) if has_dense else None
        self._graphs = GraphCompiler()
        self._link = TrackerMapSync(plan, start)
        self._num_tracks = plan.num_points + plan.num_sources * plan.points_per_source  # at most, in a frame
        most, occlusion = config.mapping.num_features + self._num_tracks, config.dynamics.occlusion
        self._states = PointStates(occlusion, sensor, start, most) if occlusion.enabled else None
        self.localizer = FrameLocalizer(sensor, self._plan.features, self._link, self._index, self._states)
        self._arrived: Map | None = None
        self._coverage, self._map_views = ViewCoverage(with_dense_keyframes(config).keyframe_below), 0
        self._changes = MapChanges()
        self._reloads = ReloadQueue(self._link, points_may_leave=self._semantics is not None)
        self._correction = IDENTITY
        self._gone: list[np.ndarray] = []  # track ids of points that the tracker must drop
        self._detector_error = ""
        self._loops_closed = self._removed = 0
        self._states_in_map = 0  # number of the latest `StateChanges` in the newest map
        self._jobs: list[_Step] = []  # for the threads, until the frame is done
        self._begun = self._closed = False
        self._has_jumped = False  # so far that other keyframes may show the view

    @property
    def map(self) -> Map:
        """The current map."""
        return self._link.map

    @property
    def loops_closed(self) -> int:
        """Number of loops closed so far, including those that merged two submaps."""
        return self._loops_closed

    @property
    def removed_by_semantics(self) -> int:
        """Number of map points removed so far because the detector found them on a movable object."""
        return self._removed

    @property
    def keyframes_passed_over(self) -> int:
        """Number of keyframes that the detector skipped because too many waited."""
        return 0 if self._semantics is None else self._semantics.num_passed_over

    def count_views(self, T_world_cam: Pose) -> int:
        """Count the keyframes of the map that show the view from a pose `(7,)` in the submap of the frame."""
        return self._coverage.num_views(self.map, T_world_cam, self._link.submap_now())

    @property
    def wishes(self) -> MapWishes:
        """Wishes of the maps for the next frame."""
        return MapWishes(self._keyframe_demand(), self._map_views, self._changes.pending)

    def _keyframe_demand(self) -> KeyframeDemand:
        # Keyframes wait that mapping has not begun with, as at first; never on the schedule of a deterministic run.
        if not self._config.run.in_turn and self._link.num_on_the_way > _MAX_ON_THE_WAY:
            return KeyframeDemand.FEWER
        return KeyframeDemand.NOW if self.dense is not None and self.dense.wants_keyframe else KeyframeDemand.NORMAL

    def programs(self, frame: FrameArrays, state: TrackState) -> tuple[list[_Step], list[_Step]]:
        """Return what compiles every program of the back end, step by step.

        Args:
            frame: Any frame of the camera.
            state: Any state of the tracker; it is used up.

        Returns:
            The steps after which `begin` may be called, and those after which that of `dense` may be called too.
        """
        steps: list[_Step] = [
            partial(import_scipy, self._config.run.threads),
            partial(self._writer.compile, frame, self._num_tracks),
            partial(self._link.compile, state, drops_points=self._semantics is not None),
            partial(compile_view_matching, self._sensor, self._plan.features),
        ]
        if frame.right is None:
            steps.append(FrameDepth(np.zeros(6, np.float32), frame, self._sensor).compile)
        if self._states is not None:
            steps.append(partial(self._states.compile, frame))
        last: list[_Step] = [partial(self._graphs.compile_now, len(self.map.ids))]
        if self.dense is not None:
            last.append(self.dense.compile)
        return steps, last

    def begin(self) -> None:
        """Begin with the jobs that wait, now that programs are compiled; until then, `update` changes nothing."""
        self._begun = True
        self._to_mapping.begin()
        self._to_places.begin()
        self._adjuster.worker.begin()

    def check_open(self) -> None:
        """Raise a `RuntimeError` after `close`."""
        if self._closed:
            raise RuntimeError("the tracker is closed; Slam.reset() begins anew")

    def is_due(self, frame: int) -> bool:
        """Tell whether a deterministic run must have results, and so the programs, by frame number `frame`."""
        return self._to_mapping.is_due(frame) or (self._semantics is not None and self._semantics.worker.is_due(frame))

    def update(self, state: TrackState, frame: int) -> tuple[TrackState, np.ndarray]:
        """Take over the results that are ready: correct the tracker's state as the map, and reload a keyframe.

        Args:
            state: State of the tracker.
            frame: Number of the frame to come.

        Returns:
            The state, and the correction of the world `(7,)` at the camera since the last update.

        Raises:
            RuntimeError: After `close`.
            Exception: Error of a job in a thread. The state is unchanged, and nothing else is lost.
        """
        self.check_open()
        self._adjuster.frame_begun()
        self.localizer.begin_frame()
        if self._semantics is not None:
            self._take_movers(*self._semantics.collect(frame), frame)
        self._take_places(self._to_places.collect(frame), frame)
        self._take_adjusted(self._adjuster.worker.collect(frame), frame)
        more = self._take_maps(self._to_mapping.collect(frame), frame)
        if self.dense is not None:
            self.dense.collect(frame)
        state = self._carried(state)
        if more:
            self._request_reload(self._link.tracker_pose(self._link.reference), frame)
        correction, self._correction = self._correction, IDENTITY
        return self._reloads.load_next(state), correction

    def dispatch_jobs(self) -> None:
        """Give the threads the jobs of this frame: the last thing to do in it.

        A thread that begins in the middle of a frame takes the interpreter away from the rest of it: 95 of 100 frames
        of fr1_rpy, live, had flow within 4.4 ms then instead of 3.6.
        """
        jobs, self._jobs = self._jobs, []
        for submit in jobs:
            submit()
        self._adjuster.frame_ended()

    def latest_error(self) -> str:
        """Return the latest error of the detector of keyframes, once; empty if there is none."""
        error, self._detector_error = self._detector_error, ""
        return error

    def hand_over(
        self, frame: Frame, arrays: FrameArrays, output: TrackOutput, number: int, recognized: AnchoredPose | None
    ) -> None:
        """Give a keyframe to the map, and every tracked frame to the dense map.

        Args:
            frame: The frame; its images are copied where they are needed.
            arrays: Arrays of the frame; copied too.
            output: Output of the tracker for the frame.
            number: Number of the frame.
            recognized: Pose of the frame in the map if it was relocalized.
        """
        if output.keyframe:
            self._changes.keyframe_made()
            self._insert_keyframe(frame, arrays, output, number, recognized)
        if self.dense is not None and int(output.status) != TrackStatus.LOST:
            self.dense.frame_tracked(number, frame.image, arrays, output)

    def match_local_map(
        self, state: TrackState, arrays: FrameArrays, output: TrackOutput, radii_px: tuple[float, ...]
    ) -> tuple[TrackState, TrackOutput, int]:
        """Refine the pose of a tracked frame against the local map.

        Args:
            state: State of the tracker after the frame.
            arrays: The frame.
            output: Output of the tracker for the frame.
            radii_px: Search radius of each pass around the predicted pixels at octave 0.

        Returns:
            State and output with the refined pose, and the number of map points that agree with it. Unchanged state
            and output, and 0, if too few points agree.
        """
        return self.localizer.match_tracked(state, arrays, output, self._config.track.weak_inliers, radii_px)

    def update_occlusion(self, arrays: FrameArrays, output: TrackOutput) -> float | None:
        """Update the occlusion states of the points of the reference keyframe from a tracked frame.

        Returns:
            Share of the points that are OCCLUDED; `None` if `dynamics.occlusion` is off or the map has no keyframe.
        """
        if self._states is None or not self._begun or (anchored := self._link.in_map(pose_of(output))) is None:
            return None
        return self._states.see(self.map, anchored.keyframe, anchored.T_keyframe_cam, np.asarray(output.twist), arrays)

    def reset_at_pose(self, state: TrackState, recognized: AnchoredPose, twist: Float[np.ndarray, "6"]) -> TrackState:
        """Return the tracker's state reset to a recognized pose, with keyframes of that place loaded.

        Args:
            state: State of the tracker.
            recognized: Pose in the map.
            twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s; 0 if it is not known.
        """
        self._link.set_reference_keyframe(recognized.keyframe)
        T_world_cam = self._link.pose(recognized)
        state = self._link.reset_at_pose(state, T_world_cam, twist)
        self._reloads.replace(self._searches.reload(Reload(self.map, T_world_cam, self._link.submap_now())).keyframes)
        return self._reloads.load_all(state)

    def reset_after_motion(self, state: TrackState, T_world_cam: Pose, twist: Float[np.ndarray, "6"]) -> TrackState:
        """Return the tracker's state reset to a pose that is known relative to its keyframes, which stay.

        Args:
            state: State of the tracker.
            T_world_cam: `(7,)` pose of the camera.
            twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        """
        self._has_jumped = True
        return self._link.reset_at_pose(state, T_world_cam, twist, keep_keyframes=True)

    def start_submap(self, state: TrackState, T_world_cam: Pose) -> TrackState:
        """Return the tracker's state reset to a pose `(7,)`, at rest, with which a new submap begins."""
        self._reloads.replace(())
        return self._link.reset_at_pose(state, T_world_cam, np.zeros(6))

    def frame_tracked(self, tracked: FrameResult, anchored: AnchoredPose, arrays: FrameArrays, frame: int) -> None:
        """Count the keyframes that show the view, and request those around at intervals.

        Args:
            tracked: Result of the frame.
            anchored: Its pose, relative to a keyframe.
            arrays: The frame, which must not change until another one is tracked.
            frame: Number of the frame.
        """
        T_world_cam = tracked.T_world_cam
        self.localizer.frame_tracked(arrays, anchored, tracked.twist)
        if not self._localize_only:
            self._map_views = self.count_views(T_world_cam)
        if frame % _RELOAD_EVERY == 0 or self._has_jumped:
            self._has_jumped = False
            looks = not self._localize_only and arrays.right is None and tracked.status == TrackStatus.OK
            seen = FrameDepth(tracked.twist, own_copy(arrays), self._sensor) if looks else None
            self._request_reload(T_world_cam, frame, seen)

    def anchor(self, T_world_cam: Pose) -> AnchoredPose:
        """Express a pose `(7,)` of the tracker relative to the reference keyframe."""
        return self._link.anchor(T_world_cam)

    def pose(self, anchored: AnchoredPose) -> Pose:
        """Return the current pose `(7,)` in the map of an anchored pose."""
        return self._link.pose(anchored)

    def keyframe_pose(self, keyframe_id: int) -> Pose:
        """Return the current pose `(7,)` of a keyframe, which may be culled, or on its way to the map."""
        return self._link.pose(AnchoredPose(keyframe_id, IDENTITY))

    def keyframe_submap(self, keyframe_id: int) -> int:
        """Return the number of the submap that such a keyframe is in now."""
        return self._link.submap_of(keyframe_id)

    @property
    def submap_now(self) -> int:
        """Number of the submap of the current frame."""
        return self._link.submap_now()

    def finish(self, state: TrackState) -> TrackState:
        """Wait for all jobs and take over their results; after `close`, take over those of jobs done until then.

        Args:
            state: State of the tracker.

        Returns:
            The state, corrected as the map.

        Raises:
            Exception: Error of a job in a thread. The state is unchanged, and nothing else is lost; call it again.
        """
        if self._semantics is not None:
            self._take_movers(*self._semantics.flush(), 0)
        if self._states is not None and not (self._localize_only or self._closed):
            self._offer_states(self._states)
        self._take_places(self._flush(self._to_places), 0)
        while self._take_maps(self._flush(self._to_mapping), 0) or self._take_adjusted(
            self._flush(self._adjuster.worker), 0
        ):
            self._take_places(self._flush(self._to_places), 0)
        if self.dense is not None:
            self.dense.finish()
        return self._carried(state)

    def adjust_map(self, state: TrackState) -> TrackState:
        """Adjust every submap by global bundle adjustment, and wait for it; to be called after `finish`.

        Args:
            state: State of the tracker.

        Returns:
            The state, corrected as the map.

        Raises:
            Exception: Error of a job in a thread, as in `finish`.
        """
        self._request_adjustment(self.map, np.unique(self.map.submap).tolist(), 0)
        return self.finish(state)

    def close(self) -> None:
        """End the threads within two seconds, and discard jobs that have not begun."""
        self._closed = True
        self._jobs.clear()
        self._adjuster.interrupt()
        looking = () if self._semantics is None else (self._semantics.worker,)
        dense = () if self.dense is None else (self.dense.worker,)
        close_all((self._to_mapping, self._to_places, self._adjuster.worker, *looking, *dense))

    def _insert_keyframe(
        self, frame: Frame, arrays: FrameArrays, output: TrackOutput, number: int, recognized: AnchoredPose | None
    ) -> None:
        keyframe = NONE
        if not self._localize_only:
            new = self._link.register_keyframe(frame.timestamp_ns, own_copy(arrays), output, recognized)
            keyframe = new.id
            states = None if self._states is None else self._states.handed_over()
            if self.dense is not None:
                self.dense.insert_keyframe(new, frame.image, pose_of(output), number)
            self._submit(self._to_mapping, new._replace(features=self.localizer.features, states=states), number)
        if self._semantics is not None:
            self._semantics.submit(keyframe, frame.image, np.asarray(arrays.depth), tracks_of(output), number)

    def _worker(self, work: Callable[[Any], Any], name: str, turn: int) -> Worker[Any, Any]:
        return make_worker(
            self._times.timed(name, work),
            f"jaxslam-{name}",
            deterministic=self._config.run.in_turn,
            latency_frames=turn * self._config.mapping.latency_frames,
            held=True,
        )

    def _submit(self, worker: Worker[_Job, Any], job: _Job, frame: int) -> None:
        """Submit a job at the end of the frame; on the schedule of a deterministic run, now."""
        if self._config.run.in_turn:
            worker.submit(job, frame)
        else:
            self._jobs.append(partial(worker.submit, job, frame))

    def _flush(self, worker: Worker[Any, _Result]) -> list[_Result]:
        self.dispatch_jobs()
        return worker.flush()

    def _take_maps(self, updates: list[MapUpdate], frame: int) -> bool:
        """Keep the newest map until the state is corrected, and submit loop searches; return whether one came."""
        for update in updates:
            self._arrived = update.map
            self._loops_closed += update.loops
            if update.loops and self._config.mapping.global_adjustment:
                closed = update.map.surviving_keyframe(int(update.map.loops.target[-1]))
                self._request_adjustment(update.map, [int(update.map.submap[update.map.row(closed)])], frame)
            self._removed += update.removed
            self._graphs.keep_ahead(len(update.map.ids))
            if self.dense is not None and not self._closed:
                self.dense.map_made(update.map, update.keyframe, frame)
            self._states_in_map = max(self._states_in_map, update.states)
            if update.gone is not None:
                self._gone.append(update.gone)
            if update.cleaned != NONE and not self._closed:
                self._submit(self._to_places, IndexUpdate(update.map, update.cleaned), frame)
            if update.keyframe != NONE and not self._closed:
                self._submit(self._to_places, LoopSearch(update.map, update.keyframe), frame)
        return bool(updates)

    def _carried(self, state: TrackState) -> TrackState:
        if not self._begun:
            return state
        if self._arrived is not None:
            state, change = self._link.apply_map(state, self._arrived)
            self._arrived = None
            self._correction = compose(change, self._correction)
            if self._states is not None:
                self._states.arrived(self.map, self._states_in_map)
        for gone in self._gone:
            state = self._link.drop_points(state, gone)
        self._gone.clear()
        return state

    def _take_movers(self, found: list[DynamicObservations], error: str, frame: int) -> None:
        """Remove the observations on movable objects from their keyframes, the map, and the tracker's state."""
        self._detector_error = error or self._detector_error
        for movers in found:
            self._gone.append(movers.tracks)
            if self.dense is not None and movers.mask.any() and not self._closed:
                self.dense.remove(movers, frame)
            if movers.keyframe != NONE and movers.mask.any() and not self._closed:
                self._submit(self._to_mapping, movers, frame)

    def _offer_states(self, states: PointStates) -> None:
        """Submit the occlusion states that changed since the last keyframe."""
        changes = states.handed_over()
        if len(changes.ids):
            self._submit(self._to_mapping, changes, 0)

    def _request_adjustment(self, slam_map: Map, submaps: list[int], frame: int) -> None:
        if not self._closed:
            self._submit(self._adjuster.worker, self._adjuster.next_job(slam_map, submaps), frame)

    def _take_adjusted(self, results: list[AdjustResult], frame: int) -> bool:
        """Have mapping take over the submaps after global bundle adjustment; return whether there are any."""
        adjusted = [] if self._closed else self._adjuster.still_wanted(results)
        for submap in adjusted:
            self._submit(self._to_mapping, submap, frame)
        return bool(adjusted)

    def _take_places(self, results: list[PlaceResult], frame: int) -> None:
        for result in results:
            if isinstance(result, LoopClosure):
                self._adjuster.interrupt()  # it would undo what the loop corrects
                if not self._closed:
                    self._submit(self._to_mapping, result, frame)
            elif result is not None:
                self._reloads.replace(result.keyframes, result.loaded)
                if result.vanished is not None:
                    gone = self._changes.gone(result.vanished)
                    if len(gone) and not self._closed:
                        self._submit(self._to_mapping, PointRemoval(gone), frame)

    def _request_reload(self, T_world_cam: Pose, frame: int, seen: FrameDepth | None = None) -> None:
        if self._track_plan.num_reloaded and self._link.reference != NONE:
            held = frozenset(self._link.latest()), frozenset(self._link.loaded())
            self._submit(self._to_places, Reload(self.map, T_world_cam, self._link.submap_now(), *held, seen), frame)
