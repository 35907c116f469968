"""The main path: one frame in, one pose out.

`track_step` is a pure function of arrays. It can be jitted, batched with `vmap`, run over a clip with `lax.scan`, and
differentiated with respect to camera, weights, map points, thresholds that are not comparisons, and images. Which
points agree and which keyframes are looked into are choices, constant for a derivative; the refinement after them
carries it, by the implicit function theorem.
"""

import enum
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxlie import SE3
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.depth.sampling import valid_depth
from jaxslam_kernels.flow.lk_flow import lk_flow
from jaxslam_kernels.image.pyramid import Pyramid, build_pyramid
from jaxslam_kernels.pose.pose_refine import PoseRefinement
from jaxslam_kernels.robust import weighted_median
from jaxslam_kernels.se3 import displacement, retract, to_camera, to_world
from jaxslam_kernels.types import Code, Flag, Mask, Pixels, Scalar, Weights
from jaxtyping import Array, Float, Int

from jaxslam.dynamics.object_motion import labels_at, no_motion
from jaxslam.dynamics.regions import Regions, balance_regions, find_regions, no_regions
from jaxslam.runtime.floating_dtype import floating_dtype
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import PreparedFrame, depth_sigma, match_depth, measure_points, predict_pixels
from jaxslam.tracking.dynamic_rejection import DynamicRejection, FramePoints, reject_dynamic_points
from jaxslam.tracking.keyframe_decision import KeyframeCandidate, keyframe_reason
from jaxslam.tracking.keyframe_ring import align_keyframe_points, empty_keyframes, with_keyframe
from jaxslam.tracking.point_detection import detect_new_points
from jaxslam.tracking.points import KeyframeMatches, TrackedPoints
from jaxslam.tracking.pose_estimation import coarse_pose, fits, refined_pose, worse_status
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackReason, TrackState, TrackStatus
from jaxslam.tracking.step_checks import check_cues, check_followed, check_plan, check_pose, check_state, check_step

DEFAULT_PLAN = TrackPlan()
_MAX_PREDICTION_S = 0.1
"""A constant velocity says nothing about longer gaps."""
_MAX_FUSED, _MAX_FUSED_OF_PAIR = 4, 16
"""Measurements of depth that a point counts as at most, so that an early error of the pose is forgotten. Those of a
pair are less sure: with 4, three rooms along a half sphere have 3.3, 6.4 and 4.0 mm of error, with 16 1.6, 1.9 and 1.3,
with 64 1.5, 1.5 and 1.2."""
_UNKNOWN_VARIANCE, _NO_VARIANCE = 1e2, 1e-12
"""m^2 and rad^2. The pose at which a map or submap begins is its origin by definition; not 0, which some programs take
for unknown and which has no inverse."""
_LOOK_EVERY = 3
"""Frames from one search for points on things that have too few to the next."""


class FlowResult(NamedTuple):
    """The points of a state, tracked into a frame by optical flow.

    Attributes:
        pyramid: Image pyramid of the frame.
        predicted: Pose of the camera predicted by constant velocity.
        uv: `(2, n)` positions of the points in the frame, pixels.
        ok: `(n,)` mask of the points that were found.
    """

    pyramid: Pyramid
    predicted: SE3
    uv: Pixels
    ok: Mask


class _Outcome(NamedTuple):
    """Whether the frame was tracked, and why not."""

    lost: Flag
    weak: Flag
    reason: Code
    inlier_ratio: Scalar


class _KeptPoints(NamedTuple):
    """The points of the last frame as they are in this one: those at rest, and those on what moves.

    Attributes:
        points: Both.
        tracked: `(n,)` those at rest.
        witnesses: `(n,)` those on what moves.
    """

    points: TrackedPoints
    tracked: Mask
    witnesses: Mask


