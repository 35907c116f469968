"""Noise: the numbers of `jax.random.normal`, whatever part of them is asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.datasets.synthetic.noise import normal_noise

SHAPE = (3, 37, 53)


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_numbers_are_those_of_jax(seed: int) -> None:
    key = jax.random.fold_in(jax.random.key(seed), 17)
    places = jnp.arange(np.prod(SHAPE), dtype=jnp.uint32).reshape(SHAPE)
    ours = jax.jit(normal_noise)(key, places)
    assert ours.dtype == jnp.float32
    # To the last bit but one: how XLA contracts products and sums depends on the program around.
    np.testing.assert_allclose(ours, jax.random.normal(key, SHAPE, jnp.float32), rtol=3e-7, atol=1e-7)


def test_places_in_any_order() -> None:
    key, places = jax.random.key(5), np.random.default_rng(0).integers(0, 5000, (7, 11)).astype(np.uint32)
    every = jax.random.normal(key, (5000,), jnp.float32)
    np.testing.assert_allclose(jax.jit(normal_noise)(key, places), every[places], rtol=3e-7, atol=1e-7)
