"""Keyframes of the map that wait to be loaded into the tracker."""

from collections.abc import Iterable, Set

import numpy as np

from jaxslam.map.types import Map
from jaxslam.mapping.track_table import TrackId
from jaxslam.slam.keyframe_reload import MapKeyframe
from jaxslam.slam.tracker_map_sync import TrackerMapSync
from jaxslam.tracking.state import TrackState


class ReloadQueue:
    """Keyframes of the map that wait to be loaded into the tracker, one per frame so that no frame takes long."""

    def __init__(self, link: TrackerMapSync, *, points_may_leave: bool) -> None:
        """Start empty.

        Args:
            link: The map and the keyframe slots of the tracker.
            points_may_leave: Whether points may be removed from the map while their keyframe waits, as they are where a
                detector looks at keyframes; such points are not loaded.
        """
        self._link, self._points_may_leave = link, points_may_leave
        self._waiting: list[MapKeyframe] = []
        self._wanted: set[int] = set()

    def replace(self, keyframes: Iterable[MapKeyframe], stay: Set[int] = frozenset()) -> None:
        """Load these keyframes from now on, instead of those that still wait.

        Args:
            keyframes: Keyframes to load, best first.
            stay: Ids of keyframes that are loaded, and must not make room for them.
        """
        self._waiting = list(keyframes)
        self._wanted = {keyframe.keyframe for keyframe in self._waiting} | stay

    def load_next(self, state: TrackState) -> TrackState:
        """Return the state of the tracker with the next keyframe loaded that is not loaded yet."""
        while self._waiting:
            keyframe = self._waiting.pop(0)
            slot = self._link.slot_for(keyframe.keyframe, self._wanted)
            if slot is not None:
                if self._points_may_leave:
                    keyframe = _without_removed(keyframe, self._link.map)
                return self._link.load_keyframe(state, slot, keyframe)
        return state

    def load_all(self, state: TrackState) -> TrackState:
        """Return the state of the tracker with all waiting keyframes loaded."""
        while self._waiting:
            state = self.load_next(state)
        return state


def _without_removed(keyframe: MapKeyframe, slam_map: Map) -> MapKeyframe:
    """Give weight 0 to points of a keyframe that have left the map since the keyframe was prepared."""
    present = slam_map.contents.have(TrackId.map_points(keyframe.id))
    return keyframe._replace(weight=np.where(present, keyframe.weight, np.float32(0)))