def init_state(
    height: int,
    width: int,
    plan: TrackPlan = DEFAULT_PLAN,
    *,
    T_world_cam: SE3 | None = None,
    seed: int | Int[Array, ""] = 0,
    image_dtype: DTypeLike = jnp.uint8,
    dtype: DTypeLike = jnp.float32,
) -> TrackState:
    """Create the state before the first frame: the first frame given to `track_step` starts tracking.

    Args:
        height: Number of rows of the images.
        width: Number of columns of the images.
        plan: Array sizes and search settings, static.
        T_world_cam: Pose of the camera at the first frame; by default the origin of the world.
        seed: Seed of every random choice.
        image_dtype: Type of the images: `uint8`, or floating point to differentiate with respect to them. The step
            rejects other types, because keyframes hold images of this type.
        dtype: Floating-point type of everything else, equal to that of parameters and frames; float32 by default, also
            with `jax_enable_x64`.

    Raises:
        ValueError: If the parts of the plan are inconsistent, or the image is too small for its levels.
        TypeError: If `T_world_cam` is not a pose, or `dtype` is not a floating-point type or is float64 while
            `jax_enable_x64` is off.
    """
    check_plan(plan)
    n, dtype = plan.num_points, floating_dtype(dtype)
    blank = build_pyramid(jnp.zeros((height, width), dtype), num_levels=plan.num_levels)
    pose = SE3.identity() if T_world_cam is None else T_world_cam
    check_pose("T_world_cam", pose)
    return TrackState(
        pyramid=blank,
        points=TrackedPoints(
            uv=jnp.zeros((2, n), dtype),
            xy=jnp.zeros((2, n), dtype),
            depth=jnp.zeros(n, dtype),
            X_world=jnp.zeros((3, n), dtype),
            X_anchor=jnp.zeros((3, n), dtype),
            information=jnp.zeros(n, dtype),
            weight=jnp.ones(n, dtype),
            age=jnp.zeros(n, jnp.int32),
            anchor_age=jnp.zeros(n, jnp.int32),
            id=jnp.zeros(n, jnp.int32),
            valid=jnp.zeros(n, bool),
        ),
        keyframes=empty_keyframes(height, width, plan, jnp.dtype(image_dtype), dtype),
        T_world_cam=SE3(pose.wxyz_xyz.astype(dtype)),
        twist=jnp.zeros(6, dtype),
        elapsed_s=jnp.zeros((), dtype),
        since_keyframe_s=jnp.zeros((), dtype),
        since_keyframe=jnp.zeros((), jnp.int32),
        lost_frames=jnp.full((), 2**20, jnp.int32),
        frame=jnp.zeros((), jnp.int32),
        next_id=jnp.zeros((), jnp.int32),
        key=jax.random.key_data(jax.random.key(seed)),
        regions=no_regions(plan.regions, dtype),
        motion=no_motion(plan.motion, n, dtype),
    )


@lru_cache(maxsize=32)
def _state_for(height: int, width: int, plan: TrackPlan, image_dtype: jnp.dtype, dtype: jnp.dtype) -> TrackState:
    """Shapes and types of a state for a plan and frames of a size and a type."""
    return jax.eval_shape(partial(init_state, height, width, plan, image_dtype=image_dtype, dtype=dtype))


def _check(state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan) -> TrackState:
    """Refuse arguments that do not fit each other; shapes and types of a state that does."""
    check_step(state, frame, params, plan)
    image = jax.typeof(frame.image)
    expected = _state_for(*image.shape, plan._replace(cues=()), image.dtype, jax.typeof(state.twist).dtype)
    check_state(state, expected)
    return expected


def track_step(
    state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan = DEFAULT_PLAN
) -> tuple[TrackState, TrackOutput]:
    """Track one frame.

    Args:
        state: State from `init_state` or from the previous step.
        frame: Image, depth and time of the frame.
        params: Camera and thresholds, traced.
        plan: Array sizes and search settings, static; the plan with which the state was made.

    Returns:
        The new state and the output for the frame. A frame that cannot be used is not an error: points and pose stay,
        and `status` and `reason` report it.

    Raises:
        ValueError: While tracing, if a shape does not fit the image or the plan; also if an image that is not a tracer
            has gray values from 0 to 1 instead of 255.
        TypeError: While tracing, if state, parameters and frame differ in floating-point type, the images of the state
            and the frame differ in type, or float32 is given with `TrackPlan.exact()`.
    """
    _check(state, frame, params, plan)
    check_cues(state, frame, params, plan)  # here too: before anything is computed where nothing is traced
    return track_followed(state, frame, follow_points(state, frame, params, plan), params, plan)


