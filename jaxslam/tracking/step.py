"""The main path: one frame in, one pose out.

`track_step` is a pure function of arrays. It can be jitted, batched with `vmap`, run over a clip with `lax.scan`, and
differentiated with respect to camera, weights, map points, thresholds that are not comparisons, and images. Which
points agree and which keyframes are matched are choices, constant for a derivative; the refinement after them carries
it, by the implicit function theorem.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.flow.lk_flow import lk_flow
from jaxslam_kernels.image.pyramid import Pyramid, build_pyramid
from jaxslam_kernels.pose.pose_cost import PosePrior
from jaxslam_kernels.robust import masked_median
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Flag, Mask, Pixels, Scalar, Weights
from jaxtyping import Array, Int

from jaxslam.dynamics.object_motion import labels_at, object_numbers
from jaxslam.dynamics.regions import Regions, balance_regions, find_regions
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import (
    Measurements,
    PixelRays,
    PreparedFrame,
    match_depth,
    pixel_rays,
    predict_pixels,
)
from jaxslam.tracking.conclusion import FrameEstimate, conclude
from jaxslam.tracking.dynamic_rejection import FramePoints, reject_dynamic_points
from jaxslam.tracking.initial_state import DEFAULT_PLAN, state_shapes
from jaxslam.tracking.keyframe_ring import align_keyframe_points
from jaxslam.tracking.motion_prediction import predict_pose
from jaxslam.tracking.outcome import judge_frame
from jaxslam.tracking.point_update import probation_weights, update_points
from jaxslam.tracking.pose_estimation import coarse_pose, fits, measure_matches, refined_pose, worse_status
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackState
from jaxslam.tracking.step_checks import check_cues, check_followed, check_pose, check_prior, check_state, check_step
from jaxslam.tracking.step_context import StepContext
from jaxslam.tracking.unknown_depth import with_located


class FlowResult(NamedTuple):
    """The points of a state, tracked into a frame by optical flow.

    Attributes:
        pyramid: Image pyramid of the frame.
        predicted: Predicted pose of the camera.
        uv: `(2, n)` positions of the points in the frame, pixels.
        ok: `(n,)` mask of the points that were found.
        prior: Pose of the camera known beforehand, with its information; `None` if nothing is known.
    """

    pyramid: Pyramid
    predicted: SE3
    uv: Pixels
    ok: Mask
    prior: PosePrior | None = None


def track_step(
    state: TrackState,
    frame: FrameArrays,
    params: TrackParams,
    plan: TrackPlan = DEFAULT_PLAN,
    *,
    predicted: SE3 | None = None,
    prior: PosePrior | None = None,
) -> tuple[TrackState, TrackOutput]:
    """Track one frame.

    Args:
        state: State from `init_state` or from the previous step.
        frame: Image, depth and time of the frame.
        params: Camera and thresholds, traced.
        plan: Array sizes and search settings, static; the plan with which the state was made.
        predicted: Pose of the camera from which points are tracked; by default that of `prior`, or else one predicted
            from the velocity.
        prior: Pose of the camera known beforehand, such as that of wheel odometry, with its information: the inverse of
            its covariance in the tangent space at the camera. It is one term of the pose.

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
    flow = follow_points(state, frame, params, plan, predicted=predicted, prior=prior)
    return track_followed(state, frame, flow, params, plan)


def predicted_pose(state: TrackState, dt_s: Scalar) -> SE3:
    """Predict the pose of the camera a time after the frame before, in seconds, from its velocity."""
    return predict_pose(state.T_world_cam, state.twist, state.velocity, state.elapsed_s + dt_s)


