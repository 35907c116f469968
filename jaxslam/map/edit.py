"""Edits of the map: each is a pure function from a map to a new map.

The new map shares the arrays that did not change. No array is ever written to, so a reader of an older map is not
affected. An id that is not in the map raises a `KeyError`, because it is a mistake of the caller.
"""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8

from jaxslam.dynamics.occlusion import PointState
from jaxslam.geometry.se3 import compose, transform
from jaxslam.geometry.types import Ids, Pose, Poses
from jaxslam.map.point_records import (
    NONE,
    MapPoints,
    Observations,
    distinct,
    has,
    joined,
    observations_at,
    points_at,
    rows,
)
from jaxslam.map.spanning_tree import parents_from
from jaxslam.map.types import Keyframe, Loops, Map, point_submaps, surviving_keyframes
from jaxslam.map.validate import Record, number_problems


def with_keyframe(slam_map: Map, keyframe: Keyframe, T_world_cam: Pose, parent: int, submap: int) -> Map:
    """Add a keyframe.

    Args:
        slam_map: The map.
        keyframe: The keyframe, whose id is the map's next one.
        T_world_cam: `(7,)` pose of the keyframe.
        parent: Id of its parent, a keyframe of the same submap; `NONE` for the first keyframe of a submap.
        submap: Number of its submap.

    Raises:
        ValueError: If the id is not the next one, the parent is in another submap, or a number is out of range.
    """
    if keyframe.id != slam_map.next_keyframe:
        raise ValueError(f"keyframe.id: expected the next one, {slam_map.next_keyframe}, got {keyframe.id}")
    if parent != NONE and slam_map.submap[slam_map.row(parent)] != submap:
        raise ValueError(f"parent: keyframe {parent} is not in submap {submap}")
    if parent == NONE and (slam_map.submap == submap).any():
        raise ValueError(f"parent: submap {submap} has a first keyframe already")
    _require_sound(keyframe.features)
    return slam_map._replace(
        keyframes=(*slam_map.keyframes, keyframe),
        ids=np.append(slam_map.ids, np.int64(keyframe.id)),
        T_world_cam=np.concatenate([slam_map.T_world_cam, _poses(T_world_cam)]),
        parent=np.append(slam_map.parent, np.int64(parent)),
        submap=np.append(slam_map.submap, np.int32(submap)),
        next_keyframe=slam_map.next_keyframe + 1,
    )


def with_points(slam_map: Map, points: MapPoints) -> Map:
    """Add points, whose ids must continue from the map's next one.

    Raises:
        ValueError: If the ids do not continue, or a number is out of range.
        KeyError: If the reference keyframe of a point was never in the map.
    """
    after = slam_map.next_point + len(points.ids)
    if not np.array_equal(points.ids, np.arange(slam_map.next_point, after)):
        raise ValueError(f"points.ids: expected {slam_map.next_point} to {after - 1} in order")
    surviving_keyframes(slam_map, points.reference_keyframe)
    _require_sound(points)
    return slam_map.with_arrays(points=joined([slam_map.points, points]))._replace(next_point=after)


def with_observations(slam_map: Map, observations: Observations) -> Map:
    """Add observations; of two that conflict, only the first stays, and old ones come before new ones.

    Two observations conflict if they have the same keyframe and either the same point or the same feature.

    Raises:
        ValueError: If a keyframe does not have such a feature, a point is in another submap than its keyframe, or a
            number is out of range.
        KeyError: If a keyframe or a point is not in the map.
    """
    _require_sound(observations)
    at = rows(slam_map.ids, observations.keyframe)
    if (slam_map.submap[at] != point_submaps(slam_map)[rows(slam_map.points.ids, observations.point)]).any():
        raise ValueError("a keyframe cannot see a point of another submap")
    involved, _ = distinct(at)
    num_features = np.array([len(slam_map.keyframes[row].features.octave) for row in involved], np.int64)
    wrong = (observations.feature < NONE) | (observations.feature >= num_features[rows(involved, at)])
    if wrong.any():
        raise ValueError(f"keyframe {observations.keyframe[wrong][0]} has no feature {observations.feature[wrong][0]}")
    new = observations_at(observations, ~_conflicts(slam_map, observations))
    new = observations_at(new, first_of_rivals(new))
    return slam_map.with_arrays(observations=joined([slam_map.observations, new]))