def follow_points(
    state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan = DEFAULT_PLAN
) -> FlowResult:
    """Track the points of the state into a frame by optical flow: the first part of `track_step`.

    Only the image and the time of the frame are read, so its masks can be computed at the same time.

    Args:
        state: State from `init_state` or from the previous step.
        frame: Image and time of the frame; the values of depth, `ignore` and `movable` may still change afterward.
        params: Camera and thresholds, traced; the parameters of cues may be missing.
        plan: Array sizes and search settings, static.

    Raises:
        ValueError: In the same cases as `track_step`.
        TypeError: In the same cases as `track_step`.
    """
    _check(state, frame, params, plan)
    height, width = frame.image.shape
    elapsed_s = state.elapsed_s + frame.dt_s
    pyramid = build_pyramid(frame.image, num_levels=plan.num_levels, dtype=state.twist.dtype)
    # Constant velocity.
    predicted = retract(state.T_world_cam, state.twist * jnp.clip(elapsed_s, 0, _MAX_PREDICTION_S))
    points = state.points
    before = predict_pixels(to_camera(state.T_world_cam, points.X_world), state.twist, height, params.sensor)
    after = predict_pixels(to_camera(predicted, points.X_world), state.twist, height, params.sensor)
    guess = points.uv + lax.stop_gradient(after - before)
    inside = jnp.all((guess > 0) & (guess < jnp.array([[width - 1], [height - 1]], guess.dtype)), axis=0)
    guess = jnp.where(inside[None, :], guess, points.uv)
    flow = lk_flow(state.pyramid, pyramid, points.uv, guess, points.valid, plan=plan.flow)
    return FlowResult(pyramid, predicted, flow.points, flow.ok & (points.weight > 0))


def track_followed(
    state: TrackState,
    frame: FrameArrays,
    followed_points: FlowResult,
    params: TrackParams,
    plan: TrackPlan = DEFAULT_PLAN,
) -> tuple[TrackState, TrackOutput]:
    """Estimate the pose, update the points, and decide on a keyframe: the second part of `track_step`.

    Args:
        state: State from which the points were tracked.
        frame: The frame into which they were tracked, with depth and masks.
        followed_points: Result of `follow_points`.
        params: Camera and thresholds, traced.
        plan: Array sizes and search settings, static.

    Returns:
        The new state and the output for the frame, as `track_step`.

    Raises:
        ValueError: In the same cases as `track_step`.
        TypeError: In the same cases as `track_step`.
    """
    expected = _check(state, frame, params, plan)
    check_cues(state, frame, params, plan)
    points = expected.points
    check_followed(followed_points, FlowResult(expected.pyramid, expected.T_world_cam, points.uv, points.valid))
    pyramid, predicted, uv, found = followed_points
    depth = valid_depth(frame.depth, params.sensor.min_depth_m, params.sensor.max_depth_m)
    view = PreparedFrame(frame, pyramid, depth, state.elapsed_s + frame.dt_s)
    view = _matched(view, state, uv, found, predicted, params, plan)
    column, row = jnp.round(lax.stop_gradient(uv)).astype(jnp.int32)
    masked = frame.ignore.at[row, column].get(mode="fill", fill_value=True)
    thing = _object_ids_at(frame, uv, plan)
    followed = _background(state, found & ~masked, thing, params)
    params = _widened(params, state.points.uv, uv, followed)
    regions = _regions(state, view, uv, predicted, params, plan)
    trust = _trust(state.points, params)
    votes = jnp.where(followed, trust, 0)
    if regions is not None and plan.balance_regions:
        votes = balance_regions(votes, regions)
    coarse, agreeing, coarse_status = coarse_pose(state, view, uv, votes, predicted, params, plan)
    twist = _twist(state.T_world_cam, coarse, view.elapsed_s)
    points = FramePoints(uv, followed, found & masked, agreeing, trust, found & ~masked, thing)
    judged = reject_dynamic_points(state, view, points, regions, coarse, twist, params, plan)
    if judged.motion is not None:
        joining = judged.motion.joining()
        followed, agreeing = followed | joining, agreeing | (joining & fits(state, view, uv, coarse, twist, params))
    # Not `votes`: what carries the pose is out by now, and with even votes here too the kitchen has 0.029 m, not 0.025.
    trust = judged.weights(trust)
    agreeing &= trust > 0
    keyframe_matches = align_keyframe_points(
        state.keyframes, coarse, twist, judged.without_moving_pixels(view), params, plan
    )
    counting = jnp.where(agreeing, trust, 0)
    refined, inliers = refined_pose(state, view, uv, counting, keyframe_matches, coarse, twist, params, plan)
    verdict = _judge(state, view, refined, followed & judged.counts(), inliers, params)
    witnesses = judged.monitor_points(uv, state.points.anchor_age, followed & ~inliers)
    kept = _update_points(state, view, uv, inliers, witnesses, refined.T_world_cam, params)
    new_state, output = _conclude(state, view, kept, refined, keyframe_matches, verdict, judged, params, plan)
    said = {
        "cue_results": judged.cue_results,
        "regions": judged.regions,
        "moving": judged.moving,
        "motion": judged.motion,
    }
    if plan.pose_steps > DEFAULT_PLAN.pose_steps:
        # Not always: one more use of the coarse pose's status has XLA round the pose itself in another way.
        said["pose_status"] = worse_status(coarse_status, refined.status)
    return new_state, output._replace(**said)


