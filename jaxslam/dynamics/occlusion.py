"""Occluded points: map points that something passed in front of and that were there again afterwards.

What stays where it was while something moves before it belongs to the background, and counts more in every adjustment.

Source: Occlusion SLAM, algorithm 1 and formula 3; weights 1 and 3 there.
"""

import enum

import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.types import Mask, Scalar, Weights
from jaxtyping import Array, Float32, Int

States = Int[Array, " n"]
"""A `PointState` of each of `n` map points."""


class PointState(enum.IntEnum):
    """What is known of a map point from masks that passed over it."""

    STATIC = 0
    """Nothing has passed before it."""
    BLOCKED = 1
    """A mask was over it when last it was in the picture."""
    OCCLUDED = 2
    """It was seen again after it had been blocked."""


def next_states(states: States, inside: Mask, masked: Mask, displaced: Mask) -> States:
    """States after a frame.

    A point that is STATIC and under the mask becomes BLOCKED; one that is BLOCKED, in the picture and not under the
    mask becomes OCCLUDED, and stays so. That is the paper's state machine, and all of it where nothing is
    `displaced`. A box that stands still, is passed, and is carried away later would keep its weight for good; the
    guard, which the paper does not have, takes a point that is seen, but not where it should be, back to STATIC.

    Args:
        states: Before it.
        inside: `(n,)` which points the pose puts into the picture, in front of the camera.
        masked: `(n,)` which of them are under the mask.
        displaced: `(n,)` which of them were found elsewhere than the pose puts them; all false without the guard.
    """
    static, blocked = (jnp.full_like(states, state) for state in (PointState.STATIC, PointState.BLOCKED))
    occluded = jnp.full_like(states, PointState.OCCLUDED)
    was_static, was_blocked = states == PointState.STATIC, states == PointState.BLOCKED
    passed = jnp.where(was_static & inside & masked, blocked, states)
    passed = jnp.where(was_blocked & inside & ~masked, occluded, passed)
    return jnp.where(displaced & inside & ~masked, static, passed)


def occlusion_weights(states: States, occluded_weight: Scalar) -> Weights:
    """`(n,)` how much each point counts: `occluded_weight` if it is OCCLUDED, 1 otherwise."""
    return jnp.where(states == PointState.OCCLUDED, occluded_weight, jnp.ones_like(occluded_weight))


def state_weights(states: np.ndarray, occluded_weight: float) -> Float32[np.ndarray, " n"]:
    """`occlusion_weights` of any number of points of a map, nothing compiled."""
    return np.where(states == PointState.OCCLUDED, np.float32(occluded_weight), np.float32(1))


def occluded_share(states: States, counts: Mask) -> Scalar:
    """Share of the points that count which are OCCLUDED; the paper finds its effect from a fifth on. 0 of none."""
    occluded = jnp.sum(counts & (states == PointState.OCCLUDED), dtype=jnp.float32)
    return occluded / jnp.maximum(jnp.sum(counts, dtype=jnp.float32), 1)
