"""The dense map in the making, in a thread of its own.

The tracker's thread hands over copies and goes on. At most so many keyframes wait; when more come, the oldest of them
is never looked at.
"""

import threading
from typing import TypeAlias

import numpy as np

from jaxslam.config.schema import Config, DenseConfig
from jaxslam.dense.coverage import SeenArea
from jaxslam.dense.dense_map import DenseFigures, DenseKeyframe, DenseMap, DepthGlance
from jaxslam.dense.key_objects import Neighbors
from jaxslam.dense.occupancy import Occupancy
from jaxslam.dense.point_cloud import DenseCloud
from jaxslam.geometry.se3 import IDENTITY, retract
from jaxslam.map.dynamic_removal import DynamicObservations
from jaxslam.map.types import NONE, Map
from jaxslam.mapping.local_mapping import NewKeyframe
from jaxslam.runtime.stage_timer import StageTimes
from jaxslam.runtime.worker import Worker, make_worker
from jaxslam.semantics import Detector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import SensorModel
from jaxslam.slam.tracker_map_sync import pose_of
from jaxslam.tracking.state import TrackOutput

_MAX_WAITING = 8
"""Keyframes that wait: 2.5 MB each at 640x480, and more than two seconds of a tracker that makes three a second."""
_LOOK_EVERY = 5
"""Frames, of which one has its look at what is not there any more, and at what is new: with keyframes alone, twice as
many ghosts stay. A keyframe of a camera that measures depth has none of its own besides."""

_Job: TypeAlias = DenseKeyframe | DepthGlance | DynamicObservations | None
"""`None`: look at the newest map."""