def _object_ids_at(frame: FrameArrays, uv: Pixels, plan: TrackPlan) -> Int[Array, " n"]:
    """Number of the thing that may move at each pixel; 0 for none, and where nobody asks."""
    if plan.motion is None:
        return jnp.zeros(uv.shape[1], jnp.int32)
    assert frame.movable is not None
    return labels_at(frame.movable, uv)


def _background(state: TrackState, there: Mask, thing: Int[Array, " n"], params: TrackParams) -> Mask:
    """`(n,)` which points the coarse pose is made of: those on nothing that may move.

    Where such things cover nearly all, those that stood still in the last frame count too.
    """
    outside = there & (thing == 0)
    if not state.motion.at_rest.shape[0]:
        return outside
    before = state.motion.of_point
    stood = there & (before > 0) & state.motion.at_rest[jnp.maximum(before - 1, 0)]
    few = jnp.sum(outside, dtype=state.twist.dtype) < params.weak_inliers
    return outside | (few & stood)


def _matched(
    view: PreparedFrame,
    state: TrackState,
    uv: Pixels,
    found: Mask,
    predicted: SE3,
    params: TrackParams,
    plan: TrackPlan,
) -> PreparedFrame:
    """The frame with the right image of a pair, and the depth of the points followed by it; without one as it was."""
    view = view.with_right()
    expected = to_camera(predicted, state.points.X_world)[2]
    return view._replace(matched=match_depth(view, uv, expected, found, params.sensor, plan=plan.pair_flow))


def _widened(params: TrackParams, before: Pixels, after: Pixels, followed: Mask) -> TrackParams:
    """Thresholds on reprojection errors, widened by the motion in the image.

    They are scales of robust losses too, and so have a derivative.
    """
    squared = jnp.sum(jnp.square(after - before), axis=0)
    length = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
    extra = params.error_per_flow * weighted_median(length, followed.astype(length.dtype))
    return params._replace(ransac_px=params.ransac_px + extra, outlier_px=params.outlier_px + extra)


def _trust(points: TrackedPoints, params: TrackParams) -> Weights:
    """Weight of each point, lower while it is on probation; 0 for a slot without a point."""
    served = (points.age + 1).astype(points.weight.dtype) / params.probation_frames
    return jnp.where(points.valid, points.weight * jnp.minimum(served, 1), 0)


def _regions(
    state: TrackState, view: PreparedFrame, uv: Pixels, predicted: SE3, params: TrackParams, plan: TrackPlan
) -> Regions | None:
    """The surfaces of the frame, if something asks for them."""
    if plan.regions is None:
        return None
    seen = measure_points(state.points.X_world, uv, predicted, state.twist, view, params.sensor, view.matched)
    key, ideal = jax.random.fold_in(state.random_key(), -1 - state.frame), without_distortion(params.sensor.intrinsics)
    return find_regions(key, view.depth, state.regions.centers, seen.in_camera(), ideal, plan.regions)


def _twist(before: SE3, after: SE3, elapsed_s: Scalar) -> Float[Array, "6"]:
    """Velocity of the camera in its own axes."""
    known = elapsed_s > 1e-4
    return jnp.where(known, displacement(before, after) / jnp.where(known, elapsed_s, 1), 0)


def _judge(
    state: TrackState, view: PreparedFrame, refined: PoseRefinement, followed: Mask, inliers: Mask, params: TrackParams
) -> _Outcome:
    """Lost, weak or fine, and why."""
    num_followed, num_inliers = (jnp.sum(mask, dtype=state.twist.dtype) for mask in (followed, inliers))
    ratio = num_inliers / jnp.maximum(num_followed, 1)
    twist = _twist(state.T_world_cam, refined.T_world_cam, view.elapsed_s)
    speed, turn = jnp.linalg.norm(twist[:3]), jnp.linalg.norm(twist[3:])
    causes = (
        (view.frame.dt_s <= 0, TrackReason.BAD_TIME),
        (num_followed < params.min_inliers, TrackReason.NO_POINTS),
        (num_inliers < params.min_inliers, TrackReason.FEW_INLIERS),
        (ratio < params.min_share, TrackReason.FEW_SHARE),
        (~((speed < params.max_speed_m_per_s) & (turn < params.max_turn_rad_per_s)), TrackReason.IMPLAUSIBLE_MOTION),
    )
    conditions = [condition for condition, _ in causes]
    lost = jnp.any(jnp.stack(conditions))
    weak = num_inliers < params.weak_inliers
    mild = jnp.where(weak, _code(TrackReason.FEW_INLIERS), _code(TrackReason.NONE))
    codes = [_code(reason) for _, reason in causes]
    return _Outcome(lost, weak & ~lost, jnp.select(conditions, codes, mild), ratio)


