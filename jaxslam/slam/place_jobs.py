"""Jobs of the place worker: detect loops, update the place index, and reload keyframes for the tracker."""

from typing import NamedTuple, TypeAlias

from jaxslam.geometry.types import Pose
from jaxslam.loop_closing.loop_detector import LoopClosing, LoopClosure
from jaxslam.map.types import Map
from jaxslam.mapping.local_map_tracking import keyframes_in_view, nearest_keyframes
from jaxslam.mapping.vanished_points import FrameDepth, VanishedPoints, vanished_points
from jaxslam.slam.keyframe_reload import MapKeyframe, reload_keyframe
from jaxslam.tracking.state import TrackPlan


class LoopSearch(NamedTuple):
    """A job: check whether a keyframe closes a loop.

    Attributes:
        map: Map that contains the keyframe.
        keyframe: Id of the keyframe.
    """

    map: Map
    keyframe: int


class Reload(NamedTuple):
    """A job: prepare keyframes of the map that see what the camera sees, for the tracker.

    Attributes:
        map: Map with the keyframes.
        T_world_cam: `(7,)` pose of the camera.
        submap: Number of the submap that the camera is in.
        latest: Ids of the keyframes in the tracker's ring, which are left out.
        loaded: Ids of the keyframes that are loaded into the tracker: they need not be prepared again.
        seen: Depth of the frame, to find the points that are gone; `None` not to look for them.
    """

    map: Map
    T_world_cam: Pose
    submap: int
    latest: frozenset[int] = frozenset()
    loaded: frozenset[int] = frozenset()
    seen: FrameDepth | None = None


class Surroundings(NamedTuple):
    """Keyframes of the map that best cover the camera's view.

    Attributes:
        loaded: Ids of those that are loaded into the tracker, and stay.
        keyframes: Those to load, best first.
        vanished: Points in view that the frame sees through; `None` if they were not looked for.
    """

    loaded: frozenset[int]
    keyframes: tuple[MapKeyframe, ...]
    vanished: VanishedPoints | None = None


class IndexUpdate(NamedTuple):
    """A job: update the place index after features of a keyframe were removed.

    Attributes:
        map: Map after the removal.
        keyframe: Id of the keyframe.
    """

    map: Map
    keyframe: int


PlaceJob: TypeAlias = LoopSearch | Reload | IndexUpdate
PlaceResult: TypeAlias = LoopClosure | Surroundings | None
"""A loop, or keyframes for the tracker; `None` if there is no loop."""


class PlaceSearch:
    """Does the jobs of the place worker."""

    def __init__(self, loops: LoopClosing, plan: TrackPlan) -> None:
        """Keep what the jobs need.

        Args:
            loops: Loop detector with its place index.
            plan: Plan of the tracker, with the number of keyframes to reload.
        """
        self._loops, self._plan = loops, plan

    def do(self, job: PlaceJob) -> PlaceResult:
        """Do a job."""
        if isinstance(job, LoopSearch):
            return self._loops.look(job.map, job.keyframe)
        if isinstance(job, IndexUpdate):
            return self._loops.replace(job.map, job.keyframe)
        return self.reload(job)

    def reload(self, job: Reload) -> Surroundings:
        """Return the keyframes that best cover the camera's view, at most `num_reloaded` of the plan."""
        wanted = keyframes_in_view(job.map, job.T_world_cam, job.submap, set(job.latest), self._plan.num_reloaded)
        new = (keyframe_id for keyframe_id in wanted if keyframe_id not in job.loaded)
        prepared = tuple(reload_keyframe(job.map, keyframe_id, self._plan.num_points) for keyframe_id in new)
        return Surroundings(job.loaded.intersection(wanted), prepared, self._vanished(job))

    @staticmethod
    def _vanished(job: Reload) -> VanishedPoints | None:
        if job.seen is None:
            return None
        # Not only those that show the view: what was moved had been seen from anywhere.
        around = nearest_keyframes(job.map, job.T_world_cam, job.submap)
        return vanished_points(job.map, around, job.T_world_cam, job.seen)
