"""Derivatives of the fixed point `p = c + g (sin p_v, cos p_u)`, worked out by hand."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.test_util import check_grads
from jaxslam_kernels.implicit_positions import ConvergedPositions, implicit_positions

N = 6


class _Inputs(NamedTuple):
    c: Any
    g: Any
    accepted: Any
    steps: Any


def _slope(position, inputs):
    u, v = position
    return position - inputs.c - inputs.g[None, :] * jnp.stack([jnp.sin(v), jnp.cos(u)])


def _explain(position, inputs):
    energy = inputs.g * jnp.sum(jnp.square(position), axis=0) + inputs.c[0]
    return _slope(position, inputs), {"energy": energy, "slack": jnp.zeros_like(energy)}


def _solve(inputs):
    """By iteration in a loop of unknown length, which has no reverse derivative of its own."""
    step = lambda carry: (carry[0] - _slope(carry[0], inputs), carry[1] + 1)
    position = lax.while_loop(lambda carry: carry[1] < inputs.steps, step, (inputs.c, 0))[0]
    slope, measures = _explain(position, inputs)
    finite = jnp.isfinite(position).all(axis=0)
    slack = jnp.sum(jnp.square(slope), axis=0)
    measures = jax.tree.map(lambda a: jnp.where(finite, a, 0), {**measures, "slack": slack})
    return ConvergedPositions(jnp.where(finite[None, :], position, 0), inputs.accepted & finite, measures)


def _found(inputs):
    return implicit_positions(_solve, _explain, inputs)


_find = jax.jit(_found)
_of_c_and_g = jax.jit(lambda c, g: _differentiable(_found(_inputs()._replace(c=c, g=g))))
_forward = jax.jit(jax.jacfwd(_of_c_and_g, argnums=(0, 1)))
_reverse = jax.jit(jax.jacrev(_of_c_and_g, argnums=(0, 1)))


@jax.jit
def _gradient(inputs):
    loss = lambda c, g: sum(map(jnp.sum, _differentiable(_found(inputs._replace(c=c, g=g)))))
    return jax.grad(loss, argnums=(0, 1))(inputs.c, inputs.g)


def _differentiable(found):
    return found.positions, found.measures["energy"]


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _inputs(seed=0, dtype: Any = np.float64):
    rng = np.random.default_rng(seed)
    c, g = rng.normal(size=(2, N)).astype(dtype), rng.uniform(0.2, 0.5, N).astype(dtype)
    return _Inputs(c, g, np.ones(N, bool), np.array(80, np.int32))


def _by_hand(inputs):
    """Position and energy, and the `(2, 2, n)` and `(2, n)` derivatives of the position by `c` and `g`."""
    c, g = inputs.c, inputs.g
    u, v = c
    for _ in range(200):
        u, v = c[0] + g * np.sin(v), c[1] + g * np.cos(u)
    determinant = 1 + g**2 * np.cos(v) * np.sin(u)
    by_c = np.array([[np.ones(N), g * np.cos(v)], [-g * np.sin(u), np.ones(N)]]) / determinant
    by_g = np.einsum("ijn,jn->in", by_c, np.stack([np.sin(v), np.cos(u)]))
    return np.stack([u, v]), g * (u**2 + v**2) + c[0], by_c, by_g


class TestImplicitPositions:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_shapes(self, dtype):
        with jax.enable_x64(dtype == np.float64):
            found = _find(_inputs(dtype=dtype))
        assert found.positions.shape == (2, N)
        assert found.converged.shape == found.measures["energy"].shape == (N,)
        assert found.positions.dtype == found.measures["energy"].dtype == dtype

    @pytest.mark.parametrize("jacobian", [_forward, _reverse], ids=["forward", "reverse"])
    def test_matches_reference(self, x64, jacobian):
        inputs = _inputs()
        position, energy, by_c, by_g = _by_hand(inputs)
        np.testing.assert_allclose(_find(inputs).positions, position, atol=1e-14)
        np.testing.assert_allclose(_find(inputs).measures["energy"], energy, atol=1e-14)
        (position_by_c, position_by_g), (energy_by_c, energy_by_g) = jacobian(inputs.c, inputs.g)
        u, v = position
        each = np.arange(N)
        # Index arrays around a slice move the points to the front; points do not depend on each other.
        np.testing.assert_allclose(position_by_c[:, each, :, each], np.moveaxis(by_c, -1, 0), atol=1e-12)
        np.testing.assert_allclose(position_by_g[:, each, each], by_g, atol=1e-12)
        slope = 2 * inputs.g * (u * by_c[0] + v * by_c[1]) + np.array([[1.0], [0.0]])
        np.testing.assert_allclose(energy_by_c[each, :, each].T, slope, atol=1e-12)
        np.testing.assert_allclose(
            energy_by_g[each, each], u**2 + v**2 + 2 * inputs.g * (u * by_g[0] + v * by_g[1]), atol=1e-12
        )
        for matrix in (position_by_g[0], position_by_g[1], energy_by_g):
            assert np.count_nonzero(matrix) == np.count_nonzero(np.diag(np.diag(matrix)))

    def test_gradient(self, x64):
        """Twice: the rule can itself be differentiated."""
        inputs = _inputs()
        check_grads(_of_c_and_g, (inputs.c, inputs.g), order=2, modes=("fwd", "rev"), eps=1e-5, rtol=1e-7, atol=1e-7)

    @pytest.mark.parametrize("weak", [1e-3, 1e-9])
    def test_gradient_near_the_singular_case(self, x64, weak):
        """A system that hardly determines one direction: a large derivative, still right to rounding."""
        turn = np.array([[0.6, -0.8], [0.8, 0.6]])
        matrix = jnp.asarray(turn @ np.diag([1, weak]) @ turn.T)
        system = lambda position, b: matrix @ position - b
        solve = lambda b: ConvergedPositions(jnp.linalg.solve(matrix, b), jnp.ones(N, bool), ())
        find = jax.jit(lambda b: implicit_positions(solve, lambda p, b: (system(p, b), ()), b).positions)
        derivative = jax.jit(jax.jacrev(find))(jnp.ones((2, N)))[:, 0, :, 0]
        np.testing.assert_allclose(derivative, np.linalg.inv(matrix), rtol=1e-6)

    @pytest.mark.parametrize("weak", [0.0, 1e-17])
    def test_a_singular_system_has_derivative_zero(self, x64, weak):
        matrix = jnp.array([[1.0, 1.0], [1.0, 1.0 + weak]])
        explain = lambda position, b: (matrix @ position - b, jnp.sum(position * b, axis=0))
        solve = lambda b: ConvergedPositions(b / 2, jnp.ones(N, bool), jnp.zeros(N))
        gradient = jax.jit(jax.grad(lambda b: sum(map(jnp.sum, implicit_positions(solve, explain, b)[::2]))))
        np.testing.assert_array_equal(gradient(jnp.ones((2, N))), 0)

    def test_vmap_equals_loop(self, x64):
        inputs = [_inputs(s) for s in range(3)]
        batch = jax.tree.map(lambda *leaves: np.stack(leaves), *inputs)
        found, gradient = jax.jit(jax.vmap(_found))(batch), jax.jit(jax.vmap(_gradient))(batch)
        for k in range(3):
            np.testing.assert_allclose(found.positions[k], _find(inputs[k]).positions, atol=1e-14)
            for batched, one in zip(gradient, _gradient(inputs[k]), strict=True):
                np.testing.assert_allclose(batched[k], one, atol=1e-12)

    def test_single_trace(self):
        compute = jax.jit(eqx.debug.assert_max_traces(_gradient, max_traces=1))
        for seed in range(3):
            compute(_inputs(seed, np.float32))

    def test_not_converged(self, x64):
        """No derivative, and none of its measures; that of the others stays."""
        inputs, accepted = _inputs(), np.arange(N) % 2 > 0
        refused = _gradient(inputs._replace(accepted=accepted))
        for whole, part in zip(_gradient(inputs), refused, strict=True):
            np.testing.assert_array_equal(part, np.where(accepted, whole, 0))

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("case", ["some NaN", "all NaN", "infinite", "none accepted", "diverging"])
    def test_degenerate(self, case, dtype):
        inputs = _inputs(dtype=dtype)
        bad = np.arange(N) < (N if case in ("all NaN", "none accepted") else 2)
        match case:
            case "some NaN" | "all NaN":
                inputs.c[0, bad], inputs.g[bad] = np.nan, np.nan
            case "infinite":
                inputs.c[1, bad] = np.inf
            case "none accepted":
                inputs = inputs._replace(accepted=~bad)
            case "diverging":
                inputs.g[bad] = np.finfo(dtype).max
                inputs.accepted[bad] = False
        with jax.enable_x64(dtype == np.float64):
            found, gradients, clean = _find(inputs), _gradient(inputs), _gradient(_inputs(dtype=dtype))
        assert np.isfinite(found.positions).all()
        for gradient, expected in zip(gradients, clean, strict=True):
            np.testing.assert_allclose(gradient, np.where(bad, 0, expected), rtol=1e-6)