def _code(value: enum.IntEnum) -> Code:
    return jnp.full((), value, jnp.int32)


def _update_points(
    state: TrackState,
    view: PreparedFrame,
    uv: Pixels,
    inliers: Mask,
    witnesses: Mask,
    T_world_cam: SE3,
    params: TrackParams,
) -> _KeptPoints:
    """Keep the inliers, and fuse the depth measured now into where they are.

    Witnesses, on what moves, are kept too, measured anew in every frame.
    """
    points = state.points
    twist = _twist(state.T_world_cam, T_world_cam, view.elapsed_s)
    seen = measure_points(points.X_world, uv, T_world_cam, twist, view, params.sensor, view.matched)
    X_cam = to_camera(T_world_cam, points.X_world)
    sigma = depth_sigma(seen.depth, params.sensor)
    agrees = inliers & (seen.depth > 0) & (jnp.abs(seen.depth - X_cam[2]) < 3 * sigma)
    information = jnp.where(agrees, 1 / jnp.square(sigma), 0)
    total = jnp.where(agrees, points.information + information, 1)
    fused = X_cam + (information / total)[None, :] * (seen.in_camera() - X_cam)
    X_world = to_world(T_world_cam, fused)
    cap = (_MAX_FUSED if view.right is None else _MAX_FUSED_OF_PAIR) * information
    X_world = jnp.where(agrees[None, :], X_world, points.X_world)
    information = jnp.where(agrees, jnp.minimum(points.information + information, cap), points.information)
    witnesses &= seen.depth > 0
    X_world = jnp.where(witnesses[None, :], to_world(T_world_cam, seen.in_camera()), X_world)
    there = inliers | witnesses
    anchored = points.anchor_age.astype(X_world.dtype) < params.anchor_frames
    updated = TrackedPoints(
        uv=jnp.where(there[None, :], uv, points.uv),
        xy=jnp.where(there[None, :], seen.xy, points.xy),
        depth=jnp.where(there, seen.depth, points.depth),
        X_world=X_world,
        X_anchor=jnp.where(anchored[None, :], points.X_anchor, X_world),
        information=jnp.where(witnesses, 1 / jnp.square(sigma), information),
        weight=points.weight,
        age=jnp.where(witnesses, 0, points.age + inliers.astype(jnp.int32)),
        anchor_age=jnp.where(anchored, points.anchor_age + 1, 0),
        id=points.id,
        valid=points.valid & there,
    )
    return _KeptPoints(updated, points.valid & inliers, witnesses)


