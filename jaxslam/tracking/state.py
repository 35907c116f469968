"""Everything the tracker carries from frame to frame, as pytrees of fixed capacity, and what it says of a frame."""

import enum
from typing import Any, Literal, NamedTuple

import jax
from jaxlie import SE3
from jaxslam_kernels.flow.disparity import ROW_PLAN
from jaxslam_kernels.flow.lk_flow import FlowPlan, LevelPlan
from jaxslam_kernels.image.pyramid import Pyramid
from jaxslam_kernels.types import Code, Flag, Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Int, Key, Num, UInt32

from jaxslam.config.schema import TrackConfig
from jaxslam.dynamics.cue import Cue, CueResult
from jaxslam.dynamics.object_motion import MotionMemory, MotionParams, MotionPlan, MotionState
from jaxslam.dynamics.regions import RegionMemory, RegionPlan, Regions
from jaxslam.sensors.sensor_model import SensorModel


class TrackStatus(enum.IntEnum):
    """What a pose is worth."""

    OK = 0
    WEAK = 1
    """Few points agree, or they agree badly: the pose is an estimate, its covariance is wide."""
    LOST = 2
    """No pose was found; the one given is the last one, held."""
    STARTED = 3
    """Tracking begins here, or begins anew in a new submap, at the pose held while lost."""
    REJECTED = 4
    """The frame could not be read or does not fit; it never reached the tracker."""
    RELOCALIZED = 5
    """After a loss, tracking goes on where the map shows this place, in the submap that `Tracked.submap` names."""
    DROPPED = 6
    """In a run in real time: the next frame was there before the tracker had time for this one."""


class KeyframeReason(enum.IntEnum):
    """Why a frame was kept, the first that applies."""

    NONE = 0
    """It was not kept."""
    STARTED = 1
    """Tracking begins here."""
    NEW_AREA = 2
    """No kept keyframe shows much of what it shows."""
    FEW_FOLLOWED = 3
    """Few of the points followed were there at the last keyframe."""
    WEAK = 4
    """Tracking is weak here: more points are wanted."""
    TIME = 5
    """The last one was long ago."""
    FEW_POINTS = 6
    """Few points are left to follow."""


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

    @property
    def text(self) -> str:
        """One line for a person."""
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
}


_SETTINGS = TrackConfig()  # the only place of defaults


