"""A random number generator of few instructions: each number is a hash of its index and the key.

Threefry, JAX's default, is made for simulations that draw billions of numbers; a tracker draws a few hundred a frame.
On the CPU, its rounds for three such draws were 4 % of all that is compiled for a frame. Keys of `COUNTER_RANDOM` work
in all of `jax.random`; the kernels take keys of any kind.

Source: Wellons, "Prospecting for Hash Functions", 2018, `triple32`, whose bias is that of an ideal hash; Jarzynski and
Olano, "Hash Functions for GPU Rendering", Journal of Computer Graphics Techniques 9(3), 2020, for hashes of counters.
"""

import math
from collections.abc import Hashable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.random import define_prng_impl
from jaxtyping import Array, Shaped, UInt, UInt32

_SECOND = 0x9E3779B9
"""Where the second word of a key begins: the golden ratio in 32 bits."""


_Words: TypeAlias = Any
"""Unsigned integers of 32 bits, of JAX or of NumPy."""


def seed_words(seed: int) -> UInt32[np.ndarray, "2"]:
    """The data of the key of a seed, `jax.random.key_data(jax.random.key(seed, impl=COUNTER_RANDOM))`.

    In NumPy, since JAX compiles eight small programs for it, at every start of a process: 0.15 s.
    """
    high = seed >> 32 if jax.config.values["jax_enable_x64"] else 0  # as JAX, where an integer has 32 bits
    low, high = (np.array([word & 0xFFFFFFFF], np.uint32) for word in (seed, high))
    return np.concatenate(_seed_hashes(low, high))


def _hashed(x: _Words) -> _Words:
    for shift, factor in ((17, 0xED5AD4BB), (11, 0xAC4C1B51), (15, 0x31848BAB)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    return x ^ (x >> np.uint32(14))


def _seed_hashes(low: _Words, high: _Words) -> tuple[_Words, _Words]:
    return _hashed(low), _hashed(high ^ _hashed(low ^ np.uint32(_SECOND)))


def _seeded(seed: Shaped[Array, ""]) -> UInt32[Array, "2"]:
    low = seed.astype(jnp.uint32)
    wide = seed.dtype.itemsize > 4
    high = lax.shift_right_logical(seed.astype(jnp.uint64), jnp.uint64(32)).astype(jnp.uint32) if wide else low * 0
    return jnp.stack(_seed_hashes(low, high))


def _folded(key: UInt32[Array, "2"], data: int | UInt32[Array, ""]) -> UInt32[Array, "2"]:
    first = _hashed(key[0] + _hashed(jnp.asarray(data, jnp.uint32)))
    return jnp.stack([first, _hashed(key[1] ^ first)])


def _split(key: UInt32[Array, "2"], shape: tuple[int, ...]) -> UInt32[Array, "*shape 2"]:
    index = _indices(shape)
    first = _hashed(key[0] ^ _hashed(index + jnp.uint32(_SECOND)))
    return jnp.stack([first, _hashed(key[1] + first)], axis=-1)


def _bits(key: UInt32[Array, "2"], bit_width: int, shape: tuple[int, ...]) -> UInt[Array, "*shape"]:
    if bit_width == 64:
        low, high = jnp.moveaxis(_bits(key, 32, (*shape, 2)), -1, 0).astype(jnp.uint64)
        return low | (high << jnp.uint64(32))
    bits = _hashed(_hashed(_indices(shape) + key[0]) ^ key[1])
    return bits if bit_width == 32 else (bits >> jnp.uint32(32 - bit_width)).astype(f"uint{bit_width}")


def _indices(shape: tuple[int, ...]) -> UInt32[Array, "*shape"]:
    return lax.iota(jnp.uint32, math.prod(shape)).reshape(shape)


COUNTER_RANDOM: Hashable = define_prng_impl(
    key_shape=(2,), seed=_seeded, split=_split, random_bits=_bits, fold_in=_folded, name="counter_random", tag="ctr"
)
"""For `jax.random.key(seed, impl=COUNTER_RANDOM)` and `jax.random.wrap_key_data`. Not for cryptography, and for no more
than some millions of numbers a key."""
