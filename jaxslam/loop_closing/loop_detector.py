"""Loop detection: recognize a place seen long ago, verify it, and compute the correction of the map.

The detector runs beside tracking and mapping. It reads a map and returns the correction; local mapping applies it to
the map as it is by then.

Source: Mur-Artal et al., "ORB-SLAM", 2015, section VII, for the steps. A wrong loop is worse than a missed one, so the
geometry of a place must fit (`place_recognition`), its surroundings must not contradict it (`visibility_check`), two
keyframes must agree on the correction, and the change of the keyframes in between must be within the uncertainty of
their relative poses (`essential_graph`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxslam.features.orb import FeaturePlan
from jaxslam.geometry.se3 import angle, between, compose, displacement, inverse
from jaxslam.geometry.types import Ids, Pose, Poses
from jaxslam.loop_closing.essential_graph import poses_with_loop
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.loop_closing.place_recognition import Recognition, recognize
from jaxslam.loop_closing.visibility_check import see_through_ratio
from jaxslam.map.point_records import has, rows
from jaxslam.map.types import Map, covisible
from jaxslam.sensors.sensor_model import SensorModel

_LATEST = 10
"""Keyframes too recent to count as a place seen long ago, and keyframes allowed until a loop has entered the map."""
_AGREE_REACH, _AGREE_RAD = 1 / 120, 0.04
"""Maximum difference between the corrections of two keyframes, as a share of the largest valid depth, and in radians:
5 cm for a sensor that measures up to 6 m, 34 cm on a road seen by a pair with a baseline of 0.54 m."""
_REMEMBERED = 3
"""Number of keyframes for which a first candidate waits for a second one that agrees."""
_MAX_SEEN_THROUGH = 0.3
"""Share of a place's surfaces that a keyframe may have to see through. Pairs of keyframes that do show the same place
come out below 0.28 in a static room, and three of four come out below it in a crowd."""
_COMMON_ERRORS = 3.0
"""Factor on the standard deviation of a recognition for the errors that its features share: depth, calibration,
and the keyframe's own pose relative to its points. On recordings, poses are off by this much more."""
_LOOP_REACH, _LOOP_RAD = 1 / 600, 0.005
"""Minimum standard deviation of a loop, as a share of the largest valid depth, and in radians."""

_NEWS = 6.0
"""Squared distance in standard deviations from which a recognized place corrects the map: the mean where there is
nothing to correct. In a room that is well known, closing such loops moved keyframes by millimeters, for nothing."""


class LoopClosure(NamedTuple):
    """A verified loop and the correction it implies.

    Attributes:
        source: Id of the keyframe that first showed the place.
        target: Id of the keyframe that showed it again.
        T_source_target: `(7,)` measured relative pose.
        information: `(6, 6)` inverse covariance of the measurement.
        keyframes: `(k,)` ids of the keyframes with a corrected pose; empty if the loop merges two submaps.
        T_world_cam: `(k, 7)` corrected poses of these keyframes.
    """

    source: int
    target: int
    T_source_target: Pose
    information: Float64[np.ndarray, "6 6"]
    keyframes: Ids
    T_world_cam: Poses


class _Candidate(NamedTuple):
    recognition: Recognition
    keyframe: int
    T_new_old: Pose
    """The correction of the world that it implies at the keyframe."""