def follow_points(
    state: TrackState,
    frame: FrameArrays,
    params: TrackParams,
    plan: TrackPlan = DEFAULT_PLAN,
    *,
    predicted: SE3 | None = None,
    prior: PosePrior | None = None,
    is_known: Flag | bool = True,
) -> FlowResult:
    """Track the points of the state into a frame by optical flow: the first part of `track_step`.

    Only the image and the time of the frame are read, so its masks can be computed at the same time.

    Args:
        state: State from `init_state` or from the previous step.
        frame: Image and time of the frame; the values of depth, `ignore` and `movable` may still change afterward.
        params: Camera and thresholds, traced; the parameters of cues may be missing.
        plan: Array sizes and search settings, static.
        predicted: Pose of the camera from which points are tracked; by default that of `prior`, or else one predicted
            from the velocity.
        prior: Pose of the camera known beforehand, with its information, for `track_followed`.
        is_known: Whether `predicted` comes from a measurement, so that points it takes out of the image are gone. If it
            is only predicted from the velocity, they are sought where they were.

    Raises:
        ValueError: In the same cases as `track_step`.
        TypeError: In the same cases as `track_step`.
    """
    _check(state, frame, params, plan)
    frame = _in_jax(frame)
    params = _for_readout(params, frame)
    height, width = frame.image.shape
    pyramid = build_pyramid(frame.image, num_levels=plan.num_levels, dtype=state.twist.dtype)
    if prior is not None:
        check_prior(prior, state.twist.dtype)
    if predicted is None and prior is not None:
        predicted = prior.T_world_cam
    if predicted is None:
        predicted, is_known = predicted_pose(state, frame.dt_s), False
    check_pose("predicted", predicted)
    points = state.points
    before = predict_pixels(to_camera(state.T_world_cam, points.X_world), state.twist, height, params.sensor)
    after = predict_pixels(to_camera(predicted, points.X_world), state.twist, height, params.sensor)
    guess = points.uv + lax.stop_gradient(after - before)
    inside = jnp.all((guess > 0) & (guess < jnp.array([[width - 1], [height - 1]], guess.dtype)), axis=0)
    guess = jnp.where(inside[None, :], guess, points.uv)
    flow = lk_flow(state.pyramid, pyramid, points.uv, guess, points.valid, plan=plan.flow)
    gone = is_known & ~inside
    return FlowResult(pyramid, predicted, flow.points, flow.ok & (points.weight > 0) & ~gone, prior)


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
    _check_followed(state, frame, followed_points, params, plan)
    frame = _in_jax(frame)
    params = _for_readout(params, frame)
    pyramid, predicted, uv, found, prior = followed_points
    # 1. Prepare the frame: depth that can be believed, and the right image of a stereo pair.
    step, X_world = _prepared(state, frame, pyramid, params, plan), state.points.X_world
    # 2. Rays of the tracked points, without distortion: the same for every pose below.
    rays = _tracked_rays(step, uv, found, predicted)
    # 3. Background points: those outside the mask and on no movable object. Points of unknown depth wait.
    masked, objects = step.view.ignored(uv), _object_ids(step, uv)
    found, waiting = found & state.points.has_position(), found & ~masked & ~state.points.has_position()
    background = _background(step, found & ~masked, objects)
    if plan.judge_masked:  # by the cues; and points are detected everywhere
        step = step._replace(view=step.view.without_mask())
    step = step._replace(params=_widened(params, state.points.uv, uv, background))
    # 4. Coarse pose: RANSAC PnP, in which no region of the depth image has more than an even share of the votes.
    seen = step.measured(rays, X_world, predicted, state.twist)
    regions = _regions(step, seen, predicted)
    trust = step.view.weighed(uv, probation_weights(state.points, params))
    coarse, agreeing, coarse_status = coarse_pose(
        step, seen, _votes(step, trust, background, regions), predicted, prior
    )
    # 5. Dynamic cues: points, regions and objects that move relative to the coarse pose are rejected.
    twist = step.twist_to(coarse)
    seen = step.measured(rays, X_world, coarse, twist)
    points = FramePoints(uv, background, found & masked, agreeing, trust, found & ~masked, objects, seen)
    rejection = reject_dynamic_points(step, points, regions, coarse)
    if rejection.motion is not None:
        joining = rejection.motion.joining()
        background, agreeing = background | joining, agreeing | (joining & fits(step, seen, coarse))
    if plan.judge_masked:
        joining = found & masked & rejection.found_static()
        background, agreeing = background | joining, agreeing | (joining & fits(step, seen, coarse))
    # Not the votes: what carries the pose is out by now, and with even votes here the kitchen has 0.029 m, not 0.025.
    trust = rejection.weights(trust)
    agreeing &= trust > 0
    # 6. Keyframe points, aligned with the frame by their patches around where the coarse pose predicts them.
    static_view = rejection.without_moving_pixels(step.view)
    if plan.judge_masked:
        static_view = static_view.without(frame.ignore)
    matches = align_keyframe_points(step._replace(view=static_view), coarse, twist)
    # 7. Refinement of the pose by tracked points and keyframe points together.
    counting, matches_seen = jnp.where(agreeing, trust, 0), measure_matches(step, matches, coarse, twist)
    refined, inliers, matched = refined_pose(step, seen, counting, matches, matches_seen, coarse, prior)
    outcome = judge_frame(step, refined, background & rejection.counts(), inliers, matched)
    # 8. Points at the refined pose; new ones, and a keyframe, if they are needed.
    monitored = rejection.monitor_points(uv, state.points.anchor_age, background & ~inliers)
    pose = refined.T_world_cam
    seen = step.measured(rays, X_world, pose, step.twist_to(pose))
    kept = update_points(step, uv, seen, inliers, monitored, pose)
    kept = with_located(kept, step, uv, seen, waiting & ~monitored & rejection.at_rest(uv), pose)
    new_state, output = conclude(step, FrameEstimate(refined, matches, matched, kept, outcome, rejection))
    if plan.pose_steps > DEFAULT_PLAN.pose_steps:
        # Not always: one more use of the coarse pose's status has XLA round the pose itself in another way.
        output = output._replace(pose_status=worse_status(coarse_status, refined.status))
    return new_state, output


