"""Robust losses on squared residuals, and robust estimates of scale.

A loss maps the squared, whitened residual `s >= 0` (a squared Mahalanobis norm) to `rho(s)`. All are normalized as
in Ceres and SciPy: `rho(s) = c² rho_1(s / c²)`, so `rho(s) = s + O(s²)` near zero and an inlier counts as in plain
least squares. The cost of a problem is `½ Σ rho(s_i)`, the weight in iteratively reweighted least squares is
`rho'(s)`, and the scale `c` is in the unit of the whitened residual: standard deviations.

Source: Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 4.3; Black and Rangarajan, "On the
Unification of Line Processes, Outlier Rejection, and Robust Statistics", 1996, for the Geman-McClure loss.
"""

from typing import Literal, TypeAlias, assert_never

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.types import Mask, Scalar, Weights

Loss: TypeAlias = Literal["squared", "huber", "cauchy", "geman_mcclure"]
"""`squared` trusts everyone, `huber` bounds the pull, `cauchy` lets it fade, `geman_mcclure` lets go."""

SquaredResiduals: TypeAlias = Float[Array, "*batch"]

_MAD_TO_SIGMA = 1.482602218505602  # 1 / Φ⁻¹(3/4): the deviation of a Gaussian per median absolute deviation
LARGEST_SQUARED = 1e16
"""Squared residuals beyond this count as this; its square and its ratios to its inverse are finite in float32."""


@checked
def loss_value(squared: SquaredResiduals, scale: Scalar | float, loss: Loss) -> SquaredResiduals:
    """The robust cost `rho(s)` of each squared residual; 0 where `squared` is not finite.

    Args:
        squared: Squared whitened residuals `s`, any shape.
        scale: The scale `c` at which the loss departs from a parabola, traced.
        loss: Name of the loss, static.
    """
    s, known = _known(squared)
    c2 = _squared_scale(scale, s)
    match loss:
        case "squared":
            value = s
        case "huber":
            outside = s > c2
            root = jnp.sqrt(jnp.where(outside, s, c2) * c2)
            value = jnp.where(outside, 2.0 * root - c2, s)
        case "cauchy":
            value = c2 * jnp.log1p(s / c2)
        case "geman_mcclure":
            value = s * (c2 / (c2 + s))
        case _:
            assert_never(loss)
    return jnp.where(known, value, 0.0)


@checked
def loss_weight(squared: SquaredResiduals, scale: Scalar | float, loss: Loss) -> SquaredResiduals:
    """The weight `rho'(s)` in [0, 1] of each squared residual; 0 where `squared` is not finite.

    Args:
        squared: Squared whitened residuals `s`, any shape.
        scale: The scale `c`, traced.
        loss: Name of the loss, static.
    """
    s, known = _known(squared)
    c2 = _squared_scale(scale, s)
    match loss:
        case "squared":
            weight = jnp.ones_like(s)
        case "huber":
            weight = jnp.sqrt(c2 / jnp.maximum(s, c2))
        case "cauchy":
            weight = c2 / (c2 + s)
        case "geman_mcclure":
            weight = jnp.square(c2 / (c2 + s))
        case _:
            assert_never(loss)
    return jnp.where(known, weight, 0.0)


@checked
def weighted_median(values: Weights, weights: Weights) -> Scalar:
    """The smallest value at which half of the weight is reached; 0 if nothing has weight.

    Values that are not finite do not count; of no values at all it is 0. `O(n log n)`, one sort.

    Args:
        values: The numbers, any sign.
        weights: Non-negative weights; a mask works as `mask.astype(values.dtype)`.
    """
    if values.shape[0] == 0:
        return jnp.zeros((), values.dtype)
    counts = jnp.isfinite(values) & (weights > 0)
    order = jnp.argsort(jnp.where(counts, values, jnp.inf))
    ordered = jnp.where(counts, values, 0.0)[order]
    reached = jnp.cumsum(jnp.where(counts, weights, 0.0)[order])
    return ordered[jnp.argmax(reached >= 0.5 * reached[-1])]


@checked
def masked_median(values: Weights, mask: Mask) -> Scalar:
    """The smallest value at which half of the values that count is reached; 0 if none counts.

    As `weighted_median` with weights of 0 and 1, in a third of its time: whole numbers are sorted alone, in the order
    of the values, which XLA's CPU backend does in 6 us for 512 of them, and sorting with their places takes 46.

    Args:
        values: The numbers, any sign.
        mask: `(n,)` which of them count; those that are not finite do not.
    """
    if values.shape[0] == 0:
        return jnp.zeros((), values.dtype)
    counts = jnp.isfinite(values) & mask
    ordinal = _ordinal(lax.stop_gradient(jnp.where(counts, values, jnp.inf)))
    half = (jnp.sum(counts, dtype=jnp.int32) + 1) >> 1
    middle = lax.dynamic_index_in_dim(jnp.sort(ordinal), jnp.maximum(half - 1, 0), keepdims=False)
    at_middle = counts & (ordinal == middle)
    return apart(lambda: jnp.where(half > 0, jnp.max(jnp.where(at_middle, values, -jnp.inf)), 0))


def _ordinal(values: Weights) -> Int[Array, " n"]:
    """Whole numbers in the order of floating-point numbers, none of them NaN: their bits, mirrored if negative."""
    width = jnp.finfo(values.dtype).bits
    bits = lax.bitcast_convert_type(values, jnp.dtype(f"int{width}"))
    return jnp.where(bits < 0, bits ^ jnp.iinfo(bits.dtype).max, bits)


@checked
def robust_scale(residuals: Weights, weights: Weights) -> Scalar:
    """The standard deviation of the inliers, from the median absolute deviation: 1.4826 med |r - med r|.

    Stands up to just under half of the weight on outliers; 0 if nothing has weight.

    Args:
        residuals: Signed residuals in any unit; not-finite ones do not count.
        weights: Non-negative weights.
    """
    deviation = jnp.abs(residuals - weighted_median(residuals, weights))
    return _MAD_TO_SIGMA * weighted_median(deviation, weights)


def _known(squared: SquaredResiduals) -> tuple[Array, Array]:
    """The squared residuals without what is not finite, kept in the range of single precision."""
    known = jnp.isfinite(squared)
    return jnp.minimum(jnp.where(known, squared, 0.0), LARGEST_SQUARED), known


def _squared_scale(scale: Scalar | float, like: Array) -> Array:
    """`c²`, kept off zero so that a scale of zero, or none at all, gives vanishing weights and no NaN."""
    c = jnp.asarray(scale, like.dtype)
    return jnp.maximum(jnp.square(jnp.where(jnp.isfinite(c), c, 0.0)), 1.0 / LARGEST_SQUARED)
