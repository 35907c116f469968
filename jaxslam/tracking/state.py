"""The tracker's settings, its state between frames, and its output for a frame, as pytrees of fixed capacity."""

import enum
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.counter_random import COUNTER_RANDOM
from jaxslam_kernels.flow.disparity import ROW_PLAN
from jaxslam_kernels.flow.lk_flow import FlowPlan, LevelPlan
from jaxslam_kernels.image.pyramid import Pyramid
from jaxslam_kernels.types import Code, Flag, Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from jaxslam.config.schema import TrackConfig
from jaxslam.dynamics.cue import Cue, CueResult
from jaxslam.dynamics.object_motion import MotionMemory, MotionParams, MotionPlan, MotionState
from jaxslam.dynamics.regions import RegionMemory, RegionPlan, Regions
from jaxslam.sensors.sensor_model import SensorModel
from jaxslam.tracking.motion_prediction import VelocityStatistics
from jaxslam.tracking.points import KeyframeMatches, KeyframeRing, TrackedPoints


class TrackStatus(enum.IntEnum):
    """Quality of the pose of a frame."""

    OK = 0
    WEAK = 1
    """Few points agree with the pose, or they agree badly: its covariance is large."""
    LOST = 2
    """No pose was found; the pose of the last tracked frame is repeated."""
    STARTED = 3
    """Tracking starts in this frame, or restarts in a new submap at the pose held while lost."""
    REJECTED = 4
    """The frame could not be read or is invalid; the tracker did not process it."""
    RELOCALIZED = 5
    """After a loss, the frame was localized in the map; `FrameResult.submap` names the submap."""
    DROPPED = 6
    """In a real-time run, the next frame arrived before the tracker was ready for this one."""


class KeyframeReason(enum.IntEnum):
    """Why a frame became a keyframe: the first reason that applies."""

    NONE = 0
    """The frame is not a keyframe."""
    STARTED = 1
    """Tracking starts in this frame."""
    NEW_AREA = 2
    """No keyframe that the tracker holds shows enough of the view, and few of the map do."""
    FEW_FOLLOWED = 3
    """Few of the tracked points were tracked at the last keyframe, and what the frame shows is hardly in the map."""
    WEAK = 4
    """Tracking is weak, and few keyframes show the view from which it could get points."""
    FEW_POINTS = 5
    """Few points are still tracked."""
    CHANGED = 6
    """Many points of the map are gone: something was moved."""


class TrackPhase(enum.IntEnum):
    """What the tracker does with the next frame."""

    START = 0
    """It starts there, at the pose of the state."""
    TRACK = 1
    """It tracks the points of the last good frame."""
    LOST = 2
    """It tracks them too, and starts anew once more than `TrackParams.restart_after` frames are lost."""


class TrackReason(enum.IntEnum):
    """Why a status is not `OK`."""

    NONE = 0
    NO_POINTS = 1
    FEW_INLIERS = 2
    FEW_SHARE = 3
    IMPLAUSIBLE_MOTION = 4
    NO_DEPTH = 5
    BAD_TIME = 6
    NO_CORNERS = 7
    PLACE_NOT_IN_MAP = 8
    MASKED = 9
    UNCONFIRMED = 10
    GETTING_READY = 11

    @property
    def text(self) -> str:
        """The reason in words."""
        return _REASON_TEXT[self]


_REASON_TEXT = {
    TrackReason.NONE: "",
    TrackReason.NO_POINTS: "too few points could be followed into the frame (dark, blurred, covered or too far away)",
    TrackReason.FEW_INLIERS: "too few points agree on one motion",
    TrackReason.FEW_SHARE: "only a small share of the points agrees on one motion",
    TrackReason.IMPLAUSIBLE_MOTION: "the motion found is faster than the limit",
    TrackReason.NO_DEPTH: "too few of the corners in the image have depth to start from",
    TrackReason.BAD_TIME: "the time since the last frame is not positive",
    TrackReason.NO_CORNERS: "too few corners were found in the image to start from"
    " (dark, blurred, covered, all to be ignored, or gray values not from 0 to 255)",
    TrackReason.PLACE_NOT_IN_MAP: "the place was not recognized: it is not in the map",
    TrackReason.MASKED: "nearly all of the image is masked",
    TrackReason.UNCONFIRMED: "the background, which has no depth, does not move as the pose says",
    TrackReason.GETTING_READY: "getting ready to relocalize: the programs for it are still being compiled",
}


def code(value: enum.IntEnum) -> Code:
    """Return a member of an enumeration as an array."""
    return jnp.full((), value, jnp.int32)


