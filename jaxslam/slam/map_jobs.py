"""Jobs that change the map, done one after the other by the mapping worker."""

from typing import NamedTuple, TypeAlias

import numpy as np

from jaxslam.features.orb import no_features
from jaxslam.geometry.types import Ids
from jaxslam.loop_closing.loop_detector import LoopClosure
from jaxslam.map.dynamic_removal import DynamicObservations
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map
from jaxslam.mapping.global_bundle_adjustment import AdjustedSubmap
from jaxslam.mapping.local_mapping import LocalMapping, MappingPlan, NewKeyframe, with_new_keyframe
from jaxslam.mapping.occlusion_states import StateChanges
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import SensorModel


class PointRemoval(NamedTuple):
    """A job: remove points that are gone.

    Attributes:
        ids: `(n,)` ids of the points, some of which may have left the map.
    """

    ids: Ids


MapJob: TypeAlias = NewKeyframe | LoopClosure | AdjustedSubmap | DynamicObservations | StateChanges | PointRemoval
"""A keyframe to insert, a loop to close, a submap after global bundle adjustment, observations or points to remove, or
occlusion states to store."""


class MapUpdate(NamedTuple):
    """The map after a job, and what the job changed.

    Attributes:
        map: The map after the job.
        keyframe: Id of the inserted keyframe, or `NONE`.
        loops: Number of loops that were closed.
        cleaned: Id of the keyframe whose dynamic observations were removed, or `NONE`.
        removed: Number of points that were removed from the map.
        gone: `(n,)` track ids of the removed points; `None` if the job removes none.
        states: Number of the latest `StateChanges` that the map contains; 0 if the job stored none.
    """

    map: Map
    keyframe: int = NONE
    loops: int = 0
    cleaned: int = NONE
    removed: int = 0
    gone: np.ndarray | None = None
    states: int = 0


class MapWriter:
    """Changes the map; only the mapping worker calls `do`."""

    def __init__(self, camera: Camera, sensor: SensorModel, plan: MappingPlan, start: Map) -> None:
        """Start with a map.

        Args:
            camera: Camera of the keyframes.
            sensor: Noise model of the camera.
            plan: Static sizes of local mapping.
            start: Map to change, possibly empty.
        """
        self._camera, self._sensor, self._plan = camera, sensor, plan
        self._mapping = LocalMapping(camera, sensor, plan, start)

    def compile(self, frame: FrameArrays, num_tracks: int) -> None:
        """Compile local mapping for frames of one size.

        Args:
            frame: Any frame of that size.
            num_tracks: Largest number of points that the tracker sees in a frame.
        """
        self._mapping.compile(frame, num_tracks)

    def do(self, job: MapJob) -> MapUpdate:
        """Do a job.

        Raises:
            Exception: Any error of the job. The map is then the one before it, with a new keyframe inserted without
                points, since later keyframes are linked to it.
        """
        before = self._mapping.map
        try:
            if isinstance(job, LoopClosure):
                slam_map = self._mapping.close_loop(job)
                return MapUpdate(slam_map, loops=int(slam_map is not before))
            if isinstance(job, AdjustedSubmap):
                return MapUpdate(self._mapping.take_adjusted(job))
            if isinstance(job, DynamicObservations):
                slam_map, gone = self._mapping.remove(job)
                removed = before.contents.num_points - slam_map.contents.num_points
                return MapUpdate(slam_map, cleaned=job.keyframe, removed=removed, gone=gone)
            if isinstance(job, PointRemoval):
                return MapUpdate(self._mapping.remove_points(job.ids))
            if isinstance(job, StateChanges):
                return MapUpdate(self._mapping.take_states(job), states=job.number)
            return MapUpdate(self._mapping.add(job), job.id, states=0 if job.states is None else job.states.number)
        except BaseException:
            slam_map = with_new_keyframe(before, job, no_features()) if isinstance(job, NewKeyframe) else before
            self._mapping = LocalMapping(self._camera, self._sensor, self._plan, slam_map)
            raise
