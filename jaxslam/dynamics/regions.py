"""Regions: parts of a depth image whose points are near each other, each a surface that moves as one.

Source: TRS-SLAM (Ji, Wang and Xie, ICRA 2021), section III-B: K-means on the points of the depth image. An object may
be several regions, and need not be rigid.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxslam_kernels.camera import Intrinsics, back_project
from jaxslam_kernels.clustering.kmeans import kmeans
from jaxslam_kernels.types import DepthImage, Mask, Points, Weights
from jaxtyping import Array, Bool, Float, Int, Key

_PER_LIMIT = 0.25
Centers = Float[Array, "3 k"]
"""Of regions, in the axes of the camera, meters; not finite where none is known."""


class RegionPlan(NamedTuple):
    """How a depth image is divided; static.

    Attributes:
        num_regions: How many regions.
        step_px: One pixel of so many is looked at, in rows and in columns.
        num_steps: Steps of K-means a frame, from where the last frame left off.
        recover_frames: Frames without motion after which a region that moved counts again, if it moved for long: what
            is carried pauses.
    """

    num_regions: int = 24
    step_px: int = 4
    num_steps: int = 2
    recover_frames: int = 15


class Regions(NamedTuple):
    """A depth image, divided.

    Attributes:
        of_pixel: `(h', w')` region of one pixel in each block of `step_px` by `step_px`; -1 for none, without depth.
        of_point: `(n,)` region of each point; -1 for none.
        centers: `(3, k)` meters, in the axes of the camera; not finite for a region without pixels.
        num_pixels: `(k,)` pixels looked at that are in each.
    """

    of_pixel: Int[Array, "h w"]
    of_point: Int[Array, " n"]
    centers: Centers
    num_pixels: Int[Array, " k"]


class RegionCueResult(NamedTuple):
    """What a cue says of each region; as `CueResult`, `(k,)` each.

    Attributes:
        weight: 0 for what moves to 1 for what is at rest; 1 where nothing is known.
        evidence: What was measured, in units of its limit; 0 where nothing is known.
        known: Where something is.
    """

    weight: Float[Array, " k"]
    evidence: Float[Array, " k"]
    known: Bool[Array, " k"]


class RegionMemory(NamedTuple):
    """What the next frame has of the regions of this one.

    Attributes:
        centers: `(3, k)` see `Regions`.
        weight: `(k,)` 0 for what has moved much, 1 for what has been at rest for long; below one half it moves.
    """

    centers: Centers
    weight: Float[Array, " k"]


def no_regions(plan: RegionPlan | None, dtype: jnp.dtype) -> RegionMemory:
    """Before anything is seen."""
    num = 0 if plan is None else plan.num_regions
    return RegionMemory(jnp.full((3, num), jnp.inf, dtype), jnp.ones(num, dtype))


def find_regions(
    key: Key[Array, ""], depth: DepthImage, before: Centers, X_cam: Points, intrinsics: Intrinsics, plan: RegionPlan
) -> Regions:
    """Divide a depth image. Regions are choices, constant for a derivative.

    Args:
        key: Of random choices: where regions begin of which nothing is known.
        depth: `(h, w)` meters, 0 where missing.
        before: Centers in the last frame.
        X_cam: `(3, n)` points whose regions are asked for, in the axes of the camera, at its center where not known.
        intrinsics: The camera; lens distortion, which moves a whole region alike, may be left out.
        plan: Static.
    """
    step = plan.step_px
    rows, columns = (np.minimum(np.arange(0, size, step) + step // 2, size - 1) for size in depth.shape)
    sampled = lax.stop_gradient(depth)[rows][:, columns]
    v, u = np.meshgrid(rows, columns, indexing="ij")
    known = sampled.reshape(-1) > 0
    points = back_project(intrinsics, jnp.asarray([u.ravel(), v.ravel()], depth.dtype), sampled.reshape(-1))
    found = kmeans(key, points, known, num_clusters=plan.num_regions, num_steps=plan.num_steps, initial=before)
    there = found.counts > 0
    centers = lax.stop_gradient(jnp.where(there[None, :], found.centers, jnp.inf))
    return Regions(found.label.reshape(sampled.shape), _nearest(X_cam, centers), centers, found.counts)


def region_weights(verdicts: Sequence[RegionCueResult]) -> Float[Array, " k"]:
    """`(k,)` the product of the weights of verdicts on the same regions, at least one."""
    weight = verdicts[0].weight
    for verdict in verdicts[1:]:
        weight = weight * verdict.weight
    return weight


def remembered_weights(
    regions: Regions, verdicts: Sequence[RegionCueResult], before: Float[Array, " k"], plan: RegionPlan
) -> Float[Array, " k"]:
    """`(k,)` what is remembered of regions: below one half, one moves whatever is said of it now.

    What is carried stops now and then, and a box before the camera that is taken for a wall while it does takes the
    pose with it when it goes on. So evidence is summed up (the cumulative sum of Page, "Continuous inspection
    schemes", Biometrika 1954): what is beyond the limit, in limits, takes a quarter of that away, and a frame without
    motion gives little back. Where no verdict is known the weight stays: nobody has seen the region stop. A region
    without pixels is gone.

    With one verdict enough, a region at rest that is beyond the limit in one frame of ten, where the pose is not that
    precise, was left out for good: 41 % of what is at rest in a kitchen with people, now 17 %, and 11 % of a rendered
    room with boxes, now 2 %. What moves is missed as rarely in the room, and in 8 % of the kitchen instead of 1 %.

    Args:
        regions: Of the frame.
        verdicts: On them, at least one.
        before: What was remembered in the last frame.
        plan: Static.
    """
    evidence, known = jnp.zeros_like(before), jnp.zeros(before.shape, bool)
    for verdict in verdicts:
        evidence = jnp.maximum(evidence, jnp.where(verdict.known, verdict.evidence, 0))
        known = known | verdict.known
    beyond = lax.stop_gradient(evidence) - 1
    change = jnp.where(beyond > 0, -_PER_LIMIT * beyond, 0.5 / plan.recover_frames)
    return jnp.where(regions.num_pixels > 0, jnp.where(known, jnp.clip(before + change, 0, 1), before), 1)


def lasting_weights(
    regions: Regions,
    verdicts: Sequence[RegionCueResult],
    before: Float[Array, " k"],
    agreeing: Mask,
    plan: RegionPlan,
) -> Float[Array, " k"]:
    """`remembered_weights`, all before this frame forgotten where it has proved wrong.

    It has where it speaks against most of the points that agree on a pose now: somebody has carried the pose with him
    for a moment, and the room would be left out until nothing is left to track by.

    Args:
        regions: Of the frame.
        verdicts: On them, at least one.
        before: What was remembered in the last frame.
        agreeing: `(n,)` which points agree on a pose now.
        plan: Static.
    """
    fresh, lasting = (remembered_weights(regions, verdicts, old, plan) for old in (jnp.ones_like(before), before))
    now, one = region_weights(verdicts), jnp.ones_like(before[0])
    left = [jnp.sum(agreeing & (of_points(weight, regions, one) >= 0.5)) for weight in (now, jnp.minimum(now, lasting))]
    return jnp.where(2 * left[1] >= left[0], lasting, fresh)


def moving_pixels(
    regions: Regions, weight: Float[Array, " k"], height: int, width: int, plan: RegionPlan
) -> Bool[Array, "h w"]:
    """`(height, width)` true in regions that rather move."""
    moving = (weight < 0.5)[jnp.maximum(regions.of_pixel, 0)] & (regions.of_pixel >= 0)
    whole = jnp.repeat(jnp.repeat(moving, plan.step_px, axis=0), plan.step_px, axis=1)
    return whole[:height, :width]


def mean_of_regions(values: Weights, counts: Mask, regions: Regions) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """`(k,)` mean of the values of the points in each region that count, 0 for none, and how many those are."""
    num = regions.centers.shape[1]
    counted = counts & (regions.of_point >= 0)
    to = jnp.where(counted, regions.of_point, num)
    sums = jnp.zeros(num, values.dtype).at[to].add(jnp.where(counted, values, 0), mode="drop")
    number = jnp.zeros(num, values.dtype).at[to].add(1, mode="drop")
    return sums / jnp.maximum(number, 1), number


def balance_regions(weights: Weights, regions: Regions) -> Weights:
    """`(n,)` weights with which no region has more of a say than an even share; what is in none keeps its own.

    A textured box before the camera has most of the points, and a room behind it most of the surfaces.
    """
    num = regions.centers.shape[1]
    to = jnp.where(regions.of_point >= 0, regions.of_point, num)
    sums = jnp.zeros(num + 1, weights.dtype).at[to].add(weights)
    share = jnp.sum(sums[:num]) / num
    factor = jnp.minimum(1, share / jnp.maximum(sums, 1e-6)).at[num].set(1)
    return weights * factor[to]


def of_points(per_region: Array, regions: Regions, otherwise: Array) -> Array:
    """`(n,)` what each point's region has; `otherwise` for points in none."""
    return jnp.where(regions.of_point >= 0, per_region[jnp.maximum(regions.of_point, 0)], otherwise)


def _nearest(X_cam: Points, centers: Centers) -> Int[Array, " n"]:
    X_cam = lax.stop_gradient(X_cam)
    known = jnp.isfinite(X_cam).all(axis=0) & (X_cam[2] > 0) & jnp.isfinite(centers).all(axis=0).any()
    apart = jnp.where(known[None, :, None], X_cam[:, :, None], 0) - centers[:, None, :]
    squared = jnp.sum(jnp.square(apart), axis=0)
    return jnp.where(known, jnp.argmin(squared, axis=1).astype(jnp.int32), -1)
