"""Robust losses and scales against SciPy, NumPy and their definitions."""

from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.robust import Loss, loss_value, loss_weight, masked_median, robust_scale, weighted_median
from scipy.optimize import least_squares

LOSSES = get_args(Loss)
SCALE = 1.7
SQUARED = np.concatenate([[0.0], np.logspace(-12, 6, 25), [SCALE**2 * (1 - 1e-9), SCALE**2 * (1 + 1e-9)]])
SEEDS = st.integers(0, 2**32 - 1)

_value = jax.jit(loss_value, static_argnames="loss")
_weight = jax.jit(loss_weight, static_argnames="loss")
_median = jax.jit(weighted_median)
_scale = jax.jit(robust_scale)


def _scipy_rho(squared: float, loss: str) -> float:
    """Twice the cost that SciPy reports for one residual that does not depend on the unknown."""
    residual = np.array([np.sqrt(squared)])
    return 2.0 * least_squares(lambda _: residual, [0.0], loss=loss, f_scale=SCALE).cost


def _numpy_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])])


@pytest.mark.parametrize("loss", LOSSES)
class TestLoss:
    @pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
    def test_shapes(self, loss, shape):
        squared = jnp.ones(shape, jnp.float32)
        for f in (_value, _weight):
            result = f(squared, 1.0, loss)
            assert result.shape == shape
            assert result.dtype == jnp.float32

    def test_matches_reference(self, loss):
        if loss == "geman_mcclure":  # SciPy has none: Black and Rangarajan 1996
            expected = SCALE**2 * SQUARED / (SCALE**2 + SQUARED)
        else:
            name = "linear" if loss == "squared" else loss
            expected = np.array([_scipy_rho(s, name) for s in SQUARED])
        with jax.enable_x64(True):
            ours = np.asarray(_value(jnp.asarray(SQUARED), SCALE, loss))
        np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=1e-16)

    def test_gradient(self, loss):
        """The weight is the derivative of the value: forward, reverse, and finite differences; finite at 0."""
        with jax.enable_x64(True):
            squared, scale = jnp.asarray(SQUARED), jnp.asarray(SCALE)
            ones = jnp.ones_like(squared)
            _, forward = jax.jvp(lambda s: _value(s, scale, loss), (squared,), (ones,))
            reverse = jax.grad(lambda s: _value(s, scale, loss).sum())(squared)
            weight = _weight(squared, scale, loss)
            step = 1e-6 * np.maximum(SQUARED, 1e-3)
            difference = _value(squared + step, scale, loss) - _value(jnp.maximum(squared - step, 0.0), scale, loss)
            numeric = difference / (step + np.minimum(step, SQUARED))
            by_scale = jax.grad(lambda c: _value(squared, c, loss).sum())(scale)
            numeric_scale = (
                _value(squared, scale + 1e-6, loss).sum() - _value(squared, scale - 1e-6, loss).sum()
            ) / 2e-6
        np.testing.assert_allclose(forward, weight, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(reverse, weight, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(numeric, weight, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(by_scale, numeric_scale, rtol=1e-6, atol=1e-6)

    def test_vmap_equals_loop(self, loss):
        squared, scales = jnp.asarray(SQUARED[:6], jnp.float32).reshape(3, 2), jnp.asarray([0.5, 1.0, 3.0])
        batched = jax.jit(jax.vmap(lambda s, c: loss_value(s, c, loss)))(squared, scales)
        looped = np.stack([_value(s, c, loss) for s, c in zip(squared, scales, strict=True)])
        np.testing.assert_allclose(batched, looped, rtol=1e-6)

    def test_single_trace(self, loss):
        traced = jax.jit(eqx.debug.assert_max_traces(lambda s, c: loss_weight(s, c, loss), max_traces=1))
        for scale in (0.5, 1.0, 2.0):
            traced(jnp.ones(3), jnp.asarray(scale))

    @pytest.mark.parametrize("scale", [1.0, 0.0, np.nan, np.inf])
    def test_degenerate(self, loss, scale):
        squared = jnp.asarray([0.0, 1.0, np.nan, np.inf, 1e38])
        value, weight = _value(squared, scale, loss), _weight(squared, scale, loss)
        assert np.isfinite(value).all()
        assert np.isfinite(weight).all()
        np.testing.assert_array_equal(value[2:4], 0.0)
        np.testing.assert_array_equal(weight[2:4], 0.0)
        for f in (_value, _weight):
            gradients = jax.grad(lambda s, c, f=f: f(s, c, loss).sum(), argnums=(0, 1))(squared, jnp.asarray(scale))
            assert all(np.isfinite(g).all() for g in gradients)

    @settings(max_examples=20, deadline=None, derandomize=True)
    @given(seed=SEEDS)
    def test_never_trusts_more_than_least_squares(self, loss, seed):
        rng = np.random.default_rng(seed)
        squared, scale = np.sort(rng.exponential(10.0, 28)).astype(np.float32), np.float32(rng.uniform(0.1, 5.0))
        value, weight = np.asarray(_value(squared, scale, loss)), np.asarray(_weight(squared, scale, loss))
        assert (value <= squared * (1 + 1e-5)).all()
        assert ((weight >= 0) & (weight <= 1)).all()
        assert (np.diff(weight) <= 1e-6).all()


class TestMedianAndScale:
    def test_shapes(self):
        values, weights = jnp.arange(5.0), jnp.ones(5)
        assert _median(values, weights).shape == ()
        assert _scale(values, weights).dtype == jnp.float32

    @pytest.mark.parametrize("seed", range(5))
    def test_matches_reference(self, seed):
        rng = np.random.default_rng(seed)
        values, weights = rng.normal(size=101), rng.uniform(0.0, 1.0, 101)
        with jax.enable_x64(True):
            median = float(_median(jnp.asarray(values), jnp.asarray(weights)))
            scale = float(_scale(jnp.asarray(values), jnp.asarray(weights)))
            plain = float(_median(jnp.asarray(values), jnp.ones(101)))
        assert median == _numpy_median(values, weights)
        assert scale == pytest.approx(1.482602218505602 * _numpy_median(np.abs(values - median), weights), rel=1e-12)
        assert plain == np.median(values)

    @pytest.mark.parametrize("seed", range(5))
    def test_of_a_mask_is_that_of_weights_zero_and_one(self, seed):
        """With and without equal values, negative ones, zeros of both signs, and some that are not finite."""
        rng = np.random.default_rng(seed)
        values = np.round(rng.normal(size=60), rng.integers(0, 6)).astype(np.float32)
        values[:3], values[3:5] = (np.nan, np.inf, -np.inf), (0.0, -0.0)
        mask = rng.random(60) < rng.choice([0.0, 0.1, 0.5, 1.0])
        expected = _median(values, mask.astype(np.float32))
        np.testing.assert_array_equal(jax.jit(masked_median)(values, mask), expected)

    def test_of_nothing(self):
        values = jnp.asarray([1.0, jnp.nan])
        assert masked_median(values, jnp.asarray([False, True])) == 0
        assert masked_median(jnp.zeros(0), jnp.zeros(0, bool)) == 0

    def test_scale_withstands_outliers(self):
        rng = np.random.default_rng(0)
        residuals = rng.normal(0.0, 2.5, 4000).astype(np.float32)
        residuals[:1200] = rng.uniform(-1000.0, 1000.0, 1200)
        clean = float(_scale(residuals[1200:], np.ones(2800, np.float32)))
        assert clean == pytest.approx(2.5, rel=0.05)
        assert float(_scale(residuals, np.ones(4000, np.float32))) == pytest.approx(2.5, rel=0.7)

    def test_gradient(self):
        """The median moves with the one value it is; the scale with two."""
        with jax.enable_x64(True):
            values = jnp.asarray(np.random.default_rng(1).normal(size=31))
            weights = jnp.ones(31)
            direction = jnp.asarray(np.random.default_rng(2).normal(size=31))
            for f in (_median, _scale, lambda values, weights: masked_median(values, weights > 0)):
                _, forward = jax.jvp(lambda v, f=f: f(v, weights), (values,), (direction,))
                reverse = jax.grad(f)(values, weights) @ direction
                numeric = (f(values + 1e-7 * direction, weights) - f(values - 1e-7 * direction, weights)) / 2e-7
                np.testing.assert_allclose(forward, numeric, rtol=1e-6)
                np.testing.assert_allclose(reverse, numeric, rtol=1e-6)

    def test_vmap_equals_loop(self):
        rng = np.random.default_rng(0)
        values, weights = (jnp.asarray(rng.uniform(size=(3, 11)), jnp.float32) for _ in range(2))
        batched = jax.jit(jax.vmap(robust_scale))(values, weights)
        np.testing.assert_array_equal(batched, [_scale(v, w) for v, w in zip(values, weights, strict=True)])

    def test_single_trace(self):
        traced = jax.jit(eqx.debug.assert_max_traces(robust_scale, max_traces=1))
        for k in range(3):
            traced(jnp.arange(4.0) * k, jnp.ones(4))

    @pytest.mark.parametrize(
        ("values", "weights", "median"),
        [
            ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], 0.0),
            ([np.nan, np.inf, 3.0], [1.0, 1.0, 1.0], 3.0),
            ([np.nan] * 3, [1.0] * 3, 0.0),
            ([1.0, 2.0, 9.0], [np.nan, -1.0, 1.0], 9.0),
            ([4.0, 4.0, 4.0], [1.0, 1.0, 1.0], 4.0),
        ],
    )
    def test_degenerate(self, values, weights, median):
        values, weights = jnp.asarray(values), jnp.asarray(weights)
        assert float(_median(values, weights)) == median
        assert float(_scale(values, weights)) == 0.0
        for f in (_median, _scale):
            assert all(np.isfinite(g).all() for g in jax.grad(f, argnums=(0, 1))(values, weights))

    @settings(max_examples=20, deadline=None, derandomize=True)
    @given(seed=SEEDS)
    def test_order_and_zero_weights_do_not_matter(self, seed):
        rng = np.random.default_rng(seed)
        values, weights = rng.normal(size=24).astype(np.float32), rng.integers(1, 5, 24).astype(np.float32)
        weights[:6] = 0.0
        changed = values.copy()
        changed[:6] = 1e6
        order = rng.permutation(24)
        for f in (_median, _scale):
            assert float(f(values, weights)) == float(f(changed[order], weights[order]))