class TrackPlan(NamedTuple):
    """Sizes of all arrays and how searches run; static: each combination is compiled once.

    Attributes:
        num_points: Points followed from frame to frame.
        num_levels: Levels of the image pyramid.
        num_keyframes: Latest keyframes kept to look points up in again.
        num_reloaded: Further keyframes to look into, put there from a map by `reloaded`.
        num_sources: How many of them are looked into in a frame; 0 for following alone.
        points_per_source: Points looked up from each.
        num_hypotheses: Pose hypotheses a frame.
        cell_px: Side of the cells that each get at most one new corner, even.
        new_points: In which frames new points are sought: `always`, where there are few, or in `keyframes` only.
        flow: How points are followed from frame to frame.
        cues: What tells points that move, see `dynamics.cue.Cue`; functions, in the order of `TrackParams.cues`.
        regions: How the depth image is divided for cues that judge whole surfaces; `None` if none does.
        balance_regions: Whether no region has more of a say in the pose than an even share.
        motion: How things that may move are judged, see `FrameArrays.movable`; `None` if they are not.
        keyframe_policy: Whether a keyframe is made as soon as there is a reason, or at the right moment after.
        look_up: How points of keyframes are searched. A window of 21 takes 1 ms a frame more and is no more accurate;
            17, 15 and 13 are alike too: TUM `fr1_rpy` 10.2, 10.2, 10.2 mm, Bonn `crowd` (start) 9.7, 9.6, 9.5.
        pose_steps: Bound on the evaluations of the cost in each refinement of the pose; `TrackOutput.pose_status`
            says where it was reached.
        pair_flow: How points of a stereo pair are matched along the rows of its images.
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
    flow: FlowPlan = FlowPlan()
    look_up: LevelPlan = LevelPlan(15, 8, 0.05)
    cues: tuple[Cue, ...] = ()
    regions: RegionPlan | None = None
    balance_regions: bool = False
    motion: MotionPlan | None = None
    keyframe_policy: Literal["as_needed", "sparing"] = _SETTINGS.keyframe_policy
    pose_steps: int = 25
    pair_flow: FlowPlan = ROW_PLAN

    def exact(self) -> "TrackPlan":
        """The same with searches and solvers that go on until nothing moves, for derivatives that must be exact.

        State, parameters and frames must be float64: float32 cannot hold what these searches stop at, and `track_step`
        refuses it.

        A search that stops at a few hundredths of a pixel, as is enough to track with, leaves a result that still
        depends on where it started. Derivatives are those of the solution itself: over ten frames of a small picture
        they differ from finite differences of the tracker by 0.2 to 1 % for the camera and the map points, by up to
        10 % for weights; with this plan by 1e-5. Points whose search never settles are dropped here. A pose whose
        refinement has not converged all the same has the `TrackOutput.pose_status` NOT_CONVERGED, and no exact
        derivative.
        """
        to_the_end = lambda level: LevelPlan(level.window, 100, 1e-10, 1e-8)
        return self._replace(
            flow=self.flow._replace(finest=to_the_end(self.flow.finest)),
            look_up=to_the_end(self.look_up),
            pose_steps=1000,
            pair_flow=self.pair_flow._replace(finest=to_the_end(self.pair_flow.finest)),
        )


class TrackParams(NamedTuple):
    """Everything that can change, or be differentiated, without recompiling; scalars unless said otherwise.

    Attributes:
        sensor: Camera with its depth noise.
        pixel_sigma: Standard deviation of a tracked point, pixels.
        loss_scale: Scale of the Cauchy loss, in standard deviations.
        ransac_px: Reprojection error up to which a point supports a pose hypothesis while nothing moves, pixels.
        outlier_px: Reprojection error over which a point is dropped while nothing moves, pixels.
        error_per_flow: Growth of both with the median motion in the image, pixels a pixel: blur and what is left of
            the rolling shutter grow with it, and so would a threshold that lets people pass in a calm picture.
        min_correlation: Correlation from which a point looked up in a keyframe is believed.
        min_inliers: Fewest points that make a pose.
        weak_inliers: Below this the status is `WEAK`.
        min_share: Smallest share of the followed points that must agree on the pose.
        detect_below: New points are sought when fewer than this share of the capacity is alive.
        keyframe_below: A keyframe is made when no kept one shows more than this share of its points (`NEW_AREA`),
        keyframe_followed_below: when less than this share of the followed points was there at the last keyframe
            (`FEW_FOLLOWED`),
        keyframe_points_below: when less than this share of the capacity is still followed (`FEW_POINTS`), half of it
            if the last one was made just now,
        keyframe_after_s: or when the last one was made this many seconds ago (`TIME`),
        keyframe_weak_after_s: or this many while tracking is weak (`WEAK`) or has few points.
        keyframe_min_s: With a sparing choice, not before this many seconds have gone since the last one,
        keyframe_motion: nor before points have moved by this part of their depth in the axes of the camera,
        keyframe_movable_below: nor while more than this share of the picture may move,
        keyframe_patience_s: for so many seconds more.
        probation_frames: Frames after which a point counts in full. What moves on its own is an outlier within a few
            frames, so that it never counts for much.
        anchor_frames: Frames after which the place of a point counts as where it was, for cues to slow motion.
        restart_after: Frames of loss after which tracking starts anew at the held pose.
        max_speed_m_per_s: Highest believed speed of the camera.
        max_turn_rad_per_s: Highest believed angular speed of the camera.
        cues: Parameters of each of `TrackPlan.cues`.
        motion: Parameters of `TrackPlan.motion`; `None` without.
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
    keyframe_points_below: Scalar
    keyframe_after_s: Scalar
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


class TrackedPoints(NamedTuple):
    """Points followed from frame to frame; slots that are not `valid` are free.

    Attributes:
        uv: `(2, n)` where they are in the last good frame, pixels.
        xy: `(2, n)` the same as an ideal camera sees it, normalized coordinates.
        depth: `(n,)` measured there, meters, 0 where nothing was.
        X_world: `(3, n)` where they are in the world, meters, as measured over the last few frames.
        X_anchor: `(3, n)` the same as measured `anchor_age` frames ago: what moves slowly leaves it.
        information: `(n,)` inverse variance of their depth, 1 / m^2.
        weight: `(n,)` how much each counts, 0 to 1; the caller may change it between steps.
        age: `(n,)` frames each has survived.
        anchor_age: `(n,)` frames since `X_anchor` was measured.
        id: `(n,)` number of each point, given once and never again.
        valid: `(n,)` which slots hold a point.
    """

    uv: Pixels
    xy: Pixels
    depth: Weights
    X_world: Points
    X_anchor: Points
    information: Weights
    weight: Weights
    age: Int[Array, " n"]
    anchor_age: Int[Array, " n"]
    id: Int[Array, " n"]
    valid: Mask


