"""Loops: a keyframe that shows a place seen long ago ties the map together.

Runs beside tracking and mapping. It reads a map, and gives back what is to change; mapping makes the change, on the
map as it is then.

A wrong loop is worse than a missed one. So the geometry of a place must fit (`place_recognition`), two keyframes
must agree on the correction, and what the correction asks of the keyframes in between must be within what their
relative poses leave open.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III-C, for the pose graph of spanning tree, strong covisibility
and loops.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.pose_graph import PoseGraphStatus, band_rank, optimise_pose_graph
from jaxslam_kernels.pose_graph_cost import PoseGraphEdges

from jaxslam.features import FeaturePlan
from jaxslam.map import NONE, Map, covisible, has, rows, visibility
from jaxslam.place_index import PlaceIndex
from jaxslam.place_recognition import Recognition, recognise
from jaxslam.pose import angle, between, compose, inverse
from jaxslam.state import TrackParams

_LATEST = 10
"""Keyframes too young to be a place seen long ago."""
_AGREE_M, _AGREE_RAD = 0.05, 0.04
"""How far apart the corrections of two keyframes may be."""
_REMEMBERED = 3
"""Keyframes for which a first candidate waits for a second one that agrees."""
_STRONG = 100
"""Points in common from which covisible keyframes are tied in the pose graph (ORB-SLAM's essential graph)."""
_EDGE_M, _EDGE_M_PER_M, _EDGE_RAD, _EDGE_RAD_PER_RAD = 0.005, 0.01, 0.003, 0.01
"""Standard deviation of the relative pose of two keyframes, and its growth with distance and angle."""
_LOOP_M, _LOOP_RAD = 0.01, 0.005
"""Least standard deviation of a loop."""
_MOST_CHI2 = 16.8
"""Squared whitened error a loop may keep, and mean one that edges may have: 99 % of six degrees of freedom."""
_SIZES = (64, 256, 1024, 4096)
"""Keyframes a pose graph has room for; each size is compiled once."""
_EDGES_A_NODE = 6


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

    def __init__(self, index: PlaceIndex, params: TrackParams, plan: FeaturePlan) -> None:
        """Share an index of places; it is filled here."""
        self._index, self._params, self._plan = index, params, plan
        self._candidates: list[_Candidate] = []

    def look(self, map: Map, keyframe_id: int) -> LoopClosure | None:
        """Take in a keyframe of the map; a loop if it closes one."""
        if not has(map.ids, np.array([keyframe_id]))[0]:
            return None
        keyframe = map.keyframe(keyframe_id)
        found = recognise(
            map, self._index, keyframe.features, self._params, exclude=_familiar(map, keyframe_id), plan=self._plan
        )
        self._index.add(keyframe_id, keyframe.features)
        for gone in self._index.ids() - set(map.ids.tolist()):
            self._index.remove(gone)
        if found is None:
            return None
        pose = compose(map.pose(found.keyframe), found.T_keyframe_cam)
        candidate = _Candidate(found, keyframe_id, compose(pose, inverse(map.pose(keyframe_id))))
        self._candidates = [c for c in self._candidates if c.keyframe >= keyframe_id - _REMEMBERED]
        agreed = any(_agree(map, candidate, other) for other in self._candidates)
        self._candidates.append(candidate)
        if not agreed:
            return None
        closure = _closure(map, candidate)
        if closure is not None:
            self._candidates.clear()
        return closure


def _familiar(map: Map, keyframe_id: int) -> set[int]:
    """Keyframes it is no news to see again: the latest, and those that share points."""
    row = map.row(keyframe_id)
    near, _ = covisible(map, keyframe_id, at_least=1)
    of_submap = map.submap == map.submap[row]
    latest = map.ids[of_submap & (map.ids > keyframe_id - _LATEST)]
    return {*near.tolist(), *latest.tolist(), keyframe_id}


def _agree(map: Map, one: _Candidate, other: _Candidate) -> bool:
    """Whether two candidates ask for the same correction, of keyframes of the same submaps."""
    pairs = [(c.recognition.keyframe, c.keyframe) for c in (one, other)]
    if not has(map.ids, np.array(pairs).ravel()).all():
        return False
    submaps = map.submap[rows(map.ids, np.array(pairs).ravel())].reshape(2, 2)
    if not np.array_equal(submaps[0], submaps[1]):
        return False
    pose = map.pose(one.keyframe)
    apart = between(compose(one.T_new_old, pose), compose(other.T_new_old, pose))
    return bool(np.linalg.norm(apart[4:]) < _AGREE_M and angle(apart) < _AGREE_RAD)


def _closure(map: Map, candidate: _Candidate) -> LoopClosure | None:
    """What the loop changes, if the rest of the map can bear it."""
    found = candidate.recognition
    covariance = found.covariance + np.diag([_LOOP_M**2] * 3 + [_LOOP_RAD**2] * 3)
    information = np.linalg.inv(covariance)
    closure = LoopClosure(
        found.keyframe,
        candidate.keyframe,
        found.T_keyframe_cam,
        0.5 * (information + information.T),
        np.zeros(0, np.int64),
        np.zeros((0, 7)),
    )
    submaps = map.submap[rows(map.ids, np.array([closure.source, closure.target]))]
    return closure if submaps[0] != submaps[1] else _optimised(map, closure)


def _optimised(map: Map, closure: LoopClosure) -> LoopClosure | None:
    """The poses that suit the loop and all relative poses of the map, if that is within their uncertainty."""
    inside = np.flatnonzero(map.submap == map.submap[map.row(closure.target)])
    size = next((size for size in _SIZES if size >= len(inside)), None)
    if size is None:
        return None
    ids, poses = map.ids[inside], map.T_world_cam[inside]
    source, target, measured, information = _edges(map, inside, closure)
    room, num = size * _EDGES_A_NODE, len(source)
    padded: Any = lambda array, fill: np.concatenate([array, np.broadcast_to(fill, (room - num, *array.shape[1:]))])
    identity = np.array([1.0, 0, 0, 0, 0, 0, 0])
    in_use = np.arange(size) < len(inside)
    start = np.concatenate([poses, np.broadcast_to(identity, (size - len(inside), 7))])
    edges: Any = PoseGraphEdges(
        source=padded(source, 0).astype(np.int32),
        target=padded(target, 0).astype(np.int32),
        T_source_target=SE3(padded(measured, identity).astype(np.float32)),  # type: ignore[arg-type]
        information=padded(information, np.eye(6)).astype(np.float32),
        weights=padded(np.ones(num, np.float32), 0),
        mask=padded(np.ones(num, bool), False),
    )
    fixed = np.zeros(size, bool)
    fixed[rows(ids, ids[map.parent[inside] == NONE])] = True
    solved: Any = jax.device_get(
        _optimise(SE3(start.astype(np.float32)), edges, fixed, in_use, band_rank(source, target, size))  # type: ignore[arg-type]
    )
    chi2 = solved.chi2[:num]
    good = solved.status == PoseGraphStatus.OK and chi2[-1] < _MOST_CHI2 and chi2.mean() < _MOST_CHI2
    if not good:
        return None
    return closure._replace(keyframes=ids, T_world_cam=np.asarray(solved.T_world_cam.wxyz_xyz[: len(ids)], np.float64))


@jax.jit
def _optimise(T_world_cam: SE3, edges: PoseGraphEdges, fixed: Any, mask: Any, rank: Any) -> Any:
    return optimise_pose_graph(T_world_cam, edges, fixed, mask=mask, rank=rank, loss="squared", max_steps=30)


def _edges(map: Map, inside: np.ndarray, closure: LoopClosure) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows of both ends, relative poses and information: the spanning tree, strong covisibility, loops, the new one."""
    ids = map.ids[inside]
    child = np.flatnonzero(map.parent[inside] != NONE)
    tree = np.stack([rows(ids, map.parent[inside][child]), child])
    seen = visibility(map)[inside]
    shared = (seen @ seen.T).tocoo()
    strong = (shared.data >= _STRONG) & (shared.row < shared.col)
    pairs = np.concatenate([tree, np.stack([shared.row[strong], shared.col[strong]])], axis=1)
    _, first = np.unique(np.sort(pairs, axis=0), axis=1, return_index=True)
    pairs = pairs[:, np.sort(first)[: len(inside) * (_EDGES_A_NODE - 1)]]
    relative = between(map.T_world_cam[inside][pairs[0]], map.T_world_cam[inside][pairs[1]])
    far, turn = np.linalg.norm(relative[:, 4:], axis=1), angle(relative)
    sigmas = np.concatenate(
        [
            np.repeat((_EDGE_M + _EDGE_M_PER_M * far)[:, None], 3, axis=1),
            np.repeat((_EDGE_RAD + _EDGE_RAD_PER_RAD * turn)[:, None], 3, axis=1),
        ],
        axis=1,
    )
    information = np.eye(6) / np.square(sigmas)[:, None, :]
    old = has(ids, map.loops.source) & has(ids, map.loops.target)
    ends = np.stack([rows(ids, map.loops.source[old]), rows(ids, map.loops.target[old])])
    new = rows(ids, np.array([closure.source, closure.target]))[:, None]
    return (
        *np.concatenate([pairs, ends, new], axis=1),
        np.concatenate([relative, map.loops.T_source_target[old], closure.T_source_target[None]]),
        np.concatenate([information, map.loops.information[old], closure.information[None]]),
    )
