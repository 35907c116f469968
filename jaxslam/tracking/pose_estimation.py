"""The pose of a frame: the one that most points vote for, then the one that fits best those that agree with it."""

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.camera import to_pixels, without_distortion
from jaxslam_kernels.pose.pnp import ransac_pnp
from jaxslam_kernels.pose.pose_cost import PosePrior
from jaxslam_kernels.pose.pose_refine import PoseRefinement, PoseStatus, refine_pose
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import Code, Mask, Pixels, Points, Weights
from jaxtyping import Array, Float

from jaxslam.sensors.measurement import Measurements, match_depth, pixel_rays
from jaxslam.tracking.points import KeyframeMatches
from jaxslam.tracking.state import TrackParams
from jaxslam.tracking.step_context import StepContext

_NEAR_SIGMAS, _DEPTH_SIGMAS = 20.0, 3.0
"""Error of depth up to which it supports a pose hypothesis, in standard deviations of depth close to the camera (10 cm
by default), and with even votes or of a pair in its own standard deviations.

With even votes points vote by the latter, and of those that agree the ones within both count for what follows. The
former in the vote too: Bonn `crowd` loses a frame in two of five runs, and a frame of noise moves what follows by 7 mm
instead of 6. The latter alone: a rendered room with people who sit has 4.1 mm instead of 2.4; the former in the vote
alone, or as a weight of zero for points that are kept: 4.1 too. The larger of 0.1 m and one deviation for all: `static`
has 36 mm instead of 16 in the room xyz.
"""

_COARSER = 10.0
"""How much longer the last step to the coarse pose may be than that to the refined one, which begins there: the median
of its steps on fr1_rpy is 3 instead of 5."""


def coarse_pose(
    step: StepContext, seen: Measurements, votes: Weights, predicted: SE3, prior: PosePrior | None = None
) -> tuple[SE3, Mask, Code]:
    """Estimate the pose that most points agree with, by RANSAC.

    Args:
        step: Context of the step.
        seen: Measurements of the points of the state at the predicted pose.
        votes: `(n,)` weights of the points; 0 for a point that is not used.
        predicted: Predicted pose, one of the hypotheses.
        prior: Pose known beforehand, which votes too; `None` if nothing is known.

    Returns:
        The pose, the `(n,)` mask of the points that agree with it, and its `PoseStatus`.
    """
    state, view, params, plan = step
    by_noise = plan.balance_regions or view.right is not None
    near_gate_m = _NEAR_SIGMAS * params.sensor.depth_sigma_m
    expected_depth = jnp.where(seen.depth > 0, seen.depth, to_camera(predicted, state.points.X_world)[2])
    result = ransac_pnp(
        jax.random.fold_in(state.random_key(), state.frame),
        state.points.X_world,
        to_pixels(params.sensor.intrinsics, seen.xy),
        without_distortion(params.sensor.intrinsics),
        weights=votes,
        depth=seen.depth,
        threshold_px=params.ransac_px,
        threshold_depth=_DEPTH_SIGMAS * seen.sigma if by_noise else near_gate_m,
        averaged=plan.balance_regions,
        num_hypotheses=plan.num_hypotheses,
        max_steps=plan.pose_steps,
        tolerance=None if plan.pose_tolerance is None else _COARSER * plan.pose_tolerance,
        initial=predicted,
        expected_depth=expected_depth,
        # With even votes the redescending loss is narrow, and its optimum as good as that of the inliers. With a wide
        # one it is not: on the start of Bonn `crowd`, `ngd` would have 12.1 mm instead of 11.0, `rts` 9.4, not 8.5.
        on_inliers=not plan.balance_regions,
        prior=prior,
    )
    if not plan.balance_regions or view.right is not None:
        return result.T_world_cam, result.inliers, result.status
    apart_m = to_camera(result.T_world_cam, state.points.X_world)[2] - seen.depth
    near = (seen.depth <= 0) | (jnp.abs(apart_m) < near_gate_m)
    return result.T_world_cam, result.inliers & near, result.status