class KeyframeRing(NamedTuple):
    """Past frames with the points seen in them, to look up again: a ring of the latest, then those reloaded.

    Attributes:
        images: `(k, h, w)` pictures, of the type of the frames.
        T_world_cam: `(k, 7)` poses as `wxyz_xyz`.
        uv: `(k, 2, n)` the points in them, pixels.
        X_world: `(k, 3, n)` the points in the world, meters.
        weight: `(k, n)` how much each counted when the keyframe was made; 0 for a slot without a point.
        id: `(k, n)` number of each point.
        made: Keyframes made so far; the next one goes to slot `made` modulo the size of the ring.
    """

    images: Num[Array, "k h w"]
    T_world_cam: Float[Array, "k 7"]
    uv: Float[Array, "k 2 n"]
    X_world: Float[Array, "k 3 n"]
    weight: Float[Array, "k n"]
    id: Int[Array, "k n"]
    made: Code


class KeyframeMatches(NamedTuple):
    """Points of keyframes found in a frame.

    Attributes:
        X_world: `(3, n)` meters.
        uv: `(2, n)` pixels in the frame.
        weight: `(n,)` how much each counts; 0 for what was not found.
        id: `(n,)` number of each point.
        overlap: Largest share of a keyframe's points that the frame shows.
    """

    X_world: Points
    uv: Pixels
    weight: Weights
    id: Int[Array, " n"]
    overlap: Scalar


class TrackState(NamedTuple):
    """What the tracker knows after a frame: a pytree whose leaves are all plain arrays.

    A state can be saved with `numpy.savez(path, *jax.tree.leaves(state))`, with `pickle`, or with
    `equinox.tree_serialize_leaves`. To restore one from its leaves, take the structure of a state that `init_state`
    makes for the same plan and size of image, `jax.tree.unflatten(jax.tree.structure(blank), leaves)`. Tracking goes on
    from it with the same bytes.

    Attributes:
        pyramid: Of the last good frame.
        points: Followed points, as in the last good frame.
        keyframes: Past frames to look points up in.
        T_world_cam: Pose of the camera.
        twist: Velocity of the camera in its own axes, meters a second then radians a second.
        elapsed_s: Seconds since the last good frame.
        since_keyframe_s: Seconds since the last keyframe.
        since_keyframe: Good frames since the last keyframe.
        lost_frames: Frames since tracking was lost, 0 while it is not.
        frame: Frames seen.
        next_id: Number of the next new point.
        key: Data of the random key that every random choice is derived from, see `random_key`.
        regions: What is kept of the regions of the last frame, see `TrackPlan.regions`.
        motion: What is kept of the things in it that may move, see `TrackPlan.motion`.
    """

    pyramid: Pyramid
    points: TrackedPoints
    keyframes: KeyframeRing
    T_world_cam: SE3
    twist: Float[Array, "6"]
    elapsed_s: Scalar
    since_keyframe_s: Scalar
    since_keyframe: Code
    lost_frames: Code
    frame: Code
    next_id: Code
    key: UInt32[Array, " words"]
    regions: RegionMemory
    motion: MotionMemory

    def random_key(self) -> Key[Array, ""]:
        """The typed random key that `key` holds the data of; JAX's own typed keys cannot be saved as arrays."""
        return jax.random.wrap_key_data(self.key)


class TrackOutput(NamedTuple):
    """What the tracker says of one frame.

    Attributes:
        T_world_cam: Pose of the camera; meaningful when `status` is not `LOST`, then it is the last one.
        covariance: `(6, 6)` of the pose, in the tangent space at the camera, translation first.
        status: A `TrackStatus`.
        reason: A `TrackReason`.
        num_inliers: Followed points that agree with the pose.
        inlier_ratio: Their share of the points that could be followed.
        num_keyframe_matches: Points found again in keyframes.
        residual_px: Robust standard deviation of the reprojection error of the inliers, pixels.
        uv: `(2, n)` pixels of the points in this frame, new ones included.
        weights: `(n,)` final weight of each, 0 to 1; 0 for what is no inlier, 1 times the given weight for a new point.
        tracked: `(n,)` which of the points came from the frame before.
        X_world: `(3, n)` where the points are in the world, meters.
        id: `(n,)` number of each point.
        keyframe_matches: Points of keyframes found in the frame.
        twist: Velocity of the camera in its own axes, meters a second then radians a second.
        keyframe: A `KeyframeReason`.
        pose_status: A `PoseStatus` of the refinement of the pose in this frame, also of one that was not taken because
            the frame is lost. `NOT_CONVERGED` means that it ran out of `TrackPlan.pose_steps`: the pose is then near
            the optimum, and its derivatives are not exact. With more steps than by default, as in
            `TrackPlan.exact()`, it is `NOT_CONVERGED` too where the coarse pose that it began with is.
        verdicts: What each of `TrackPlan.cues` says of the points that were followed,
        regions: and the regions they speak of.
        moving: `(h, w)` true in regions and things that move; `None` without either.
        motion: What is known of the things that may move; `None` without `TrackPlan.motion`.
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
        """Whether the frame was kept."""
        return self.keyframe > 0
