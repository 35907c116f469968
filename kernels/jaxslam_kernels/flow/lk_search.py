"""The search of pyramidal Lucas-Kanade optical flow: templates, steps, levels, chunks. `lk_flow` is its public face.

The forward-additive scheme of Bouguet, "Pyramidal Implementation of the Lucas Kanade Feature Tracker" (Intel, 2000),
which OpenCV implements too: template and its gradients from the previous image, one 2x2 system a point and level,
iterated until the step is below a tolerance. As in OpenCV, pixels of a template outside the image do not count. Unlike
there, a change of brightness over the whole window does not either, unless the plan says so.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxslam_kernels.image import patches
from jaxslam_kernels.image.patches import Window
from jaxslam_kernels.image.pyramid import Pyramid
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import masked_median
from jaxslam_kernels.types import Flag, Mask, Pixels, Scalar

_NEAR_PX = 2.0
"""How far from its start a point may be found at the finest level alone, and `_WORST_FIT` the largest residual it may
have there, as a multiple of the seeds' median. The window draws from further, but what moves unlike its seed is then
found where it fits badly: more than half a pixel off are, in a room with two people and in Bonn `crowd`, 0.43 and
0.56 % of the points with 3 px and 32 seeds, 0.05 and 0.35 % with 2 px, 64 seeds and the largest residual."""
_WORST_FIT = 2.0
_PLENTY = 4
"""How many times the number of seeds is enough points to search the others near them. Fewer are all searched from the
coarsest level: in Bonn `crowd` the tracker loses its place in front of people who leave it ever fewer points."""


class LevelPlan(NamedTuple):
    """Settings of the search on one pyramid level; static.

    Attributes:
        window: Side of the window in pixels, odd.
        iterations: Most steps a point may take.
        tolerance: A point is done when its step is shorter than this, in pixels of the level.
        accepted: A point whose last step was longer than this has not been found; it matters where the result is
            one. A few searches go round in circles, of up to a tenth of a pixel, in the bends of bilinear
            interpolation: their result is good enough to track with, but no smooth function of the images.
    """

    window: int
    iterations: int
    tolerance: float
    accepted: float = 0.1


class FlowPlan(NamedTuple):
    """Settings of optical flow; static.

    A large motion is found at the coarsest level, which therefore has the full window and many steps; the levels
    between only carry its result down, and a smaller window serves them as well. Measured against
    `cv2.calcOpticalFlowPyrLK` (21x21, 10 iterations, 0.03 pixels) on 1000 corners of a 640x480 picture and twelve known
    warps of 5 to 25 pixels: share within one pixel 0.990 (OpenCV 0.987), median error 0.106 pixels (0.106), 0.7 of the
    time with both pyramids, each library on one thread.

    Rejected, on another picture (0.974; OpenCV 0.966): windows that leave the image at coarse levels, 0.969 and 1.15
    times the time; the full window between, 0.970 and 1.25 times; a window of 13 at the coarsest, 0.970, and 0.93
    instead of 0.97 for motions of 30 to 60 pixels; more iterations there, no gain; going on in a smaller array with
    the points that have not converged, no gain over early stopping in small chunks; Broyden updates of the 2x2
    systems, no fewer steps.

    Attributes:
        coarsest: Plan of the smallest level.
        middle: Plan of all levels between.
        finest: Plan of the image itself.
        chunk: Points searched together; the search stops when all of them are done. It also bounds memory: XLA's
            buffers for 1000 points at once are 52 MB, and freshly mapped memory of that size costs 25 ms a call in
            page faults alone.
        ignores_brightness: Whether what the two images differ by in brightness over a window does not count. Under a
            flickering lamp in a rendered room, points are 0.042 instead of 0.074 pixels off in the median; while the
            exposure falls to a third within five frames, 99 instead of 90 % are found. The errors of trajectories
            are smaller by 13 % (geometric mean of eight recordings with depth, five of them rendered, ten seeds each).
            Not so for stereo along a road: 37.7 instead of 30.7 mm in KITTI 06 (medians of 40 seeds), and no smaller in
            five parts of rendered streets.
        along_rows: Whether points only move along their row, as from left to right in a rectified pair. Brightness
            does not count there: two cameras expose apart.
        seeds: Number of points that are searched from the coarsest level; 0 for all, and all are if there are at most
            `_PLENTY` times as many. The others begin at the finest where the nearest seed has moved, and at the
            coarsest if they do not fit well within `_NEAR_PX` of there. A handheld camera leaves the prediction by 4.5
            pixels in the median, but nearly all points by the same (fr1_rpy): with 64 seeds, live at 30 Hz, a frame has
            0.86 of ORB-SLAM3's median time instead of 0.91, and 0.77 of its processor time instead of 0.80 (five runs
            in turn, AMD EPYC). Along a road, neighbors at other depths move far apart: with 3 px and 32 seeds, KITTI 06
            has 38 mm instead of 34 (medians of 30 seeds).
    """

    coarsest: LevelPlan = LevelPlan(21, 12, 0.2)
    middle: LevelPlan = LevelPlan(11, 5, 0.2)
    finest: LevelPlan = LevelPlan(21, 6, 0.03)
    chunk: int = 32
    ignores_brightness: bool = True
    along_rows: bool = False
    seeds: int = 0

    def level(self, level: int, num_levels: int) -> LevelPlan:
        """The plan of a level, 0 the finest."""
        if level == 0:
            return self.finest
        return self.coarsest if level == num_levels - 1 else self.middle


class Template(NamedTuple):
    """Template of each point from the previous image.

    Attributes:
        patch: Intensities over the window.
        gradient: Their derivatives along `u` and `v`, of mean 0 if brightness does not count; zero where a pixel does
            not.
        inverse: `a, b, c` of the symmetric inverse `[[a, b], [b, c]]` of the gradient matrix.
        texture: Smaller eigenvalue of the mean matrix of these gradients; along rows, its first entry.
    """

    patch: Float[Array, "n l"]
    gradient: Float[Array, "n 2 l"]
    inverse: Float[Array, "3 n"]
    texture: Float[Array, " n"]


class Sight(NamedTuple):
    """Patches of the current image, and how far right of and below their corner each point is."""

    cut: Float[Array, "n r c"]
    fraction: Pixels


class Solution(NamedTuple):
    """Result of the search.

    Attributes:
        position: `(2, n)` in the current image.
        last_step: `(n,)` squared length of the last step at the finest level; not finite where a pixel was not.
        residual: `(n,)` mean absolute difference over the window, from its mean.
        correlation: `(n,)` correlation of the window with the template.
        texture: `(n,)` texture of the template at the finest level.
    """

    position: Pixels
    last_step: Float[Array, " n"]
    residual: Float[Array, " n"]
    correlation: Float[Array, " n"]
    texture: Float[Array, " n"]


class Search(NamedTuple):
    """Positions of points, squared length of their last step, and which points still move."""

    position: Pixels
    last_step: Float[Array, " n"]
    active: Mask


def make_template(
    level: Float[Array, "h w"],
    position: Pixels,
    border: int,
    window: Window,
    plan: FlowPlan,
) -> Template:
    """The templates around `position`."""
    corner, fraction = patches.corner(position, border, window.half + 1)
    stride, length = window.stride, window.length
    cut = patches.flattened(apart(lambda: patches.cut(level, corner, window.side + 4, stride)))
    smooth = apart(lambda: patches.bilinear(cut, fraction, stride, length + 2 * stride + 2))
    counts = patches.in_image(position, level, border, window).astype(smooth.dtype)
    gradient = apart(lambda: patches.gradients(smooth, window) * counts[:, None, :])
    if plan.ignores_brightness or plan.along_rows:
        gradient = _without_mean(gradient, counts)
    patch = smooth[:, stride + 1 : stride + 1 + length]
    return _row_template(patch, gradient[:, 0], window) if plan.along_rows else template_with(patch, gradient, window)


def _without_mean(gradient: Float[Array, "n 2 l"], counts: Float[Array, "n l"]) -> Float[Array, "n 2 l"]:
    """Subtract from the gradients of pixels that count their mean, so that steps do not depend on brightness.

    What a change of brightness over the whole window would explain is no motion (Hager and Belhumeur, Efficient Region
    Tracking With Parametric Models of Geometry and Illumination, 1998; here for an offset alone). Taking out a change
    of contrast as well gains nothing more, and loses 6 % in one of six worlds.
    """
    mean = jnp.sum(gradient, axis=2) / jnp.maximum(jnp.sum(counts, axis=1), 1)[:, None]
    return apart(lambda: gradient - mean[:, :, None] * counts[:, None, :])


def _row_template(patch: Float[Array, "n l"], along: Float[Array, "n l"], window: Window) -> Template:
    """The templates of points that move along their row."""
    squared = jnp.einsum("nl,nl->n", along, along)
    nothing = jnp.zeros_like(squared)
    return Template(
        patch=patch,
        gradient=jnp.stack([along, jnp.zeros_like(along)], axis=1),
        inverse=jnp.stack([1 / jnp.where(squared > 0, squared, 1), nothing, nothing]),
        texture=squared / window.side**2,
    )


def template_with(patch: Float[Array, "n l"], gradient: Float[Array, "n 2 l"], window: Window) -> Template:
    """The templates of flat patches with gradients that are zero where a pixel does not count."""
    (xx, xy), (_, yy) = (jnp.einsum("nkl,nl->kn", gradient, gradient[:, axis]) for axis in range(2))
    spread = jnp.sqrt(jnp.square(xx - yy) + 4 * jnp.square(xy) + jnp.finfo(xx.dtype).tiny)
    determinant = xx * yy - xy * xy
    safe = jnp.where(determinant > 0, determinant, jnp.ones_like(determinant))
    return Template(
        patch=patch,
        gradient=gradient,
        inverse=jnp.stack([yy, -xy, xx]) / safe[None, :],
        texture=(xx + yy - spread) / (2 * window.side**2),
    )


def look(position: Pixels, level: Float[Array, "h w"], border: int, window: Window) -> Sight:
    """The patches of the current image around `position`, held inside the padded level."""
    corner, fraction = patches.corner(patches.hold(position, level, border), border, window.half)
    return Sight(patches.cut(level, corner, window.side + 2, window.stride), fraction)


def seen(sight: Sight, window: Window) -> Float[Array, "n l"]:
    """Current intensities over the window; columns past it hold something, but have no gradient."""
    return patches.bilinear(patches.flattened(sight.cut), sight.fraction, window.stride, window.length)


def difference(sight: Sight, patch: Float[Array, "n l"], window: Window) -> Float[Array, "n l"]:
    """Current minus previous intensity over the window."""
    return seen(sight, window) - patch


def likeness(sight: Sight, patch: Float[Array, "n l"], window: Window) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Compare the window in the current image with the template, whatever their brightness.

    Returns:
        Mean absolute difference from the mean difference, and correlation: 0 if one of the windows is uniform.
    """
    share = window.columns().astype(patch.dtype) / window.side**2
    current = apart(lambda: seen(sight, window))
    mean_current, mean_patch = (jnp.einsum("nl,l->n", values, share)[:, None] for values in (current, patch))

    def products() -> Float[Array, "4 n l"]:
        here, there = current - mean_current, patch - mean_patch
        return jnp.stack([here * there, jnp.square(here), jnp.square(there), jnp.abs(here - there)])

    # In one loop: 0.4 ms for 640 points; the mean difference alone takes 0.2, each product by itself 0.6.
    together, here, there, residual = jnp.einsum("knl,l->kn", apart(products), share)
    return residual, together / jnp.sqrt(jnp.maximum(here * there, jnp.finfo(patch.dtype).tiny))


