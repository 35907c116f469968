"""What all cues of a plan say of the points, regions and things of one frame, and what is left out of it for that."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.camera import to_pixels, without_distortion
from jaxslam_kernels.se3 import to_world
from jaxslam_kernels.types import Flag, Mask, Pixels, Weights
from jaxtyping import Array, Bool, Float, Int

from jaxslam.dynamics.cue import CueInput, CueResult, combine_cues
from jaxslam.dynamics.object_motion import MeasuredPoints, MotionState, classify_motion
from jaxslam.dynamics.regions import (
    RegionMemory,
    Regions,
    lasting_weights,
    moving_pixels,
    of_points,
    region_weights,
)
from jaxslam.sensors.measurement import PreparedFrame, depth_sigma, measure_points
from jaxslam.tracking.state import TrackParams, TrackPlan, TrackState
from jaxslam.tracking.step_checks import check_verdict

_MAX_WITNESSES, _ENOUGH_WITNESSES = 10, 5
"""Of each region."""


class FramePoints(NamedTuple):
    """The points of a state in a frame, `(n,)` each.

    Attributes:
        uv: `(2, n)` where they are, pixels.
        followed: Which are there under no mask.
        masked: Which are there under one.
        agreeing: Which of those that are followed agree with the coarse pose.
        trust: How much each counts, before anything is said of it.
        there: Which are there under nothing that is left out in any case.
        thing: Number of the thing that may move that each is on, from 1; 0 for none.
    """

    uv: Pixels
    followed: Mask
    masked: Mask
    agreeing: Mask
    trust: Weights
    there: Mask
    thing: Int[Array, " n"]


class DynamicRejection(NamedTuple):
    """What cues say, and the pixels that are left out for it.

    Attributes:
        verdicts: Of each cue, in the order of `TrackPlan.cues`.
        regions: The surfaces of the frame, if something asks for them.
        memory: What the next frame has of them.
        remembered: `(n,)` 0 for points in regions that moved a moment ago.
        moving: Pixels of regions and things that move.
        heard: Whether it counts for points: not where the frame would be lost for it.
        motion: What is known of the things that may move.
    """

    verdicts: tuple[CueResult, ...] = ()
    regions: Regions | None = None
    memory: RegionMemory | None = None
    remembered: Weights | None = None
    moving: Bool[Array, "h w"] | None = None
    heard: Flag | bool = True
    motion: MotionState | None = None

    def weights(self, weight: Weights) -> Weights:
        """Weights of the points, times those of the cues, and 0 in regions that moved a moment ago."""
        judged = combine_cues(self.verdicts, weight)
        judged = judged if self.remembered is None else judged * self.remembered
        return jnp.where(self.heard, judged, weight)

    def counts(self) -> Mask | Flag:
        """`(n,)` which points no cue says anything against."""
        return self.weights(jnp.ones(())) > 0

    def without_moving_pixels(self, view: PreparedFrame) -> PreparedFrame:
        """The frame with nothing trusted where regions move."""
        return view if self.moving is None else view.without(self.moving)

    def with_motion(self, motion: MotionState, view: PreparedFrame) -> "DynamicRejection":
        """The same, with what is known of the things that may move."""
        assert view.frame.movable is not None
        moving = motion.moving_pixels(view.frame.movable)
        return self._replace(motion=motion, moving=moving if self.moving is None else self.moving | moving)

    def monitor_points(self, uv: Pixels, age: Int[Array, " n"], points: Mask) -> Mask:
        """`(n,)` which points, now at `uv`, are to be followed on what moves, to see whether it goes on.

        A few of each, those of some age first. New points in their place in every frame show the motion of one frame
        only, and a box that comes nearer by 5 mm is at rest then: the rendered room rpy with two boxes 0.024 to 0.12 m,
        with witnesses 0.002. With all of them as witnesses little room is left for points of the room: xyz 0.042 m.
        """
        if self.moving is None:
            return jnp.zeros_like(points)
        points = points & ~self.at_rest(uv)
        if self.motion is not None:
            points = points | self.motion.monitored()
        old = points & (age > 0)
        there_old, there_new = self._in_regions(old), self._in_regions(points & ~old)
        after = jnp.sum(there_old, axis=1, dtype=jnp.int32)[:, None]
        old_rank, new_rank = (jnp.cumsum(there, axis=1, dtype=jnp.int32) for there in (there_old, there_new))
        rank = jnp.where(there_old, old_rank, after + new_rank)
        return jnp.any((there_old | there_new) & (rank <= _MAX_WITNESSES), axis=0)

    def without_monitored(self, view: PreparedFrame, witnesses: Mask, plan: TrackPlan) -> PreparedFrame:
        """The frame with nothing new to be followed where what moves has witnesses."""
        if self.moving is None:
            return view
        watched = jnp.sum(self._in_regions(witnesses), axis=1) >= _ENOUGH_WITNESSES
        height, width = view.depth.shape
        if self.regions is not None and plan.regions is not None:
            num = self.regions.centers.shape[1]
            weight = 1.0 - watched[:num].astype(view.depth.dtype)
            view = view.without(moving_pixels(self.regions, weight, height, width, plan.regions))
            watched = watched[num:]
        return view if self.motion is None else view.without(self._in_objects(watched & ~self.motion.at_rest, view))

    def unmonitored(self, view: PreparedFrame, witnesses: Mask) -> Bool[Array, "h w"] | None:
        """Pixels of things that move, for all that is known, and have too few points to tell; `None` without things."""
        if self.motion is None:
            return None
        few = jnp.sum(self._in_regions(witnesses), axis=1) < _ENOUGH_WITNESSES
        return self._in_objects(few[-len(self.motion.at_rest) :] & ~self.motion.at_rest, view)

    def _in_objects(self, chosen: Bool[Array, " k"], view: PreparedFrame) -> Bool[Array, "h w"]:
        assert view.frame.movable is not None
        by_label = jnp.concatenate([jnp.zeros(1, bool), chosen])
        return by_label[view.frame.movable.astype(jnp.int32)]

    def _in_regions(self, points: Mask) -> Bool[Array, "k n"]:
        """Which points are in each region, and on each thing."""
        parts: list[Bool[Array, "_k n"]] = []
        if self.regions is not None:
            parts.append(
                self.regions.of_point[None, :] == jnp.arange(self.regions.centers.shape[1], dtype=jnp.int32)[:, None]
            )
        if self.motion is not None:
            numbers = jnp.arange(1, len(self.motion.at_rest) + 1, dtype=jnp.int32)
            parts.append(self.motion.of_point[None, :] == numbers[:, None])
        return points[None, :] & jnp.concatenate(parts)

    def at_rest(self, uv: Pixels) -> Mask:
        """`(n,)` which pixels are in no region that moves.

        New points are taken there all the same where witnesses are few: without them nothing is known of the region in
        the next frame, and what moves passes for a room in every other one.
        """
        if self.moving is None:
            return jnp.ones(uv.shape[1], bool)
        column, row = jnp.round(lax.stop_gradient(uv)).astype(jnp.int32)
        return ~self.moving.at[row, column].get(mode="fill", fill_value=False)


def reject_dynamic_points(
    state: TrackState,
    view: PreparedFrame,
    seen: FramePoints,
    regions: Regions | None,
    coarse: SE3,
    twist: Float[Array, "6"],
    params: TrackParams,
    plan: TrackPlan,
) -> DynamicRejection:
    """What is said of points and things, given the coarse pose, which most of the points at rest have made."""
    verdicts = _cue_results(state, view, seen, regions, coarse, twist, params, plan)
    judged = _with_regions(verdicts, regions, state.regions.weight, view, seen.agreeing, plan)
    if verdicts:
        left = jnp.sum(seen.agreeing & (judged.weights(seen.trust) > 0), dtype=seen.trust.dtype)
        judged = judged._replace(heard=left >= params.min_inliers)
    if plan.motion is None:
        return judged
    motion = _motion(state, view, seen, coarse, twist, params, as_published=plan.motion.as_published)
    return judged.with_motion(motion, view)


def _motion(
    state: TrackState,
    view: PreparedFrame,
    seen: FramePoints,
    coarse: SE3,
    twist: Float[Array, "6"],
    params: TrackParams,
    *,
    as_published: bool,
) -> MotionState:
    """What is known of the things that may move."""
    assert params.motion is not None
    points = state.points
    observed = measure_points(points.X_world, seen.uv, coarse, twist, view, params.sensor, view.matched)
    there = seen.there & (observed.depth > 0) & (points.depth > 0)
    across = (
        params.pixel_sigma
        * observed.depth[None, :]
        / jnp.stack([params.sensor.intrinsics.fx, params.sensor.intrinsics.fy])[:, None]
    )
    sigma = jnp.concatenate([across, depth_sigma(observed.depth, params.sensor)[None, :]])
    X_world = points.X_world
    if as_published:
        before = jnp.concatenate([points.xy, jnp.ones_like(points.xy[:1])]) * points.depth[None, :]
        X_world = to_world(state.T_world_cam, before)
    measured = MeasuredPoints(X_world, observed.in_camera(), sigma, there)
    background = seen.agreeing.astype(sigma.dtype)
    return classify_motion(
        measured, seen.thing, background, coarse, state.motion, params.motion, as_published=as_published
    )


def _with_regions(
    verdicts: tuple[CueResult, ...],
    regions: Regions | None,
    before: Float[Array, " k"],
    view: PreparedFrame,
    agreeing: Mask,
    plan: TrackPlan,
) -> DynamicRejection:
    """Verdicts, and what becomes of those on regions, given what was remembered before."""
    if regions is None or plan.regions is None:
        return DynamicRejection(verdicts)
    of_regions = [verdict.regions for verdict in verdicts if verdict.regions is not None]
    if not of_regions:
        return DynamicRejection(verdicts, regions, RegionMemory(regions.centers, before))
    weight = lasting_weights(regions, of_regions, before, agreeing, plan.regions)
    remembered = of_points((weight >= 0.5).astype(weight.dtype), regions, jnp.ones_like(weight[0]))
    height, width = view.depth.shape
    moving = moving_pixels(regions, jnp.minimum(weight, region_weights(of_regions)), height, width, plan.regions)
    return DynamicRejection(verdicts, regions, RegionMemory(regions.centers, weight), remembered, moving)


def _cue_results(
    state: TrackState,
    view: PreparedFrame,
    seen: FramePoints,
    regions: Regions | None,
    coarse: SE3,
    twist: Float[Array, "6"],
    params: TrackParams,
    plan: TrackPlan,
) -> tuple[CueResult, ...]:
    if not plan.cues:
        return ()
    points, ideal = state.points, without_distortion(params.sensor.intrinsics)
    observed = measure_points(points.X_world, seen.uv, coarse, twist, view, params.sensor, view.matched)
    height, width = view.frame.image.shape
    scene = CueInput(
        uv_before=to_pixels(ideal, points.xy),
        uv=to_pixels(ideal, observed.xy),
        followed=seen.followed,
        masked=seen.masked,
        agrees=seen.agreeing,
        weight=seen.trust,
        depth_before=points.depth,
        depth=observed.depth,
        X_world=points.X_world,
        X_anchor=points.X_anchor,
        T_world_before=state.T_world_cam,
        T_world_cam=coarse,
        intrinsics=ideal,
        size=jnp.array([width, height], seen.uv.dtype),
        key=jax.random.fold_in(jax.random.fold_in(state.random_key(), -1 - state.frame), 1),
        regions=regions,
    )
    verdicts = tuple(cue(scene, chosen) for cue, chosen in zip(plan.cues, params.cues, strict=True))
    for index, verdict in enumerate(verdicts):
        check_verdict(f"plan.cues[{index}]", verdict, seen.uv.shape[1], seen.uv.dtype)
    return verdicts
