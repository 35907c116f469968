"""The search of `lk_flow` for points that move along their row, as from left to right in a rectified pair.

A point that stays in its row always sees the same rows, at the same fraction between them. What its template's gradient
sums up to over the current image is then a function of one number, straight between whole columns: it is computed for
all columns in reach at once, and the Gauss-Newton steps of `lk_search` are a few numbers a point. They end where those
do. On a pair of KITTI, 417 points there and back, it takes 2.0 ms instead of 3.4.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxslam_kernels import _patches as patches
from jaxslam_kernels._patches import Window
from jaxslam_kernels.image import Pyramid
from jaxslam_kernels.lk_search import (
    FlowPlan,
    LevelPlan,
    Solution,
    Template,
    difference,
    in_chunks,
    look,
    make_template,
    mean_absolute,
    move_inside,
)
from jaxslam_kernels.types import Mask, Pixels, Scalar, Weights

_REACH, _NEXT_REACH = 6, 3
"""Whole columns on either side of the guess that are looked at: on the coarsest level as far as a window of 11 is
drawn; the guess it gives to the next is good to a pixel or two."""
MORE_BORDER = _REACH - 3
"""Padding that images need beyond `Window.border`, for windows around all these columns."""


class _Slopes(NamedTuple):
    """Sums of template gradients over the current image, at whole columns.

    Attributes:
        of_column: `(k, n)` of the windows around columns from `first` on.
        first: `(n,)` column.
        of_template: `(n,)` over the template itself: they are equal where the search ends.
    """

    of_column: Float[Array, "k n"]
    first: Weights
    of_template: Weights


class _Search(NamedTuple):
    """Where points are in their rows, how far squared they last moved, and which still move."""

    u: Weights
    last_step: Weights
    active: Mask


def search_rows(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels,
    usable: Mask,
    min_texture: Scalar,
    *,
    plan: FlowPlan,
) -> Solution:
    """Search all points along their rows; as `lk_search.search`, and one of a batch after the other as there."""

    @jax.custom_batching.sequential_vmap
    def search_all(previous, current, points, guess, usable, min_texture):
        chunk = partial(_search_chunk, previous=previous, current=current, plan=plan, min_texture=min_texture)
        return in_chunks(chunk, (points, guess, usable), usable, plan.chunk)

    return search_all(previous, current, points, guess, usable, min_texture)


def _search_chunk(
    points: Pixels,
    guess: Pixels,
    usable: Mask,
    *,
    previous: Pyramid,
    current: Pyramid,
    plan: FlowPlan,
    min_texture: Scalar,
) -> Solution:
    """Search one chunk of finite points, from the coarsest level to the finest."""
    num_levels, border = len(previous.levels), previous.border
    once = partial(patches.at_once, alive=jnp.all(jnp.isfinite(points)))

    def search_level(level: int, shift: Weights) -> tuple[_Search, Template, Weights]:
        level_plan = plan.level(level, num_levels)
        window = Window(level_plan.window)
        start = points / 2**level
        if level > 0:
            flow = jnp.stack([shift, jnp.zeros_like(shift)])
            start = move_inside(start, flow, previous.levels[level], border, window)
        template = make_template(previous.levels[level], start, border, window, once, along_rows=True)
        begin, picture = start.at[0].add(shift), current.levels[level]
        reach = _REACH if level == num_levels - 1 else _NEXT_REACH
        slopes = once(lambda: _slopes(template, begin, picture, border, window, reach))
        active = usable & (template.texture > min_texture)
        found = _iterate(begin[0], active, slopes, template.inverse[0], picture, border, level_plan)
        return found, template, found.u - start[0]

    shift = (guess[0] - points[0]) / 2**num_levels
    for level in range(num_levels - 1, 0, -1):
        shift = search_level(level, 2 * shift)[2]
    found, template, _ = search_level(0, 2 * shift)
    window, position = Window(plan.finest.window), points.at[0].set(found.u)
    sight = once(lambda: look(position, current.levels[0], border, window))
    residual = mean_absolute(difference(sight, template.patch, window), window)
    return Solution(position, found.last_step, residual, template.texture)


def _slopes(
    template: Template, position: Pixels, level: Float[Array, "h w"], border: int, window: Window, reach: int
) -> _Slopes:
    """What the template gradients sum up to around `position`, in its row."""
    side, num = window.side, 2 * reach + 2
    corner, fraction = patches.corner(patches.hold(position, level, border), border, window.half)
    strips = patches.cut(level, corner - jnp.array([[reach], [0]], corner.dtype), side + 1, side + num - 1)
    rows = strips[:, :-1] + fraction[1][:, None, None] * (strips[:, 1:] - strips[:, :-1])
    gradient = template.gradient[:, 0].reshape(-1, side, window.stride)

    # 0.16 ms for 512 points, 8 columns; as matrix products, or with points last so that all are vectors, 0.43; as one
    # product of vectors a column 0.97.
    def add_row(row: Int[Array, ""], sums: Float[Array, "n k"]) -> Float[Array, "n k"]:
        weight, strip = (lax.dynamic_index_in_dim(array, row, 1, keepdims=False) for array in (gradient, rows))
        for column in range(side):
            sums = sums + weight[:, column : column + 1] * strip[:, column : column + num]
        return sums

    of_column = lax.fori_loop(0, side, add_row, jnp.zeros((len(strips), num), strips.dtype))
    of_template = jnp.einsum("nl,nl->n", template.gradient[:, 0], template.patch)
    first = (corner[0] + (window.half - border - reach)).astype(fraction.dtype)
    return _Slopes(of_column.T, first, of_template)


def _iterate(
    begin: Weights,
    active: Mask,
    slopes: _Slopes,
    inverse: Weights,
    level: Float[Array, "h w"],
    border: int,
    plan: LevelPlan,
) -> _Search:
    """Step every active point until none is left or the plan's iterations are used up.

    One that leaves the columns in reach stops at the last of them, and has not been found.
    """
    low, high = (bound[0, 0] for bound in patches.bounds(level, border))
    columns = jnp.arange(slopes.of_column.shape[0], dtype=begin.dtype)[:, None]

    def body(carry: tuple[_Search, Array]) -> tuple[_Search, Array]:
        search, count = carry
        along = jnp.clip(search.u, low - 2, high + 2) - slopes.first
        part = 1 - jnp.abs(along[None, :] - columns)
        slope = jnp.sum(jnp.where(part > 0, part * slopes.of_column, 0), axis=0) - slopes.of_template
        step = -inverse * slope
        length = jnp.square(step)
        # A step that is not a number (a pixel is not) ends the search of its point where it stands.
        moves = search.active & jnp.isfinite(length)
        u = search.u + jnp.where(moves, step, 0)
        held = jnp.clip(u, slopes.first, slopes.first + (len(columns) - 1))
        last_step = jnp.where(search.active, jnp.where(held == u, length, jnp.inf), search.last_step)
        return _Search(held, last_step, moves & (held == u) & (length > plan.tolerance**2)), count + 1

    def going(carry: tuple[_Search, Array]) -> Array:
        search, count = carry
        return (count < plan.iterations) & jnp.any(search.active)

    start = _Search(begin, jnp.zeros_like(begin), active)
    return lax.while_loop(going, body, (start, jnp.zeros((), jnp.int32)))[0]