def _step(sight: Sight, template: Template, window: Window) -> Pixels:
    """The Gauss-Newton step of every point."""
    slope = jnp.einsum("nkl,nl->nk", template.gradient, difference(sight, template.patch, window))
    a, b, c = template.inverse
    return -jnp.stack([a * slope[:, 0] + b * slope[:, 1], b * slope[:, 0] + c * slope[:, 1]])


def iterate(search: Search, template: Template, level: Float[Array, "h w"], border: int, plan: LevelPlan) -> Search:
    """Step every active point until none is left or the plan's iterations are used up."""
    window = Window(plan.window)

    def body(carry):
        search, sight, count = carry
        step = _step(sight, template, window)
        length = jnp.sum(jnp.square(step), axis=0)
        # A step that is not a number (a pixel is not) ends the search of its point where it stands.
        moves = search.active & jnp.isfinite(length)
        position = search.position + jnp.where(moves[None, :], step, 0)
        last_step = jnp.where(search.active, length, search.last_step)
        # The next patch is part of the carry, not of the next iteration: XLA would cut it again for each of its uses.
        sight = look(position, level, border, window)
        return Search(position, last_step, moves & (length > plan.tolerance**2)), sight, count + 1

    def going(carry):
        search, _, count = carry
        return (count < plan.iterations) & jnp.any(search.active)

    start = (search, look(search.position, level, border, window), jnp.zeros((), jnp.int32))
    return lax.while_loop(going, body, start)[0]


