"""Pyramidal Lucas-Kanade optical flow for many points at once, differentiable; the search itself is in `lk_search`."""

import enum
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.flow.lk_row_search import MORE_BORDER, settle_in_rows
from jaxslam_kernels.flow.lk_search import FlowPlan, LevelPlan, difference, likeness, look, make_template, search
from jaxslam_kernels.image.patches import Window
from jaxslam_kernels.image.pyramid import Pyramid
from jaxslam_kernels.implicit_positions import ConvergedPositions, implicit_positions
from jaxslam_kernels.types import Mask, Pixels, Scalar

__all__ = ["Flow", "FlowPlan", "FlowStatus", "LevelPlan", "lk_flow", "lk_flow_forward_backward"]

DEFAULT_PLAN = FlowPlan()
MIN_CORRELATION = 0.5
"""A smaller correlation is taken for another thing. In nine rendered worlds, it leaves out 0.00 to 0.23 % of the points
found within a pixel, and half of those that were covered or are more than two pixels off on the road and in a crowd
(61 and 48 %; 0 to 8 % in the others). In a black image, where no step of a search leads anywhere, it leaves out all."""


class FlowStatus(enum.IntEnum):
    """Outcome of tracking a point."""

    OK = 0
    MASKED = 1
    OUTSIDE = 2
    """It starts or ends outside the image."""
    NO_TEXTURE = 3
    """Its window has too little gradient in some direction."""
    NOT_CONVERGED = 4
    """The last step was still longer than the plan accepts, a tenth of a pixel if it does not say."""
    BAD_INPUT = 5
    """A coordinate, or a pixel near it, was not a number."""
    INCONSISTENT = 6
    """Tracked back, it does not return to where it came from."""
    DISSIMILAR = 7
    """Its window correlates too little with what is there: the point is covered, or the image is black."""


class Flow(NamedTuple):
    """Tracked points.

    Attributes:
        points: `(2, n)` positions in the current image; finite always, meaningful where `status` is `OK`.
        status: `(n,)` a `FlowStatus` a point.
        residual: `(n,)` mean absolute difference of intensity over the window at the end, from the mean difference.
        correlation: `(n,)` correlation of the window with that in the previous image, at the end.
        texture: `(n,)` smaller eigenvalue of the covariance of gradients, or of their mean products if brightness
            counts, in squared intensity per squared pixel.
    """

    points: Pixels
    status: Int[Array, " n"]
    residual: Float[Array, " n"]
    correlation: Float[Array, " n"]
    texture: Float[Array, " n"]

    @property
    def ok(self) -> Mask:
        """True for points that were tracked."""
        return self.status == FlowStatus.OK


@checked
def lk_flow(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels | None = None,
    mask: Mask | None = None,
    *,
    plan: FlowPlan = DEFAULT_PLAN,
    min_texture: Scalar | float = 1.0,
    min_correlation: Scalar | float = MIN_CORRELATION,
) -> Flow:
    """Track points from one image to the next.

    Differentiable in both images and in `points`, forward and reverse, by the implicit function theorem at the
    solution (not through the iterations, so the guess has no influence). The derivative of a point that was not
    tracked is zero. Bilinear interpolation bends between pixels: at a point with whole coordinates, the derivative is
    that towards greater ones.

    Args:
        previous: Pyramid of the image the points are in; its border at least half the largest window plus 6,
            or plus 9 with a plan along rows.
        current: Pyramid of the image they are searched in, of the same sizes.
        points: `(2, n)` pixel coordinates in the previous image.
        guess: `(2, n)` where to start the search in the current image; `points` if not given. With a plan along rows,
            in the rows of `points`.
        mask: `(n,)` which points to track; all if not given.
        plan: Windows and iterations, static.
        min_texture: Smallest accepted `Flow.texture`, in squared intensity per squared pixel; positive.
        min_correlation: Smallest accepted correlation of the windows in both images, -1 to 1.

    Returns:
        Positions with a status for each; a point that was not tracked is where its search ended, or at its guess if
        it was not searched.

    Raises:
        ValueError: While tracing, if the pyramids do not match or their border is too narrow for the plan.
    """
    _check(previous, current, plan)
    guess = points if guess is None else guess
    finite = jnp.all(jnp.isfinite(points) & jnp.isfinite(guess), axis=0)
    wanted = jnp.ones(points.shape[1], bool) if mask is None else mask
    usable = finite & wanted & _inside(points, previous)
    held, start = (jnp.where(usable[None, :], pixels, 0) for pixels in (points, guess))
    thresholds = (jnp.asarray(least, points.dtype) for least in (min_texture, min_correlation))
    inputs = _Inputs(previous, current, held, start, usable, *thresholds)
    found = implicit_positions(partial(_solve, plan=plan), partial(_explain, plan=plan), inputs)
    end = found.measures
    reasons = (
        (~wanted, FlowStatus.MASKED),
        (~finite | ~jnp.isfinite(end.last_step) | ~jnp.isfinite(end.texture), FlowStatus.BAD_INPUT),
        (~usable | ~_inside(found.positions, current), FlowStatus.OUTSIDE),
        (~(end.texture > inputs.min_texture), FlowStatus.NO_TEXTURE),
        (~(end.last_step < plan.finest.accepted**2), FlowStatus.NOT_CONVERGED),
        (~found.converged, FlowStatus.DISSIMILAR),
    )
    conditions, codes = zip(*reasons, strict=True)
    status = jnp.select(
        conditions, [jnp.full(usable.shape, code, jnp.int32) for code in codes], jnp.int32(FlowStatus.OK)
    )
    unsearched = lax.stop_gradient(jnp.where(jnp.isfinite(guess), guess, 0))
    position = jnp.where(usable[None, :], found.positions, unsearched)
    measures = (
        jnp.where(usable & jnp.isfinite(array), array, 0) for array in (end.residual, end.correlation, end.texture)
    )
    return Flow(position, status, *measures)


