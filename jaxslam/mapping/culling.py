"""Culling: remove map points that too few keyframes confirm, redundant keyframes, and what exceeds the memory.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, and "ORB-SLAM", 2015, sections VI-B and VI-E, for the rules.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int

from jaxslam.geometry.types import Ids
from jaxslam.loop_closing.place_index import INDEX_BYTES
from jaxslam.map.edit import without_points
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.partial_map import extract_around, merge_back
from jaxslam.map.point_records import NONE, has, rows
from jaxslam.map.spanning_tree import children
from jaxslam.map.types import Keyframe, Map, covisible, surviving_keyframes
from jaxslam.mapping.local_map_tracking import keyframes_in_view
from jaxslam.mapping.view_coverage import in_view, seen_alike

CONFIRM_WITHIN = 3
"""Number of keyframes after which a point must have been observed by others, if they look there."""
_MIN_VIEWS, _MIN_VIEWS_WITHOUT_DEPTH = 2, 3
"""Minimum number of keyframes that observe a point; one more if none measured its depth, since two rays meet somewhere
even if matched wrongly."""
_REDUNDANT_SHARE, _REDUNDANT_VIEWS = 0.9, 3
"""A keyframe is redundant if this share of its points is observed by this many others at least as accurately."""
_AS_EXACT = 1.25
"""Factor on the standard deviation up to which an observation counts as accurate as another: one pyramid level."""
_SPARE_SHARE = 0.5
"""Share of its points that others must observe for a keyframe to leave a full map before those that are far away."""
_MOST_AT_ONCE = 4
"""Largest number of keyframes that leave a full map for a new one, so that the work stays bounded."""
KEEP_LATEST = 12
"""Latest keyframes, which the tracker may still use."""


def without_unconfirmed(slam_map: Map, keyframe_id: int) -> Map:
    """Drop points that too few keyframes have observed, some keyframes after their creation, where the latest looks.

    ORB-SLAM drops them wherever they are, but makes a keyframe every few frames. Here the next keyframes may be far
    away: after a person passed before the lens of Bonn's `crowd`, 16 points were found of a map that dropped them, and
    78 to 94 in one that did not.

    Args:
        slam_map: The map, or a part of it.
        keyframe_id: Id of the latest keyframe.
    """
    row = rows(slam_map.points.ids, slam_map.observations.point)
    seen = np.bincount(row, minlength=len(slam_map.points.ids))
    measured = np.bincount(row[slam_map.observations.depth > 0], minlength=len(slam_map.points.ids)) > 0
    enough = seen >= np.where(measured, _MIN_VIEWS, _MIN_VIEWS_WITHOUT_DEPTH)
    old = slam_map.points.reference_keyframe <= keyframe_id - CONFIRM_WITHIN
    missed = np.flatnonzero(old & ~enough)
    missed = missed[_should_be_seen(slam_map, keyframe_id, missed)]
    leaves = seen < 1
    leaves[missed] = True
    return without_points(slam_map, slam_map.points.ids[leaves])


def _should_be_seen(slam_map: Map, keyframe_id: int, row: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Tell which points, given by their rows, are in view of a keyframe and seen as they were by their first one."""
    X_world, now = slam_map.points.X_world[:, row], slam_map.pose(keyframe_id)
    makers = surviving_keyframes(slam_map, slam_map.points.reference_keyframe[row])
    then = slam_map.T_world_cam[rows(slam_map.ids, makers), 4:].T
    return in_view(slam_map.camera, now, X_world) & seen_alike(X_world, then, now[4:, None])


def without_redundant(slam_map: Map, keyframe_id: int, among: Ids) -> Map:
    """Drop the neighbors of a keyframe whose points other keyframes observe well enough.

    Args:
        slam_map: The map, or a part of it.
        keyframe_id: Id of the latest keyframe.
        among: Ascending ids of the keyframes that may be dropped: those whose points are all in this part. The first
            keyframe of a submap and the latest keyframes always stay.
    """
    near, _ = covisible(slam_map, keyframe_id)
    first = slam_map.parent[rows(slam_map.ids, near)] == NONE
    for candidate in near[has(among, near) & ~first & (near <= keyframe_id - KEEP_LATEST)].tolist():
        if _redundant(slam_map, candidate):
            slam_map = without_keyframe(slam_map, candidate)
    return slam_map