_SETTINGS = TrackConfig()  # defaults are defined there only


class TrackPlan(NamedTuple):
    """Sizes of all arrays and search settings: static, so each combination is compiled once.

    Attributes:
        num_points: Number of points tracked from frame to frame.
        num_levels: Number of levels of the image pyramid.
        num_keyframes: Number of latest keyframes that are kept to match their points again.
        num_reloaded: Number of further keyframes, loaded from the map by `load_keyframe`.
        num_sources: Number of keyframes whose points are matched in a frame; 0 to track by optical flow only.
        points_per_source: Number of points matched from each of these keyframes.
        num_hypotheses: Number of RANSAC pose hypotheses per frame.
        cell_px: Side of the cells that each get at most one new corner, pixels, even.
        new_points: Frames in which new points are detected: `always` for every frame with too few points, or
            `keyframes` for keyframes only.
        flow: Settings of the optical flow from frame to frame. `Slam` searches all points of stereo pairs from the
            coarsest level, and lets their brightness count.
        look_up: Settings of the alignment of keyframe points. A window of 21 takes 1 ms more per frame and is not more
            accurate; 17, 15 and 13 are alike: TUM `fr1_rpy` 10.2, 10.2, 10.2 mm, Bonn `crowd` (start) 9.7, 9.6, 9.5.
        cues: Functions that find dynamic points (`dynamics.cue.Cue`), in the order of `TrackParams.cues`.
        regions: Segmentation of the depth image for cues that classify whole surfaces; `None` if no cue needs it.
        balance_regions: Whether the votes of points are weighted so that no region has more than an even share.
        motion: Settings of the motion estimates of movable objects (`FrameArrays.movable`); `None` without estimates.
        judge_masked: Whether points at ignored pixels are classified by the cues instead of being left out.
        keyframe_policy: Whether a keyframe is made as soon as there is a reason (`as_needed`), or only when it adds
            information (`sparing`).
        pose_steps: Largest number of cost evaluations in each refinement of the pose; `TrackOutput.pose_status` tells
            whether it was reached.
        pose_tolerance: Length of the step with which a refinement of the pose ends, in standard deviations of the pose;
            `None` for what the floating-point type resolves.
        pair_flow: Settings of the matching along the rows of a stereo pair.
    """

    num_points: int = _SETTINGS.num_points
    num_levels: int = _SETTINGS.num_levels
    num_keyframes: int = _SETTINGS.num_keyframes
    num_reloaded: int = _SETTINGS.num_reloaded
    num_sources: int = _SETTINGS.num_sources
    points_per_source: int = _SETTINGS.points_per_source
    num_hypotheses: int = _SETTINGS.num_hypotheses
    cell_px: int = _SETTINGS.cell_px
    new_points: Literal["always", "keyframes"] = _SETTINGS.new_points
    flow: FlowPlan = FlowPlan(seeds=64)
    look_up: LevelPlan = LevelPlan(15, 8, 0.05)
    cues: tuple[Cue, ...] = ()
    regions: RegionPlan | None = None
    balance_regions: bool = False
    motion: MotionPlan | None = None
    judge_masked: bool = False
    keyframe_policy: Literal["as_needed", "sparing"] = _SETTINGS.keyframe_policy
    pose_steps: int = 25
    pose_tolerance: float | None = 0.03
    pair_flow: FlowPlan = ROW_PLAN

    def exact(self) -> "TrackPlan":
        """Return the plan with searches and solvers that run to convergence, for exact derivatives.

        State, parameters and frames must be float64: float32 cannot resolve the tolerances of these searches, and
        `track_step` rejects it.

        A search that stops at a few hundredths of a pixel, which is enough for tracking, gives a result that still
        depends on its start. Derivatives are those of the exact solution: over ten frames of a small image they differ
        from finite differences of the tracker by 0.2 to 1 % for the camera and the map points and by up to 10 % for
        weights; with this plan, by 1e-5. Points whose search never converges are dropped here. A pose whose refinement
        has still not converged has the `TrackOutput.pose_status` NOT_CONVERGED, and no exact derivative.
        """
        to_the_end = lambda level: LevelPlan(level.window, 100, 1e-10, 1e-8)
        return self._replace(
            flow=self.flow._replace(finest=to_the_end(self.flow.finest), seeds=0),
            look_up=to_the_end(self.look_up),
            pose_steps=1000,
            pose_tolerance=None,
            pair_flow=self.pair_flow._replace(finest=to_the_end(self.pair_flow.finest)),
        )


