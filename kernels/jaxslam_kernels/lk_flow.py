"""Pyramidal Lucas-Kanade optical flow for many points at once, differentiable; the search itself is in `lk_search`."""

import enum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxslam_kernels._patches import Window
from jaxslam_kernels.image import Pyramid
from jaxslam_kernels.lk_search import (
    FlowPlan,
    LevelPlan,
    Solution,
    difference,
    look,
    make_template,
    mean_absolute,
    search,
)
from jaxslam_kernels.types import Mask, Pixels, Scalar

__all__ = ["Flow", "FlowPlan", "FlowStatus", "LevelPlan", "lk_flow", "lk_flow_forward_backward"]

DEFAULT_PLAN = FlowPlan()
_CONVERGED_PX = 0.1


class FlowStatus(enum.IntEnum):
    """What became of a point."""

    OK = 0
    MASKED = 1
    OUTSIDE = 2
    """It starts or ends outside the image."""
    NO_TEXTURE = 3
    """Its window has too little gradient in some direction."""
    NOT_CONVERGED = 4
    """The last step was still larger than a tenth of a pixel."""
    BAD_INPUT = 5
    """A coordinate, or a pixel near it, was not a number."""
    INCONSISTENT = 6
    """Tracked back, it does not return to where it came from."""


class Flow(NamedTuple):
    """Where points went.

    Attributes:
        points: `(2, n)` positions in the current image; finite always, meaningful where `status` is `OK`.
        status: `(n,)` a `FlowStatus` a point.
        residual: `(n,)` mean absolute difference of intensity over the window at the end.
        texture: `(n,)` smaller eigenvalue of the mean gradient matrix, in squared intensity per squared pixel.
    """

    points: Pixels
    status: Int[Array, " n"]
    residual: Float[Array, " n"]
    texture: Float[Array, " n"]

    @property
    def ok(self) -> Mask:
        """Which points were tracked."""
        return self.status == FlowStatus.OK


