"""Random minimal samples of weighted points for RANSAC, all hypotheses at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key

from jaxslam_kernels.checks import checked
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.types import Weights

_MAX_COMPARED = 2**15
"""Up to so many weights times samples comparing with all is faster than halving, and twenty times less code."""


@checked
def draw_samples(key: Key[Array, ""], weights: Weights, num_samples: int, size: int) -> Int[Array, "size h"]:
    """Draw samples of different points, each point in proportion to its weight among those left.

    Exact sequential sampling without replacement: a draw lands on the line of stacked weights from which the ones
    drawn before have been cut out. With fewer points of positive weight than the sample has, some come twice.

    Args:
        key: Random key.
        weights: Weight of each point, not negative and finite.
        num_samples: Number of samples, static.
        size: Number of points of a sample, static.

    Returns:
        `(size, num_samples)` int32, the numbers of the points drawn.

    Raises:
        ValueError: While tracing, if there is no point at all.
    """
    if weights.size == 0:
        raise ValueError("draw_samples: weights: expected at least one, got none")
    search = "compare_all" if weights.size * num_samples <= _MAX_COMPARED else "scan"
    ends = jnp.cumsum(weights)
    starts, total = ends - weights, ends[-1]
    uniform = jax.random.uniform(key, (size, num_samples), weights.dtype)
    none = jnp.full((size, num_samples), jnp.inf, weights.dtype)

    def draw(taken: _Taken, position_uniform: Array) -> tuple[_Taken, Array]:
        target = position_uniform * (total - taken.weight.sum(axis=0))
        for start, weight in zip(taken.start, taken.weight, strict=True):  # every cut ahead of the target moves it on
            target = target + jnp.where(target >= start, weight, 0.0)
        chosen = jnp.searchsorted(ends, target, side="right", method=search).astype(jnp.int32)
        chosen = jnp.minimum(chosen, weights.size - 1)
        return _inserted(taken, starts[chosen], weights[chosen]), chosen

    return apart(lambda: lax.scan(draw, _Taken(none, jnp.zeros_like(none)), uniform)[1])


class _Taken(NamedTuple):
    """What is cut out of the line, in its order: where each piece starts, and its weight; infinity and 0 for none."""

    start: Float[Array, "size h"]
    weight: Float[Array, "size h"]


def _inserted(taken: _Taken, start: Float[Array, " h"], weight: Float[Array, " h"]) -> _Taken:
    """The pieces with one more in place of the last of none; elementwise, where a sort is a call of its own."""
    here, before = taken.start < start[None], jnp.roll(taken.start, 1, axis=0) < start[None]
    before = before.at[0].set(True)
    put = lambda old, new: jnp.where(here, old, jnp.where(before, new[None], jnp.roll(old, 1, axis=0)))
    return _Taken(put(taken.start, start), put(taken.weight, weight))