def _move_inside(position: Pixels, flow: Pixels, level: Float[Array, "h w"], border: int, window: Window) -> Pixels:
    """The nearest positions whose windows, there and at `position + flow`, lie in the image.

    A coarse level gives no more than a guess to the next, and that of a neighbor with a whole window is better than
    a point's own with half a window.
    """
    low, high = patches.bounds(level, border)
    margin = jnp.minimum(window.half, high / 2)
    low, high = low + margin, high - margin
    lowest = jnp.minimum(low - jnp.minimum(flow, 0), high)
    highest = jnp.maximum(high - jnp.maximum(flow, 0), low)
    return jnp.clip(position, lowest, highest)


def _search_chunk(
    points: Pixels,
    guess: Pixels,
    usable: Mask,
    *,
    previous: Pyramid,
    current: Pyramid,
    plan: FlowPlan,
    min_texture: Scalar,
    settle: Callable[..., Search],
    from_coarsest: Flag | None = None,
) -> Solution:
    """Search one chunk of finite points from the coarsest level to the finest, or at the finest alone by a flag."""
    num_levels, border = len(previous.levels), previous.border

    def search_level(level: int, flow: Pixels) -> tuple[Search, Template, Pixels]:
        level_plan = plan.level(level, num_levels)
        window = Window(level_plan.window)
        start = points / 2**level
        if level > 0:
            start = _move_inside(start, flow, previous.levels[level], border, window)
        template = make_template(previous.levels[level], start, border, window, plan)
        active = usable & (template.texture > min_texture)
        search = Search(start + flow, jnp.zeros_like(points[0]), active)
        coarsest = level == num_levels - 1
        search = settle(search, template, current.levels[level], border, level_plan, coarsest=coarsest)
        return search, template, search.position - start

    def coarse_flow() -> Pixels:
        flow = (guess - points) / 2**num_levels
        for level in range(num_levels - 1, 0, -1):
            flow = search_level(level, 2 * flow)[2]
        return 2 * flow

    flow = coarse_flow() if from_coarsest is None else lax.cond(from_coarsest, coarse_flow, lambda: guess - points)
    search, template, _ = search_level(0, flow)
    window = Window(plan.finest.window)
    sight = apart(lambda: look(search.position, current.levels[0], border, window))
    residual, correlation = likeness(sight, template.patch, window)
    return Solution(search.position, search.last_step, residual, correlation, template.texture)