class LoopClosing:
    """Detects loops, keyframe by keyframe."""

    def __init__(self, index: PlaceIndex, sensor: SensorModel, plan: FeaturePlan) -> None:
        """Share a place index, to which keyframes are added here."""
        self._index, self._sensor, self._plan = index, sensor, plan
        self._farthest_m = float(sensor.max_depth_m)
        self._candidates: list[_Candidate] = []
        self._closed: tuple[int, int] | None = None

    def look(self, slam_map: Map, keyframe_id: int) -> LoopClosure | None:
        """Add a keyframe of the map; return the loop that it closes, if any."""
        # 0. The keyframe may have been culled before its turn came.
        if not slam_map.has_keyframe(keyframe_id):
            return None
        # 1. Loop candidate detection and its relative pose (sections VII-A and VII-B): place recognition.
        found = self._recognized(slam_map, keyframe_id)
        if found is None or self._outdated(slam_map, keyframe_id):
            return None
        # 2. Express the candidate as a correction of the world at the keyframe.
        pose = compose(slam_map.pose(found.keyframe), found.T_keyframe_cam)
        candidate = _Candidate(found, keyframe_id, compose(pose, inverse(slam_map.pose(keyframe_id))))
        # 3. Consistency (section VII-A): a recent candidate must ask for the same correction. The paper wants three
        #    consecutive ones; here two suffice, as their full poses must agree.
        self._candidates = [c for c in self._candidates if c.keyframe >= keyframe_id - _REMEMBERED]
        agreed = any(_agree(slam_map, candidate, other, self._farthest_m) for other in self._candidates)
        self._candidates.append(candidate)
        # 4. Essential graph optimization (section VII-D). The map itself is corrected later, by local mapping.
        closure = _closure(slam_map, candidate, self._farthest_m) if agreed else None
        if closure is not None:
            self._candidates.clear()
            self._closed = len(slam_map.loops.source), keyframe_id
        return closure

    def replace(self, slam_map: Map, keyframe_id: int) -> None:
        """Update the place index after a keyframe of the map has lost features."""
        with self._index.lock:
            if keyframe_id in self._index and slam_map.has_keyframe(keyframe_id):
                self._index.replace(keyframe_id, slam_map.keyframe(keyframe_id).features)

    def _recognized(self, slam_map: Map, keyframe_id: int) -> Recognition | None:
        """Recognize a place seen long ago in a keyframe, and add the keyframe to the place index."""
        features = slam_map.keyframe(keyframe_id).features
        exclude = _familiar(slam_map, keyframe_id)
        with self._index.lock:
            found = recognize(slam_map, self._index, features, self._sensor, exclude=exclude, plan=self._plan)
            self._index.add(keyframe_id, features)
            for gone in self._index.ids() - set(slam_map.ids.tolist()):
                self._index.remove(gone)
        if found is None:
            return None
        source = slam_map.keyframe(found.keyframe).features
        through = see_through_ratio(slam_map.camera, source, features, found.T_keyframe_cam)
        return found if through < _MAX_SEEN_THROUGH else None

    def _outdated(self, slam_map: Map, keyframe_id: int) -> bool:
        """Return whether the map still lacks the last closure, so that the same loop would be found again."""
        if self._closed is None:
            return False
        loops, at = self._closed
        return len(slam_map.loops.source) <= loops and keyframe_id <= at + _LATEST


def _familiar(slam_map: Map, keyframe_id: int) -> set[int]:
    """Return the keyframes excluded from loop detection: the recent ones, and those that share points."""
    row = slam_map.row(keyframe_id)
    near, _ = covisible(slam_map, keyframe_id, at_least=1)
    of_submap = slam_map.submap == slam_map.submap[row]
    latest = slam_map.ids[of_submap & (slam_map.ids > keyframe_id - _LATEST)]
    return {*near.tolist(), *latest.tolist(), keyframe_id}


def _agree(slam_map: Map, one: _Candidate, other: _Candidate, farthest_m: float) -> bool:
    """Return whether two candidates imply the same correction between keyframes of the same submaps."""
    pairs = [(c.recognition.keyframe, c.keyframe) for c in (one, other)]
    if not has(slam_map.ids, np.array(pairs).ravel()).all():
        return False
    submaps = slam_map.submap[rows(slam_map.ids, np.array(pairs).ravel())].reshape(2, 2)
    if not np.array_equal(submaps[0], submaps[1]):
        return False
    pose = slam_map.pose(one.keyframe)
    apart = between(compose(one.T_new_old, pose), compose(other.T_new_old, pose))
    return bool(np.linalg.norm(apart[4:]) < _AGREE_REACH * farthest_m and angle(apart) < _AGREE_RAD)


def _closure(slam_map: Map, candidate: _Candidate, farthest_m: float) -> LoopClosure | None:
    """Compute the correction for a loop; `None` if the map agrees with it already, or contradicts it."""
    found = candidate.recognition
    least = np.repeat([_LOOP_REACH * farthest_m, _LOOP_RAD], 3)
    covariance = _COMMON_ERRORS**2 * found.covariance + np.diag(least**2)
    information = np.linalg.inv(covariance)
    information = 0.5 * (information + information.T)
    source, target = found.keyframe, candidate.keyframe
    first, second = slam_map.submap[rows(slam_map.ids, np.array([source, target]))]
    changed = np.zeros(0, np.int64), np.zeros((0, 7))  # two submaps are merged, each unchanged in itself
    if first == second:
        off = displacement(between(slam_map.pose(source), slam_map.pose(target)), found.T_keyframe_cam)
        if off @ information @ off < _NEWS:
            return None
        changed = poses_with_loop(slam_map, source, target, found.T_keyframe_cam, information, farthest_m)
    return None if changed is None else LoopClosure(source, target, found.T_keyframe_cam, information, *changed)
