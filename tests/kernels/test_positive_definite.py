"""Scaling of Hessians, and which of them determine every unknown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.positive_definite import is_determined, solve_determined, unit_diagonal


def _hessian(seed: int, smallest: float, size: int = 6) -> np.ndarray:
    """A matrix of a unit diagonal whose smallest eigenvalue is about `smallest`, in units far apart."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(size, size)))
    matrix = basis @ np.diag(np.append(rng.uniform(0.5, 2.0, size - 1), smallest)) @ basis.T
    units = 10.0 ** rng.uniform(-2, 3, size) / np.sqrt(np.diag(matrix))
    return matrix * units * units[:, None]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_matches_eigenvalues(dtype):
    """Far from the limit the answer is that of the smallest eigenvalue, whatever the order of the unknowns."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(dtype == "float64"):
        limit = float(jnp.finfo(dtype).eps) ** 0.75
        for seed in range(20):
            for smallest, expected in ((100 * limit, True), (0.01 * limit, False), (-0.1, False)):
                order = rng.permutation(6)
                hessian = jnp.asarray(_hessian(seed, smallest)[np.ix_(order, order)], dtype)
                assert bool(is_determined(hessian)) == expected


def test_unit_diagonal():
    hessian = _hessian(1, 0.1)
    scaled, unit = map(np.asarray, unit_diagonal(jnp.asarray(hessian, jnp.float32)))
    np.testing.assert_allclose(np.diag(scaled), 1.0, rtol=1e-6)
    np.testing.assert_allclose(scaled, hessian * unit * unit[:, None], rtol=1e-5)


def test_solve():
    """A vector and a matrix, in units far apart; finite where nothing is determined."""
    hessian, right = _hessian(1, 0.1), np.random.default_rng(1).normal(size=(6, 2))
    with jax.enable_x64(True):
        for b in (right, right[:, 0]):
            solution = solve_determined(jnp.asarray(hessian), jnp.asarray(True), jnp.asarray(b))
            np.testing.assert_allclose(solution, np.linalg.solve(hessian, b), rtol=1e-9)
        nothing = solve_determined(jnp.full((6, 6), jnp.nan), jnp.asarray(False), jnp.asarray(right))
    assert np.isfinite(nothing).all()


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_degenerate(value):
    """A matrix of zeros, one with an unknown that nothing measures, or one that is not finite."""
    assert not bool(is_determined(jnp.full((6, 6), value, jnp.float32)))
    hessian = jnp.asarray(_hessian(2, 0.1), jnp.float32).at[2, 2].set(value)
    assert not bool(is_determined(hessian))


def test_vmap_equals_loop():
    batch = jnp.asarray(np.stack([_hessian(3, 0.1), _hessian(4, 1e-9)]), jnp.float32)
    np.testing.assert_array_equal(jax.vmap(is_determined)(batch), [is_determined(h) for h in batch])
