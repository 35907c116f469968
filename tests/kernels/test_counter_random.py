"""The random number generator of few instructions: its numbers look random, and it works in all of `jax.random`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.counter_random import COUNTER_RANDOM, seed_words
from scipy import stats


def _key(seed: int) -> jax.Array:
    return jax.random.key(seed, impl=COUNTER_RANDOM)


def test_uniform_and_independent_within_a_key() -> None:
    numbers = np.asarray(jax.random.uniform(_key(0), (200_000,)))
    assert stats.kstest(numbers, "uniform").pvalue > 1e-3
    for lag in (1, 2, 7, 64, 1000):
        assert abs(np.corrcoef(numbers[:-lag], numbers[lag:])[0, 1]) < 0.01


@pytest.mark.parametrize("derive", ["fold_in", "split", "seed"])
def test_independent_between_keys(derive: str) -> None:
    """Neighboring frames and seeds draw samples that have nothing in common."""
    keys = {
        "fold_in": lambda: jax.vmap(lambda frame: jax.random.fold_in(_key(3), frame))(jnp.arange(400)),
        "split": lambda: jax.random.split(_key(3), 400),
        "seed": lambda: jnp.stack([_key(seed) for seed in range(400)]),
    }[derive]()
    numbers = np.asarray(jax.vmap(lambda key: jax.random.uniform(key, (4, 64)))(keys)).reshape(400, -1)
    assert stats.kstest(numbers.ravel(), "uniform").pvalue > 1e-3
    for correlations in (np.corrcoef(numbers), np.corrcoef(numbers.T)):
        off_diagonal = correlations[np.triu_indices(len(correlations), 1)]
        assert np.abs(off_diagonal).max() < 0.4  # 6.4 and 8 standard deviations
        assert abs(off_diagonal.mean()) < 1e-3


def test_reproducible() -> None:
    draw = lambda seed: np.asarray(jax.random.bits(_key(seed), (3,)))
    np.testing.assert_array_equal(draw(5), draw(5))
    assert (draw(5) != draw(6)).all()
    compiled = np.asarray(jax.jit(lambda key: jax.random.bits(key, (3,)))(_key(5)))
    np.testing.assert_array_equal(draw(5), compiled)


@pytest.mark.parametrize(("dtype", "width"), [("float32", 32), ("float64", 64), ("float16", 16)])
def test_types(dtype: str, width: int) -> None:
    with jax.enable_x64(True):
        numbers = np.asarray(jax.random.uniform(_key(1), (50_000,), dtype)).astype(np.float64)
        bits = jax.random.bits(_key(1), (3,), f"uint{width}")
        wide_seed = jax.random.bits(_key(2**40 + 5), (3,))
        narrow_seed = jax.random.bits(_key(5), (3,))
    assert bits.dtype == f"uint{width}"
    assert abs(numbers.mean() - 0.5) < 0.01
    assert numbers.min() >= 0
    assert numbers.max() < 1
    assert not np.array_equal(wide_seed, narrow_seed)
    assert jax.random.normal(_key(1), (3,)).shape == (3,)
    assert sorted(np.asarray(jax.random.permutation(_key(1), 10))) == list(range(10))


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1, 2**31, 2**32 - 1])
def test_words_of_a_seed_are_those_of_its_key(seed: int, *, wide: bool) -> None:
    with jax.enable_x64(wide):
        key = jax.random.key_data(jax.random.key(seed, impl=COUNTER_RANDOM))
        np.testing.assert_array_equal(seed_words(seed), key)