def _check(state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan) -> TrackState:
    """Check that the arguments fit each other, and return the shapes and types of such a state."""
    check_step(state, frame, params, plan)
    image = jax.typeof(frame.image)
    expected = state_shapes(*image.shape, plan._replace(cues=()), image.dtype, jax.typeof(state.twist).dtype)
    check_state(state, expected)
    return expected


def _check_followed(
    state: TrackState, frame: FrameArrays, followed_points: FlowResult, params: TrackParams, plan: TrackPlan
) -> None:
    """Check that the arguments of `track_followed` fit each other."""
    expected = _check(state, frame, params, plan)
    check_cues(state, frame, params, plan)
    points = expected.points
    check_followed(followed_points, FlowResult(expected.pyramid, expected.T_world_cam, points.uv, points.valid))
    if followed_points.prior is not None:
        check_prior(followed_points.prior, jax.typeof(state.twist).dtype)


def _in_jax(frame: FrameArrays) -> FrameArrays:
    """Return the frame with arrays of JAX; those of NumPy come where nothing is traced."""
    return jax.tree.map(jnp.asarray, frame)


def _for_readout(params: TrackParams, frame: FrameArrays) -> TrackParams:
    """Return the settings with the direction in which the frame's rolling shutter reads the rows."""
    return params._replace(sensor=params.sensor.for_readout(frame.readout_sign))


def _prepared(
    state: TrackState, frame: FrameArrays, pyramid: Pyramid, params: TrackParams, plan: TrackPlan
) -> StepContext:
    """Prepare the frame: depth that can be believed, and the right image of a stereo pair."""
    view = PreparedFrame(frame, pyramid, state.elapsed_s + frame.dt_s)
    return StepContext(state, view.with_right(), params, plan)


def _tracked_rays(step: StepContext, uv: Pixels, found: Mask, predicted: SE3) -> PixelRays:
    """Make the rays of the tracked points, with their depths of a stereo pair if the frame is one."""
    state, view, sensor = step.state, step.view, step.params.sensor
    X_world = state.points.X_world
    matched = match_depth(view, uv, to_camera(predicted, X_world)[2], found, sensor, plan=step.plan.pair_flow)
    return pixel_rays(uv, sensor, matched)


def _object_ids(step: StepContext, uv: Pixels) -> Int[Array, " n"]:
    """Return the `(n,)` number of the movable object at each pixel; 0 for none, or without motion estimates."""
    if step.plan.motion is None:
        return jnp.zeros(uv.shape[1], jnp.int32)
    assert step.view.frame.movable is not None
    return object_numbers(labels_at(step.view.frame.movable, uv))


def _background(step: StepContext, found: Mask, objects: Int[Array, " n"]) -> Mask:
    """Return the `(n,)` mask of the points for the coarse pose: those on no movable object.

    Where objects cover nearly everything, points on objects that were at rest in the last frame count as well.
    """
    memory = step.state.motion
    outside = found & (objects == 0)
    if not memory.at_rest.shape[0]:
        return outside
    before = memory.of_point
    at_rest = found & (before > 0) & memory.at_rest[jnp.maximum(before - 1, 0)]
    few = jnp.sum(outside, dtype=step.state.twist.dtype) < step.params.weak_inliers
    return outside | (few & at_rest)


def _widened(params: TrackParams, before: Pixels, after: Pixels, background: Mask) -> TrackParams:
    """Widen the thresholds on reprojection errors by the motion in the image.

    They are scales of robust losses too, and so have a derivative.
    """
    squared = jnp.sum(jnp.square(after - before), axis=0)
    length = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
    extra = params.error_per_flow * masked_median(length, background)
    return params._replace(ransac_px=params.ransac_px + extra, outlier_px=params.outlier_px + extra)


def _regions(step: StepContext, seen: Measurements, predicted: SE3) -> Regions | None:
    """Segment the depth image into surfaces, if the plan asks for them.

    Without depth, points are where the map has them.
    """
    state, plan, sensor = step.state, step.plan, step.params.sensor
    if plan.regions is None:
        return None
    key = jax.random.fold_in(state.random_key(), -1 - state.frame)
    ideal = without_distortion(sensor.intrinsics)
    X_cam = jnp.where(step.has_depth(), seen.in_camera(), to_camera(predicted, state.points.X_world))
    limits_m = sensor.min_depth_m, sensor.max_depth_m
    depth, before = step.view.frame.depth, state.regions.centers
    return find_regions(key, depth, before, X_cam, ideal, plan.regions, limits_m=limits_m)


def _votes(step: StepContext, trust: Weights, background: Mask, regions: Regions | None) -> Weights:
    """Return the `(n,)` weights of the points in RANSAC."""
    votes = jnp.where(background, trust, 0)
    return votes if regions is None or not step.plan.balance_regions else balance_regions(votes, regions)
