"""When a frame is kept as a keyframe, and why."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.robust import weighted_median
from jaxslam_kernels.scene_flow import flow_length
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Code, Flag, Mask, Scalar

from jaxslam.tracking.state import KeyframeReason, KeyframeRing, TrackedPoints, TrackParams, TrackPlan, TrackState

_MIN_OVERLAP = 0.25
"""Share of the interval between keyframes that is kept to where nothing is left of the last one."""


class KeyframeCandidate(NamedTuple):
    """A frame that may be kept.

    Attributes:
        T_world_cam: Its pose.
        points: What is followed in it.
        tracked: `(n,)` which of them are at rest and were there before.
        overlap: Largest share of a keyframe's points that it shows.
        lost: Whether it was not tracked,
        weak: or only just.
        started: Whether tracking begins in it.
        since_keyframe_s: Seconds since the last keyframe.
        movable: Share of the picture that may move.
    """

    T_world_cam: SE3
    points: TrackedPoints
    tracked: Mask
    overlap: Scalar
    lost: Flag
    weak: Flag
    started: Flag
    since_keyframe_s: Scalar
    movable: Scalar


def keyframe_reason(state: TrackState, frame: KeyframeCandidate, params: TrackParams, plan: TrackPlan) -> Code:
    """Why to keep a frame, a `KeyframeReason`; `NONE` if it is not kept."""
    num_points, since_s = frame.tracked.shape[0], frame.since_keyframe_s
    old = frame.tracked & (frame.points.age > state.since_keyframe)
    num_kept = jnp.sum(frame.tracked, dtype=since_s.dtype)
    share = jnp.sum(old, dtype=since_s.dtype) / jnp.maximum(num_kept, 1)
    tracked = ~frame.lost
    enough = params.keyframe_points_below * num_points
    few, hardly_any = tracked & (num_kept < enough), num_kept < 0.5 * enough
    weak_for_long = since_s > params.keyframe_weak_after_s
    causes = (
        (tracked & (frame.overlap < params.keyframe_below), KeyframeReason.NEW_AREA),
        (tracked & (share < params.keyframe_followed_below), KeyframeReason.FEW_FOLLOWED),
        (few & (hardly_any | weak_for_long), KeyframeReason.FEW_POINTS),
        (frame.weak & weak_for_long, KeyframeReason.WEAK),
        (tracked & (since_s > params.keyframe_after_s), KeyframeReason.TIME),
    )
    may = (
        jnp.ones((), bool)
        if plan.keyframe_policy == "as_needed"
        else _adds_information(state.keyframes, frame, params, plan)
    )
    urgent = (KeyframeReason.FEW_POINTS, KeyframeReason.WEAK)
    conditions = [condition if reason in urgent else condition & may for condition, reason in causes]
    codes = [jnp.full((), reason, jnp.int32) for reason in (KeyframeReason.STARTED, *(reason for _, reason in causes))]
    return jnp.select([frame.started, *conditions], codes, jnp.full((), KeyframeReason.NONE, jnp.int32))


def _adds_information(keyframes: KeyframeRing, frame: KeyframeCandidate, params: TrackParams, plan: TrackPlan) -> Flag:
    """Whether a keyframe for which there is time comes at the right moment: the rules of USD-SLAM, section III-C.

    Not soon after the last one, but the sooner the less is left of that; only if the camera has moved, as the points
    show; and not while much of the picture may move, unless that lasts.
    """
    left = frame.overlap / jnp.maximum(params.keyframe_below, 1e-3)
    interval_s = params.keyframe_min_s * jnp.clip(left, _MIN_OVERLAP, 1)
    due = frame.since_keyframe_s >= interval_s
    crowded = frame.movable > params.keyframe_movable_below
    waited = frame.since_keyframe_s >= interval_s + params.keyframe_patience_s
    return due & _has_moved(keyframes, frame, params, plan) & (~crowded | waited)


def _has_moved(keyframes: KeyframeRing, frame: KeyframeCandidate, params: TrackParams, plan: TrackPlan) -> Flag:
    """Whether the points have gone far enough in the axes of the camera since the last keyframe, in parts of depth."""
    last = SE3(keyframes.T_world_cam[(keyframes.made - 1) % plan.num_keyframes])
    then, now = (to_camera(pose, frame.points.X_world) for pose in (last, frame.T_world_cam))
    parts = flow_length(now - then) / jnp.maximum(now[2], params.sensor.min_depth_m)
    return weighted_median(parts, frame.tracked.astype(parts.dtype)) >= params.keyframe_motion
