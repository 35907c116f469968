"""Find points of an older picture in the current one, by the patch around them, warped as the pose predicts.

Where `lk_flow` follows a point from frame to frame, this looks a point up again after any time: the patch is cut from
the picture the point was first seen in, warped by the affine map that the relative pose and the depth predict (as PTAM
and SVO do), and aligned by Lucas-Kanade steps on one level, whatever the brightness.
"""

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num

from jaxslam_kernels.checks import checked
from jaxslam_kernels.flow.lk_search import LevelPlan, Search, Template, in_chunks, iterate, look, seen, template_with
from jaxslam_kernels.image import patches
from jaxslam_kernels.image.patches import Window
from jaxslam_kernels.image.pyramid import Pyramid
from jaxslam_kernels.implicit_positions import ConvergedPositions, implicit_positions
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.types import Mask, Pixels, Scalar, Weights

DEFAULT_PLAN = LevelPlan(21, 8, 0.05)
_GAIN_SQUARED = (0.25, 4.0)
"""Smallest and largest."""
_Rows: TypeAlias = tuple[Float[Array, "n l"], Float[Array, "n l"], Float[Array, "n l"]]


class PatchMatch(NamedTuple):
    """Result of patch alignment.

    Attributes:
        points: `(2, n)` pixel coordinates in the current image.
        correlation: `(n,)` zero-mean normalized cross-correlation of the warped patch and what is there, -1 to 1.
        converged: `(n,)` whether the search settled, inside the image and at a correlation above 0.
    """

    points: Pixels
    correlation: Weights
    converged: Mask


