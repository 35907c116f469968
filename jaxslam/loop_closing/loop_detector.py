"""Loops: a keyframe that shows a place seen long ago ties the map together.

Runs beside tracking and mapping. It reads a map, and gives back what is to change; mapping makes the change, on the
map as it is then.

A wrong loop is worse than a missed one. So the geometry of a place must fit (`place_recognition`), what is around it
must not contradict (`surroundings`), two keyframes must agree on the correction, and what the correction asks of the
keyframes in between must be within what their relative poses leave open (`essential_graph`).
"""

import threading
from contextlib import AbstractContextManager
from typing import NamedTuple

import numpy as np

from jaxslam.features.orb import FeaturePlan
from jaxslam.geometry.se3 import angle, between, compose, inverse
from jaxslam.loop_closing.essential_graph import poses_with_loop
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.loop_closing.place_recognition import Recognition, recognize
from jaxslam.loop_closing.visibility_check import see_through_ratio
from jaxslam.map.types import Map, covisible, has, rows
from jaxslam.tracking.state import TrackParams

_LATEST = 10
"""Keyframes too young to be a place seen long ago; for as many a loop found may take to come into the map."""
_AGREE_M, _AGREE_RAD = 0.05, 0.04
"""How far apart the corrections of two keyframes may be."""
_REMEMBERED = 3
"""Keyframes for which a first candidate waits for a second one that agrees."""
_MAX_SEEN_THROUGH = 0.3
"""Share of a place's surfaces that a keyframe may have to see through. Pairs of keyframes that do show one place come
out below 0.28 in a room at rest, and three of four below it in a crowd."""
_COMMON_ERRORS = 3.0
"""Factor of the standard deviation of a recognition, for the errors that its features have in common: those of depth
and calibration, and of the keyframe's own place among its points. On recordings, poses are off by so much more."""
_LOOP_M, _LOOP_RAD = 0.01, 0.005
"""Least standard deviation of a loop."""


class LoopClosure(NamedTuple):
    """A loop, and what it changes.

    Attributes:
        source: Keyframe of the place.
        target: Keyframe that showed it again.
        T_source_target: `(7,)` measured.
        information: `(6, 6)` its inverse covariance.
        keyframes: `(k,)` keyframes with a new pose; none where two submaps become one.
        T_world_cam: `(k, 7)` their new poses.
    """

    source: int
    target: int
    T_source_target: np.ndarray
    information: np.ndarray
    keyframes: np.ndarray
    T_world_cam: np.ndarray


class _Candidate(NamedTuple):
    recognition: Recognition
    keyframe: int
    T_new_old: np.ndarray
    """The correction of the world that it asks for at the keyframe."""


