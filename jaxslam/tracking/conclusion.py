"""Conclude a tracking step: where the camera is, new points, the keyframe decision, the new state and the output."""

from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.pose.pose_refine import PoseRefinement
from jaxslam_kernels.types import Code, Flag, Mask, Scalar
from jaxtyping import Array, Float

from jaxslam.tracking.dynamic_rejection import DynamicRejection
from jaxslam.tracking.keyframe_decision import KeyframeCandidate, keyframe_reason
from jaxslam.tracking.keyframe_ring import with_keyframe
from jaxslam.tracking.motion_prediction import updated_statistics
from jaxslam.tracking.outcome import Outcome
from jaxslam.tracking.point_detection import detect_new_points
from jaxslam.tracking.point_update import KeptPoints, probation_weights
from jaxslam.tracking.points import KeyframeMatches, TrackedPoints
from jaxslam.tracking.state import TrackOutput, TrackPhase, TrackReason, TrackState, TrackStatus, code
from jaxslam.tracking.step_context import StepContext

_UNKNOWN_VARIANCE, _NO_VARIANCE = 1e2, 1e-12
"""m^2 and rad^2. The pose at which a map or submap begins is its origin by definition; not 0, which some programs take
for unknown and which has no inverse."""
_MONITOR_EVERY = 3
"""Number of frames from one search for points on movable objects that have too few to the next."""

_FEW_LOCATED = 0.75
"""In frames without depth, share of `detect_below` below which new points are detected. Little is known there of what
moves: with 1, Bonn `crowd` with depth in every 3rd frame has 14.8 mm (two seeds; points were located at 5 % of error
then), with 0.75 and 0.5 13.4 and 13.6. A kitchen in which depth fails for five seconds has 25 and 45 mm with 0.5, 7 and
9 with 0.75."""

T = TypeVar("T")


class FrameEstimate(NamedTuple):
    """What a step has found out about its frame.

    Attributes:
        refined: Refinement of the pose.
        matches: Keyframe points aligned with the frame.
        matched: `(m,)` mask of those that agree with the pose.
        kept: Tracked points, updated.
        outcome: Whether the frame was tracked.
        rejection: Combined result of the dynamic cues.
    """

    refined: PoseRefinement
    matches: KeyframeMatches
    matched: Mask
    kept: KeptPoints
    outcome: Outcome
    rejection: DynamicRejection


class _Motion(NamedTuple):
    """Where the camera is after a frame.

    Attributes:
        T_world_cam: Pose of the frame; the last one while tracking is lost.
        twist: `(6,)` velocity of the camera; 0 while tracking is lost, that of the reset where it starts.
        start: Whether tracking is to start in the frame, at the pose.
        lost_frames: Number of frames since tracking was lost, this one included.
    """

    T_world_cam: SE3
    twist: Float[Array, "6"]
    start: Flag
    lost_frames: Code


class _Ending(NamedTuple):
    """The points after a frame, and what was decided about it.

    Attributes:
        points: Points of the new state.
        at_rest: `(n,)` mask of the points outside moving regions and objects.
        started: Whether tracking started in the frame.
        reason: A `TrackReason`.
        keyframe: A `KeyframeReason`.
        since_keyframe_s: Time since the last keyframe before this frame, seconds.
    """

    points: TrackedPoints
    at_rest: Mask
    started: Flag
    reason: Code
    keyframe: Code
    since_keyframe_s: Scalar


def conclude(step: StepContext, estimate: FrameEstimate) -> tuple[TrackState, TrackOutput]:
    """Make the new state and the output: of a frame that was tracked, lost, or in which tracking starts.

    Args:
        step: Context of the step.
        estimate: What the step has found out about its frame.
    """
    motion = _motion(step, estimate)
    ending = _ending(step, estimate, motion)
    return _new_state(step, estimate, motion, ending), _output(step, estimate, motion, ending)


def _motion(step: StepContext, estimate: FrameEstimate) -> _Motion:
    """Move the camera to the refined pose, or hold it where it was; decide whether a lost tracker starts anew there."""
    state, lost = step.state, estimate.outcome.lost
    lost_frames = jnp.where(lost, state.lost_frames + 1, 0)
    waited = lost_frames.astype(state.twist.dtype) > step.params.restart_after
    start = lost & ((state.phase == TrackPhase.START) | waited)
    pose = _choose(lost, state.T_world_cam, estimate.refined.T_world_cam)
    # A start at a recognized place keeps the velocity of the reset: without it, a fast camera is lost again at once.
    at_reset = start & (state.phase == TrackPhase.START)
    twist = jnp.where(lost, jnp.where(at_reset, state.twist, 0), step.twist_to(estimate.refined.T_world_cam))
    return _Motion(pose, twist, start, lost_frames)