class DenseMapping:
    """Makes the dense map of keyframes that are in the map.

    All but `cloud`, `cells` and `figures` is called from the tracker's thread.

    Attributes:
        wants_keyframe: Whether much is in the picture that no keyframe shows.
    """

    def __init__(self, slam_map: DenseMap, seen: SeenArea, config: DenseConfig, *, deterministic: bool) -> None:
        """Begin.

        Args:
            slam_map: Empty; from now on nobody else's.
            seen: Without keyframes; nobody else's either.
            config: Settings that it was made with.
            deterministic: Work in turn; else in a thread.
        """
        self._map, self._carves = slam_map, config.carve
        self._seen, self._least_seen, self.wants_keyframe = seen, config.keyframe_below, False
        self._neighbors = Neighbors(config.key_window, config.key_frames) if slam_map.has_keys else None
        self._on_the_way: dict[int, DenseKeyframe] = {}
        self._lock = threading.Lock()
        self.worker: Worker[_Job, None] = make_worker(
            self._do_job,
            "jaxslam-dense",
            deterministic=deterministic,
            latency_frames=0,
            max_waiting=_MAX_WAITING,
            may_drop=_is_keyframe,
        )

    def compile(self) -> None:
        """Compile all that is needed."""
        with self._lock:
            self._map.compile()

    def insert_keyframe(self, new: NewKeyframe, image: np.ndarray, pose: np.ndarray, frame: int) -> None:
        """Take a keyframe; it is put in when it is in the map.

        Args:
            new: The keyframe, as local mapping gets it.
            image: `(h, w, 3)` RGB or `(h, w)`; copied.
            pose: `(7,)` where the tracker has it.
            frame: Its number.
        """
        arrays = new.frame
        self._seen.add(pose)
        self.wants_keyframe = False
        self._on_the_way[new.id] = DenseKeyframe(
            keyframe=new.id,
            image=image.copy(),
            depth=np.asarray(arrays.depth),
            pair=None if arrays.right is None else (np.asarray(arrays.image), np.asarray(arrays.right)),
            ignore=np.asarray(arrays.ignore),
            T_cam_depth=retract(IDENTITY, new.twist * float(arrays.depth_delay_s)),
            neighbors=() if self._neighbors is None else self._neighbors.before(frame, pose),
        )

    def frame_tracked(self, frame: int, image: np.ndarray, arrays: FrameArrays, output: TrackOutput) -> None:
        """Take in a frame that was tracked.

        It may show key objects of a keyframe to come, and what it sees past is not there.
        """
        depth, ignore, pose = np.asarray(arrays.depth), np.asarray(arrays.ignore), pose_of(output)
        if self._neighbors is not None:
            self._neighbors.see(frame, image, depth, ignore, pose)
        if frame % _LOOK_EVERY:
            return
        self.wants_keyframe = self._seen.share(depth, ignore, pose) < self._least_seen
        # Rough depth of a pair would see past what is there: keyframes, which are matched again, look instead.
        if self._carves and arrays.right is None and self.worker.num_waiting < _MAX_WAITING:
            pose = retract(pose, np.asarray(output.twist) * float(arrays.depth_delay_s))
            self._add_job(self._map.look_of(depth, ignore, pose), frame)

    def map_made(self, slam_map: Map, keyframe: int, frame: int) -> None:
        """Take in a new map, and the keyframe that is new in it, or `NONE`."""
        self._map.sparse = slam_map
        shown = self._on_the_way.pop(keyframe, None)
        self._add_job(shown, frame)

    def remove(self, movers: DynamicObservations, frame: int) -> None:
        """Take in what may move in a keyframe."""
        shown = self._on_the_way.get(movers.keyframe)
        if shown is not None:
            self._on_the_way[movers.keyframe] = shown._replace(ignore=shown.ignore | movers.mask)
        elif movers.keyframe != NONE:
            self._add_job(movers, frame)

    def collect(self, frame: int) -> None:
        """Raise what went wrong, if something did."""
        self.worker.collect(frame)

    def finish(self) -> None:
        """Wait until all is in, and every keyframe where the map has it."""
        self.worker.flush()
        with self._lock:
            self._map.correct_all()

    def cloud(self) -> DenseCloud:
        """The points as they are now, in the submap with most keyframes; from any thread."""
        with self._lock:
            return self._map.cloud()

    def cells(self) -> Occupancy:
        """Return the occupied and free cells by all keyframes that are kept; from any thread.

        Raises:
            MapFileError: If there is none yet.
        """
        with self._lock:
            depths, poses = self._map.depths()
        return self._map.cells(depths, poses)

    @property
    def sees_anything(self) -> bool:
        """Whether a keyframe that is kept has depth."""
        with self._lock:
            return self._map.sees_anything

    def figures(self) -> DenseFigures:
        """Return figures of the map so far; from any thread."""
        with self._lock:
            return self._map.figures(self.worker.num_dropped)

    def _add_job(self, job: _Job, frame: int) -> None:
        if job is None and self.worker.num_waiting:
            return  # every job brings the dense map up to date with the newest map
        self.worker.submit(job, frame)

    def _do_job(self, job: _Job) -> None:
        with self._lock:
            if isinstance(job, DenseKeyframe):
                self._map.add(job)
            elif isinstance(job, DynamicObservations):
                self._map.remove(job)
            elif isinstance(job, DepthGlance):
                self._map.look(job)
            else:
                self._map.correct()


def _is_keyframe(job: _Job) -> bool:
    """Whether a job may be dropped: a keyframe may, but what was removed from another one must not be lost."""
    return isinstance(job, DenseKeyframe)


def dense_mapping_of(
    camera: Camera, sensor: SensorModel, config: Config, key_detector: Detector | None, times: StageTimes
) -> DenseMapping:
    """Make the dense map that the settings describe, empty, and its thread.

    Args:
        camera: Camera that takes the frames.
        sensor: Camera with the limits of its depth.
        config: Settings in effect.
        key_detector: Finds what the map has at full density; `None` for nothing.
        times: Record of the duration of every job.
    """
    nearest_m, farthest_m = float(sensor.min_depth_m), float(sensor.max_depth_m)
    dense_map = DenseMap(
        camera, config.dense, nearest_m=nearest_m, farthest_m=farthest_m, key_detector=key_detector, times=times
    )
    seen = SeenArea(camera, nearest_m, farthest_m)
    return DenseMapping(dense_map, seen, config.dense, deterministic=config.run.in_turn)
