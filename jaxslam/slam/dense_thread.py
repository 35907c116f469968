"""The thread that makes the dense map.

The tracker's thread hands over copies and goes on. The number of waiting keyframes is limited; when more come, the
oldest one is dropped.
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
from jaxslam.geometry.types import Pose
from jaxslam.map.dynamic_removal import DynamicObservations
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map
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
"""Largest number of waiting keyframes: 2.5 MB each at 640x480, over two seconds of a tracker that makes three a second.
"""
_LOOK_EVERY = 5
"""Every so many frames, free space is carved and the share of new surface is measured. With keyframes alone, twice as
many ghosts stay; so keyframes of a depth camera do not carve themselves."""

_Job: TypeAlias = DenseKeyframe | DepthGlance | DynamicObservations | None
"""`None`: move the points with the keyframes of the newest map."""


class DenseMapping:
    """Makes the dense map from the keyframes of the map.

    The tracker's thread calls the methods; `cloud`, `cells`, `figures` and `sees_anything` may be called from any
    thread.

    Attributes:
        wants_keyframe: Whether a large share of the image shows surface that no keyframe shows.
    """

    def __init__(
        self, slam_map: DenseMap, seen: SeenArea, config: DenseConfig, *, deterministic: bool, held: bool = False
    ) -> None:
        """Start with an empty dense map.

        Args:
            slam_map: Empty dense map, of which this object becomes the only user.
            seen: Area seen by keyframes, empty, of which this object becomes the only user.
            config: Settings that the dense map was made with.
            deterministic: Run jobs in the caller's thread instead of a thread of its own.
            held: Whether jobs wait until `begin`.
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
            held=held,
        )

    def compile(self) -> None:
        """Compile the programs of the dense map."""
        with self._lock:
            self._map.compile()

    def begin(self) -> None:
        """Begin with the jobs that wait, now that the programs are compiled."""
        self.worker.begin()

    def insert_keyframe(self, new: NewKeyframe, image: np.ndarray, pose: Pose, frame: int) -> None:
        """Keep a keyframe, which is added to the dense map when local mapping has inserted it.

        Args:
            new: Keyframe, as local mapping gets it.
            image: `(h, w, 3)` RGB or `(h, w)` gray image; copied.
            pose: `(7,)` pose of the keyframe as the tracker estimated it.
            frame: Number of the frame.
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
        """Use a tracked frame: it may show key objects of the next keyframe, and it carves free space.

        Args:
            frame: Number of the frame.
            image: `(h, w, 3)` RGB or `(h, w)` gray image; copied if it is kept.
            arrays: Arrays of the frame; copied if they are kept.
            output: Output of the tracker for the frame.
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
        """Take over a new map, with the id of the keyframe that was inserted into it, or `NONE`."""
        self._map.sparse = slam_map
        shown = self._on_the_way.pop(keyframe, None)
        self._add_job(shown, frame)

    def remove(self, movers: DynamicObservations, frame: int) -> None:
        """Remove the pixels of movable objects of a keyframe."""
        shown = self._on_the_way.get(movers.keyframe)
        if shown is not None:
            self._on_the_way[movers.keyframe] = shown._replace(ignore=shown.ignore | movers.mask)
        elif movers.keyframe != NONE:
            self._add_job(movers, frame)

    def collect(self, frame: int) -> None:
        """Raise the error of a job, if there was one."""
        self.worker.collect(frame)

    def finish(self) -> None:
        """Wait for all jobs, and move all points with the keyframes of the newest map."""
        self.worker.flush()
        with self._lock:
            self._map.correct_all()

    def cloud(self) -> DenseCloud:
        """Return the current points of the submap with most keyframes; from any thread."""
        with self._lock:
            return self._map.cloud()

    def cells(self) -> Occupancy:
        """Return the occupied and free cells according to all stored keyframes; from any thread.

        Raises:
            MapFileError: If no keyframe is stored yet.
        """
        with self._lock:
            depths, poses = self._map.depths()
        return self._map.cells(depths, poses)

    @property
    def sees_anything(self) -> bool:
        """Whether any stored keyframe has depth."""
        with self._lock:
            return self._map.sees_anything

    def figures(self) -> DenseFigures:
        """Return figures of the dense map so far; from any thread."""
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
    """Whether a job may be dropped: a keyframe may be, the removal of observations must not be."""
    return isinstance(job, DenseKeyframe)


def dense_mapping_of(
    camera: Camera, sensor: SensorModel, config: Config, key_detector: Detector | None, times: StageTimes
) -> DenseMapping:
    """Make an empty dense map according to the settings, and its thread, which is held.

    Args:
        camera: Camera that takes the frames.
        sensor: Camera with the limits of its depth.
        config: Settings in effect.
        key_detector: Detector of objects that the map keeps at full density; `None` for none.
        times: Record of the duration of every job.
    """
    nearest_m, farthest_m = float(sensor.min_depth_m), float(sensor.max_depth_m)
    dense_map = DenseMap(
        camera, config.dense, nearest_m=nearest_m, farthest_m=farthest_m, key_detector=key_detector, times=times
    )
    seen = SeenArea(camera, nearest_m, farthest_m)
    return DenseMapping(dense_map, seen, config.dense, deterministic=config.run.in_turn, held=True)