def _ending(step: StepContext, estimate: FrameEstimate, motion: _Motion) -> _Ending:
    """Detect new points if there are few, and decide whether tracking has started and whether to make a keyframe."""
    state, _, params, plan = step
    kept, outcome = estimate.kept, estimate.outcome
    candidate = KeyframeCandidate(
        T_world_cam=estimate.refined.T_world_cam,
        points=kept.points,
        tracked=kept.tracked,
        overlap=estimate.matches.overlap,
        recognized=_recognized_share(estimate.matches),
        lost=outcome.lost,
        weak=outcome.weak,
        started=motion.start,
        since_keyframe_s=state.since_keyframe_s + jnp.maximum(step.view.frame.dt_s, 0),
        movable=_movable_share(step),
        has_depth=step.has_depth(),
    )
    points, num_corners = _with_new_points(step, estimate, motion, candidate)
    num_started = jnp.sum(points.has_position(), dtype=state.twist.dtype)
    failed = motion.start & (num_started < params.min_inliers)
    started = motion.start & ~failed
    few_corners = num_corners.astype(state.twist.dtype) < params.min_inliers
    cannot_start = jnp.where(few_corners, code(TrackReason.NO_CORNERS), code(TrackReason.NO_DEPTH))
    reason = jnp.select([failed, started], [cannot_start, code(TrackReason.NONE)], outcome.reason)
    keyframe = keyframe_reason(state, candidate._replace(started=started), params, plan)
    at_rest = estimate.rejection.at_rest(points.uv)
    return _Ending(points, at_rest, started, reason, keyframe, candidate.since_keyframe_s)


def _recognized_share(matches: KeyframeMatches) -> Scalar:
    """Return the share of the keyframe points looked for that were matched."""
    num_matched = jnp.sum(matches.weight > 0, dtype=matches.overlap.dtype)
    return num_matched / jnp.maximum(matches.num_sought, 1)


def _movable_share(step: StepContext) -> Scalar:
    """Return the share of the image that movable objects cover."""
    movable, dtype = step.view.frame.movable, step.state.twist.dtype
    return jnp.zeros((), dtype) if movable is None else jnp.mean(movable > 0, dtype=dtype)


def _with_new_points(
    step: StepContext, estimate: FrameEstimate, motion: _Motion, candidate: KeyframeCandidate
) -> tuple[TrackedPoints, Code]:
    """Detect new points for free slots, if there are few points or tracking is to start.

    Returns:
        The points, and the number of grid cells that hold a corner; 0 if none were sought.
    """
    state, view, params, plan = step
    lost, kept, rejection = estimate.outcome.lost, estimate.kept, estimate.rejection
    held = state.points._replace(valid=state.points.valid & ~motion.start)
    points = _choose(lost, held, kept.points)
    few = params.detect_below * plan.num_points
    num_points, num_located = (jnp.sum(mask, dtype=few.dtype) for mask in (points.valid, points.has_position()))
    # Points that wait hold no pose: sought by how many points there are, Bonn `crowd` has 9.0 mm instead of 7.9.
    few_without_depth = (num_points < few) & (num_located < _FEW_LOCATED * few)
    wanted = jnp.where(candidate.has_depth, num_located < few, few_without_depth)
    if plan.new_points == "keyframes":
        wanted &= keyframe_reason(state, candidate, params, plan) > 0
    unmonitored = rejection.unmonitored(view, kept.monitored)
    if unmonitored is not None:
        wanted |= jnp.any(unmonitored) & (state.frame % _MONITOR_EVERY == 0)
    free = rejection.without_monitored(view, kept.monitored, plan)
    detect = partial(detect_new_points, step=step._replace(view=free), T_world_cam=motion.T_world_cam)
    # In a frame that has depth, half of the slots above `detect_below`: so new points are not sought in every frame.
    beside = jnp.round(0.5 * (1 - params.detect_below) * plan.num_points).astype(jnp.int32)
    most_waiting = jnp.where(lost, 0, jnp.where(candidate.has_depth, beside, plan.num_points))
    detect = partial(detect, twist=motion.twist, most_waiting=most_waiting, first=unmonitored)
    branch = (motion.start | (wanted & ~lost)).astype(jnp.int32)
    branches = [lambda points: (points, jnp.zeros((), jnp.int32)), detect]
    if plan.motion is not None:  # more features from the rest, as in USD-SLAM
        branches.append(partial(detect, cell_px=plan.motion.dense_cell_px))
        branch = branch * jnp.where(candidate.movable > 0.5, 2, 1)
    return lax.switch(branch, branches, points)


