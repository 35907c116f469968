"""Queries of the spanning tree of a submap's keyframes, and its new parents after a keyframe is removed."""

import numpy as np

from jaxslam.geometry.types import Ids
from jaxslam.map.point_records import NONE, rows
from jaxslam.map.types import Map, covisible


def children(slam_map: Map, keyframe_id: int) -> Ids:
    """Return the ascending ids of the children of a keyframe in the spanning tree."""
    return slam_map.ids[slam_map.parent == keyframe_id]


def ancestor_outside(slam_map: Map, keyframe_id: int, inside: Ids) -> int:
    """Return the nearest of a keyframe and its ancestors in the spanning tree not among some; `NONE` without any."""
    while keyframe_id != NONE and keyframe_id in inside:
        keyframe_id = int(slam_map.parent[slam_map.row(keyframe_id)])
    return keyframe_id


def subtree(slam_map: Map, keyframe_id: int) -> Ids:
    """Return the ascending ids of a keyframe and all its descendants in the spanning tree."""
    from scipy.sparse import csr_array  # noqa: PLC0415 - see `runtime.preload`
    from scipy.sparse.csgraph import breadth_first_order  # noqa: PLC0415

    hangs = np.flatnonzero(slam_map.parent != NONE)
    above = rows(slam_map.ids, slam_map.parent[hangs])
    below = csr_array((np.ones(len(hangs), np.int8), (above, hangs)), shape=(len(slam_map.ids), len(slam_map.ids)))
    return np.sort(slam_map.ids[breadth_first_order(below, slam_map.row(keyframe_id), return_predecessors=False)])


def parents_from(slam_map: Map, keyframe_id: int) -> Ids:
    """Return the `(k,)` parents with a keyframe as the root of its submap.

    The path from the keyframe to the former root is reversed. All other keyframes keep their parents.
    """
    parent, above, below = slam_map.parent.copy(), int(keyframe_id), NONE
    while above != NONE:
        row = slam_map.row(above)
        parent[row], below, above = below, above, int(slam_map.parent[row])
    return parent


def new_anchor(slam_map: Map, keyframe_id: int) -> int:
    """Return the id of the keyframe relative to which the pose of a removed keyframe is stored.

    It is the parent or, for the first keyframe of a submap, the child with the most shared points.

    Raises:
        ValueError: If the keyframe is the only one of its submap.
    """
    parent = slam_map.parent[slam_map.row(keyframe_id)]
    if parent != NONE:
        return int(parent)
    below = children(slam_map, keyframe_id)
    if not len(below):
        raise ValueError(f"keyframe {keyframe_id} is the only one of its submap")
    near, _ = covisible(slam_map, keyframe_id, at_least=1)
    near = near[np.isin(near, below)]
    return int(near[0] if len(near) else below[0])


def parents_without(slam_map: Map, keyframe_id: int, anchor: int) -> Ids:
    """Return the `(k,)` parents after the removal of a keyframe whose anchor is `anchor`.

    Each of its children gets the keyframe with the most shared points that is not its own descendant as parent or, if
    there is none, `anchor`.
    """
    parent = slam_map.parent.copy()
    if slam_map.parent[slam_map.row(keyframe_id)] == NONE:
        parent[slam_map.row(anchor)] = NONE
    orphans = children(slam_map, keyframe_id)
    for orphan in orphans[orphans != anchor].tolist():
        near, _ = covisible(slam_map, orphan, at_least=1)
        below = subtree(slam_map._replace(parent=parent), orphan)
        allowed = near[~np.isin(near, below) & (near != keyframe_id)]
        parent[slam_map.row(orphan)] = allowed[0] if len(allowed) else anchor
    return parent
