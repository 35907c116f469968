"""Random minimal samples of weighted points for RANSAC, all hypotheses at once."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from jaxslam_kernels.checks import checked
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
    drawn: list[Array] = []
    taken: list[tuple[Array, Array]] = []  # where each one drawn starts on the line, in its order, and its weight
    for position in range(size):
        target = uniform[position] * (total - sum(weight for _, weight in taken))
        for start, weight in taken:  # every cut ahead of the target moves it on
            target = target + jnp.where(target >= start, weight, 0.0)
        chosen = jnp.searchsorted(ends, target, side="right", method=search).astype(jnp.int32)
        drawn.append(jnp.minimum(chosen, weights.size - 1))
        taken = _inserted(taken, starts[drawn[-1]], weights[drawn[-1]])
    return jnp.stack(drawn)


def _inserted(line: list[tuple[Array, Array]], start: Array, weight: Array) -> list[tuple[Array, Array]]:
    """The pieces of a line in their order, with one more; elementwise, where a sort is a call of its own."""
    longer: list[tuple[Array, Array]] = []
    for other_start, other_weight in line:
        first = start < other_start
        longer.append((jnp.where(first, start, other_start), jnp.where(first, weight, other_weight)))
        start, weight = jnp.where(first, other_start, start), jnp.where(first, other_weight, weight)
    return [*longer, (start, weight)]