class TrackParams(NamedTuple):
    """Settings that can change, or be differentiated, without recompiling; scalars unless said otherwise.

    Attributes:
        sensor: Camera model with its depth noise.
        pixel_sigma: Standard deviation of the position of a tracked point, pixels.
        loss_scale: Scale of the Cauchy loss, in standard deviations.
        ransac_px: Largest reprojection error of an inlier of a pose hypothesis with a static camera, pixels.
        outlier_px: Reprojection error above which a point is dropped with a static camera, pixels.
        error_per_flow: Growth of `ransac_px` and `outlier_px` per pixel of median image motion: motion blur and the
            residual rolling-shutter error grow with it. A large constant threshold would accept points on people in a
            calm scene.
        min_correlation: Smallest correlation of an accepted match with a keyframe.
        min_inliers: Smallest number of inliers of a pose.
        weak_inliers: Number of points that agree with the pose, those of keyframes included, below which the status is
            `WEAK`; the smallest number of inliers after a lost frame.
        min_share: Smallest share of the tracked points that are inliers of the pose.
        detect_below: Share of the capacity below which new points are detected.
        keyframe_below: Share of a keyframe's points in view from which on it shows the view. A keyframe is made if none
            does that the tracker holds (`NEW_AREA`), unless `keyframe_views` keyframes of the map do.
        keyframe_followed_below: Share of the tracked points. A keyframe is made if fewer of them were tracked at the
            last keyframe (`FEW_FOLLOWED`), unless tracking is weak, `keyframe_views` keyframes show the view, or many
            of their points are found.
        keyframe_views: Number of keyframes that show a view from which on another one is no news; four times as many
            where hardly a point of them is found.
        map_views: Number of keyframes of a map that show the view. Those that the state itself holds are counted by the
            tracker: this is for maps with more, and 0 without one.
        map_changed: 1 if many points of a map are gone, and no keyframe was made since (`CHANGED`), else 0.
        keyframe_points_below: Share of the capacity. A keyframe is made if fewer points are still tracked
            (`FEW_POINTS`); right after a keyframe, half this share.
        keyframe_weak_after_s: Time after which the next keyframe is made while tracking has few points, or is weak
            (`WEAK`) and fewer than `keyframe_views` keyframes show the view, seconds.
        keyframe_min_s: Shortest time between keyframes with the `sparing` policy, seconds.
        keyframe_motion: Smallest motion of the points between keyframes with the `sparing` policy, in the camera frame,
            as a share of their depth.
        keyframe_movable_below: Share of movable pixels above which a keyframe is postponed with the `sparing` policy.
        keyframe_patience_s: Longest time for which such a keyframe is postponed, seconds.
        probation_frames: Number of frames after which a point has full weight. A point on a moving object becomes an
            outlier within a few frames, so it never has much weight.
        anchor_frames: Number of frames after which the anchor position of a point is renewed, for cues to slow motion.
        restart_after: Number of lost frames after which tracking restarts at the held pose; infinity for never.
        max_speed_m_per_s: Largest plausible speed of the camera.
        max_turn_rad_per_s: Largest plausible angular speed of the camera.
        cues: Parameters of each of `TrackPlan.cues`.
        motion: Parameters of `TrackPlan.motion`; `None` without motion estimates.
    """

    sensor: SensorModel
    pixel_sigma: Scalar
    loss_scale: Scalar
    ransac_px: Scalar
    outlier_px: Scalar
    error_per_flow: Scalar
    min_correlation: Scalar
    min_inliers: Scalar
    weak_inliers: Scalar
    min_share: Scalar
    detect_below: Scalar
    keyframe_below: Scalar
    keyframe_followed_below: Scalar
    keyframe_views: Scalar
    map_views: Scalar
    map_changed: Scalar
    keyframe_points_below: Scalar
    keyframe_weak_after_s: Scalar
    keyframe_min_s: Scalar
    keyframe_motion: Scalar
    keyframe_movable_below: Scalar
    keyframe_patience_s: Scalar
    probation_frames: Scalar
    anchor_frames: Scalar
    restart_after: Scalar
    max_speed_m_per_s: Scalar
    max_turn_rad_per_s: Scalar
    cues: tuple[Any, ...] = ()
    motion: MotionParams | None = None