class LoopClosing:
    """Looks for loops, keyframe by keyframe."""

    def __init__(
        self,
        index: PlaceIndex,
        params: TrackParams,
        plan: FeaturePlan,
        lock: AbstractContextManager[bool] | None = None,
    ) -> None:
        """Share an index of places; it is filled here, and only while the lock is held."""
        self._lock = lock or threading.Lock()
        self._index, self._params, self._plan = index, params, plan
        self._candidates: list[_Candidate] = []
        self._closed: tuple[int, int] | None = None

    def look(self, slam_map: Map, keyframe_id: int) -> LoopClosure | None:
        """Take in a keyframe of the map; a loop if it closes one."""
        if not has(slam_map.ids, np.array([keyframe_id]))[0]:
            return None
        found = self._recognized(slam_map, keyframe_id)
        if found is None or self._outdated(slam_map, keyframe_id):
            return None
        pose = compose(slam_map.pose(found.keyframe), found.T_keyframe_cam)
        candidate = _Candidate(found, keyframe_id, compose(pose, inverse(slam_map.pose(keyframe_id))))
        self._candidates = [c for c in self._candidates if c.keyframe >= keyframe_id - _REMEMBERED]
        agreed = any(_agree(slam_map, candidate, other) for other in self._candidates)
        self._candidates.append(candidate)
        closure = _closure(slam_map, candidate) if agreed else None
        if closure is not None:
            self._candidates.clear()
            self._closed = len(slam_map.loops.source), keyframe_id
        return closure

    def replace(self, slam_map: Map, keyframe_id: int) -> None:
        """Take in that a keyframe of the map has lost features."""
        with self._lock:
            if keyframe_id in self._index and has(slam_map.ids, np.array([keyframe_id]))[0]:
                self._index.replace(keyframe_id, slam_map.keyframe(keyframe_id).features)

    def _recognized(self, slam_map: Map, keyframe_id: int) -> Recognition | None:
        """The place a keyframe shows, if it was seen long ago; the keyframe is in the index then."""
        features = slam_map.keyframe(keyframe_id).features
        exclude = _familiar(slam_map, keyframe_id)
        with self._lock:
            found = recognize(slam_map, self._index, features, self._params, exclude=exclude, plan=self._plan)
            self._index.add(keyframe_id, features)
            for gone in self._index.ids() - set(slam_map.ids.tolist()):
                self._index.remove(gone)
        if found is None:
            return None
        source = slam_map.keyframe(found.keyframe).features
        through = see_through_ratio(slam_map.camera, source, features, found.T_keyframe_cam)
        return found if through < _MAX_SEEN_THROUGH else None

    def _outdated(self, slam_map: Map, keyframe_id: int) -> bool:
        """Whether the map does not have the loop found last yet, so that it would be found again."""
        if self._closed is None:
            return False
        loops, at = self._closed
        return len(slam_map.loops.source) <= loops and keyframe_id <= at + _LATEST


def _familiar(slam_map: Map, keyframe_id: int) -> set[int]:
    """Keyframes it is no news to see again: the latest, and those that share points."""
    row = slam_map.row(keyframe_id)
    near, _ = covisible(slam_map, keyframe_id, at_least=1)
    of_submap = slam_map.submap == slam_map.submap[row]
    latest = slam_map.ids[of_submap & (slam_map.ids > keyframe_id - _LATEST)]
    return {*near.tolist(), *latest.tolist(), keyframe_id}


def _agree(slam_map: Map, one: _Candidate, other: _Candidate) -> bool:
    """Whether two candidates ask for the same correction, of keyframes of the same submaps."""
    pairs = [(c.recognition.keyframe, c.keyframe) for c in (one, other)]
    if not has(slam_map.ids, np.array(pairs).ravel()).all():
        return False
    submaps = slam_map.submap[rows(slam_map.ids, np.array(pairs).ravel())].reshape(2, 2)
    if not np.array_equal(submaps[0], submaps[1]):
        return False
    pose = slam_map.pose(one.keyframe)
    apart = between(compose(one.T_new_old, pose), compose(other.T_new_old, pose))
    return bool(np.linalg.norm(apart[4:]) < _AGREE_M and angle(apart) < _AGREE_RAD)


def _closure(slam_map: Map, candidate: _Candidate) -> LoopClosure | None:
    """What the loop changes, if the rest of the map can bear it."""
    found = candidate.recognition
    covariance = _COMMON_ERRORS**2 * found.covariance + np.diag([_LOOP_M**2] * 3 + [_LOOP_RAD**2] * 3)
    information = np.linalg.inv(covariance)
    information = 0.5 * (information + information.T)
    source, target = found.keyframe, candidate.keyframe
    first, second = slam_map.submap[rows(slam_map.ids, np.array([source, target]))]
    changed = np.zeros(0, np.int64), np.zeros((0, 7))  # two submaps become one, each as it is
    if first == second:
        changed = poses_with_loop(slam_map, source, target, found.T_keyframe_cam, information)
    return None if changed is None else LoopClosure(source, target, found.T_keyframe_cam, information, *changed)
