"""Changes of the map, each a pure function from a map to a new one.

The new map shares the arrays that did not change; none is ever written to, so that those who still hold an older map
read what they always read. Ids that are not in the map are a `KeyError`: a mistake of the caller.
"""

import numpy as np

from jaxslam.dynamics.occlusion import PointState
from jaxslam.geometry.se3 import between, compose, inverse, transform
from jaxslam.geometry.so3 import matrices
from jaxslam.map.spanning_tree import new_anchor, parents_from, parents_without
from jaxslam.map.types import (
    NONE,
    Culled,
    Keyframe,
    Loops,
    Map,
    MapPoints,
    Observations,
    observations_at,
    point_submaps,
    points_at,
    rows,
    surviving_keyframes,
)
from jaxslam.map.validate import Record, number_problems


def with_keyframe(slam_map: Map, keyframe: Keyframe, T_world_cam: np.ndarray, parent: int, submap: int) -> Map:
    """Add a keyframe.

    Args:
        slam_map: The map.
        keyframe: With the map's next id.
        T_world_cam: `(7,)` its pose.
        parent: Id of a keyframe of the same submap; `NONE` if this is the first of a submap.
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
    """Add points, whose ids go on from the map's next one.

    Raises:
        ValueError: If the ids do not, or a number is out of range.
        KeyError: If one was made by a keyframe that was never in the map.
    """
    after = slam_map.next_point + len(points.ids)
    if not np.array_equal(points.ids, np.arange(slam_map.next_point, after)):
        raise ValueError(f"points.ids: expected {slam_map.next_point} to {after - 1} in order")
    surviving_keyframes(slam_map, points.reference_keyframe)
    _require_sound(points)
    joined = {
        name: _joined(old, getattr(points, name), axis=0 if name == "descriptor" else -1)
        for name, old in slam_map.points._asdict().items()
    }
    return slam_map._replace(points=MapPoints(**joined), next_point=after)


def with_observations(slam_map: Map, observations: Observations) -> Map:
    """Add observations; where two contradict, the first stays and old ones come before new ones.

    Two contradict if they are of the same point in the same keyframe, or of the same feature of it.

    Raises:
        ValueError: If a keyframe does not have such a feature, or sees a point of another submap, or a number is out
            of range.
        KeyError: If a keyframe or a point is not in the map.
    """
    _require_sound(observations)
    at = rows(slam_map.ids, observations.keyframe)
    if (slam_map.submap[at] != point_submaps(slam_map)[rows(slam_map.points.ids, observations.point)]).any():
        raise ValueError("a keyframe cannot see a point of another submap")
    involved, which = np.unique(at, return_inverse=True)
    num_features = np.array([len(slam_map.keyframes[row].features.octave) for row in involved], np.int64)
    wrong = (observations.feature < NONE) | (observations.feature >= num_features[which])
    if wrong.any():
        raise ValueError(f"keyframe {observations.keyframe[wrong][0]} has no feature {observations.feature[wrong][0]}")
    rivals = np.isin(slam_map.observations.keyframe, observations.keyframe)
    both = _joined_observations(observations_at(slam_map.observations, rivals), observations)
    new = observations_at(observations, _first_of_rivals(both)[int(rivals.sum()) :])
    return slam_map._replace(observations=_joined_observations(slam_map.observations, new))


def with_loop(slam_map: Map, source: int, target: int, T_source_target: np.ndarray, information: np.ndarray) -> Map:
    """Add the relative pose of two keyframes, `(7,)`, and its inverse covariance, `(6, 6)`.

    Raises:
        ValueError: If they are one keyframe, or a number is not finite.
        KeyError: If one is not in the map.
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
    slam_map: Map, keyframe_ids: np.ndarray, T_world_cam: np.ndarray, point_ids: np.ndarray, X_world: np.ndarray
) -> Map:
    """Give keyframes and points new places.

    Args:
        slam_map: The map.
        keyframe_ids: `(m,)` ids.
        T_world_cam: `(m, 7)` their poses.
        point_ids: `(q,)` ids.
        X_world: `(3, q)` their coordinates.

    Raises:
        ValueError: If a number is not finite.
        KeyError: If one is not in the map.
    """
    if len(keyframe_ids):
        poses = slam_map.T_world_cam.copy()
        poses[rows(slam_map.ids, keyframe_ids)] = _poses(T_world_cam)
        slam_map = slam_map._replace(T_world_cam=poses)
    if len(point_ids):
        _require_finite(X_world)
        places = slam_map.points.X_world.copy()
        places[:, rows(slam_map.points.ids, point_ids)] = X_world
        slam_map = slam_map._replace(points=slam_map.points._replace(X_world=places))
    return slam_map


