"""A small network that scores points in groups: each by its own features, by those of its group and by those of all.

Every point is embedded by one layer. The mean embedding of a group and that of all points, with features of the group
itself, give a score of the group; the embedding of a point and what is known of its group correct that score for the
point. Means over sets make the scores independent of the order of points and groups. Source: Zaheer et al., "Deep
Sets", NeurIPS 2017, theorem 2 and section 3.1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import Mask, Scalar


class PointNetwork(NamedTuple):
    """Weights of the network, for `f` features of a point, `c` of a group, and `h` hidden units.

    Attributes:
        embed: `(h, f)` matrix of the layer that embeds points.
        embed_bias: `(h,)` bias of that layer.
        join: `(h, 2 * h + c)` matrix of the layer of groups: mean embedding of the group, that of all points, features.
        join_bias: `(h,)` bias of that layer.
        group: `(h,)` weights of the score of a group.
        group_bias: Bias of that score.
        refine: `(h, 3 * h)` matrix of the second layer of points: embedding, layer of the group, mean of all points.
        refine_bias: `(h,)` bias of that layer.
        point: `(h,)` weights of the correction of a point's score.
        point_bias: Bias of that correction.
    """

    embed: Float[Array, "h f"]
    embed_bias: Float[Array, " h"]
    join: Float[Array, "h joined"]
    join_bias: Float[Array, " h"]
    group: Float[Array, " h"]
    group_bias: Scalar
    refine: Float[Array, "h refined"]
    refine_bias: Float[Array, " h"]
    point: Float[Array, " h"]
    point_bias: Scalar


class PointScores(NamedTuple):
    """Scores of points and groups, finite.

    Attributes:
        point: `(n,)` score of each point.
        group: `(k,)` score of each group.
        number: `(k,)` number of points that count in each group.
    """

    point: Float[Array, " n"]
    group: Float[Array, " k"]
    number: Float[Array, " k"]


def network_shapes(num_features: int, num_group_features: int, num_hidden: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of a `PointNetwork`, by name."""
    f, c, h = num_features, num_group_features, num_hidden
    return {
        "embed": (h, f),
        "embed_bias": (h,),
        "join": (h, 2 * h + c),
        "join_bias": (h,),
        "group": (h,),
        "group_bias": (),
        "refine": (h, 3 * h),
        "refine_bias": (h,),
        "point": (h,),
        "point_bias": (),
    }


@checked
def score_points(
    network: PointNetwork,
    features: Float[Array, "f n"],
    group_features: Float[Array, "c k"],
    group_of: Int[Array, " n"],
    mask: Mask,
) -> PointScores:
    """Score points and groups.

    The group of a point is a choice, constant for a derivative; scores are smooth in everything else.

    Args:
        network: Weights of the network.
        features: `(f, n)` features of the points, of about unit size. Those of points that do not count are not read.
        group_features: `(c, k)` features of the groups, of about unit size.
        group_of: `(n,)` group of each point; -1 for none.
        mask: `(n,)` which points count in the means. A point with a feature that is not finite does not.

    Returns:
        `PointScores`. Without any point that counts, the means are zero. A point that does not count has a score of
        zero, and a point in no group one that begins at zero instead of at the score of its group.

    Raises:
        ValueError: While tracing, if the matrices of the network do not fit the features.
    """
    _check(network, features.shape[0], group_features.shape[0])
    num = group_features.shape[1]
    counts = mask & jnp.isfinite(features).all(axis=0)
    features = jnp.where(counts[None, :], features, 0)
    grouped = counts & (group_of >= 0) & (group_of < num)
    to = jnp.where(grouped, group_of, num)
    embedded = jax.nn.tanh(network.embed @ features + network.embed_bias[:, None])
    # The last row gathers points in no group: they count in the mean of all.
    rows = jnp.where(counts[:, None], jnp.concatenate([embedded, jnp.ones_like(embedded[:1])]).T, 0)
    sums = jnp.zeros((num + 1, rows.shape[1]), rows.dtype).at[to].add(rows)
    total, number = sums.sum(axis=0), sums[:num, -1]
    of_all = total[:-1] / jnp.maximum(total[-1], 1)
    of_group = (sums[:num, :-1] / jnp.maximum(number, 1)[:, None]).T
    every = jnp.broadcast_to(of_all[:, None], of_group.shape)
    known = jnp.where(jnp.isfinite(group_features), group_features, 0)
    joined = jax.nn.tanh(network.join @ jnp.concatenate([of_group, every, known]) + network.join_bias[:, None])
    group = network.group @ joined + network.group_bias
    # A column of zeros for points in no group.
    inherited = jnp.pad(jnp.concatenate([joined, group[None]]), ((0, 0), (0, 1)))[:, to]
    everywhere = jnp.broadcast_to(of_all[:, None], embedded.shape)
    refined = network.refine @ jnp.concatenate([embedded, inherited[:-1], everywhere]) + network.refine_bias[:, None]
    point = inherited[-1] + network.point @ jax.nn.tanh(refined) + network.point_bias
    return PointScores(jnp.where(counts, point, 0), group, number)


def _check(network: PointNetwork, num_features: int, num_group_features: int) -> None:
    """Check that the matrices fit each other and the features."""
    expected = network_shapes(num_features, num_group_features, network.embed.shape[0])
    for name, shape in expected.items():
        if getattr(network, name).shape != shape:
            raise ValueError(
                f"score_points: network.{name}: expected {shape} for {num_features} features of points,"
                f" {num_group_features} of groups and {network.embed.shape[0]} hidden units, got"
                f" {getattr(network, name).shape}"
            )