def _conflicts(slam_map: Map, new: Observations) -> Bool[np.ndarray, " n"]:
    """Return which new observations conflict with one of the map."""
    seen = slam_map.observations
    near = np.flatnonzero(has(distinct(new.keyframe)[0], seen.keyframe))
    shown = near[seen.feature[near] != NONE]
    points = _group(seen.keyframe[near], seen.point[near])
    features = _group(seen.keyframe[shown], seen.feature[shown])
    return has(np.sort(points), _group(new.keyframe, new.point)) | has(
        np.sort(features), _group(new.keyframe, new.feature)
    )


def with_loop(
    slam_map: Map, source: int, target: int, T_source_target: Pose, information: Float[np.ndarray, "6 6"]
) -> Map:
    """Add a loop constraint between two keyframes.

    Args:
        slam_map: The map.
        source: Id of the keyframe in whose frame the relative pose is given.
        target: Id of the other keyframe.
        T_source_target: `(7,)` pose of the target relative to the source.
        information: `(6, 6)` inverse covariance of the relative pose; the tangent is translation, then rotation.

    Raises:
        ValueError: If the two keyframes are the same, or a number is not finite.
        KeyError: If a keyframe is not in the map.
    """
    if source == target:
        raise ValueError(f"a loop cannot lead from keyframe {source} to itself")
    ends = rows(slam_map.ids, np.array([source, target]))
    _require_finite(information)
    loops = Loops(
        source=np.append(slam_map.loops.source, slam_map.ids[ends[0]]),
        target=np.append(slam_map.loops.target, slam_map.ids[ends[1]]),
        T_source_target=np.concatenate([slam_map.loops.T_source_target, _poses(T_source_target)]),
        information=np.concatenate([slam_map.loops.information, np.asarray(information, np.float64)[None]]),
    )
    return slam_map._replace(loops=loops)


def with_positions(
    slam_map: Map,
    keyframe_ids: Int[np.ndarray, " m"],
    T_world_cam: Float64[np.ndarray, "m 7"],
    point_ids: Int[np.ndarray, " q"],
    X_world: Float[np.ndarray, "3 q"],
) -> Map:
    """Replace the poses of some keyframes and the positions of some points.

    Args:
        slam_map: The map.
        keyframe_ids: `(m,)` ids of the keyframes.
        T_world_cam: `(m, 7)` new poses of the keyframes.
        point_ids: `(q,)` ids of the points.
        X_world: `(3, q)` new positions of the points in the world, meters.

    Raises:
        ValueError: If a number is not finite.
        KeyError: If a keyframe or a point is not in the map.
    """
    if len(keyframe_ids):
        poses = slam_map.T_world_cam.copy()
        poses[rows(slam_map.ids, keyframe_ids)] = _poses(T_world_cam)
        slam_map = slam_map._replace(T_world_cam=poses)
    if len(point_ids):
        _require_finite(X_world)
        places = slam_map.points.X_world.copy()
        places[:, rows(slam_map.points.ids, point_ids)] = X_world
        slam_map = slam_map.with_arrays(points=slam_map.points._replace(X_world=places))
    return slam_map


def with_descriptors(slam_map: Map, point_ids: Int[np.ndarray, " n"], descriptors: UInt8[np.ndarray, "n 32"]) -> Map:
    """Give descriptors to those of some points that have none.

    Raises:
        KeyError: If a point is not in the map.
    """
    row = rows(slam_map.points.ids, point_ids)
    new = ~slam_map.points.has_descriptor[row]
    if not new.any():
        return slam_map
    descriptor, has_descriptor = slam_map.points.descriptor.copy(), slam_map.points.has_descriptor.copy()
    descriptor[row[new]], has_descriptor[row[new]] = descriptors[new], True
    points = slam_map.points._replace(descriptor=descriptor, has_descriptor=has_descriptor)
    return slam_map.with_arrays(points=points)


def with_states(slam_map: Map, point_ids: Int[np.ndarray, " n"], states: Int[np.ndarray, " n"]) -> Map:
    """Replace the states of some points; each new state is a `PointState`.

    Raises:
        ValueError: If a number is not a `PointState`.
        KeyError: If a point is not in the map.
    """
    if not len(point_ids):
        return slam_map
    if not np.isin(states, list(PointState)).all():
        raise ValueError(f"states: expected {min(PointState)} to {max(PointState)}")
    state = slam_map.points.state.copy()
    state[rows(slam_map.points.ids, point_ids)] = states
    return slam_map.with_arrays(points=slam_map.points._replace(state=state))