def refined_pose(
    step: StepContext,
    seen: Measurements,
    trust: Weights,
    matches: KeyframeMatches,
    matches_seen: Measurements,
    coarse: SE3,
    prior: PosePrior | None = None,
) -> tuple[PoseRefinement, Mask, Mask]:
    """Refine the coarse pose from tracked points and keyframe matches together.

    Args:
        step: Context of the step.
        seen: Measurements of the points of the state at the coarse pose.
        trust: `(n,)` weights of the points; 0 for a point that is not used.
        matches: Keyframe points matched with the frame.
        matches_seen: Measurements of these matches at the coarse pose.
        coarse: Coarse pose.
        prior: Pose known beforehand, one more term; `None` if nothing is known.

    Returns:
        The refinement, the `(n,)` mask of the tracked points that agree with it, and the `(m,)` mask of the matches.
    """
    params = step.params
    X_world = jnp.concatenate([step.state.points.X_world, matches.X_world], axis=1)
    seen = seen.followed_by(matches_seen)
    weights = jnp.concatenate([trust, matches.weight])
    refined = refine_pose(
        coarse,
        X_world,
        to_pixels(params.sensor.intrinsics, seen.xy),
        without_distortion(params.sensor.intrinsics),
        weights=weights,
        depth=seen.depth,
        sigma_px=params.pixel_sigma,
        sigma_depth=seen.sigma,
        loss="cauchy",
        scale=params.loss_scale,
        prior=prior,
        max_steps=step.plan.pose_steps,
        tolerance=step.plan.pose_tolerance,
    )
    close = reprojects(refined.T_world_cam, X_world, seen.xy, params)
    agreeing = (weights > 0) & close
    return refined, agreeing[: trust.shape[0]], agreeing[trust.shape[0] :]


def worse_status(coarse: Code, refined: Code) -> Code:
    """The `PoseStatus` of a refined pose, `NOT_CONVERGED` also where the coarse pose it began with is."""
    only_coarse = (refined == PoseStatus.OK) & (coarse == PoseStatus.NOT_CONVERGED)
    return jnp.where(only_coarse, coarse, refined)


def measure_matches(step: StepContext, matches: KeyframeMatches, coarse: SE3, twist: Float[Array, "6"]) -> Measurements:
    """Measure the keyframe points matched with the frame, with their depths of a stereo pair if it is one.

    Args:
        step: Context of the step.
        matches: Keyframe points matched with the frame.
        coarse: Coarse pose.
        twist: `(6,)` velocity of the camera at the coarse pose, m/s, then rad/s.
    """
    view, sensor = step.view, step.params.sensor
    expected = to_camera(coarse, matches.X_world)[2]
    depth = match_depth(view, matches.uv, expected, matches.weight > 0, sensor, plan=step.plan.pair_flow)
    return step.measured(pixel_rays(matches.uv, sensor, depth), matches.X_world, coarse, twist)


def fits(step: StepContext, seen: Measurements, pose: SE3) -> Mask:
    """Tell which points of the state a pose puts where they are seen, in the image and in depth where it is measured.

    Args:
        step: Context of the step.
        seen: Measurements of the points at the pose.
        pose: Pose of the camera.
    """
    X_world = step.state.points.X_world
    apart_m = jnp.abs(to_camera(pose, X_world)[2] - seen.depth)
    near = (seen.depth <= 0) | (apart_m < _DEPTH_SIGMAS * seen.sigma)
    return reprojects(pose, X_world, seen.xy, step.params) & near


def reprojects(T_world_cam: SE3, X_world: Points, xy: Pixels, params: TrackParams) -> Mask:
    """Tell which points are seen within the outlier threshold of where the pose puts them."""
    X_cam = to_camera(T_world_cam, X_world)
    front = X_cam[2] > params.sensor.min_depth_m / 2
    predicted = X_cam[:2] / jnp.where(front, X_cam[2], 1)[None, :]
    error = to_pixels(params.sensor.intrinsics, predicted) - to_pixels(params.sensor.intrinsics, xy)
    return front & (jnp.sum(jnp.square(error), axis=0) < jnp.square(params.outlier_px))
