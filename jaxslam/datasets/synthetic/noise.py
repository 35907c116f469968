"""Normally distributed noise: the numbers of `jax.random.normal`, sooner.

JAX runs the rounds of its generator in a loop over arrays in memory on a CPU, half of the time of a picture's sensor
model. Written out, XLA makes them part of what uses them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def normal_noise(key: Array, places: UInt[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return numbers of `jax.random.normal`, float32.

    Args:
        key: Random key of JAX's default kind.
        places: Places of the numbers in the array that JAX would make, counted row by row.
    """
    bits = _threefry(jax.random.key_data(key), places)
    from_1_to_2 = jax.lax.bitcast_convert_type(bits >> 9 | jnp.uint32(0x3F800000), jnp.float32)
    lowest = np.nextafter(np.float32(-1.0), np.float32(0.0))
    uniform = jnp.maximum((from_1_to_2 - 1.0) * (1.0 - lowest) + lowest, lowest)
    return np.float32(np.sqrt(2.0)) * jax.lax.erf_inv(uniform)


def _threefry(key: UInt[Array, " 2"], places: UInt[Array, "*shape"]) -> UInt[Array, "*shape"]:
    """Return random bits: both words of Threefry-2x32 of each place (Salmon et al. 2011), put together."""
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    first, second = keys[0], places + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            first = first + second
            second = (second << rotation | second >> (32 - rotation)) ^ first
        first = first + keys[(group + 1) % 3]
        second = second + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return first ^ second
