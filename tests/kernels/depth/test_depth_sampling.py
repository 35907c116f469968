"""Depth sampled at points, and where it is missing, against a loop; edges, holes, borders and numbers that are none."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jaxslam_kernels.depth.sampling import lacks_depth, sample_depth, valid_depth

H, W, N = 12, 16, 60

_sample = {reach: jax.jit(lambda d, uv, r=reach: sample_depth(d, uv, reach=r, max_step=0.1)) for reach in range(3)}


@jax.jit
def _pipeline(depth, uv):
    """Samples of what is valid_depth, and the derivative of their sum."""
    samples = lambda depth, uv: sample_depth(valid_depth(depth, 0.3, 8.0), uv)
    return samples(depth, uv), jax.grad(lambda *a: jnp.sum(samples(*a)), argnums=(0, 1))(depth, uv)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _depth(seed=0, dtype: Any = np.float64):
    """A gentle slope, a step at column 9, and holes."""
    v, u = np.mgrid[:H, :W]
    depth = 2 + 0.02 * u + 0.01 * v + 2.0 * (u >= 9)
    depth[np.random.default_rng(seed).uniform(size=(H, W)) < 0.04] = 0
    return depth.astype(dtype)


def _points(seed=0, dtype: Any = np.float64):
    return np.random.default_rng(seed).uniform([[-2.0], [-2.0]], [[W + 1], [H + 1]], (2, N)).astype(dtype)


def _by_loop(depth, uv, reach, max_step):
    samples = []
    for u, v in np.rint(uv).T.astype(int):
        if not (reach <= u < W - reach and reach <= v < H - reach):
            samples.append(0)
            continue
        around = depth[v - reach : v + reach + 1, u - reach : u + reach + 1]
        agree = around.min() > 0 and np.ptp(around) <= max_step * depth[v, u] + 0.02
        samples.append(depth[v, u] if agree else 0)
    return np.array(samples)


class TestSampleDepth:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_shapes(self, dtype):
        with jax.enable_x64(dtype == np.float64):
            samples = _sample[1](_depth(dtype=dtype), _points(dtype=dtype))
        assert samples.shape == (N,)
        assert samples.dtype == dtype

    @pytest.mark.parametrize("reach", [0, 1, 2])
    def test_matches_reference(self, x64, reach):
        depth, uv = _depth(), _points()
        expected = _by_loop(depth, uv, reach, 0.1)
        assert 0 < np.count_nonzero(expected) < N
        np.testing.assert_array_equal(_sample[reach](depth, uv), expected)

    @pytest.mark.parametrize("reach", [0, 1, 2])
    def test_a_step_and_a_hole(self, reach):
        """The step between columns 8 and 9 and a hole at column 3 blind as many columns as the reach says."""
        depth = np.full((H, W), 2.0, np.float32)
        depth[:, 9:], depth[:, 3] = 4.0, 0.0
        samples = _sample[reach](depth, np.stack([np.arange(W), np.full(W, 6)]).astype(np.float32))
        blind = np.zeros(W, bool)
        blind[:reach] = blind[W - reach :] = True
        blind[3 - reach : 4 + reach] = True
        blind[9 - reach : 9 + reach] = True
        np.testing.assert_array_equal(samples, np.where(blind, 0, depth[6]))

    @pytest.mark.parametrize(("rise", "agrees"), [(0.099, True), (0.101, False)])
    @pytest.mark.parametrize("meters", [0.04, 1.0, 40.0])
    def test_at_any_scale(self, meters, rise, agrees):
        depth = np.full((H, W), meters, np.float32)
        depth[5, 6] *= 1 + rise
        assert (_sample[1](depth, np.full((2, 1), 5.0, np.float32))[0] > 0) == agrees

    @pytest.mark.parametrize(("rise", "agrees"), [(0.059, True), (0.061, False)])
    def test_noise_is_allowed_at_any_depth(self, rise, agrees):
        depth = np.full((H, W), 0.4, np.float32)
        depth[5, 6] += rise
        sample = sample_depth(jnp.asarray(depth), jnp.full((2, 1), 5.0), max_step=0.1, noise=0.02)
        assert (sample[0] > 0) == agrees

    def test_nearest_pixel(self, x64):
        uv = np.array([[4.49, 3.51, 4.4], [6.4, 5.6, 6.49]])
        depth = np.arange(H * W, dtype=float).reshape(H, W)
        np.testing.assert_array_equal(_sample[0](depth, uv), [depth[6, 4]] * 3)

    def test_gradient(self, x64):
        """That of picking a pixel; none with respect to where."""
        depth, uv = _depth(), _points()
        check_grads(_sample[1], (depth, uv), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-8)
        samples, (by_depth, by_uv) = _pipeline(depth, uv)
        assert float(by_depth.sum()) == np.count_nonzero(samples)
        np.testing.assert_array_equal(by_uv, 0)

    def test_gradient_close_to_being_refused(self, x64):
        """A difference of depth a hair below the largest one allowed."""
        depth = np.full((H, W), 2.0)
        depth[5, 6] = 2.0 * 1.1 - 1e-5
        uv = np.full((2, 1), 5.0)
        assert _sample[1](depth, uv)[0] == 2.0
        check_grads(_sample[1], (depth, uv), order=1, modes=("fwd", "rev"), eps=1e-7, rtol=1e-6)

    def test_vmap_equals_loop(self, x64):
        depths, points = np.stack([_depth(s) for s in range(3)]), np.stack([_points(s) for s in range(3)])
        batched = jax.jit(jax.vmap(lambda d, uv: sample_depth(d, uv, max_step=0.1)))(depths, points)
        for k in range(3):
            np.testing.assert_array_equal(batched[k], _sample[1](depths[k], points[k]))

    def test_single_trace(self):
        compute = jax.jit(eqx.debug.assert_max_traces(sample_depth, max_traces=1))
        for seed in range(3):
            compute(_depth(seed, np.float32), _points(seed, np.float32))

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("case", ["points", "depth NaN", "depth infinite", "depth missing"])
    def test_degenerate(self, case, dtype):
        depth, uv = _depth(dtype=dtype), _points(dtype=dtype)
        match case:
            case "points":
                uv[:] = np.resize(np.array([np.nan, np.inf, -np.inf, 1e30, -1e30, 3e9, -3e9]), (2, N))
            case "depth NaN":
                depth[:] = np.nan
            case "depth infinite":
                depth[:] = np.inf
            case "depth missing":
                depth[:] = 0
        with jax.enable_x64(dtype == np.float64):
            results = (_sample[1](depth, uv), *jax.tree.leaves(_pipeline(depth, uv)))
        for result in results:
            np.testing.assert_array_equal(result, 0)

    @pytest.mark.parametrize("hole", [np.nan, np.inf, -np.inf, -1.0])
    def test_a_bad_pixel_is_a_hole(self, x64, hole):
        depth, bad = _depth(), _depth()
        depth[4:6, 4:6], bad[4:6, 4:6] = 0, hole
        for reach in range(3):
            np.testing.assert_array_equal(_sample[reach](bad, _points()), _sample[reach](depth, _points()))


class TestBelievable:
    def test_matches_reference(self):
        depth = np.array([[0.2, 0.3, 0.31, 7.9, 8.0, 9.0], [0.0, -1.0, np.nan, np.inf, -np.inf, 5.0]], np.float32)
        expected = np.array([[0, 0, 0.31, 7.9, 0, 0], [0, 0, 0, 0, 0, 5.0]], np.float32)
        result = valid_depth(jnp.asarray(depth), jnp.float32(0.3), 8.0)
        assert result.dtype == np.float32
        np.testing.assert_array_equal(result, expected)

    def test_gradient(self):
        depth = jnp.array([[1.0, jnp.nan, jnp.inf, 0.1]])
        gradient = jax.grad(lambda depth: jnp.sum(jnp.square(valid_depth(depth, 0.3, 8.0))))(depth)
        np.testing.assert_array_equal(gradient, [[2, 0, 0, 0]])


class TestLacksDepth:
    @pytest.mark.parametrize("reach", [0, 1, 3])
    def test_matches_reference(self, reach: int) -> None:
        """Holes of every width, at the edges too."""
        depth, uv = _with_holes(), np.mgrid[:H, :W].reshape(2, -1)[::-1].astype(np.float32)
        padded = np.pad(valid_depth(jnp.asarray(depth), 0.3, 8.0), reach)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1, 2 * reach + 1))
        leaves = (np.minimum(*uv) < reach) | (uv[0] >= W - reach) | (uv[1] >= H - reach)
        expected = leaves | ~(windows > 0).any(axis=(2, 3)).ravel()
        missing = lacks_depth(jnp.asarray(depth), jnp.asarray(uv), reach=reach, nearest=0.3, farthest=8.0)
        np.testing.assert_array_equal(missing, expected)
        assert 0 < np.sum(missing) < len(expected)

    def test_not_a_number_is_no_depth(self) -> None:
        nothing, uv = jnp.full((H, W), jnp.nan, jnp.float32), jnp.full((2, 1), 5.0, jnp.float32)
        one_pixel = nothing.at[4, 6].set(2.0)
        assert lacks_depth(nothing, uv, reach=2).all()
        assert not lacks_depth(one_pixel, uv, reach=2).any()
        assert lacks_depth(one_pixel, uv * jnp.nan, reach=2).all()

    def test_vmap_equals_loop(self) -> None:
        depths = jnp.stack([_with_holes(seed) for seed in range(3)])
        points = jnp.stack([_points(seed, np.float32) for seed in range(3)])
        batched = jax.vmap(lambda d, uv: lacks_depth(d, uv, reach=2))(depths, points)
        for k in range(3):
            np.testing.assert_array_equal(batched[k], lacks_depth(depths[k], points[k], reach=2))


def _with_holes(seed: int = 0) -> np.ndarray:
    """A wide hole, a narrow one, and what is too near and too far."""
    depth = _depth(seed, np.float32)
    depth[:, 10:] = 0
    depth[3:6, 4] = 0
    depth[7:, :3], depth[:2, :4] = 0.2, 9.0
    return depth
