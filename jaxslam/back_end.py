"""All that goes on beside tracking: mapping, loop closing and recall, in threads or on a fixed schedule.

The tracker hands over keyframes and takes what is there; it never waits. Every exchange happens in the tracker's
thread, in `update`: jobs and results are immutable, so threads share nothing but the index of places, which has a lock.
"""

import threading
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from jaxslam.camera import Camera
from jaxslam.config import Config
from jaxslam.features import features_of
from jaxslam.frame_arrays import FrameArrays
from jaxslam.local_mapping import LocalMapping, NewKeyframe, mapping_plan
from jaxslam.loop_closing import LoopClosing, LoopClosure
from jaxslam.map import NONE, Map, empty_map
from jaxslam.map_link import Hung, MapLink
from jaxslam.place_index import PlaceIndex
from jaxslam.place_recognition import MIN_INLIERS, compile_recognition, recognise
from jaxslam.pose import IDENTITY, compose
from jaxslam.recall import Recalled, recall, worth_recalling
from jaxslam.state import TrackOutput, TrackParams, TrackPlan, TrackState
from jaxslam.state_edit import relocated
from jaxslam.worker import InlineWorker, ThreadWorker, Worker

_relocated = jax.jit(relocated, donate_argnums=0)

_RECALL_EVERY = 10
"""Frames after which a tracker that only localises gets other keyframes."""


class _Look(NamedTuple):
    """A job: look whether a keyframe closes a loop."""

    map: Map
    keyframe: int


class _Recall(NamedTuple):
    """A job: find and prepare keyframes that show what the camera sees."""

    map: Map
    T_world_cam: np.ndarray
    submap: int
    known: frozenset[int]


class _MapUpdate(NamedTuple):
    """A new map, and the keyframe it is of; `NONE` if a loop was closed."""

    map: Map
    keyframe: int


_PlaceJob: TypeAlias = _Look | _Recall
_PlaceResult: TypeAlias = LoopClosure | tuple[Recalled, ...] | None