def with_fused_points(slam_map: Map, keep: np.ndarray, drop: np.ndarray) -> Map:
    """Make one point of two: observations of `drop[i]` become those of `keep[i]`, and `drop[i]` goes.

    Points linked by several pairs become one, the lowest of those not dropped. It takes over the place and weight of
    the one seen most often, a descriptor if it has none, and the highest state: what passed before one of them passed
    before the thing that all of them are. Of two observations in one keyframe the first stays.

    Args:
        slam_map: The map.
        keep: `(f,)` ids of points.
        drop: `(f,)` ids of points.

    Raises:
        ValueError: If two points are not of the same submap.
        KeyError: If one is not in the map.
    """
    if not len(keep):
        return slam_map
    into = _representatives(slam_map, rows(slam_map.points.ids, keep), rows(slam_map.points.ids, drop))
    submaps = point_submaps(slam_map)
    if (submaps != submaps[into]).any():
        raise ValueError("points of different submaps cannot be one")
    changed = np.isin(slam_map.observations.point, [keep, drop])
    point = slam_map.observations.point.copy()
    point[changed] = slam_map.points.ids[into[rows(slam_map.points.ids, point[changed])]]
    seen = slam_map.observations._replace(point=point)
    stays = ~changed
    stays[changed] = _first_of_rivals(observations_at(seen, changed))
    points = _with_best_known(_with_descriptors(slam_map.points, into), into, slam_map.observations.point)
    points = _with_highest_state(points, into)
    return slam_map._replace(
        points=points_at(points, into == np.arange(len(into))), observations=observations_at(seen, stays)
    )


def with_states(slam_map: Map, point_ids: np.ndarray, states: np.ndarray) -> Map:
    """Give points new states, a `PointState` each.

    Raises:
        ValueError: If one is no state.
        KeyError: If a point is not in the map.
    """
    if not len(point_ids):
        return slam_map
    if not np.isin(states, list(PointState)).all():
        raise ValueError(f"states: expected {min(PointState)} to {max(PointState)}")
    state = slam_map.points.state.copy()
    state[rows(slam_map.points.ids, point_ids)] = states
    return slam_map._replace(points=slam_map.points._replace(state=state))


def without_points(slam_map: Map, point_ids: np.ndarray) -> Map:
    """Remove points and all their observations."""
    stays = np.ones(len(slam_map.points.ids), bool)
    stays[rows(slam_map.points.ids, point_ids)] = False
    seen = ~np.isin(slam_map.observations.point, point_ids)
    return slam_map._replace(
        points=points_at(slam_map.points, stays), observations=observations_at(slam_map.observations, seen)
    )


def without_observations(slam_map: Map, mask: np.ndarray) -> Map:
    """Remove the observations where an `(s,)` mask is true; points stay, even those that nobody sees any more."""
    return slam_map._replace(observations=observations_at(slam_map.observations, ~mask))