def without_isolated(slam_map: Map, keyframe_id: int) -> Map:
    """Drop the keyframe that is no longer one of the latest, if it shares few points and others show its view.

    After a loss the tracker needs a keyframe at once, even if somebody covers the view. In Bonn's `crowd`, three stayed
    of each loss, with 0 to 154 points that were never found again.

    Args:
        slam_map: The whole map.
        keyframe_id: Id of the latest keyframe.
    """
    candidate = keyframe_id - KEEP_LATEST
    if not slam_map.has_keyframe(candidate):
        return slam_map
    row = slam_map.row(candidate)
    if slam_map.parent[row] == NONE or len(covisible(slam_map, candidate)[0]):
        return slam_map
    others = keyframes_in_view(slam_map, slam_map.pose(candidate), int(slam_map.submap[row]), {candidate}, 1)
    return _without(slam_map, candidate) if others else slam_map


def within_memory(slam_map: Map, keyframe_id: int, max_bytes: int) -> Map:
    """Drop keyframes of a map that takes too much memory, at most four: those that others show best, then the farthest.

    Args:
        slam_map: The map.
        keyframe_id: Id of the latest keyframe. It and those shortly before it stay, and so does the last keyframe of
            each submap.
        max_bytes: Memory that the map may take, as `memory_bytes` counts it.
    """
    for _ in range(_MOST_AT_ONCE):
        if memory_bytes(slam_map) <= max_bytes:
            break
        alone = np.bincount(slam_map.submap, minlength=1)[slam_map.submap] == 1
        leaving = np.flatnonzero((slam_map.ids <= keyframe_id - KEEP_LATEST) & ~alone)
        if not len(leaving):
            break
        shown = _shares_seen_by_others(slam_map)[leaving]
        latest = slam_map.row(keyframe_id)
        apart_m = np.linalg.norm(slam_map.T_world_cam[leaving, 4:] - slam_map.T_world_cam[latest, 4:], axis=1)
        apart_m[slam_map.submap[leaving] != slam_map.submap[latest]] = np.inf
        spare = shown >= _SPARE_SHARE
        first = np.lexsort((leaving, np.where(spare, -shown, -apart_m), ~spare))[0]
        slam_map = _without(slam_map, int(slam_map.ids[leaving[first]]))
    return slam_map


def _without(slam_map: Map, keyframe_id: int) -> Map:
    """Remove a keyframe of the whole map: an edit of the part around it and its children, which get other parents."""
    part = extract_around(slam_map, np.append(children(slam_map, keyframe_id), keyframe_id))
    return merge_back(slam_map, part, without_keyframe(part.map, keyframe_id))


def memory_bytes(slam_map: Map) -> int:
    """Return the memory that a map takes, with what the place index holds of it, bytes."""
    arrays = [*slam_map.loops, *slam_map.culled, slam_map.T_world_cam]
    of_arrays = sum(array.nbytes for array in arrays) + slam_map.contents.nbytes
    return of_arrays + sum(map(_keyframe_bytes, slam_map.keyframes))


def _keyframe_bytes(keyframe: Keyframe) -> int:
    features = sum(array.nbytes for array in keyframe.features)
    return features + len(keyframe.image_file) + INDEX_BYTES * len(keyframe.features.octave)


def _shares_seen_by_others(slam_map: Map) -> Float64[np.ndarray, " k"]:
    """Return the share of the points of each keyframe that enough others observe."""
    point, keyframe = rows(slam_map.points.ids, slam_map.observations.point), slam_map.observations.keyframe
    enough = np.bincount(point)[point] > _REDUNDANT_VIEWS
    of = rows(slam_map.ids, keyframe)
    counts = np.bincount(of, minlength=len(slam_map.ids))
    return np.bincount(of, enough, minlength=len(slam_map.ids)) / np.maximum(counts, 1)


def _redundant(slam_map: Map, keyframe_id: int) -> bool:
    mine = slam_map.observations.keyframe == keyframe_id
    sigma = np.zeros(len(slam_map.points.ids), np.float32)
    seen = rows(slam_map.points.ids, slam_map.observations.point)
    sigma[seen[mine]] = slam_map.observations.sigma_px[mine]
    as_exact = ~mine & (slam_map.observations.sigma_px <= _AS_EXACT * sigma[seen])
    views = np.bincount(seen[as_exact], minlength=len(slam_map.points.ids))[seen[mine]]
    return bool(len(views) and np.mean(views >= _REDUNDANT_VIEWS) > _REDUNDANT_SHARE)