@checked
def lk_flow_forward_backward(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels | None = None,
    mask: Mask | None = None,
    *,
    max_return_px: Scalar | float = 1.0,
    expected_px: Scalar | float = 0.0,
    plan: FlowPlan = DEFAULT_PLAN,
    min_texture: Scalar | float = 1.0,
    min_correlation: Scalar | float = MIN_CORRELATION,
) -> Flow:
    """`lk_flow`, and back again: a point that does not return to within `max_return_px` is `INCONSISTENT`.

    Source: Kalal, Mikolajczyk, Matas, Forward-Backward Error, ICPR 2010. The way back starts from the forward result
    moved by the reversed guess, so that it does not know where it should arrive. A point found within `expected_px` of
    its guess is taken without a way back. Other arguments as for `lk_flow`.
    """
    track = partial(lk_flow, plan=plan, min_texture=min_texture, min_correlation=min_correlation)
    forward = track(previous, current, points, guess, mask)
    moved = jnp.zeros_like(points) if guess is None else points - guess
    arrived = lax.stop_gradient(forward.points)
    off = jnp.sum(jnp.square(arrived - points + moved), axis=0)
    unsure = forward.ok & ~(off < jnp.square(expected_px))
    back = track(current, previous, arrived, arrived + moved, unsure)
    distance = jnp.sum(jnp.square(back.points - points), axis=0)
    returned = back.ok & (distance < max_return_px**2)
    status = jnp.where(unsure & ~returned, FlowStatus.INCONSISTENT, forward.status)
    return forward._replace(status=status)


class _Inputs(NamedTuple):
    previous: Pyramid
    current: Pyramid
    points: Pixels
    guess: Pixels
    usable: Mask
    min_texture: Scalar
    min_correlation: Scalar


class _End(NamedTuple):
    residual: Float[Array, " n"]
    correlation: Float[Array, " n"]
    texture: Float[Array, " n"]
    last_step: Float[Array, " n"]


def _solve(inputs: _Inputs, *, plan: FlowPlan) -> ConvergedPositions:
    how = {"settle": settle_in_rows} if plan.along_rows else {}
    end = search(*inputs[:-1], plan=plan, **how)
    tracked = inputs.usable & (end.texture > inputs.min_texture) & (end.last_step < plan.finest.accepted**2)
    tracked &= _inside(end.position, inputs.current) & (end.correlation > inputs.min_correlation)
    return ConvergedPositions(end.position, tracked, _End(end.residual, end.correlation, end.texture, end.last_step))


def _explain(position: Pixels, inputs: _Inputs, *, plan: FlowPlan) -> tuple[Pixels, _End]:
    """The slope of half the squared difference at the finest level, zero where the search ends, and the measures."""
    window, border = Window(plan.finest.window), inputs.previous.border
    template = make_template(inputs.previous.levels[0], inputs.points, border, window, plan)
    sight = look(position, inputs.current.levels[0], border, window)
    slope = jnp.einsum("nkl,nl->kn", template.gradient, difference(sight, template.patch, window))
    if plan.along_rows:
        slope = slope.at[1].set(position[1] - inputs.points[1])
    return slope, _End(*likeness(sight, template.patch, window), template.texture, jnp.zeros_like(position[0]))


def _check(previous: Pyramid, current: Pyramid, plan: FlowPlan) -> None:
    sizes = [[level.shape for level in pyramid.levels] for pyramid in (previous, current)]
    if sizes[0] != sizes[1] or previous.border != current.border:
        raise ValueError(f"pyramids of the same levels and border expected, got levels of {sizes[0]} and {sizes[1]}")
    used = [plan.level(level, len(sizes[0])) for level in range(len(sizes[0]))]
    needed = max(Window(level.window).border for level in used) + (MORE_BORDER if plan.along_rows else 0)
    if previous.border < needed:
        raise ValueError(f"border: at least {needed} pixels needed by this plan, got {previous.border}")


def _inside(position: Pixels, pyramid: Pyramid) -> Mask:
    height, width = pyramid.size()
    u, v = position
    return (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