def without_points(slam_map: Map, point_ids: Ids) -> Map:
    """Remove points and all their observations."""
    stays = np.ones(len(slam_map.points.ids), bool)
    stays[rows(slam_map.points.ids, point_ids)] = False
    seen = ~has(np.sort(point_ids), slam_map.observations.point)
    return slam_map.with_arrays(points_at(slam_map.points, stays), observations_at(slam_map.observations, seen))


def without_observations(slam_map: Map, mask: Bool[np.ndarray, " s"]) -> Map:
    """Remove the observations where an `(s,)` mask is true; points stay, even without any observation left."""
    return slam_map.with_arrays(observations=observations_at(slam_map.observations, ~mask))


def transformed(slam_map: Map, T_new_old: Pose, submap: int, into: int, parent: int = NONE, child: int = NONE) -> Map:
    """Transform all keyframes and points of a submap rigidly into the frame of another submap, or of the same one.

    Args:
        slam_map: The map.
        T_new_old: `(7,)` transform from the frame of `submap` to the frame of `into`.
        submap: Number of the submap to transform.
        into: Number of the submap that its keyframes belong to afterward.
        parent: Keyframe of `into` that becomes the parent of `child`; by default the first one of `into`.
        child: Keyframe of `submap` that becomes a child of `parent`; by default the first one of `submap`. Its former
            ancestors become its descendants, so the spanning tree connects the submaps where they are known to touch.

    Raises:
        ValueError: If the transform is not finite, the parent is not in `into`, or the child not in `submap`.
        KeyError: If the parent or the child is not in the map.
    """
    T = _poses(T_new_old)[0]
    inside, points = slam_map.submap == submap, point_submaps(slam_map) == submap
    poses, places, parents = slam_map.T_world_cam.copy(), slam_map.points.X_world.copy(), slam_map.parent.copy()
    poses[inside] = compose(T, poses[inside])
    places[:, points] = transform(T, places[:, points])
    there = (slam_map.submap == into) & ~inside
    if there.any() and inside.any():
        if parent == NONE:
            parent = int(slam_map.ids[there & (slam_map.parent == NONE)][0])
        if not there[slam_map.row(parent)]:
            raise ValueError(f"parent: keyframe {parent} is not in submap {into}")
        if child != NONE:
            if not inside[slam_map.row(child)]:
                raise ValueError(f"child: keyframe {child} is not in submap {submap}")
            parents = parents_from(slam_map, child)
        parents[inside & (parents == NONE)] = parent
    slam_map = slam_map.with_arrays(points=slam_map.points._replace(X_world=places))
    return slam_map._replace(
        T_world_cam=poses, parent=parents, submap=np.where(inside, np.int32(into), slam_map.submap)
    )


def _require_finite(values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")


def _require_sound(record: Record) -> None:
    if wrong := number_problems(record):
        raise ValueError(wrong[0])


def _poses(T: Pose | Poses) -> Poses:
    """Convert one pose or several to `(m, 7)` with normalized quaternions."""
    poses = np.array(T, np.float64).reshape(-1, 7)
    _require_finite(poses)
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    return poses


def first_of_rivals(observations: Observations) -> Bool[np.ndarray, " s"]:
    """Return the `(s,)` mask of the observations to keep: each that does not conflict with an earlier kept one."""
    stays, undecided = np.zeros(len(observations.point), bool), np.arange(len(observations.point))
    # An observation without a feature gets a number of its own, so that it conflicts with no other feature.
    by_feature = np.where(observations.feature == NONE, -2 - undecided, observations.feature)
    while len(undecided):
        pair = _group(observations.keyframe[undecided], observations.point[undecided])
        feature = _group(observations.keyframe[undecided], by_feature[undecided])
        first = _is_first(pair) & _is_first(feature)
        stays[undecided[first]] = True
        rest = np.flatnonzero(~first)
        beaten = has(np.sort(pair[first]), pair[rest]) | has(np.sort(feature[first]), feature[rest])
        undecided = undecided[rest[~beaten]]
    return stays


def _group(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Number pairs: equal numbers where both values are equal. Ids of keyframes and points are far below 2^31."""
    return (first.astype(np.int64) << np.int64(32)) + second


def _is_first(groups: np.ndarray) -> np.ndarray:
    first = np.zeros(len(groups), bool)
    first[np.unique(groups, return_index=True)[1]] = True
    return first
