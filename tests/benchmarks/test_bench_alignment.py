"""Alignment and ATE of 1000 poses beside NumPy's singular value decomposition, with and without the gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.timing import compare
from jaxslam_kernels.alignment import ate
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.benchmark

N = 1000


def _scipy_ate(estimate: np.ndarray, reference: np.ndarray) -> float:
    """What a user would write."""
    x, y = estimate.T - estimate.mean(axis=1), reference.T - reference.mean(axis=1)
    rotation = Rotation.align_vectors(y, x)[0]
    return float(np.sqrt(np.square(rotation.apply(x) - y).sum(axis=1).mean()))


def test_ate_against_scipy(capsys):
    random = np.random.default_rng(0)
    reference = np.cumsum(random.normal(size=(3, N)), axis=1)
    estimate = Rotation.random(rng=random).apply((reference + 0.1 * random.normal(size=(3, N))).T).T + 5.0
    x, y = (jnp.asarray(positions, jnp.float32) for positions in (estimate, reference))
    weights = jnp.ones(N, jnp.float32)
    loss = lambda x: ate(x, y, weights).statistics.rmse
    value, gradient = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
    assert float(value(x)) == pytest.approx(_scipy_ate(estimate, reference), rel=1e-3)
    for name, ours in (("ATE", value), ("ATE with its gradient", gradient)):
        comparison = compare(lambda ours=ours: ours(x), lambda: _scipy_ate(estimate, reference))
        with capsys.disabled():
            print(f"\n{name}, {N} poses, against SciPy's value alone: {comparison}")
        assert comparison.processor_ratio < 2.0