def without_keyframe(slam_map: Map, keyframe_id: int) -> Map:
    """Remove a keyframe, its observations, and all points that no keyframe sees then.

    Its place is held in `culled`, relative to its parent, or for the first of a submap to the child that shares most
    points with it, which then is the first. Its other children hang on the keyframe that shares most points with them
    or, if there is none, where it anchored. Loops that end in it end in its anchor.

    Raises:
        ValueError: If it is the only keyframe of its submap.
    """
    row = slam_map.row(keyframe_id)
    anchor = new_anchor(slam_map, keyframe_id)
    T_anchor_keyframe = between(slam_map.T_world_cam[slam_map.row(anchor)], slam_map.T_world_cam[row])
    culled = Culled(
        ids=np.append(slam_map.culled.ids, slam_map.ids[row]),
        anchor=np.append(slam_map.culled.anchor, np.int64(anchor)),
        T_anchor_keyframe=np.concatenate([slam_map.culled.T_anchor_keyframe, T_anchor_keyframe[None]]),
    )
    stays, seen = slam_map.ids != keyframe_id, slam_map.observations.keyframe != keyframe_id
    observations = observations_at(slam_map.observations, seen)
    return slam_map._replace(
        keyframes=slam_map.keyframes[:row] + slam_map.keyframes[row + 1 :],
        ids=slam_map.ids[stays],
        T_world_cam=slam_map.T_world_cam[stays],
        parent=parents_without(slam_map, keyframe_id, anchor)[stays],
        submap=slam_map.submap[stays],
        points=points_at(slam_map.points, np.isin(slam_map.points.ids, observations.point)),
        observations=observations,
        loops=_loops_without(slam_map.loops, keyframe_id, anchor, T_anchor_keyframe),
        culled=culled,
    )


def transformed(
    slam_map: Map, T_new_old: np.ndarray, submap: int, into: int, parent: int = NONE, child: int = NONE
) -> Map:
    """Carry all keyframes and points of a submap rigidly into the frame of another, or of the same.

    Args:
        slam_map: The map.
        T_new_old: `(7,)` from the frame of `submap` to that of `into`.
        submap: Number of a submap.
        into: Number of the submap that they belong to then.
        parent: Keyframe of `into` on which `child` hangs then; by default the first one there.
        child: Keyframe of `submap` that hangs on it, and on which those hang that were above it; by default the first
            one of `submap`. The tree then leads from one to the other where they are known to touch.

    Raises:
        ValueError: If the transform is not finite, the parent is not in `into`, or the child not in `submap`.
        KeyError: If one is not in the map.
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
    return slam_map._replace(
        T_world_cam=poses,
        parent=parents,
        submap=np.where(inside, np.int32(into), slam_map.submap),
        points=slam_map.points._replace(X_world=places),
    )


def _require_finite(values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")


def _require_sound(record: Record) -> None:
    if wrong := number_problems(record):
        raise ValueError(wrong[0])


def _poses(T: np.ndarray) -> np.ndarray:
    """`(m, 7)` float64 of `(m, 7)` or `(7,)`, with quaternions of unit length."""
    poses = np.array(T, np.float64).reshape(-1, 7)
    _require_finite(poses)
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    return poses


def _joined(old: np.ndarray, new: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.concatenate([old, new], axis=axis, dtype=old.dtype, casting="same_kind")


def _joined_observations(old: Observations, new: Observations) -> Observations:
    return Observations(*map(_joined, old, new))


def _first_of_rivals(observations: Observations) -> np.ndarray:
    """`(s,)` which observations stay if each in turn stays unless it contradicts one that does."""
    stays, undecided = np.zeros(len(observations.point), bool), np.arange(len(observations.point))
    by_feature = np.where(
        observations.feature == NONE, -2 - undecided, observations.feature
    )  # `NONE` is nobody's rival
    while len(undecided):
        pair = _group(observations.keyframe[undecided], observations.point[undecided])
        feature = _group(observations.keyframe[undecided], by_feature[undecided])
        first = _is_first(pair) & _is_first(feature)
        stays[undecided[first]] = True
        undecided = undecided[~(np.isin(pair, pair[first]) | np.isin(feature, feature[first]))]
    return stays


def _group(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Equal numbers where both are equal."""
    first, second = (np.unique(values, return_inverse=True)[1] for values in (first, second))
    return first * (second.max() + 1) + second


