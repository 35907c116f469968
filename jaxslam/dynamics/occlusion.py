"""Occluded points: map points that something passed in front of and that were visible again afterwards.

A point that stays in place while something moves in front of it belongs to the background, and gets more weight in
every adjustment.

Source: Occlusion SLAM, algorithm 1 and equation 3, with weights 1 and 3.
"""

import enum

import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.types import Mask, Scalar, Weights
from jaxtyping import Array, Float32, Int

States = Int[Array, " n"]
"""A `PointState` of each of `n` map points."""


class PointState(enum.IntEnum):
    """State of a map point, from the masks that passed over it."""

    STATIC = 0
    """Nothing has passed in front of it."""
    BLOCKED = 1
    """A mask covered it when it was last inside the image."""
    OCCLUDED = 2
    """It was visible again after having been blocked."""


def next_states(states: States, inside: Mask, masked: Mask, displaced: Mask) -> States:
    """Advance the states by one frame.

    A STATIC point under the mask becomes BLOCKED; a BLOCKED point inside the image and outside the mask becomes
    OCCLUDED, and stays so. This is the paper's state machine, and all of it if nothing is `displaced`. A box that
    stands still, is passed, and is carried away later would keep its weight forever; the guard, which the paper does
    not have, resets a point that is visible but not where it should be to STATIC.

    Args:
        states: `(n,)` states before the frame.
        inside: `(n,)` which points the pose projects into the image, in front of the camera.
        masked: `(n,)` which of those are under the mask.
        displaced: `(n,)` which of those were found at a different place than the pose predicts; all false without the
            guard.
    """
    static, blocked = (jnp.full_like(states, state) for state in (PointState.STATIC, PointState.BLOCKED))
    occluded = jnp.full_like(states, PointState.OCCLUDED)
    was_static, was_blocked = states == PointState.STATIC, states == PointState.BLOCKED
    passed = jnp.where(was_static & inside & masked, blocked, states)
    passed = jnp.where(was_blocked & inside & ~masked, occluded, passed)
    return jnp.where(displaced & inside & ~masked, static, passed)


def occlusion_weights(states: States, occluded_weight: Scalar) -> Weights:
    """Return `(n,)` the weight of each point: `occluded_weight` if it is OCCLUDED, 1 otherwise."""
    return jnp.where(states == PointState.OCCLUDED, occluded_weight, jnp.ones_like(occluded_weight))


def state_weights(states: np.ndarray, occluded_weight: float) -> Float32[np.ndarray, " n"]:
    """Compute `occlusion_weights` in NumPy, for any number of map points and without compilation."""
    return np.where(states == PointState.OCCLUDED, np.float32(occluded_weight), np.float32(1))


def occluded_share(states: States, counts: Mask) -> Scalar:
    """Return the share of the counted points that are OCCLUDED; 0 if none counts.

    The paper finds an effect from a share of a fifth on.
    """
    occluded = jnp.sum(counts & (states == PointState.OCCLUDED), dtype=jnp.float32)
    return occluded / jnp.maximum(jnp.sum(counts, dtype=jnp.float32), 1)