@checked
def warped_patches(
    pictures: Num[Array, "k h w"],
    picture: Int[Array, " n"],
    center: Pixels,
    warp: Float[Array, "2 2 n"],
    *,
    side: int,
    stride: int,
) -> tuple[Float[Array, "n l"], Bool[Array, "n l"]]:
    """Patches of `side` rows of `stride` pixels around points, sampled through an affine map, as flat rows.

    Args:
        pictures: `k` pictures of one size.
        picture: `(n,)` which picture each point is in.
        center: `(2, n)` pixel coordinates of the points in their pictures.
        warp: `(2, 2, n)` offset in the picture for an offset in the patch, `[to, from]`.
        side: Rows of the patch, odd, static; its middle row and column `side // 2` is the point.
        stride: Columns of the patch, static.

    Returns:
        `(n, side * stride)` intensities, and which of them lie in the picture; past its edge it repeats. None does
        where `center` or `warp` is not finite.
    """
    height, width = pictures.shape[1:]
    known = _finite(center) & _finite(warp)
    center, warp = _held(center, known), _held(warp, known)
    offset = jnp.arange(side * stride)
    du = (offset % stride - side // 2).astype(center.dtype)[None, :]
    dv = (offset // stride - side // 2).astype(center.dtype)[None, :]
    column = lambda array: array[:, None]
    u = column(center[0]) + column(warp[0, 0]) * du + column(warp[0, 1]) * dv
    v = column(center[1]) + column(warp[1, 0]) * du + column(warp[1, 1]) * dv
    inside = column(known) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    # Held one pixel inside, so that the neighbors right and below exist.
    u, v = jnp.clip(u, 0, width - 1.001), jnp.clip(v, 0, height - 1.001)
    left, top = jnp.floor(u), jnp.floor(v)
    fu, fv = u - left, v - top
    index = (column(picture) * height + top.astype(jnp.int32)) * width + left.astype(jnp.int32)
    flat = pictures.reshape(-1)
    at = lambda shift: jnp.take(flat, index + shift, mode="clip").astype(center.dtype)
    upper, lower = (1 - fu) * at(0) + fu * at(1), (1 - fu) * at(width) + fu * at(width + 1)
    return (1 - fv) * upper + fv * lower, inside


def _finite(array: Float[Array, "... n"]) -> Mask:
    """At which points all numbers are finite."""
    return jnp.all(jnp.isfinite(array), axis=tuple(range(array.ndim - 1)))


def _held(array: Float[Array, "... n"], mask: Mask) -> Float[Array, "... n"]:
    """The array with 0 at points that do not count."""
    return jnp.where(mask.reshape((1,) * (array.ndim - 1) + (-1,)), array, 0)


class _Inputs(NamedTuple):
    pictures: Num[Array, "k h w"]
    picture: Int[Array, " n"]
    center: Pixels
    warp: Float[Array, "2 2 n"]
    guess: Pixels
    mask: Mask
    current: Float[Array, "h w"]
    min_texture: Scalar


def _template(inputs: _Inputs, window: Window, border: int) -> tuple[Template, Float[Array, "n l"]]:
    """The templates, and 1 for each of their pixels that counts, 0 for the others."""
    sample = lambda: warped_patches(
        inputs.pictures, inputs.picture, inputs.center, inputs.warp, side=window.side + 2, stride=window.stride
    )
    smooth, inside = (jnp.pad(array, ((0, 0), (0, 2))) for array in apart(sample))
    counts = (inside[:, _middle(window)] & window.columns()[None, :]).astype(smooth.dtype)
    there = lax.stop_gradient(_there(inputs.guess, inputs, window, border))
    patch, gradient = apart(lambda: _matched(smooth, there, counts, window))
    return template_with(patch, gradient, window), counts


def _middle(window: Window) -> slice:
    """The window in flat patches that have a margin of one pixel."""
    return slice(window.stride + 1, window.stride + 1 + window.length)


def _matched(
    smooth: Float[Array, "n m"], there: Float[Array, "n l"], counts: Float[Array, "n l"], window: Window
) -> tuple[Float[Array, "n l"], Float[Array, "n 2 l"]]:
    """Patches with the mean and the contrast of what is `there`, and gradients that know no brightness.

    The part of a gradient that a change of gain or offset would explain is taken out of it. The solution therefore
    does not depend on how well they are known; otherwise they would be off wherever the guess is, and the result too,
    by a fifth of that.

    Source: Hager and Belhumeur, Efficient Region Tracking With Parametric Models of Geometry and Illumination, 1998.
    """
    rows = _rows(counts, smooth[:, _middle(window)], there)
    area, mean, power = _moments(rows)
    gain = jnp.sqrt(jnp.clip((power[1] + area) / (power[0] + area), *_GAIN_SQUARED))[:, None]
    gradient = patches.gradients(smooth, window) * counts[:, None, :]
    total, along = _products(gradient, rows[0], rows[1])
    share = (along - total * mean[0][:, None]) / jnp.maximum(power[0], 1)[:, None]
    centered = rows[1] - mean[0][:, None] * counts
    free = (
        gradient - (total / area[:, None])[:, :, None] * counts[:, None, :] - share[:, :, None] * centered[:, None, :]
    )
    return gain * centered + mean[1][:, None] + _level(there), gain[:, :, None] * free


def _there(position: Pixels, inputs: _Inputs, window: Window, border: int) -> Float[Array, "n l"]:
    """Sample the current image around positions."""
    return seen(apart(lambda: look(position, inputs.current, border, window)), window)


def _rows(counts: Float[Array, "n l"], patch: Float[Array, "n l"], there: Float[Array, "n l"]) -> _Rows:
    """Rows of 1 for pixels that count, and of the intensities of two patches above their levels; else 0."""
    above = lambda flat: (flat - _level(flat)) * counts
    return counts, above(patch), above(there)


def _level(flat: Float[Array, "n l"]) -> Float[Array, "n 1"]:
    """The intensity of one pixel near the middle; squares of what is above it do not swallow the contrast."""
    middle = flat.shape[1] // 2
    return lax.stop_gradient(flat[:, middle : middle + 1])


class _Moments(NamedTuple):
    """Sums over the pixels of two patches that count.

    Attributes:
        area: `(n,)` number of pixels, at least 1.
        mean: `(2, n)` mean intensity of each patch, above its level.
        power: `(3, n)` sum of squares about the mean of the first patch, of the second, and of their product.
    """

    area: Float[Array, " n"]
    mean: Float[Array, "2 n"]
    power: Float[Array, "3 n"]


def _moments(rows: _Rows) -> _Moments:
    gram = jnp.stack([product.T for product in _products(jnp.stack(rows, axis=1), *rows)])
    area = jnp.maximum(gram[0, 0], 1)
    mean = gram[0, 1:] / area[None]
    about_mean = lambda i, j: gram[i, j] - area * mean[i - 1] * mean[j - 1]
    powers = (jnp.maximum(about_mean(i, i), 0) for i in (1, 2))  # rounding takes them below zero in flat patches
    return _Moments(area, mean, jnp.stack([*powers, about_mean(1, 2)]))


def _products(matrix: Float[Array, "n k l"], *vectors: Float[Array, "n l"]) -> list[Float[Array, "n k"]]:
    """Batched products of matrices and vectors.

    In this form XLA's CPU backend takes 2 us for 17,000 multiplications; as products of two vectors 8 us for half of
    them, as products of two matrices with three rows 69 us.
    """
    return [jnp.einsum("nkl,nl->nk", matrix, vector) for vector in vectors]


def _correlation(patch: Float[Array, "n l"], there: Float[Array, "n l"], counts: Float[Array, "n l"]) -> Weights:
    first, second, product = _moments(_rows(counts, patch, there)).power
    return product / jnp.sqrt(first * second + 1)


def _solve(inputs: _Inputs, *, plan: LevelPlan, border: int, chunk: int) -> ConvergedPositions:
    """Final positions of the search, and the correlation there."""
    window = Window(plan.window)

    def search_chunk(inputs: _Inputs) -> ConvergedPositions:
        template, counts = _template(inputs, window, border)
        enough = 2 * jnp.sum(counts, axis=1) > window.side**2
        active = inputs.mask & enough & (template.texture > inputs.min_texture)
        begin = Search(inputs.guess, jnp.full_like(inputs.guess[0], jnp.inf), active)
        end = iterate(begin, template, inputs.current, border, plan)
        correlation = _correlation(template.patch, _there(end.position, inputs, window, border), counts)
        known = active & jnp.isfinite(correlation)
        settled = known & (correlation > 0) & (end.last_step < plan.accepted**2)
        low, high = patches.bounds(inputs.current, border)
        inside = jnp.all((end.position >= low) & (end.position <= high), axis=0)
        return ConvergedPositions(end.position, settled & inside, jnp.where(known, correlation, -1))

    # One of a batch after the other, as in `lk_search.search`, and for the same reasons.
    @jax.custom_batching.sequential_vmap
    def search_all(inputs: _Inputs) -> ConvergedPositions:
        run = lambda picture, center, warp, guess, mask: search_chunk(
            inputs._replace(picture=picture, center=center, warp=warp, guess=guess, mask=mask)
        )
        each = (inputs.picture, inputs.center, inputs.warp, inputs.guess, inputs.mask)
        return in_chunks(run, each, inputs.mask, chunk)

    found = search_all(inputs)
    return found._replace(measures=jnp.where(inputs.mask, found.measures, -1))


def _explain(position: Pixels, inputs: _Inputs, *, plan: LevelPlan, border: int) -> tuple[Pixels, Weights]:
    """Slope of half the squared difference, zero where the search converged, and the correlation."""
    window = Window(plan.window)
    template, counts = _template(inputs, window, border)
    there = _there(position, inputs, window, border)
    slope = jnp.einsum("nkl,nl->kn", template.gradient, there - template.patch)
    return slope, _correlation(template.patch, there, counts)


@checked
def align_patches(
    pictures: Num[Array, "k h w"],
    picture: Int[Array, " n"],
    center: Pixels,
    warp: Float[Array, "2 2 n"],
    current: Pyramid,
    guess: Pixels,
    mask: Mask,
    *,
    plan: LevelPlan = DEFAULT_PLAN,
    chunk: int = 32,
    min_texture: Scalar | float = 1.0,
) -> PatchMatch:
    """Look points up in the current image by the patches around them in older pictures.

    Differentiable in the pictures (when they are floating point), the current image, `center` and `warp`, by the
    implicit function theorem; neither guess nor brightness has an influence. The derivative of a point that did not
    converge is zero.

    Args:
        pictures: `k` pictures, gray, of any number type.
        picture: `(n,)` which of them each point is in.
        center: `(2, n)` pixel coordinates there. Pixels of a patch outside its picture do not count, and half of them
            must.
        warp: `(2, 2, n)` offset in the picture for an offset in the current image, `[to, from]`.
        current: Pyramid of the current image, its border at least half the window plus 6; its finest level is
            searched.
        guess: `(2, n)` where to start; it must be within a few pixels.
        mask: `(n,)` which points to look up.
        plan: Window and steps, static.
        chunk: Points searched together, static.
        min_texture: Smallest accepted eigenvalue of the mean gradient matrix, less what brightness explains, in
            squared intensity a squared pixel; positive.

    Returns:
        Where each point was found. A point that is not looked up (masked, or a number given for it is not finite) is
        at 0; one whose patch has too little texture or too few pixels is at its guess; one that met a pixel that is
        not a number is where its search stopped. Those have correlation -1, and none has converged.

    Raises:
        ValueError: While tracing, if the border is too narrow for the plan.
    """
    if current.border < Window(plan.window).border:
        raise ValueError(f"border: at least {Window(plan.window).border} pixels needed, got {current.border}")
    usable = mask & _finite(guess) & _finite(center) & _finite(warp)
    center, warp, guess = (_held(array, usable) for array in (center, warp, guess))
    threshold = jnp.asarray(min_texture, center.dtype)
    inputs = _Inputs(pictures, picture, center, warp, guess, usable, current.levels[0], threshold)
    settings = {"plan": plan, "border": current.border}
    found = implicit_positions(partial(_solve, chunk=chunk, **settings), partial(_explain, **settings), inputs)
    return PatchMatch(found.positions, found.measures, found.converged)