def _is_first(groups: np.ndarray) -> np.ndarray:
    first = np.zeros(len(groups), bool)
    first[np.unique(groups, return_index=True)[1]] = True
    return first


def _representatives(slam_map: Map, keep: np.ndarray, drop: np.ndarray) -> np.ndarray:
    """`(p,)` the row of the point that each becomes, its own for most."""
    from scipy.sparse import coo_array  # noqa: PLC0415 - see `late_imports`
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    count = len(slam_map.points.ids)
    links = coo_array((np.ones(len(keep), np.int8), (keep, drop)), shape=(count, count))
    group = connected_components(links, directed=False)[1]
    dropped = np.zeros(count, bool)
    dropped[drop[keep != drop]] = True
    order = np.lexsort((dropped, group))  # stable: lowest id first
    return order[np.unique(group[order], return_index=True)[1]][group]


def _with_descriptors(points: MapPoints, into: np.ndarray) -> MapPoints:
    """Points without a descriptor take over that of the first one that becomes them."""
    givers = np.flatnonzero(points.has_descriptor & ~points.has_descriptor[into])
    takers, first = np.unique(into[givers], return_index=True)
    descriptor, recognizable = points.descriptor.copy(), points.has_descriptor.copy()
    descriptor[takers], recognizable[takers] = descriptor[givers[first]], True
    return points._replace(descriptor=descriptor, has_descriptor=recognizable)


def _with_best_known(points: MapPoints, into: np.ndarray, seen: np.ndarray) -> MapPoints:
    """Points take over place and weight of that of them seen most often; of several, their own or the lowest's."""
    changing = np.flatnonzero(np.isin(into, into[into != np.arange(len(into))]))
    counts = np.bincount(rows(points.ids, seen), minlength=len(points.ids))[changing]
    order = changing[np.lexsort((changing, changing != into[changing], -counts, into[changing]))]
    takers, first = np.unique(into[order], return_index=True)
    X_world, weight = points.X_world.copy(), points.weight.copy()
    X_world[:, takers], weight[takers] = points.X_world[:, order[first]], points.weight[order[first]]
    return points._replace(X_world=X_world, weight=weight)


def _with_highest_state(points: MapPoints, into: np.ndarray) -> MapPoints:
    """Points take over the highest state of those that become them."""
    givers = np.flatnonzero(points.state[into] < points.state)
    if not len(givers):
        return points
    state = points.state.copy()
    np.maximum.at(state, into[givers], points.state[givers])
    return points._replace(state=state)


def _loops_without(loops: Loops, keyframe_id: int, anchor: int, T_anchor_keyframe: np.ndarray) -> Loops:
    """Loops that end in a keyframe end in its anchor, with the same measured error; one between the two goes."""
    begins, ends = loops.source == keyframe_id, loops.target == keyframe_id
    T_keyframe_anchor = inverse(T_anchor_keyframe)
    T, information = loops.T_source_target.copy(), loops.information.copy()
    T[begins] = compose(T_anchor_keyframe, T[begins])
    T[ends] = compose(T[ends], T_keyframe_anchor)
    adjoint = _adjoint(T_keyframe_anchor)
    information[ends] = adjoint.T @ information[ends] @ adjoint
    source, target = np.where(begins, anchor, loops.source), np.where(ends, anchor, loops.target)
    stays = source != target
    return Loops(source[stays], target[stays], T[stays], information[stays])


def _adjoint(T: np.ndarray) -> np.ndarray:
    """`(6, 6)` what a tangent, translation first, at the far end of a transform `(7,)` is at the near end."""
    R, (x, y, z) = matrices(T[:4]), T[4:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R, cross @ R], [np.zeros((3, 3)), R]])