def _new_state(step: StepContext, estimate: FrameEstimate, motion: _Motion, ending: _Ending) -> TrackState:
    """Make the state after the frame, with the frame in the ring of keyframes if it is one."""
    state, view, params, plan = step
    lost, points, moved = estimate.outcome.lost, ending.points, estimate.rejection.motion
    held, make = lost & ~ending.started, ending.keyframe > 0
    trust = view.weighed(points.uv, jnp.where(ending.at_rest, probation_weights(points, params), 0))
    image, pose = view.frame.image, motion.T_world_cam
    velocity = updated_statistics(state.velocity, state.twist, motion.twist, view.elapsed_s)
    still_to_start = held & (state.phase == TrackPhase.START)
    return TrackState(
        pyramid=_choose(held, state.pyramid, view.pyramid),
        points=points,
        keyframes=with_keyframe(state.keyframes, make, image, pose, points, trust, plan),
        T_world_cam=pose,
        twist=jnp.where(held, state.twist, motion.twist),
        velocity=_choose(lost, state.velocity, velocity),
        elapsed_s=jnp.where(held, jnp.maximum(view.elapsed_s, 0), 0),
        since_keyframe_s=jnp.where(make, 0, ending.since_keyframe_s),
        since_keyframe=jnp.where(make, 0, state.since_keyframe + (~lost).astype(jnp.int32)),
        phase=jnp.select([still_to_start, held], [state.phase, code(TrackPhase.LOST)], code(TrackPhase.TRACK)),
        lost_frames=jnp.where(ending.started, 0, motion.lost_frames),
        frame=state.frame + 1,
        next_id=jnp.maximum(state.next_id, jnp.max(jnp.where(points.valid, points.id + 1, 0))),
        key=state.key,
        regions=estimate.rejection.memory or state.regions,
        motion=state.motion if moved is None else _choose(lost, state.motion, moved.memory),
    )


def _output(step: StepContext, estimate: FrameEstimate, motion: _Motion, ending: _Ending) -> TrackOutput:
    """Make the output for the frame."""
    refined, matches, matched, kept, outcome, rejection = estimate
    lost, points, dtype = outcome.lost, ending.points, motion.twist.dtype
    statuses = (TrackStatus.STARTED, TrackStatus.LOST, TrackStatus.WEAK)
    matches = matches._replace(weight=jnp.where(lost, 0, matches.weight))
    weights = step.view.weighed(points.uv, points.weight)
    variance = jnp.where(ending.started, _NO_VARIANCE, _UNKNOWN_VARIANCE)
    return TrackOutput(
        T_world_cam=motion.T_world_cam,
        covariance=jnp.where(lost, jnp.eye(6, dtype=dtype) * variance, refined.covariance),
        status=jnp.select([ending.started, lost, outcome.weak], [*map(code, statuses)], code(TrackStatus.OK)),
        reason=ending.reason,
        num_inliers=jnp.where(lost, 0, jnp.sum(kept.tracked)),
        inlier_ratio=jnp.where(lost, 0, outcome.inlier_ratio),
        num_keyframe_matches=jnp.where(lost, 0, jnp.sum(matched)),
        residual_px=refined.residual_scale * step.params.pixel_sigma,
        uv=points.uv,
        weights=jnp.where(points.has_position() & ending.at_rest & (~lost | motion.start), weights, 0),
        tracked=kept.tracked & ~lost,
        X_world=points.X_world,
        id=points.id,
        keyframe_matches=matches,
        twist=motion.twist,
        keyframe=ending.keyframe,
        pose_status=refined.status,
        cue_results=rejection.cue_results,
        regions=rejection.regions,
        moving=rejection.moving,
        motion=rejection.motion,
    )


def _choose(condition: Flag, if_true: T, if_false: T) -> T:
    """Choose one of two pytrees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
