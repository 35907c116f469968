"""New points for free slots: corners where no point is, with depth that can be believed."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.image.corners import corner_score, grid_corners, occupied_cells
from jaxslam_kernels.se3 import to_world
from jaxslam_kernels.types import Code, Mask, Pixels, Scalar, Weights
from jaxtyping import Array, Bool, Float, Int

from jaxslam.sensors.measurement import Measurements, depth_sigma, match_depth, pixel_rays
from jaxslam.tracking.points import TrackedPoints
from jaxslam.tracking.step_context import StepContext
from jaxslam.tracking.unknown_depth import assumed_depth

_MIN_SCORE = 2.0
"""Smallest eigenvalue of a corner worth tracking, in squared intensity a squared pixel, on the second level."""
_EDGE_PX = 12
_DEPTH_STEP = 0.3
"""Largest difference of depth in the window of a point that counts as one surface, as a share of its depth."""


class _Candidates(NamedTuple):
    """Corners of the cells of a grid over the image, one per cell.

    Attributes:
        uv: `(2, m)` positions, pixels.
        score: `(m,)` scores of the corners.
        rough: `(m,)` depths at the corners, meters; where missing, the assumed depth, 0 if there is none.
        seen: Measurements of the corners.
        known: `(m,)` mask of the corners of measured depth.
        good: `(m,)` mask of the corners that may become points.
    """

    uv: Pixels
    score: Weights
    rough: Weights
    seen: Measurements
    known: Mask
    good: Mask


def detect_new_points(
    points: TrackedPoints,
    step: StepContext,
    T_world_cam: SE3,
    twist: Float[Array, "6"],
    *,
    most_waiting: Code | int = 0,
    first: Bool[Array, "h w"] | None = None,
    cell_px: int | None = None,
) -> tuple[TrackedPoints, Code]:
    """Put the best corners of empty grid cells into free slots, numbered from `next_id` on.

    Corners are sought on the second level of the pyramid: a quarter of the work, and less noise. A new point has the
    depth measured at it, the rolling shutter and the delay of the depth image taken into account.

    Corners on one surface come first: where a window also shows what is behind, flow follows neither. Mixed, ATE was
    1.4 mm instead of 0.3 on the synthetic room (camera path xyz, nobody in it), 3.9 instead of 2.1 with two people,
    16.6 instead of 11.7 on the start of Bonn `crowd`, but 8.3 instead of 9.2 on TUM `fr1_rpy`. Refusing mixed windows
    leaves too few points (`fr1_rpy` 10.2); giving them a fifth of the weight hands the scene to people, who are one
    surface (two people 145).

    Args:
        points: Current points.
        step: Context of the step; pixels that its frame ignores give no points.
        T_world_cam: Pose of the frame.
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        most_waiting: Largest number of points of unknown depth there may be, with those of `points`; they wait until it
            is known. New ones are corners in whose windows there is no depth, as out of the sensor's reach (beside
            silhouettes it is missing in a narrow strip only), and those of a pair that have no match.
        first: `(h, w)` mask of pixels whose corners come before all others; some slots are kept free for them.
        cell_px: Side of the cells instead of that of the plan, pixels, static.

    Returns:
        The points, and the number of grid cells that hold a corner, with depth or without.
    """
    state, view, params, plan = step
    assumed = jnp.where(most_waiting > 0, assumed_depth(points, T_world_cam, params.sensor.min_depth_m), 0)
    found = _candidates(points, step, twist, (cell_px or plan.cell_px) // 2, assumed)
    rank = jnp.cumsum(~points.valid, dtype=jnp.int32) - 1
    order, room = _order(found, step, rank, first)
    candidate = order[jnp.clip(rank, 0, order.shape[0] - 1)]
    new = ~points.valid & (rank < room)
    uv, rough, *chosen = (jnp.take(array, candidate, axis=-1) for array in (found.uv, found.rough, *found.seen))
    seen = Measurements(*chosen)
    matched = match_depth(view, uv, rough, new, params.sensor, known_point=False, plan=plan.pair_flow)
    if matched is not None:
        seen = Measurements(seen.xy, matched, depth_sigma(matched, params.sensor))
    known = seen.depth > 0
    waiting = jnp.sum(points.valid & ~points.has_position(), dtype=jnp.int32)
    new &= known | (waiting + jnp.cumsum(new & ~known, dtype=jnp.int32) <= most_waiting)
    X_world = to_world(T_world_cam, seen._replace(depth=jnp.where(known, seen.depth, assumed)).in_camera())
    X_anchor = jnp.where(known[None, :], X_world, T_world_cam.translation()[:, None])
    put = lambda old, fresh: jnp.where(new, fresh, old)
    filled = TrackedPoints(
        uv=put(points.uv, uv),
        xy=put(points.xy, seen.xy),
        depth=put(points.depth, seen.depth),
        X_world=put(points.X_world, X_world),
        X_anchor=put(points.X_anchor, X_anchor),
        information=put(points.information, jnp.where(known, 1 / jnp.square(seen.sigma), 0)),
        weight=jnp.where(new, 1, points.weight),
        age=jnp.where(new, 0, points.age),
        anchor_age=jnp.where(new, 0, points.anchor_age),
        id=jnp.where(new, state.next_id + rank, points.id),
        valid=points.valid | new,
    )
    return filled, jnp.sum(found.score > _MIN_SCORE, dtype=jnp.int32)


def _candidates(
    points: TrackedPoints, step: StepContext, twist: Float[Array, "6"], cell: int, assumed: Scalar
) -> _Candidates:
    """Find and measure the best corner of each cell.

    Args:
        points: Current points.
        step: Context of the step.
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        cell: Side of the cells on the second level, pixels.
        assumed: Depth to assume at corners of unknown depth, meters; 0 if there are to be none.
    """
    view, sensor = step.view, step.params.sensor
    border = view.pyramid.border
    image = view.pyramid.levels[1][border:-border, border:-border]
    v, u = jnp.mgrid[: image.shape[0], : image.shape[1]]
    edge = _EDGE_PX // 2
    inside = (u >= edge) & (v >= edge) & (u < image.shape[1] - edge) & (v < image.shape[0] - edge)
    trusted = view.may_hold_corners()[::2, ::2][: image.shape[0], : image.shape[1]]
    corners = grid_corners(corner_score(image), inside & trusted, cell=cell)
    taken = occupied_cells(points.uv / 2, points.valid, (image.shape[0], image.shape[1]), cell=cell)
    uv = corners.points * 2
    measured = view.depth_at(uv, sensor, reach=2)
    rough = jnp.where(measured > 0, measured, assumed)
    seen = pixel_rays(uv, sensor).measured(rough, twist, view.frame.depth, view.frame.depth_delay_s, sensor, reach=2)
    known = (measured > 0) & (seen.depth > 0)
    may_wait = (assumed > 0) & view.lacks_depth(uv, sensor, reach=step.plan.flow.finest.window // 2)
    good = (corners.score > _MIN_SCORE) & ~taken & (known | may_wait)
    return _Candidates(uv, corners.score, rough, seen, known, good)


def _order(
    found: _Candidates, step: StepContext, rank: Int[Array, " n"], first: Bool[Array, "h w"] | None
) -> tuple[Int[Array, " m"], Code]:
    """Order the candidates, and count those used.

    The order is: those in `first`, then those on one surface, then others of known depth, then those of unknown depth,
    each from the highest score to the lowest; those that are not good are last.
    """
    plan = step.plan
    reach = plan.flow.finest.window // 2
    one_surface = step.view.depth_at(found.uv, step.params.sensor, reach=reach, max_step=_DEPTH_STEP) > 0
    ranks = [~found.good | ~found.known, ~found.good | (found.known & ~one_surface)]
    room = jnp.sum(found.good, dtype=jnp.int32)
    if first is not None and plan.motion is not None:
        column, row = jnp.round(found.uv).astype(jnp.int32)
        ahead = found.good & first.at[row, column].get(mode="fill", fill_value=False)
        ranks, num_ahead = [~ahead, *ranks], jnp.sum(ahead, dtype=jnp.int32)
        room = jnp.minimum(room, jnp.maximum(num_ahead, rank[-1] + 1 - plan.motion.reserved))
    return _ascending(ranks, found.score), room


def _ascending(ranks: list[Mask], score: Weights) -> Int[Array, " m"]:
    """Order candidates by ranks, the first before the others, then from the highest score to the lowest.

    All of it and the number of the candidate are one integer: a sort of one array takes 69 us for 2,080 candidates,
    `lexsort` 485 (Xeon, one thread). Scores that differ by less than two thousandths are in the order of the grid.
    """
    number_bits = score.shape[0].bit_length()
    score_bits = 32 - len(ranks) - number_bits
    # The bits of a positive floating-point number are in the order of the numbers.
    bits = lax.bitcast_convert_type(score.astype(jnp.float32), jnp.uint32)
    key = (jnp.uint32(2**31 - 1) - bits) >> (31 - score_bits)
    for place, mask in enumerate(reversed(ranks)):
        key |= mask.astype(jnp.uint32) << (score_bits + place)
    number = jnp.arange(score.shape[0], dtype=jnp.uint32)
    ordered = jnp.sort((key << number_bits) | number)
    return (ordered & (2**number_bits - 1)).astype(jnp.int32)
