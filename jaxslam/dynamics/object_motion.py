"""3-D motion state: which of the things that may move do so now, and which stand still and are as good as a wall.

Source: USD-SLAM (Wang et al., RA-L 2024), section III-B: the motion of points in space, beyond that of the camera,
against what points at rest show; a thing stands still while 70 % of its points are below that limit.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.scene_flow import flow_length, group_motion, scene_flow, upper_limit
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxslam.dynamics.cue import threshold_evidence
from jaxslam.dynamics.regions import RegionCueResult

Labels = UInt8[Array, "h w"]
"""Number of the thing that may move at each pixel, from 1; 0 where there is none."""


class MotionPlan(NamedTuple):
    """Static.

    Attributes:
        num_objects: Things in one frame at most; a frame's labels are 1 to this.
        reserved: Slots of points that are kept free for points on them.
        dense_cell_px: Side of the cells that each get at most one new corner where things take up over half of the
            picture, even: more points from what is left of it.
        as_published: Whether motion is measured in meters from frame to frame, its limit from mean and standard
            deviation, and the points of a thing are counted alone.
    """

    num_objects: int = 16
    reserved: int = 48
    dense_cell_px: int = 14
    as_published: bool = False


class MotionParams(NamedTuple):
    """Of `classify_motion`; scalars.

    Attributes:
        sigmas: A point moves if it moves more than points at rest do by so many standard deviations.
        share: A thing is at rest while this share of its points does not move.
        least: Motion of a thing, in standard deviations of a point, that is none in any case: people who sit breathe.
        fewest: Least number of points that say anything of a thing.
        still_frames: Frames in which it must be at rest to be taken to stand still,
        moving_frames: and in which it must move to be taken to move again.
        temperature: See `cue.judge`; of the verdict on a thing.
    """

    sigmas: Scalar
    share: Scalar
    least: Scalar
    fewest: Scalar
    still_frames: Scalar
    moving_frames: Scalar
    temperature: Scalar


class MotionMemory(NamedTuple):
    """What the next frame has of the things in this one; they are known again by the points on them.

    Attributes:
        of_point: `(n,)` number of the thing that each point is on, 0 for none.
        stillness: `(k,)` 0 for what moves to 1 for what has been at rest for some frames.
        at_rest: `(k,)` which are taken to stand still.
    """

    of_point: Int[Array, " n"]
    stillness: Float[Array, " k"]
    at_rest: Bool[Array, " k"]


class MotionState(NamedTuple):
    """What is known of the things in a frame that may move; entry 0 is of thing 1.

    Attributes:
        there: `(n,)` which points are known in the frame.
        verdict: Of this frame alone, `(k,)`; evidence is in units of the limit.
        memory: For the next frame.
    """

    there: Mask
    verdict: RegionCueResult
    memory: MotionMemory

    @property
    def of_point(self) -> Int[Array, " n"]:
        """`(n,)` number of the thing that each point is on, from 1; 0 for none."""
        return self.memory.of_point

    @property
    def at_rest(self) -> Bool[Array, " k"]:
        """`(k,)` which are taken to stand still."""
        return self.memory.at_rest

    def moves(self) -> Bool[Array, " k1"]:
        """`(k + 1,)` by label; false for 0, what cannot move."""
        return jnp.concatenate([jnp.zeros(1, bool), ~self.at_rest])

    def moving_pixels(self, labels: Labels) -> Bool[Array, "h w"]:
        """Pixels of things that move, or of which nothing is known."""
        return self.moves()[labels.astype(jnp.int32)]

    def joining(self) -> Mask:
        """`(n,)` points on things that stand still."""
        return self.there & (self.of_point > 0) & ~self.moves()[self.of_point]

    def monitored(self) -> Mask:
        """`(n,)` points on things that move."""
        return self.there & self.moves()[self.of_point]


class MeasuredPoints(NamedTuple):
    """Points in the world and in a frame.

    Attributes:
        X_world: `(3, n)` meters, where they were.
        X_cam: `(3, n)` meters, where they are in the axes of the camera.
        sigma: `(3, n)` standard deviation of that, meters.
        there: `(n,)` which are known in both.
    """

    X_world: Points
    X_cam: Points
    sigma: Points
    there: Mask


def no_motion(plan: MotionPlan | None, num_points: int, dtype: jnp.dtype) -> MotionMemory:
    """Before anything is seen."""
    num = 0 if plan is None else plan.num_objects
    return MotionMemory(jnp.zeros(num_points, jnp.int32), jnp.zeros(num, dtype), jnp.zeros(num, bool))


def labels_at(labels: Labels, uv: Pixels) -> Int[Array, " n"]:
    """`(n,)` what is at pixels `(2, n)`; 0 outside of the picture."""
    column, row = jnp.round(lax.stop_gradient(uv)).astype(jnp.int32)
    there = labels.at[row, column].get(mode="fill", fill_value=0).astype(jnp.int32)
    return jnp.where((row >= 0) & (column >= 0), there, 0)  # negative indices count from the end


def classify_motion(
    points: MeasuredPoints,
    of_point: Int[Array, " n"],
    background: Weights,
    T_world_cam: SE3,
    before: MotionMemory,
    params: MotionParams,
    *,
    as_published: bool = False,
) -> MotionState:
    """Which things stand still, given the pose that what cannot move has.

    Lengths are in standard deviations of where a point is measured, not in meters as published: pixels are worth
    millimeters across the line of sight and depth is worth centimeters along it, so that in meters a limit of what
    depth shows hides what goes by. And a thing whose points have gone the same way on average moves though no single
    one does by the limit: noise of the mean of `n` points is `1 / sqrt(n)` of theirs.

    Args:
        points: All points that are followed.
        of_point: `(n,)` number of the thing that each is on, from 1; 0 for none.
        background: `(n,)` how much each counts for the limit: those that agree with the pose and are on no thing.
        T_world_cam: Pose of the camera.
        before: From the frame before.
        params: Limits.
        as_published: As of `MotionPlan`, static.
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
    return MotionState(points.there, verdict, _remembered(verdict, of_point, before, params))


def _remembered(
    verdict: RegionCueResult, of_point: Int[Array, " n"], before: MotionMemory, params: MotionParams
) -> MotionMemory:
    """The memory of each thing after this frame; that of a new one is of what moves.

    A thing is the one of the frame before that most of its points were on.
    """
    num = before.at_rest.shape[0]
    was, now = before.of_point, of_point
    votes = jnp.zeros((num + 1, num + 1), jnp.int32).at[now, was].add(1)[1:, 1:]
    parent, known_before = jnp.argmax(votes, axis=1), jnp.max(votes, axis=1) > 0
    stillness = jnp.where(known_before, before.stillness[parent], 0)
    at_rest = known_before & before.at_rest[parent]
    step = jnp.where(verdict.weight >= 0.5, 1 / params.still_frames, -1 / params.moving_frames)
    stillness = jnp.clip(stillness + jnp.where(verdict.known, step, 0), 0, 1)
    nearly = 1e-3  # of a sum of thirds
    at_rest = (at_rest | (stillness > 1 - nearly)) & (stillness > nearly)
    return MotionMemory(of_point, lax.stop_gradient(stillness), at_rest)