def in_chunks(function: Callable[..., Any], arrays: tuple[Array, ...], wanted: Mask, chunk: int) -> Any:
    """Apply a function of arrays whose last axis is points to the wanted points, `chunk` after the other.

    Wanted points come first, and chunks without any are left out: a slot without a point costs nothing. What the
    function gives for other points is not to be used; it may be zeros.
    """
    n = wanted.shape[0]
    if n <= chunk:
        return function(*arrays)
    count = -(-n // chunk)
    # By counting: sorting the mask takes 34 us for 512 points, this 2.
    index, rank = jnp.arange(n, dtype=jnp.int32), jnp.cumsum(wanted, dtype=jnp.int32)
    place = jnp.where(wanted, rank - 1, rank[-1] + index - rank)
    order = jnp.zeros_like(place).at[place].set(index, unique_indices=True)

    def split(array: Array) -> Array:
        padded = jnp.pad(jnp.take(array, order, axis=-1), [(0, 0)] * (array.ndim - 1) + [(0, count * chunk - n)])
        return jnp.moveaxis(padded.reshape(*array.shape[:-1], count, chunk), -2, 0)

    def join(array: Array) -> Array:
        joined = jnp.moveaxis(array, 0, -2).reshape(*array.shape[1:-1], count * chunk)
        return jnp.take(joined, place, axis=-1)

    def one(chunked: tuple[Array, ...]) -> Any:
        compute = partial(function, *chunked[:-1])
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(compute))
        return lax.cond(jnp.any(chunked[-1]), compute, lambda: nothing)

    return jax.tree.map(join, lax.map(one, tuple(map(split, (*arrays, wanted)))))


