"""3-D motion state: classify movable objects as moving or static; static ones are as good as background.

Source: USD-SLAM (Wang et al., RA-L 2024), section III-B: the 3-D motion of points beyond that of the camera, compared
with what static points show; an object is static while 70 % of its points are below that threshold.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.scene_flow import flow_length, group_motion, scene_flow, upper_limit
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxslam.config.cue_sections import MotionConfig
from jaxslam.dynamics.cue import threshold_evidence
from jaxslam.dynamics.regions import RegionCueResult
from jaxslam.runtime.filled_arrays import filled

Labels = UInt8[Array, "h w"]
"""Number of the movable object at each pixel, from 1; 0 where there is none. `INERT` is added to the number of an
object that does not move by itself."""
INERT = 128
"""Flag in `Labels` of an object that only moves if someone moves it, such as a chair or a bag."""


_SETTINGS = MotionConfig()  # the only place of defaults


class MotionPlan(NamedTuple):
    """Static settings of the motion state.

    Attributes:
        num_objects: Maximum number of objects in a frame; the labels of a frame are 1 to this.
        reserved: Point slots kept free for points on movable objects.
        dense_cell_px: Side of the grid cells that each get at most one new corner where movable objects cover over half
            of the image, in pixels (an even number). It gives more points from the remaining background.
        as_published: Whether to follow the paper: motion in meters from frame to frame, a threshold from mean and
            standard deviation, and an object classified by counting its points alone.
    """

    num_objects: int = _SETTINGS.num_objects
    reserved: int = _SETTINGS.reserved
    dense_cell_px: int = _SETTINGS.dense_cell_px
    as_published: bool = _SETTINGS.as_published


class MotionParams(NamedTuple):
    """Parameters of `classify_motion`; all scalars.

    Attributes:
        sigmas: A point moves if its motion exceeds that of static points by this many standard deviations.
        share: An object is static while this share of its points does not move.
        least: Mean motion of an object below which it never counts as moving, in standard deviations of a point: seated
            people breathe.
        fewest: Minimum number of points for an object to be classified.
        still_frames: Number of frames in which an object must be static before it is treated as static.
        moving_frames: Number of frames in which a static object must move before it is treated as moving again.
        temperature: Softness of an object's classification, as in `cue.threshold_evidence`.
    """

    sigmas: Scalar
    share: Scalar
    least: Scalar
    fewest: Scalar
    still_frames: Scalar
    moving_frames: Scalar
    temperature: Scalar


class MotionMemory(NamedTuple):
    """Motion state carried to the next frame; objects are re-identified by the points on them.

    Attributes:
        of_point: `(n,)` number of the object that each point is on; 0 for none.
        stillness: `(k,)` from 0 for a moving object to 1 for one that has been static for some frames.
        at_rest: `(k,)` whether each object is treated as static.
    """

    of_point: Int[Array, " n"]
    stillness: Float[Array, " k"]
    at_rest: Bool[Array, " k"]


class MotionState(NamedTuple):
    """Motion state of the movable objects in a frame; entry 0 belongs to object 1.

    Attributes:
        there: `(n,)` which points are measured in this frame.
        verdict: Classification from this frame alone, `(k,)`; its evidence is in units of the threshold.
        memory: State for the next frame.
    """

    there: Mask
    verdict: RegionCueResult
    memory: MotionMemory

    @property
    def of_point(self) -> Int[Array, " n"]:
        """`(n,)` number of the object that each point is on, from 1; 0 for none."""
        return self.memory.of_point

    @property
    def at_rest(self) -> Bool[Array, " k"]:
        """`(k,)` whether each object is treated as static."""
        return self.memory.at_rest

    def moves(self) -> Bool[Array, " k1"]:
        """Return `(k + 1,)` whether each label moves; false for label 0, the background."""
        return jnp.concatenate([jnp.zeros(1, bool), ~self.at_rest])

    def moving_pixels(self, labels: Labels) -> Bool[Array, "h w"]:
        """Return the pixels of objects that move or could not be classified; inert ones without points do not move."""
        numbers, moves = object_numbers(labels), self.moves()
        has_points = jnp.zeros_like(moves).at[jnp.where(self.there, self.of_point, 0)].set(True)
        return moves[numbers] & ((labels < INERT) | has_points[numbers])

    def joining(self) -> Mask:
        """Return `(n,)` which points are on static objects."""
        return self.there & (self.of_point > 0) & ~self.moves()[self.of_point]

    def monitored(self) -> Mask:
        """Return `(n,)` which points are on moving objects."""
        return self.there & self.moves()[self.of_point]


class MeasuredPoints(NamedTuple):
    """Points in the world and in a frame.

    Attributes:
        X_world: `(3, n)` earlier world positions, in meters.
        X_cam: `(3, n)` current positions in camera axes, in meters.
        sigma: `(3, n)` standard deviations of `X_cam`, in meters.
        there: `(n,)` which points are measured in both.
    """

    X_world: Points
    X_cam: Points
    sigma: Points
    there: Mask


def no_motion(plan: MotionPlan | None, num_points: int, dtype: jnp.dtype) -> MotionMemory:
    """Return the memory before the first frame."""
    num = 0 if plan is None else plan.num_objects
    return MotionMemory(filled(num_points, jnp.int32), filled(num, dtype), filled(num, bool))


def object_numbers(labels: Int[Array, "*shape"] | UInt8[Array, "*shape"]) -> Int[Array, "*shape"]:
    """Return the numbers of the objects in labels, without the flag `INERT`."""
    return labels.astype(jnp.int32) & (INERT - 1)


def labels_at(labels: Labels, uv: Pixels) -> Int[Array, " n"]:
    """Return `(n,)` the labels at pixels `(2, n)`; 0 outside the image."""
    column, row = jnp.round(lax.stop_gradient(uv)).astype(jnp.int32)
    there = labels.at[row, column].get(mode="fill", fill_value=0).astype(jnp.int32)
    return jnp.where((row >= 0) & (column >= 0), there, 0)  # negative indices count from the end


def inert_objects(of_point: Int[Array, " n"], num: int) -> Bool[Array, " k"]:
    """Return `(num,)` which objects do not move by themselves.

    Args:
        of_point: `(n,)` label of each point, from `labels_at`.
        num: Largest number of an object.
    """
    numbers = jnp.where(of_point >= INERT, object_numbers(of_point), 0)
    return jnp.zeros(num + 1, bool).at[numbers].set(True)[1:]


def classify_motion(
    points: MeasuredPoints,
    of_point: Int[Array, " n"],
    background: Weights,
    T_world_cam: SE3,
    before: MotionMemory,
    params: MotionParams,
    *,
    inert: Bool[Array, " k"] | None = None,
    as_published: bool = False,
) -> MotionState:
    """Classify the movable objects as moving or static, given the pose estimated from the background.

    Lengths are in standard deviations of a point's measured position, not in meters as published. Pixels are accurate
    to millimeters across the line of sight and depth to centimeters along it, so a threshold in meters wide enough for
    depth noise hides sideways motion. Also, an object whose points have all gone the same way on average moves although
    no single point exceeds the threshold: the noise of the mean of `n` points is `1 / sqrt(n)` of theirs.

    Args:
        points: All tracked points.
        of_point: `(n,)` number of the object that each point is on, from 1; 0 for none.
        background: `(n,)` weight of each point in the threshold: inliers of the pose that are on no object.
        T_world_cam: Camera pose.
        before: Memory of the previous frame.
        params: Thresholds.
        inert: `(k,)` objects that do not move by themselves, which are static until they are seen to move; `None` if
            all objects may move by themselves.
        as_published: Whether to follow the paper, see `MotionPlan`; static.
    """
    flow = scene_flow(points.X_world, points.X_cam, T_world_cam)
    flow = jnp.where(points.there[None, :], flow, 0)
    if not as_published:
        flow = flow / jnp.where(points.there[None, :], points.sigma, 1)
    length, counts = flow_length(flow), jnp.where(points.there, background, 0)
    limit = upper_limit(length, counts, params.sigmas, robust=not as_published)
    moves = (length > limit).astype(length.dtype)
    num = before.at_rest.shape[0]
    groups = group_motion(flow, moves, points.there, of_point - 1, num)
    by_share = groups.share / (1 - params.share)
    mean_limit = params.least + limit / jnp.sqrt(jnp.maximum(groups.number, 1))
    evidence = by_share if as_published else jnp.maximum(by_share, groups.mean / mean_limit)
    known = (groups.number >= params.fewest) & (limit > 0)
    verdict = RegionCueResult(*threshold_evidence(evidence, known, params.temperature)[:3])
    return MotionState(points.there, verdict, _remembered(verdict, of_point, before, params, inert))


def _remembered(
    verdict: RegionCueResult,
    of_point: Int[Array, " n"],
    before: MotionMemory,
    params: MotionParams,
    inert: Bool[Array, " k"] | None,
) -> MotionMemory:
    """Update the memory of each object after this frame; a new object that moves by itself starts as moving.

    An object is matched to the object of the previous frame that most of its points were on.
    """
    num = before.at_rest.shape[0]
    was, now = before.of_point, of_point
    votes = jnp.zeros((num + 1, num + 1), jnp.int32).at[now, was].add(1)[1:, 1:]
    parent, known_before = jnp.argmax(votes, axis=1), jnp.max(votes, axis=1) > 0
    starts_at_rest = jnp.zeros(num, bool) if inert is None else inert
    stillness = jnp.where(known_before, before.stillness[parent], starts_at_rest.astype(before.stillness.dtype))
    at_rest = jnp.where(known_before, before.at_rest[parent], starts_at_rest)
    step = jnp.where(verdict.weight >= 0.5, 1 / params.still_frames, -1 / params.moving_frames)
    stillness = jnp.clip(stillness + jnp.where(verdict.known, step, 0), 0, 1)
    nearly = 1e-3  # tolerance for a sum of thirds
    at_rest = (at_rest | (stillness > 1 - nearly)) & (stillness > nearly)
    return MotionMemory(of_point, lax.stop_gradient(stillness), at_rest)
