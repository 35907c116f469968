"""Alignment and ATE of 1000 poses beside NumPy's singular value decomposition, with and without the gradient."""

import jax
import jax.numpy as jnp
import pytest
from jaxslam_kernels.trajectory.alignment import ate

from jaxslam.benchmark.kernels.point_cases import paths, scipy_ate
from jaxslam.benchmark.timing import compare

pytestmark = pytest.mark.benchmark

N = 1000


def test_ate_against_scipy(capsys):
    estimate, reference = paths(N)
    x, y = (jnp.asarray(positions, jnp.float32) for positions in (estimate, reference))
    weights = jnp.ones(N, jnp.float32)
    loss = lambda x: ate(x, y, weights).statistics.rmse
    value, gradient = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
    assert float(value(x)) == pytest.approx(scipy_ate(estimate, reference), rel=1e-3)
    for name, ours in (("ATE", value), ("ATE with its gradient", gradient)):
        comparison = compare(lambda ours=ours: ours(x), lambda: scipy_ate(estimate, reference))
        with capsys.disabled():
            print(f"\n{name}, {N} poses, against SciPy's value alone: {comparison}")
        assert comparison.processor_ratio < 2.0
