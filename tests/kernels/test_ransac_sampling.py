"""Random samples of weighted points: their distribution, and weights that leave little to draw from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.ransac_sampling import draw_samples
from quick_compile import quick_compile

_draw = quick_compile(draw_samples, static_argnums=(2, 3))


def test_matches_reference() -> None:
    """First draws follow the weights; a second one follows the weights without the first."""
    weights = jnp.asarray([0.1, 0.0, 0.2, 0.3, 0.4])
    samples = np.asarray(_draw(jax.random.key(0), weights, 20_000, 4))
    assert samples.shape == (4, 20_000)
    assert all(len(set(column)) == 4 for column in samples.T)
    first = np.bincount(samples[0], minlength=5) / 20_000
    np.testing.assert_allclose(first, weights, atol=0.015)
    after_four = samples[1][samples[0] == 4]
    np.testing.assert_allclose(np.bincount(after_four, minlength=4) / after_four.size, weights[:4] / 0.6, atol=0.02)


@pytest.mark.parametrize("weights", [[0.0] * 5, [0.0, 1.0, 0.0, 0.0, 0.0], [1e-30] * 5])
def test_degenerate(weights: list[float]) -> None:
    samples = np.asarray(_draw(jax.random.key(1), jnp.asarray(weights), 16, 4))
    assert ((samples >= 0) & (samples < 5)).all()


def test_degenerate_without_points() -> None:
    with pytest.raises(ValueError, match="draw_samples: weights: expected at least one"):
        draw_samples(jax.random.key(0), jnp.zeros(0), 16, 4)