def _conclude(
    state: TrackState,
    view: PreparedFrame,
    kept: _KeptPoints,
    refined: PoseRefinement,
    keyframe_matches: KeyframeMatches,
    verdict: _Outcome,
    judged: DynamicRejection,
    params: TrackParams,
    plan: TrackPlan,
) -> tuple[TrackState, TrackOutput]:
    """The new state, and the output: tracked, held, or started anew."""
    lost_frames = jnp.where(verdict.lost, state.lost_frames + 1, 0)
    start = verdict.lost & (lost_frames.astype(state.twist.dtype) > params.restart_after)
    held = verdict.lost & ~start
    choose = lambda when_lost, when_tracked: jax.tree.map(
        lambda a, b: jnp.where(verdict.lost, a, b), when_lost, when_tracked
    )
    pose = choose(state.T_world_cam, refined.T_world_cam)
    twist = choose(jnp.zeros_like(state.twist), _twist(state.T_world_cam, pose, view.elapsed_s))
    points = choose(state.points._replace(valid=state.points.valid & held), kept.points)
    since_keyframe_s = state.since_keyframe_s + jnp.maximum(view.frame.dt_s, 0)
    movable = (
        jnp.zeros_like(twist[0]) if view.frame.movable is None else jnp.mean(view.frame.movable > 0, dtype=twist.dtype)
    )
    candidate = KeyframeCandidate(
        refined.T_world_cam,
        kept.points,
        kept.tracked,
        keyframe_matches.overlap,
        verdict.lost,
        verdict.weak,
        start,
        since_keyframe_s,
        movable,
    )
    reason_to_keep = lambda started: keyframe_reason(state, candidate._replace(started=started), params, plan)
    few = jnp.sum(points.valid, dtype=twist.dtype) < params.detect_below * plan.num_points
    may = few if plan.new_points == "always" else few & (reason_to_keep(start) > 0)
    unwatched = judged.unmonitored(view, kept.witnesses)
    may = may if unwatched is None else may | (jnp.any(unwatched) & (state.frame % _LOOK_EVERY == 0))
    free = judged.without_monitored(view, kept.witnesses, plan)
    seek = partial(detect_new_points, first=unwatched, next_id=state.next_id, view=free)
    seek = partial(seek, T_world_cam=pose, twist=twist, params=params, plan=plan)
    sought = (start | (may & ~verdict.lost)).astype(jnp.int32)
    branches = [lambda p: (p, jnp.zeros((), jnp.int32)), seek]
    if plan.motion is not None:  # more features from the rest, as in USD-SLAM
        branches.append(partial(seek, cell_px=plan.motion.dense_cell_px))
        sought = sought * jnp.where(movable > 0.5, 2, 1)
    points, num_corners = lax.switch(sought, branches, points)
    failed = start & (jnp.sum(points.valid, dtype=twist.dtype) < params.min_inliers)
    started, stale = start & ~failed, held | failed
    keyframe = reason_to_keep(started)
    make = keyframe > 0
    at_rest = judged.at_rest(points.uv)
    trust = jnp.where(at_rest, _trust(points, params), 0)
    keyframes = with_keyframe(state.keyframes, make, view.frame.image, pose, points, trust, plan)
    new_state = TrackState(
        pyramid=jax.tree.map(lambda old, new: jnp.where(stale, old, new), state.pyramid, view.pyramid),
        points=points,
        keyframes=keyframes,
        T_world_cam=pose,
        twist=twist,
        elapsed_s=jnp.where(stale, jnp.maximum(view.elapsed_s, 0), 0),
        since_keyframe_s=jnp.where(make, 0, since_keyframe_s),
        since_keyframe=jnp.where(make, 0, state.since_keyframe + (~verdict.lost).astype(jnp.int32)),
        lost_frames=jnp.where(started, 0, lost_frames),
        frame=state.frame + 1,
        next_id=jnp.maximum(state.next_id, jnp.max(jnp.where(points.valid, points.id + 1, 0))),
        key=state.key,
        regions=judged.memory or state.regions,
        motion=state.motion if judged.motion is None else choose(state.motion, judged.motion.memory),
    )
    status = jnp.select(
        [started, verdict.lost, verdict.weak],
        [_code(TrackStatus.STARTED), _code(TrackStatus.LOST), _code(TrackStatus.WEAK)],
        _code(TrackStatus.OK),
    )
    plain = num_corners.astype(twist.dtype) < params.min_inliers
    why_not = jnp.where(plain, _code(TrackReason.NO_CORNERS), _code(TrackReason.NO_DEPTH))
    reason = jnp.select([failed, started], [why_not, _code(TrackReason.NONE)], verdict.reason)
    found = keyframe_matches._replace(weight=jnp.where(verdict.lost, 0, keyframe_matches.weight))
    output = TrackOutput(
        T_world_cam=pose,
        covariance=jnp.where(
            verdict.lost,
            jnp.eye(6, dtype=twist.dtype) * jnp.where(started, _NO_VARIANCE, _UNKNOWN_VARIANCE),
            refined.covariance,
        ),
        status=status,
        reason=reason,
        num_inliers=jnp.where(verdict.lost, 0, jnp.sum(kept.tracked)),
        inlier_ratio=jnp.where(verdict.lost, 0, verdict.inlier_ratio),
        num_keyframe_matches=jnp.sum(found.weight > 0),
        residual_px=refined.residual_scale * params.pixel_sigma,
        uv=points.uv,
        weights=jnp.where(points.valid & at_rest & ~held, points.weight, 0),
        tracked=kept.tracked & ~verdict.lost,
        X_world=points.X_world,
        id=points.id,
        keyframe_matches=found,
        twist=twist,
        keyframe=keyframe,
        pose_status=refined.status,
    )
    return new_state, output
