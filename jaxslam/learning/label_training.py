"""First stage of the learned cue: its network is trained to tell moving points, from true labels of rendered scenes."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxslam_kernels.point_network import PointNetwork, PointScores, network_shapes, score_points
from jaxslam_kernels.se3 import lenient_promotion
from jaxslam_kernels.types import Scalar
from jaxtyping import Array, Float, Key

from jaxslam.dynamics.learned_cue import network_inputs
from jaxslam.dynamics.network_file import GROUP_FEATURES, POINT_FEATURES
from jaxslam.learning.point_samples import PointSamples
from jaxslam.runtime.compiled import compiled

_BATCH = 16
"""Number of frames in a step."""
_DECAY = 1e-3
"""Decay of the weights, per step and learning rate (AdamW)."""
_POINTS_PER_REGION = 24.0
"""Number of points that make a region count as much as a frame's mean point."""

_PIXELS, _SIGMAS = slice(0, 3), slice(3, 6)
"""Features that are distances from where a static point would be."""
_MAP_PX, _AGREES = POINT_FEATURES.index("map_px"), POINT_FEATURES.index("agrees")


def new_network(seed: int, num_hidden: int) -> PointNetwork:
    """Return an untrained network: every layer gives about unit size, and all scores are near zero."""
    random = np.random.default_rng(seed)
    arrays = {}
    for name, shape in network_shapes(len(POINT_FEATURES), len(GROUP_FEATURES), num_hidden).items():
        scale = 1 / np.sqrt(shape[-1]) if len(shape) == 2 else 0.1 if name in ("group", "point") else 0.0
        arrays[name] = jnp.asarray(scale * random.standard_normal(shape), jnp.float32)
    return PointNetwork(**arrays)


def joined_samples(samples: Sequence[PointSamples]) -> PointSamples:
    """Join samples of several scenes along the frames."""
    return PointSamples(*(np.concatenate(column) for column in zip(*samples, strict=True)))


def label_loss(scores: PointScores, samples: PointSamples, moving_weight: Scalar | float) -> Scalar:
    """Return the cross-entropy of the scores of one frame against true labels, of points and of regions.

    Args:
        scores: Scores of the points and regions.
        samples: Samples of the frame, without a first axis.
        moving_weight: Weight of a moving point; that of a static one is 1.
    """
    dtype = scores.point.dtype
    sure, moving = samples.sure.astype(dtype), samples.moving.astype(dtype)
    weights = sure * (1 + (moving_weight - 1) * moving)
    of_points = jnp.sum(weights * _cross_entropy(scores.point, moving)) / jnp.maximum(jnp.sum(sure), 1)
    num = len(scores.group)
    to = jnp.where(samples.sure & (samples.region_of >= 0), samples.region_of, num)
    number, moves = (jnp.zeros(num, dtype).at[to].add(each, mode="drop") for each in (sure, sure * moving))
    share = moves / jnp.maximum(number, 1)
    weights = jnp.sqrt(number / _POINTS_PER_REGION) * (1 + (moving_weight - 1) * share)
    return of_points + jnp.mean(weights * _cross_entropy(scores.group, share))


def _cross_entropy(score: Float[Array, " n"], label: Float[Array, " n"]) -> Float[Array, " n"]:
    return jax.nn.softplus(score) - score * label


def train_on_labels(
    network: PointNetwork,
    samples: PointSamples,
    key: Key[Array, ""],
    *,
    steps: int,
    rate: float,
    moving_weight: float,
    noise: float = 0.0,
) -> tuple[PointNetwork, Float[np.ndarray, " steps"]]:
    """Train a network on labeled samples (AdamW, with a learning rate that falls to zero along a cosine).

    Args:
        network: Network to begin with.
        samples: Samples of `t` frames.
        key: Random key; the same key gives the same network.
        steps: Number of steps.
        rate: Learning rate of the first step.
        moving_weight: Weight of a moving point; that of a static one is 1.
        noise: How much the noise of the samples is varied, as `WeightsRecipe.noise`.

    Returns:
        The network, and the loss of each step.
    """
    arrays = jax.tree.map(jnp.asarray, samples)
    numbers = jnp.float32(rate), jnp.float32(moving_weight), jnp.float32(noise)
    network, losses = _train(network, arrays, key, *numbers, steps=steps)
    return network, np.asarray(losses)


@compiled(when="first use", static="steps")
def _train(
    network: PointNetwork,
    samples: PointSamples,
    key: Key[Array, ""],
    rate: Scalar,
    moving_weight: Scalar,
    noise: Scalar,
    *,
    steps: int,
) -> tuple[PointNetwork, Float[Array, " steps"]]:
    falling = lambda count: rate * (0.5 + 0.5 * jnp.cos(jnp.pi * count / steps))
    optimizer = optax.adamw(falling, weight_decay=_DECAY)
    num = samples.mask.shape[0]

    def loss(network: PointNetwork, batch: PointSamples) -> Scalar:
        of_frame = lambda frame: label_loss(scores_of(network, frame), frame, moving_weight)
        return jnp.mean(jax.vmap(of_frame)(batch))

    def step(carry: tuple[PointNetwork, optax.OptState], key: Key[Array, ""]) -> tuple[tuple, Scalar]:
        network, memory = carry
        order, *keys = jax.random.split(key, _BATCH + 1)
        chosen = jax.random.randint(order, (_BATCH,), 0, num)
        batch = jax.vmap(noisier, (0, 0, None))(
            jnp.stack(keys), jax.tree.map(lambda array: array[chosen], samples), noise
        )
        value, slope = jax.value_and_grad(loss)(network, batch)
        with lenient_promotion():  # optax relies on it
            change, memory = optimizer.update(slope, memory, network)
            network = optax.apply_updates(network, change)
        return (network, memory), value

    with lenient_promotion():
        memory = optimizer.init(network)
    (network, _), losses = lax.scan(step, (network, memory), jax.random.split(key, steps))
    return network, losses


def noisier(key: Key[Array, ""], frame: PointSamples, noise: Scalar) -> PointSamples:
    """Return the samples of a frame as a worse camera would give them: longer distances, unevenly over the regions.

    Points that come to be farther from where the map has them than any that agrees with the coarse pose agree no more.
    """
    num, dtype = frame.regions.shape[1], frame.points.dtype
    of_frame, of_regions = jax.random.split(key)
    whole = jax.random.uniform(of_frame, (2, 1), dtype) * noise
    uneven = jax.random.uniform(of_regions, (2, num + 1), dtype, -0.5, 0.5) * noise
    factor = jnp.exp(whole + uneven)[:, jnp.where(frame.region_of >= 0, frame.region_of, num)]
    agrees, map_px = frame.mask & (frame.points[_AGREES] > 0), frame.points[_MAP_PX]
    limit_px = jnp.max(jnp.where(agrees, map_px, 0))
    points = frame.points.at[_PIXELS].multiply(factor[:1]).at[_SIGMAS].multiply(factor[1:])
    return frame._replace(points=points.at[_AGREES].set((agrees & (points[_MAP_PX] <= limit_px)).astype(dtype)))


def scores_of(network: PointNetwork, frame: PointSamples) -> PointScores:
    """Score the points of one frame."""
    inputs = network_inputs(frame.points, frame.mask)
    return score_points(network, inputs, frame.regions, frame.region_of, frame.mask)
