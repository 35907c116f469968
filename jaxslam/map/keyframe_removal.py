"""Remove a keyframe from the map."""

import numpy as np

from jaxslam.geometry.se3 import adjoint, between, compose, inverse
from jaxslam.geometry.types import Pose
from jaxslam.map.point_records import observations_at, points_at
from jaxslam.map.spanning_tree import new_anchor, parents_without
from jaxslam.map.types import Culled, Loops, Map


def without_keyframe(slam_map: Map, keyframe_id: int) -> Map:
    """Remove a keyframe, its observations, and all points that no keyframe observes afterward.

    Its pose is stored in `culled` relative to an anchor: its parent, or for the first keyframe of a submap the child
    with the most shared points, which becomes the first. Each of its other children gets the keyframe with the most
    shared points as parent or, if there is none, the anchor. Loops that end at the keyframe end at its anchor.

    Raises:
        ValueError: If it is the only keyframe of its submap.
        KeyError: If it is not in the map.
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
    points = points_at(slam_map.points, np.isin(slam_map.points.ids, observations.point))
    return slam_map.with_arrays(points, observations)._replace(
        keyframes=slam_map.keyframes[:row] + slam_map.keyframes[row + 1 :],
        ids=slam_map.ids[stays],
        T_world_cam=slam_map.T_world_cam[stays],
        parent=parents_without(slam_map, keyframe_id, anchor)[stays],
        submap=slam_map.submap[stays],
        loops=_loops_without(slam_map.loops, keyframe_id, anchor, T_anchor_keyframe),
        culled=culled,
    )


def _loops_without(loops: Loops, keyframe_id: int, anchor: int, T_anchor_keyframe: Pose) -> Loops:
    """Move the loops of a keyframe to its anchor, with unchanged errors, and drop a loop between the two."""
    begins, ends = loops.source == keyframe_id, loops.target == keyframe_id
    T_keyframe_anchor = inverse(T_anchor_keyframe)
    T, information = loops.T_source_target.copy(), loops.information.copy()
    T[begins] = compose(T_anchor_keyframe, T[begins])
    T[ends] = compose(T[ends], T_keyframe_anchor)
    to_keyframe = adjoint(T_keyframe_anchor)
    information[ends] = to_keyframe.T @ information[ends] @ to_keyframe
    source, target = np.where(begins, anchor, loops.source), np.where(ends, anchor, loops.target)
    stays = source != target
    return Loops(source[stays], target[stays], T[stays], information[stays])