class BackEnd:
    """Owns the map and the threads that make it."""

    def __init__(
        self,
        camera: Camera,
        params: TrackParams,
        plan: TrackPlan,
        config: Config,
        map: Map | None = None,
        *,
        localize_only: bool = False,
    ) -> None:
        """Start with a map, empty by default.

        Args:
            camera: That takes the frames.
            params: Of the tracker.
            plan: Of the tracker.
            config: Settings.
            map: To start with.
            localize_only: Leave the map as it is.
        """
        self._params, self._track_plan, self._plan = params, plan, mapping_plan(config.mapping, config.track)
        self._config, self._localize_only = config, localize_only
        start = empty_map(camera) if map is None else map
        self._mapping = LocalMapping(camera, params, self._plan, start)
        self._index, self._lock = PlaceIndex.from_map(start), threading.Lock()
        self._loops = LoopClosing(self._index, params, self._plan.features)
        self._to_mapping: Worker[NewKeyframe | LoopClosure, _MapUpdate] = self._worker(self._map_job, "mapping", 1)
        self._to_places: Worker[_PlaceJob, _PlaceResult] = self._worker(self._place_job, "places", 2)
        self._link = MapLink(plan, start)
        self._waiting: list[Recalled] = []
        self._loops_closed = 0

    @property
    def map(self) -> Map:
        """The map as it is now."""
        return self._link.map

    @property
    def loops_closed(self) -> int:
        """Loops that have been closed, submaps that became one included."""
        return self._loops_closed

    def compile(self, frame: FrameArrays) -> None:
        """Compile all that is needed while frames of this kind come."""
        num_looked_up = self._track_plan.num_sources * self._track_plan.points_per_source
        self._mapping.compile(frame, self._track_plan.num_points + num_looked_up)
        compile_recognition(self._params, self._plan.features)

    def update(self, state: TrackState, frame: int) -> tuple[TrackState, np.ndarray]:
        """Take in what is ready by a frame: carry the tracker along with the map, and give it keyframes back.

        Returns:
            The state, and the correction of the world `(7,)` at the camera since the last update.

        Raises:
            Exception: What went wrong in a thread.
        """
        state, correction = self._take_maps(state, self._to_mapping.take(frame), frame)
        self._take_places(self._to_places.take(frame), frame)
        return self._with_recalled(state), correction

    def keyframe_made(
        self, timestamp_ns: int, arrays: FrameArrays, output: TrackOutput, frame: int, recognised: Hung | None
    ) -> None:
        """Hand over a keyframe of the tracker.

        Args:
            timestamp_ns: Its time.
            arrays: The frame, not to be written to any more.
            output: What the tracker said of it.
            frame: Its number.
            recognised: Where it is, if tracking began at a place that was recognised.
        """
        if not self._localize_only:
            self._to_mapping.offer(self._link.keyframe_made(timestamp_ns, arrays, output, recognised), frame)

    def recognise(self, arrays: FrameArrays) -> tuple[Hung | None, bool]:
        """Where a frame was taken, if the map shows that place; and whether the frame shows enough to tell."""
        features = features_of(arrays, np.zeros(6, np.float32), self._params, self._plan.features)
        if np.count_nonzero(features.depth) < MIN_INLIERS:
            return None, False
        with self._lock:
            found = recognise(self.map, self._index, features, self._params, plan=self._plan.features)
        return None if found is None else Hung(found.keyframe, found.T_keyframe_cam), True

    def relocated(self, state: TrackState, recognised: Hung) -> TrackState:
        """The state of the tracker begun anew where the map recognised a place, with keyframes of it at hand."""
        self._link.refer_to(recognised.keyframe)
        pose = self._link.pose(recognised)
        state = self.restarted(state, pose)
        wanted = worth_recalling(self.map, pose, self._link.submap_now(), set(), self._track_plan.num_recalled)
        self._waiting = [recall(self.map, keyframe_id, self._track_plan.num_points) for keyframe_id in wanted]
        while self._waiting:
            state = self._with_recalled(state)
        return state

    def restarted(self, state: TrackState, T_world_cam: np.ndarray) -> TrackState:
        """The state of the tracker begun anew at a pose."""
        self._link.forget_slots()
        self._waiting = []
        return _relocated(state, T_world_cam.astype(np.float32))

    def localize(self, T_world_cam: np.ndarray, frame: int) -> None:
        """Look now and then for keyframes to recall, when none are made any more."""
        if self._localize_only and frame % _RECALL_EVERY == 0:
            self._offer_recall(T_world_cam, frame)

    def hang(self, T_world_cam: np.ndarray) -> Hung:
        """A pose of the tracker, tied to the map."""
        return self._link.hang(T_world_cam)

    def pose(self, hung: Hung) -> np.ndarray:
        """`(7,)` where it is in the map now."""
        return self._link.pose(hung)

    def finish(self, state: TrackState) -> TrackState:
        """Wait until everything handed over is in the map."""
        while maps := self._to_mapping.drain():
            state, _ = self._take_maps(state, maps, 0)
            self._take_places(self._to_places.drain(), 0)
        return state

    def close(self) -> None:
        """End the threads."""
        self._to_mapping.close()
        self._to_places.close()

    def _worker(self, work: Callable[[Any], Any], name: str, turn: int) -> Worker[Any, Any]:
        if self._config.run.deterministic:
            return InlineWorker(work, turn * self._config.mapping.latency_frames)
        return ThreadWorker(work, f"jaxslam-{name}")

    def _map_job(self, job: NewKeyframe | LoopClosure) -> _MapUpdate:
        if isinstance(job, LoopClosure):
            return _MapUpdate(self._mapping.close_loop(job), NONE)
        return _MapUpdate(self._mapping.add(job), job.id)

    def _place_job(self, job: _PlaceJob) -> _PlaceResult:
        if isinstance(job, _Look):
            with self._lock:
                return self._loops.look(job.map, job.keyframe)
        wanted = worth_recalling(job.map, job.T_world_cam, job.submap, set(job.known), self._track_plan.num_recalled)
        return tuple(recall(job.map, keyframe_id, self._track_plan.num_points) for keyframe_id in wanted)

    def _take_maps(self, state: TrackState, updates: list[_MapUpdate], frame: int) -> tuple[TrackState, np.ndarray]:
        correction = IDENTITY
        for update in updates:
            state, change = self._link.corrected(state, update.map)
            correction = compose(change, correction)
            if update.keyframe == NONE:
                self._loops_closed += 1
                continue
            self._to_places.offer(_Look(update.map, update.keyframe), frame)
            self._offer_recall(self._link.believed(self._link.reference), frame)
        return state, correction

    def _take_places(self, results: list[_PlaceResult], frame: int) -> None:
        for result in results:
            if isinstance(result, LoopClosure):
                self._to_mapping.offer(result, frame)
            elif result:
                self._waiting = list(result)

    def _offer_recall(self, T_world_cam: np.ndarray, frame: int) -> None:
        if self._track_plan.num_recalled and self._link.reference != NONE:
            known = frozenset(self._link.latest())
            self._to_places.offer(_Recall(self.map, T_world_cam, self._link.submap_now(), known), frame)

    def _with_recalled(self, state: TrackState) -> TrackState:
        """The state with one more of the keyframes that wait; one a frame, so that none takes long."""
        while self._waiting:
            keyframe = self._waiting.pop(0)
            slot = self._link.slot_for(keyframe.keyframe, {other.keyframe for other in self._waiting})
            if slot is not None:
                return self._link.recalled(state, slot, keyframe)
        return state


def copied(arrays: FrameArrays) -> FrameArrays:
    """A frame's own copy, for use after the caller has got its images back."""
    return FrameArrays(*jax.tree.map(np.array, tuple(arrays)))