def lk_flow(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels | None = None,
    mask: Mask | None = None,
    *,
    plan: FlowPlan = DEFAULT_PLAN,
    min_texture: Scalar | float = 1.0,
) -> Flow:
    """Track points from one image to the next.

    Differentiable in both images and in `points`, forward and reverse, by the implicit function theorem at the
    solution (not through the iterations, so the guess has no influence). The derivative of a point that was not
    tracked is zero.

    Args:
        previous: Pyramid of the image the points are in; its border at least half the largest window plus 6.
        current: Pyramid of the image they are searched in, of the same sizes.
        points: `(2, n)` pixel coordinates in the previous image.
        guess: `(2, n)` where to start the search in the current image; `points` if not given.
        mask: `(n,)` which points to track; all if not given.
        plan: Windows and iterations, static.
        min_texture: Smallest accepted eigenvalue of the mean gradient matrix, in squared intensity a squared pixel;
            positive.

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
    threshold = jnp.asarray(min_texture, points.dtype)
    solution = _solve(previous, current, held, start, usable, threshold, plan)
    reasons = (
        (~wanted, FlowStatus.MASKED),
        (~finite | ~jnp.isfinite(solution.last_step) | ~jnp.isfinite(solution.texture), FlowStatus.BAD_INPUT),
        (~usable | ~_inside(solution.position, current), FlowStatus.OUTSIDE),
        (~(solution.texture > threshold), FlowStatus.NO_TEXTURE),
        (~(solution.last_step < _CONVERGED_PX**2), FlowStatus.NOT_CONVERGED),
    )
    conditions, codes = zip(*reasons, strict=True)
    status = jnp.select(conditions, [jnp.full(usable.shape, code, jnp.int32) for code in codes], FlowStatus.OK)
    unsearched = lax.stop_gradient(jnp.where(jnp.isfinite(guess), guess, 0))
    position = jnp.where(usable[None, :], solution.position, unsearched)
    residual, texture = (
        jnp.where(usable & jnp.isfinite(array), array, 0) for array in (solution.residual, solution.texture)
    )
    return Flow(position, status, residual, texture)


def lk_flow_forward_backward(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels | None = None,
    mask: Mask | None = None,
    *,
    max_return_px: Scalar | float = 1.0,
    plan: FlowPlan = DEFAULT_PLAN,
    min_texture: Scalar | float = 1.0,
) -> Flow:
    """`lk_flow`, and back again: a point that does not return to within `max_return_px` is `INCONSISTENT`.

    Source: Kalal, Mikolajczyk, Matas, Forward-Backward Error, ICPR 2010. The way back starts from the forward result
    moved by the reversed guess, so that it does not know where it should arrive. Arguments as for `lk_flow`.
    """
    forward = lk_flow(previous, current, points, guess, mask, plan=plan, min_texture=min_texture)
    moved = jnp.zeros_like(points) if guess is None else points - guess
    arrived = lax.stop_gradient(forward.points)
    back = lk_flow(current, previous, arrived, arrived + moved, forward.ok, plan=plan, min_texture=min_texture)
    distance = jnp.sum(jnp.square(back.points - points), axis=0)
    returned = back.ok & (distance < max_return_px**2)
    status = jnp.where(forward.ok & ~returned, FlowStatus.INCONSISTENT, forward.status)
    return forward._replace(status=status)


@partial(jax.custom_jvp, nondiff_argnums=(6,))
def _solve(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels,
    usable: Mask,
    min_texture: Scalar,
    plan: FlowPlan,
) -> Solution:
    return search(previous, current, points, guess, usable, min_texture, plan=plan)


@_solve.defjvp
def _solve_jvp(plan: FlowPlan, primals: tuple, tangents: tuple) -> tuple[Solution, Solution]:
    """Implicit function theorem at the solution, where the slope of the squared difference is zero.

    Points that were not tracked have no such solution: their derivative is zero. That of the others holds at pixels
    with a finite value, so the rest may as well be zero.
    """
    previous, current, points, guess, usable, min_texture = primals
    solution = _solve(previous, current, points, guess, usable, min_texture, plan)
    tracked = usable & (solution.texture > min_texture) & (solution.last_step < _CONVERGED_PX**2)
    tracked &= _inside(solution.position, current)

    finite = lambda array: jnp.where(jnp.isfinite(array), array, 0)
    inputs = (jax.tree.map(finite, previous), jax.tree.map(finite, current), points)
    at = partial(_at_solution, window=Window(plan.finest.window))
    by_position = lambda position: at(*inputs, position)
    columns = [
        jax.jvp(by_position, (solution.position,), (jnp.zeros_like(points).at[axis].set(1),))[1] for axis in range(2)
    ]
    (uu, vu), (uv, vv) = (column.slope for column in columns)
    by_inputs = lambda previous, current, points: at(previous, current, points, solution.position)
    change = jax.jvp(by_inputs, inputs, tangents[:3])[1]

    determinant = uu * vv - uv * vu
    magnitude = jnp.square(uu) + jnp.square(uv) + jnp.square(vu) + jnp.square(vv)
    regular = tracked & (jnp.abs(determinant) > 10 * jnp.finfo(points.dtype).eps * magnitude)
    inverse = jnp.where(regular, 1 / jnp.where(regular, determinant, 1), 0)
    u, v = change.slope
    d_position = -inverse[None, :] * jnp.stack([vv * u - uv * v, uu * v - vu * u])
    d_residual = change.residual + sum(column.residual * d for column, d in zip(columns, d_position, strict=True))
    keep = lambda array: jnp.where(regular, array, 0)
    tangent = Solution(d_position, jnp.zeros_like(solution.last_step), keep(d_residual), keep(change.texture))
    return solution, tangent


class _AtSolution(NamedTuple):
    slope: Pixels
    residual: Float[Array, " n"]
    texture: Float[Array, " n"]


def _at_solution(previous: Pyramid, current: Pyramid, points: Pixels, position: Pixels, window: Window) -> _AtSolution:
    """What the solution is defined by, as a plain function to differentiate.

    The slope of half the squared difference at the finest level (zero at a solution), the residual, and the texture.
    """
    border = previous.border
    template = make_template(previous.levels[0], points, border, window, once=lambda compute: compute())
    error = difference(look(position, current.levels[0], border, window), template.patch, window)
    slope = jnp.einsum("nkl,nl->kn", template.gradient, error)
    return _AtSolution(slope, mean_absolute(error, window), template.texture)


def _check(previous: Pyramid, current: Pyramid, plan: FlowPlan) -> None:
    sizes = [[level.shape for level in pyramid.levels] for pyramid in (previous, current)]
    if sizes[0] != sizes[1] or previous.border != current.border:
        raise ValueError(f"pyramids of the same levels and border expected, got levels of {sizes[0]} and {sizes[1]}")
    used = [plan.level(level, len(sizes[0])) for level in range(len(sizes[0]))]
    needed = max(Window(level.window).border for level in used)
    if previous.border < needed:
        raise ValueError(f"border: at least {needed} pixels needed by this plan, got {previous.border}")


def _inside(position: Pixels, pyramid: Pyramid) -> Mask:
    height, width = pyramid.size()
    u, v = position
    return (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