class TrackState(NamedTuple):
    """State of the tracker after a frame: a pytree whose leaves are all plain arrays.

    A state can be saved with `numpy.savez(path, *jax.tree.leaves(state))`, with `pickle`, or with
    `equinox.tree_serialize_leaves`. To restore one from its leaves, take the structure of a state that `init_state`
    makes for the same plan and size of image, `jax.tree.unflatten(jax.tree.structure(blank), leaves)`. Tracking then
    continues with the same bytes.

    Attributes:
        pyramid: Image pyramid of the last good frame.
        points: Tracked points in the last good frame.
        keyframes: Keyframes whose points are matched again.
        T_world_cam: Pose of the camera.
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        velocity: Statistics of the velocity, which tell for how long it can be believed.
        elapsed_s: Time since the last good frame, seconds.
        since_keyframe_s: Time since the last keyframe, seconds.
        since_keyframe: Number of good frames since the last keyframe.
        phase: A `TrackPhase`.
        lost_frames: Number of frames since tracking was lost; 0 while it is not lost.
        frame: Number of frames processed.
        next_id: Id of the next new point.
        key: Data of the random key from which every random choice is derived (`random_key`).
        regions: Memory of the regions of the last frame (`TrackPlan.regions`).
        motion: Memory of the movable objects of the last frame (`TrackPlan.motion`).
    """

    pyramid: Pyramid
    points: TrackedPoints
    keyframes: KeyframeRing
    T_world_cam: SE3
    twist: Float[Array, "6"]
    velocity: VelocityStatistics
    elapsed_s: Scalar
    since_keyframe_s: Scalar
    since_keyframe: Code
    phase: Code
    lost_frames: Code
    frame: Code
    next_id: Code
    key: UInt32[Array, " words"]
    regions: RegionMemory
    motion: MotionMemory

    def random_key(self) -> Key[Array, ""]:
        """Return the typed random key with the data in `key`; JAX's typed keys cannot be saved as arrays."""
        return jax.random.wrap_key_data(self.key, impl=COUNTER_RANDOM)


class TrackOutput(NamedTuple):
    """Output of the tracker for one frame.

    Attributes:
        T_world_cam: Pose of the camera; if `status` is `LOST`, the pose of the last tracked frame.
        covariance: `(6, 6)` covariance of the pose in the tangent space at the camera, translation first: that of the
            fit to this frame, for the assumed errors of pixels and depth, as if the points were exact.
        status: A `TrackStatus`.
        reason: A `TrackReason`.
        num_inliers: Number of tracked points that agree with the pose.
        inlier_ratio: Share of inliers among the points found by optical flow.
        num_keyframe_matches: Number of keyframe points matched in the frame that agree with the pose.
        residual_px: Robust standard deviation of the reprojection errors of the inliers, pixels.
        uv: `(2, n)` positions of the points in this frame, new ones included, pixels.
        weights: `(n,)` final weights of the points, 0 to 1: 0 for an outlier, the given weight for a new point.
        tracked: `(n,)` mask of the points that were tracked from the previous frame.
        X_world: `(3, n)` positions of the points in the world, meters.
        id: `(n,)` ids of the points.
        keyframe_matches: Keyframe points matched in the frame.
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        keyframe: A `KeyframeReason`.
        pose_status: A `PoseStatus` of the refinement of the pose in this frame, even if the pose was rejected and the
            frame is lost. `NOT_CONVERGED` means that it ran out of `TrackPlan.pose_steps`: the pose is then near the
            optimum, and its derivatives are not exact. With more steps than by default, as in `TrackPlan.exact()`, it
            is also `NOT_CONVERGED` if the initial coarse pose is.
        cue_results: Result of each of `TrackPlan.cues` for the tracked points.
        regions: Regions to which the cue results refer; `None` without regions.
        moving: `(h, w)` mask of the moving regions and objects; `None` without either.
        motion: Motion estimates of the movable objects; `None` without `TrackPlan.motion`.
    """

    T_world_cam: SE3
    covariance: Float[Array, "6 6"]
    status: Code
    reason: Code
    num_inliers: Code
    inlier_ratio: Scalar
    num_keyframe_matches: Code
    residual_px: Scalar
    uv: Pixels
    weights: Weights
    tracked: Mask
    X_world: Points
    id: Int[Array, " n"]
    keyframe_matches: KeyframeMatches
    twist: Float[Array, "6"]
    keyframe: Code
    pose_status: Code
    cue_results: tuple[CueResult, ...] = ()
    regions: Regions | None = None
    moving: Bool[Array, "h w"] | None = None
    motion: MotionState | None = None

    @property
    def is_keyframe(self) -> Flag:
        """Whether the frame is a keyframe."""
        return self.keyframe > 0