def _search_from_seeds(
    chunk: Callable[..., Solution], points: Pixels, guess: Pixels, usable: Mask, plan: FlowPlan
) -> Solution:
    """Search seeds from the coarsest level, the others near where the seeds have moved, and what is left as the seeds.

    The three passes are one loop, so that the search is compiled once.
    """
    plenty = jnp.sum(usable, dtype=jnp.int32) > _PLENTY * plan.seeds
    is_seed = jnp.where(plenty, _evenly_chosen(usable, plan.seeds), usable)
    far_chunk = partial(chunk, from_coarsest=jnp.array(True))
    shapes = jax.eval_shape(lambda: in_chunks(far_chunk, (points, guess, usable), usable, plan.chunk))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def search_some(carry: tuple[Solution, Mask], is_near: Flag) -> tuple[tuple[Solution, Mask], None]:
        solution, done = carry
        wanted = jnp.where(jnp.any(done), usable & ~done, is_seed)
        shift = lax.cond(
            is_near, lambda: _shift_of_nearest(solution, points, guess, is_seed, plan), lambda: jnp.zeros_like(guess)
        )
        start = guess + shift
        found = in_chunks(partial(chunk, from_coarsest=~is_near), (points, start, wanted), wanted, plan.chunk)
        moved = jnp.sum(jnp.square(found.position - start), axis=0)
        fits = found.residual < _WORST_FIT * masked_median(solution.residual, _found(solution, is_seed, plan))
        is_close = (found.last_step < plan.finest.accepted**2) & (moved < _NEAR_PX**2) & fits
        known = wanted & (is_close | ~is_near)
        return (jax.tree.map(partial(jnp.where, known), found, solution), done | known), None

    passes = jnp.array([False, True, False])
    return lax.scan(search_some, (nothing, jnp.zeros_like(usable)), passes)[0][0]


def _evenly_chosen(mask: Mask, number: int) -> Mask:
    """Choose at most `number` points of a mask, at equal distances in their order."""
    rank = jnp.cumsum(mask, dtype=jnp.int32) - 1
    stride = jnp.maximum((rank[-1] + number) // number, 1)
    return mask & (rank % stride == 0)


def _found(solution: Solution, is_seed: Mask, plan: FlowPlan) -> Mask:
    """Tell which points are seeds that were found."""
    return is_seed & (solution.last_step < plan.finest.accepted**2) & (solution.texture > 0)


def _shift_of_nearest(solution: Solution, points: Pixels, guess: Pixels, is_seed: Mask, plan: FlowPlan) -> Pixels:
    """For each point, the offset from its guess at which the nearest seed was found from its own; 0 if none was."""
    found = _found(solution, is_seed, plan)
    rank = jnp.cumsum(found, dtype=jnp.int32) - 1
    place = jnp.where(found, rank, plan.seeds)
    listed = lambda array: jnp.zeros((2, plan.seeds), array.dtype).at[:, place].set(array, mode="drop")
    at, shift = listed(points), listed(solution.position - guess)
    squared = sum(jnp.square(points[axis][:, None] - at[axis][None, :]) for axis in range(2))
    # Distance and number of a seed in one integer, whose least is found by vector instructions.
    bits = plan.seeds.bit_length()
    number = jnp.arange(plan.seeds, dtype=jnp.int32)
    key = (jnp.minimum(squared, 2.0 ** (30 - bits)).astype(jnp.int32) << bits) | number[None, :]
    key = jnp.where(number[None, :] <= rank[-1], key, jnp.iinfo(jnp.int32).max)
    nearest = jnp.min(key, axis=1) & (2**bits - 1)
    return jnp.where(rank[-1] >= 0, jnp.take(shift, nearest, axis=1, mode="clip"), 0)


def _settle(
    search: Search, template: Template, level: Float[Array, "h w"], border: int, plan: LevelPlan, **_: Any
) -> Search:
    return iterate(search, template, level, border, plan)


def search(
    previous: Pyramid,
    current: Pyramid,
    points: Pixels,
    guess: Pixels,
    usable: Mask,
    min_texture: Scalar,
    *,
    plan: FlowPlan,
    settle: Callable[..., Search] = _settle,
) -> Solution:
    """Search all points; not differentiable, `lk_flow` is. `settle` finds them on one level, from where it begins.

    Under `vmap` the batch is worked off one after the other: chunks fill the vector units already, a batch would only
    wait for its slowest member, and chunks without points would no longer be left out.
    """

    @jax.custom_batching.sequential_vmap
    def search_all(previous, current, points, guess, usable, min_texture):
        fixed = {"previous": previous, "current": current, "plan": plan, "min_texture": min_texture, "settle": settle}
        chunk = partial(_search_chunk, **fixed)
        if 0 < _PLENTY * plan.seeds < points.shape[1]:
            return _search_from_seeds(chunk, points, guess, usable, plan)
        return in_chunks(chunk, (points, guess, usable), usable, plan.chunk)

    return search_all(previous, current, points, guess, usable, min_texture)
