"""Decide whether a frame becomes a keyframe, and for which reason."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.robust import masked_median
from jaxslam_kernels.scene_flow import flow_length
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Code, Flag, Mask, Scalar
from jaxtyping import Array, Float

from jaxslam.tracking.points import KeyframeRing, TrackedPoints
from jaxslam.tracking.state import KeyframeReason, TrackParams, TrackPlan, TrackState, code

_MIN_OVERLAP = 0.25
"""Smallest share of the minimum interval between keyframes that is waited when nothing overlaps the last keyframe."""


_RECOGNIZED, _MORE_VIEWS = 0.05, 4.0
"""Share of the keyframe points looked for that are found, below which a view is hardly recognized: in a crowd, in
blurred images, in another light. Then so many times more keyframes may show it."""
_KNOWN = 0.6
"""Share of the keyframe points looked for from which on the map shows what the frame does, however few points are still
followed. Half of the frames of Bonn `crowd` have 0.7 or more. Played to and fro five times, it ends with 9 keyframes
instead of 16 (seed 0), with the same error. With 0.5, a rendered room with two people has 13 % more error."""


class KeyframeCandidate(NamedTuple):
    """A frame that may become a keyframe.

    Attributes:
        T_world_cam: Pose of the frame.
        points: Points tracked in the frame.
        tracked: `(n,)` mask of the static points that were tracked from the previous frame.
        overlap: `(k,)` share of each keyframe's points that are in view.
        recognized: Share of the keyframe points looked for that were matched.
        lost: Whether tracking was lost in the frame.
        weak: Whether tracking was weak in the frame.
        started: Whether tracking starts in the frame.
        since_keyframe_s: Time since the last keyframe, seconds.
        movable: Share of the image covered by movable objects.
        has_depth: Whether the frame has any depth.
    """

    T_world_cam: SE3
    points: TrackedPoints
    tracked: Mask
    overlap: Float[Array, " k"]
    recognized: Scalar
    lost: Flag
    weak: Flag
    started: Flag
    since_keyframe_s: Scalar
    movable: Scalar
    has_depth: Flag


def keyframe_reason(state: TrackState, frame: KeyframeCandidate, params: TrackParams, plan: TrackPlan) -> Code:
    """Return the `KeyframeReason` of a frame; `NONE` if it does not become a keyframe.

    A keyframe waits for a frame with depth: without, it would add no points, and surfaces that move are not known.
    """
    num_points, since_s = frame.tracked.shape[0], frame.since_keyframe_s
    old = frame.tracked & (frame.points.age > state.since_keyframe)
    num_kept = jnp.sum(frame.tracked, dtype=since_s.dtype)
    share = jnp.sum(old, dtype=since_s.dtype) / jnp.maximum(num_kept, 1)
    # Of the tracker's keyframes, some may not be in the map yet; of the map's, most are not in the tracker.
    views_held = jnp.sum(frame.overlap >= params.keyframe_below, dtype=since_s.dtype)
    views = jnp.maximum(views_held, params.map_views)
    well_known = views >= params.keyframe_views * jnp.where(frame.recognized < _RECOGNIZED, _MORE_VIEWS, 1)
    tracked = ~frame.lost
    few_followed = (share < params.keyframe_followed_below) & (frame.recognized < _KNOWN)
    enough = params.keyframe_points_below * num_points
    few, hardly_any = tracked & (num_kept < enough), num_kept < 0.5 * enough
    weak_for_long = since_s > params.keyframe_weak_after_s
    causes = (
        (tracked & (views_held < 1) & ~well_known, KeyframeReason.NEW_AREA),
        (tracked & ~frame.weak & few_followed & ~well_known, KeyframeReason.FEW_FOLLOWED),
        (few & (hardly_any | weak_for_long), KeyframeReason.FEW_POINTS),
        (frame.weak & weak_for_long & (views < params.keyframe_views), KeyframeReason.WEAK),
        (tracked & weak_for_long & (params.map_changed > 0), KeyframeReason.CHANGED),
    )
    may = (
        jnp.ones((), bool)
        if plan.keyframe_policy == "as_needed"
        else _adds_information(state.keyframes, frame, params, plan)
    )
    urgent = (KeyframeReason.FEW_POINTS, KeyframeReason.WEAK)
    conditions = [condition if reason in urgent else condition & may for condition, reason in causes]
    conditions = [condition & frame.has_depth for condition in conditions]
    codes = [code(reason) for reason in (KeyframeReason.STARTED, *(reason for _, reason in causes))]
    # Where the map shows a place at which tracking starts again, its keyframes are loaded, and this one is no news.
    started = frame.started & (params.map_views < params.keyframe_views)
    return jnp.select([started, *conditions], codes, code(KeyframeReason.NONE))


def _adds_information(keyframes: KeyframeRing, frame: KeyframeCandidate, params: TrackParams, plan: TrackPlan) -> Flag:
    """Return whether a keyframe that is not urgent adds information: the rules of USD-SLAM, section III-C.

    It must not follow the last keyframe too soon (the interval shrinks with the overlap), the camera must have moved
    relative to the points, and the image must not be largely movable, unless that lasts.
    """
    left = jnp.max(frame.overlap) / jnp.maximum(params.keyframe_below, 1e-3)
    interval_s = params.keyframe_min_s * jnp.clip(left, _MIN_OVERLAP, 1)
    due = frame.since_keyframe_s >= interval_s
    crowded = frame.movable > params.keyframe_movable_below
    waited = frame.since_keyframe_s >= interval_s + params.keyframe_patience_s
    return due & _has_moved(keyframes, frame, params, plan) & (~crowded | waited)


def _has_moved(keyframes: KeyframeRing, frame: KeyframeCandidate, params: TrackParams, plan: TrackPlan) -> Flag:
    """Return whether the points have moved enough in the camera frame since the last keyframe, relative to depth."""
    last = SE3(keyframes.T_world_cam[(keyframes.made - 1) % plan.num_keyframes])
    then, now = (to_camera(pose, frame.points.X_world) for pose in (last, frame.T_world_cam))
    parts = flow_length(now - then) / jnp.maximum(now[2], params.sensor.min_depth_m)
    return masked_median(parts, frame.tracked) >= params.keyframe_motion
