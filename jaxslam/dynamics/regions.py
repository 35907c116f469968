"""Depth regions: clusters of nearby points in a depth image, each a surface that moves as one.

Source: TRS-SLAM (Ji, Wang and Xie, ICRA 2021), section III-B: K-means on the points of the depth image. An object may
consist of several regions and need not be rigid.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxslam_kernels.camera import Intrinsics, back_project
from jaxslam_kernels.clustering.kmeans import kmeans, nearest_centers
from jaxslam_kernels.depth.sampling import valid_depth
from jaxslam_kernels.types import DepthImage, Mask, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Int, Key, Shaped

from jaxslam.config.cue_sections import ClusterCueConfig
from jaxslam.runtime.filled_arrays import filled

_ENOUGH_PIXELS = 10_000
"""Number of sampled pixels from which on every second row and column of them gives the centers; 19,200 at 640x480."""
_PER_LIMIT = 0.25
"""Loss of weight for evidence that exceeds the threshold by one threshold."""
Centers = Float[Array, "3 k"]
"""Region centers in camera axes, in meters; not finite where none is known."""


_SETTINGS = ClusterCueConfig()  # the only place of defaults


class RegionPlan(NamedTuple):
    """Settings of the division of a depth image into regions; static.

    Attributes:
        num_regions: Number of regions.
        step_px: Spacing of the sampled pixels, in rows and in columns. Of many, the centers come from every second row
            and column.
        num_steps: K-means steps per frame, starting from the centers of the previous frame.
        recover_frames: Number of frames without motion after which a region that moved for long counts again. A carried
            object pauses.
    """

    num_regions: int = _SETTINGS.num_regions
    step_px: int = _SETTINGS.step_px
    num_steps: int = _SETTINGS.num_steps
    recover_frames: int = _SETTINGS.recover_frames


class Regions(NamedTuple):
    """Regions of a depth image.

    Attributes:
        of_pixel: `(h', w')` region of one pixel in each block of `step_px` by `step_px`; -1 where depth is missing.
        of_point: `(n,)` region of each point; -1 for none.
        centers: `(3, k)` region centers in camera axes, in meters; not finite for a region without pixels.
        num_pixels: `(k,)` number of sampled pixels in each region; 1 for a region of a frame without depth.
    """

    of_pixel: Int[Array, "h w"]
    of_point: Int[Array, " n"]
    centers: Centers
    num_pixels: Int[Array, " k"]


class RegionCueResult(NamedTuple):
    """Result of a cue per region, each `(k,)`; see `CueResult`.

    Attributes:
        weight: From 0 for a moving region to 1 for a static one; 1 where nothing is known.
        evidence: Measured value in units of the threshold; 0 where nothing is known.
        known: Whether the region could be classified.
    """

    weight: Float[Array, " k"]
    evidence: Float[Array, " k"]
    known: Bool[Array, " k"]


class RegionMemory(NamedTuple):
    """Region state carried to the next frame.

    Attributes:
        centers: `(3, k)` region centers, as in `Regions`.
        weight: `(k,)` from 0 for a region that has moved much to 1 for one that has long been static; below one half
            the region is treated as moving.
    """

    centers: Centers
    weight: Float[Array, " k"]


def no_regions(plan: RegionPlan | None, dtype: jnp.dtype) -> RegionMemory:
    """Return the memory before the first frame."""
    num = 0 if plan is None else plan.num_regions
    return RegionMemory(filled((3, num), dtype, jnp.inf), filled(num, dtype, 1))


def find_regions(
    key: Key[Array, ""],
    depth: DepthImage,
    before: Centers,
    X_cam: Points,
    intrinsics: Intrinsics,
    plan: RegionPlan,
    *,
    limits_m: tuple[Scalar | float, Scalar | float] = (0.0, float("inf")),
) -> Regions:
    """Divide a depth image into regions. The division is a discrete choice, constant for differentiation.

    A frame without any depth keeps the centers of the frame before.

    Args:
        key: Key of the random choices: the starting centers of regions without a known center.
        depth: `(h, w)` depth image in meters, 0 or NaN where missing.
        before: Centers in the previous frame.
        X_cam: `(3, n)` points whose regions are requested, in camera axes; at the camera center where unknown.
        intrinsics: Camera intrinsics; lens distortion shifts a whole region alike and may be left out.
        plan: Static settings.
        limits_m: Smallest and largest depth to be believed, meters.
    """
    step = plan.step_px
    rows, columns = (np.minimum(np.arange(0, size, step) + step // 2, size - 1) for size in depth.shape)
    sampled = valid_depth(lax.stop_gradient(depth)[rows][:, columns], *limits_m)
    v, u = np.meshgrid(rows, columns, indexing="ij")
    known = sampled.reshape(-1) > 0
    pixels = jnp.asarray([u, v], depth.dtype)
    points = back_project(intrinsics, pixels.reshape(2, -1), sampled.reshape(-1))
    # Centers are means of many pixels: those of a quarter of them are as good, in half of the time for all of it.
    spacing = 2 if sampled.size >= _ENOUGH_PIXELS else 1
    few = (slice(None, None, spacing), slice(None, None, spacing))
    few_points = back_project(intrinsics, pixels[:, *few].reshape(2, -1), sampled[few].reshape(-1))
    has_depth = sampled[few].reshape(-1) > 0
    found = kmeans(key, few_points, has_depth, num_clusters=plan.num_regions, num_steps=plan.num_steps, initial=before)
    centers = lax.stop_gradient(jnp.where(jnp.any(has_depth), found.centers, before))
    # In a branch, XLA computes the labels once; else once for each of their uses, and with `apart` a center at a time.
    nothing = jnp.full(known.shape, -1, jnp.int32)
    label = lax.cond(jnp.any(known), lambda: _nearest(points, centers), lambda: nothing)
    counts = jnp.zeros(plan.num_regions, jnp.int32).at[jnp.where(known, label, plan.num_regions)].add(1, mode="drop")
    of_before = jnp.isfinite(before).all(axis=0)
    counts = jnp.where(jnp.any(known), counts, of_before.astype(counts.dtype))
    centers = jnp.where((counts > 0)[None, :], centers, jnp.inf)
    return Regions(label.reshape(sampled.shape), _nearest(X_cam, centers), centers, counts)


def region_weights(verdicts: Sequence[RegionCueResult]) -> Float[Array, " k"]:
    """Return `(k,)` the product of the weights of at least one result for the same regions."""
    weight = verdicts[0].weight
    for verdict in verdicts[1:]:
        weight = weight * verdict.weight
    return weight


def remembered_weights(
    regions: Regions, verdicts: Sequence[RegionCueResult], before: Float[Array, " k"], plan: RegionPlan
) -> Float[Array, " k"]:
    """Update the remembered weight of each region, `(k,)`; below one half a region moves whatever the cues say now.

    A carried object stops now and then. A box in front of the camera that is taken for a wall while it pauses takes the
    pose with it when it moves again. So evidence is accumulated (the cumulative sum of Page, "Continuous inspection
    schemes", Biometrika 1954): each threshold of evidence beyond the threshold takes a quarter of the weight away, and
    a frame without motion gives a little back. Where no cue has a result the weight stays: nothing has shown that the
    region stopped. A region without pixels is forgotten.

    When a single result was enough, a static region beyond the threshold in one frame of ten, where the pose is not
    that precise, was left out forever: 41 % of the static surfaces in a kitchen with people, now 17 %, and 11 % of a
    rendered room with boxes, now 2 %. Moving surfaces are missed as rarely as before in the room, and in 8 % of the
    kitchen instead of 1 %.

    Args:
        regions: Regions of the frame.
        verdicts: At least one result for these regions.
        before: `(k,)` remembered weights of the previous frame.
        plan: Static settings.
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
    """Update the remembered weights, but drop the memory in frames in which it has proved wrong.

    The memory has proved wrong if it rejects most of the points that now agree on a pose: someone has dragged the pose
    along for a moment, and the background would be left out until nothing remains to track.

    Args:
        regions: Regions of the frame.
        verdicts: At least one result for these regions.
        before: `(k,)` remembered weights of the previous frame.
        agreeing: `(n,)` which points are inliers of the current pose.
        plan: Static settings.
    """
    fresh, lasting = (remembered_weights(regions, verdicts, old, plan) for old in (jnp.ones_like(before), before))
    now, one = region_weights(verdicts), jnp.ones_like(before[0])
    left = [jnp.sum(agreeing & (of_points(weight, regions, one) >= 0.5)) for weight in (now, jnp.minimum(now, lasting))]
    return jnp.where(2 * left[1] >= left[0], lasting, fresh)


def moving_pixels(
    regions: Regions, weight: Float[Array, " k"], height: int, width: int, plan: RegionPlan
) -> Bool[Array, "h w"]:
    """Return `(height, width)` the pixels of regions that are more likely moving."""
    moves = weight < 0.5

    def pixels() -> Bool[Array, "h w"]:
        moving = moves[jnp.maximum(regions.of_pixel, 0)] & (regions.of_pixel >= 0)
        return _of_blocks(moving, height, width, plan)

    return lax.cond(jnp.any(moves), pixels, lambda: jnp.zeros((height, width), bool))


def moving_shares(
    regions: Regions, weight: Float[Array, " k"], height: int, width: int, plan: RegionPlan
) -> Float[Array, "h w"]:
    """Return `(height, width)` one minus the weight of each pixel's region; 0 where depth is missing."""
    share = jnp.where(regions.of_pixel >= 0, 1 - weight[jnp.maximum(regions.of_pixel, 0)], 0)
    return _of_blocks(share, height, width, plan)


def mean_of_regions(values: Weights, counts: Mask, regions: Regions) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return `(k,)` the mean value of the counted points in each region, 0 for none, and how many count."""
    num = regions.centers.shape[1]
    counted = counts & (regions.of_point >= 0)
    to = jnp.where(counted, regions.of_point, num)
    sums = jnp.zeros(num, values.dtype).at[to].add(jnp.where(counted, values, 0), mode="drop")
    number = jnp.zeros(num, values.dtype).at[to].add(1, mode="drop")
    return sums / jnp.maximum(number, 1), number


def balance_regions(weights: Weights, regions: Regions) -> Weights:
    """Return `(n,)` weights with which no region exceeds an even share; points in no region keep their weight.

    A textured box in front of the camera has most of the points, and the room behind it most of the surfaces.
    """
    num = regions.centers.shape[1]
    to = jnp.where(regions.of_point >= 0, regions.of_point, num)
    sums = jnp.zeros(num + 1, weights.dtype).at[to].add(weights)
    share = jnp.sum(sums[:num]) / num
    factor = jnp.minimum(1, share / jnp.maximum(sums, 1e-6)).at[num].set(1)
    return weights * factor[to]


def of_points(per_region: Array, regions: Regions, otherwise: Array) -> Array:
    """Return `(n,)` the value of each point's region; `otherwise` for points in none."""
    return jnp.where(regions.of_point >= 0, per_region[jnp.maximum(regions.of_point, 0)], otherwise)


def _of_blocks(
    values: Shaped[Array, "rows columns"], height: int, width: int, plan: RegionPlan
) -> Shaped[Array, "h w"]:
    """Give all pixels of a block its value."""
    whole = jnp.repeat(jnp.repeat(values, plan.step_px, axis=0), plan.step_px, axis=1)
    return whole[:height, :width]


def _nearest(X_cam: Points, centers: Centers) -> Int[Array, " n"]:
    X_cam = lax.stop_gradient(X_cam)
    known = jnp.isfinite(X_cam).all(axis=0) & (X_cam[2] > 0) & jnp.isfinite(centers).all(axis=0).any()
    return jnp.where(known, nearest_centers(jnp.where(known[None], X_cam, 0), centers), -1)
