"""Disparities of points against a real pair with measured truth, OpenCV's matching, and finite differences."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox.debug import assert_max_traces
from flow_cases import all_finite
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.flow.disparity import ROW_PLAN, Disparities, row_disparities
from jaxslam_kernels.flow.lk_search import LevelPlan
from jaxslam_kernels.image.pyramid import build_pyramid
from quick_compile import quick_compile, quick_compile_nested
from skimage.data import stereo_motorcycle

from jaxslam.benchmark.kernels.scenes.image_warps import corners, picture

WIDTH, HEIGHT, N = 160, 120, 40
SHIFT_PX = 6.3
EXACT = ROW_PLAN._replace(finest=LevelPlan(13, 200, 1e-12))


def _run(plan=ROW_PLAN, **options):
    def disparities(left, right, points, guess, mask):
        left, right = (build_pyramid(image, num_levels=2) for image in (left, right))
        return row_disparities(left, right, points, guess, mask, plan=plan, **options)

    return disparities


_match = quick_compile(assert_max_traces(_run(), max_traces=1))
_exact = quick_compile_nested(_run(EXACT))


def _loss(weights, run, *inputs):
    found = run(*inputs)
    return jnp.sum(weights * (found.disparity + 0.1 * found.residual)), found


_gradient = quick_compile(lambda weights, *inputs: jax.grad(_loss, (2, 3, 4), has_aux=True)(weights, _run(), *inputs))


@functools.cache
def _motorcycle():
    """Gray left and right image (Middlebury 2014), and the disparity of each pixel of the left one, 0 where unknown."""
    left, right, disparity = stereo_motorcycle()
    gray = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    return *gray, np.where(np.isfinite(disparity), disparity, 0)


def _pair(dtype: type = np.float32, seed=0):
    """A picture and the same seen from the right: a plane whose disparity falls from top to bottom."""
    left = picture(WIDTH, HEIGHT).astype(dtype)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    true = SHIFT_PX - 2.0 * v / HEIGHT
    right = cv2.remap(left.astype(np.float32), u + true, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT).astype(
        dtype
    )
    rng = np.random.default_rng(seed)
    right = (right + rng.normal(0, 0.5, right.shape)).astype(dtype)
    points = corners(picture(WIDTH, HEIGHT), N).astype(dtype)
    guess = np.full(N, SHIFT_PX + rng.uniform(-2, 1), dtype)
    return left, right, points, guess, np.ones(N, bool)


def _truth(points):
    return SHIFT_PX - 2.0 * points[1] / HEIGHT


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(True):
        found = jax.eval_shape(_run(), *_pair(dtype))
    assert isinstance(found, Disparities)
    assert found.disparity.shape == found.found.shape == found.residual.shape == (N,)
    assert found.disparity.dtype == found.residual.dtype == dtype
    assert found.found.dtype == bool


class TestMatchesReference:
    def test_matches_reference(self):
        """A real pair, from what half-size block matching says: nearer to the truth than semi-global matching is."""
        left, right, true = _motorcycle()
        points = corners(left, 800, distance=6).astype(np.float32)
        column, row = points.round().astype(int)
        matcher = cv2.StereoSGBM.create(0, 64, 5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=10)
        theirs = matcher.compute(left, right)[row, column] / 16
        guess = true[row, column] + np.random.default_rng(0).uniform(-2, 2, points.shape[1])
        known = true[row, column] > 0
        found = quick_compile(_run())(left, right, points, guess.astype(np.float32), known)
        both = np.asarray(found.found) & (theirs > 0)
        ours, opencv = (np.abs(disparity[both] - true[row, column][both]) for disparity in (found.disparity, theirs))
        assert np.mean(np.asarray(found.found)[known]) > 0.75
        assert np.median(ours) < np.median(opencv)
        assert np.mean(ours < 1) > 0.9

    def test_matches_known_plane(self):
        left, right, points, guess, mask = _pair()
        found = _match(left, right, points, guess, mask)
        inner = points[0] > 16
        assert np.mean(np.asarray(found.found)[inner]) > 0.9
        error = np.abs(found.disparity - _truth(points))[np.asarray(found.found)]
        assert np.median(error) < 0.05

    def test_finds_what_is_covered(self):
        """Points whose place in the right image something hides are not found."""
        left, right, points, guess, mask = _pair()
        right[40:90, 50:110] = picture(WIDTH, HEIGHT)[::-1, ::-1][40:90, 50:110]
        at = points - np.stack([_truth(points), np.zeros(N)])
        covered = (at[0] > 58) & (at[0] < 102) & (at[1] > 48) & (at[1] < 82)
        assert covered.sum() > 3
        found = _match(left, right, points, guess, mask)
        wrong = np.abs(found.disparity - _truth(points)) > 1
        assert not np.any(np.asarray(found.found) & covered & ~wrong)
        assert np.mean(np.asarray(found.found)[covered]) < 0.3

    @pytest.mark.slow
    def test_what_was_expected_needs_no_way_back(self):
        """One way only near the guess: the same disparities, and whatever is further off still has to come back."""
        left, right, points, guess, mask = _pair()
        right[40:90, 50:110] = picture(WIDTH, HEIGHT)[::-1, ::-1][40:90, 50:110]
        both, one = (
            quick_compile(_run(expected_px=expected_px))(left, right, points, guess, mask) for expected_px in (0.0, 1.0)
        )
        returned, found = np.asarray(both.found), np.asarray(one.found)
        assert np.all(found[returned])
        np.testing.assert_array_equal(one.disparity[returned], both.disparity[returned])
        assert np.all(np.abs(one.disparity - guess)[found & ~returned] < 1)


class TestGradient:
    @pytest.mark.slow
    def test_gradient(self):
        """Forward, reverse and central differences agree; the guess has no part in it."""
        with jax.enable_x64(True):
            left, right, points, guess, mask = _pair(np.float64)
            points = points + np.array([[0.37], [0.21]])
            fixed = np.asarray(_exact(left, right, points, guess, mask).found)
            rng, eps = np.random.default_rng(1), 1e-6
            weights = np.where(fixed, rng.normal(size=N), 0)
            loss = lambda *inputs: jnp.sum(weights * _exact(*inputs, guess, mask).disparity)
            inputs = [left, right, points]
            reverse = jax.grad(loss, (0, 1, 2))(*inputs)
            for which in range(3):
                direction = rng.normal(size=inputs[which].shape)
                ahead, behind = ([*inputs], [*inputs])
                ahead[which], behind[which] = inputs[which] + eps * direction, inputs[which] - eps * direction
                numeric = (loss(*ahead) - loss(*behind)) / (2 * eps)
                tangents = [direction if i == which else np.zeros_like(array) for i, array in enumerate(inputs)]
                forward = jax.jvp(loss, inputs, tangents)[1]
                np.testing.assert_allclose(np.sum(reverse[which] * direction), forward, rtol=1e-9)
                np.testing.assert_allclose(forward, numeric, rtol=1e-5, atol=1e-7)

    @pytest.mark.slow
    def test_gradient_of_what_is_not_found(self):
        left, right, points, guess, mask = _pair()
        gradient, found = _gradient(np.ones(N, np.float32), left, np.full_like(right, 90), points, guess, mask)
        assert not np.any(found.found)
        assert all_finite(gradient)
        assert not np.any(gradient[2])


def test_vmap_equals_loop():
    pairs = [_pair(seed=seed) for seed in range(2)]
    batched = quick_compile(jax.vmap(_run()))(*(np.stack(arrays) for arrays in zip(*pairs, strict=True)))
    for index, pair in enumerate(pairs):
        for one, expected in zip(batched, _match(*pair), strict=True):
            np.testing.assert_allclose(one[index], expected, atol=1e-4)


def test_single_trace():
    """`_match` refuses a second trace; here everything changes that may without one."""
    for seed in range(3):
        left, right, points, guess, mask = _pair(seed=seed)
        mask[seed] = False
        assert not _match(left, right, points + seed, guess, mask).found[seed]


class TestDegenerate:
    @pytest.mark.parametrize("which", range(4))
    def test_not_a_number(self, which):
        inputs = [array.copy() for array in _pair()]
        inputs[which][:] = np.nan
        gradient, found = _gradient(np.ones(N, np.float32), *inputs)
        assert not np.any(found.found & (which < 3))
        assert all_finite((gradient, found))

    def test_degenerate(self):
        """Nothing wanted; no texture; the same picture twice, which is at infinity."""
        left, right, points, guess, mask = _pair()
        plain = np.full_like(left, 90)
        for inputs in (
            (left, right, points, guess, ~mask),
            (plain, plain, points, guess, mask),
            (left, left, points, np.zeros_like(guess), mask),
        ):
            gradient, found = _gradient(np.ones(N, np.float32), *inputs)
            assert not np.any(found.found)
            assert not np.any(found.disparity)
            assert all_finite((gradient, found))

    def test_narrow_border(self):
        wide = ROW_PLAN._replace(finest=LevelPlan(17, 8, 0.02))
        with pytest.raises(ValueError, match="border: at least 17 pixels needed by this plan, got 16"):
            jax.eval_shape(_run(wide), *_pair())

    def test_stripes_along_the_rows(self):
        """What has texture across its row only is not matched."""
        _, _, points, guess, mask = _pair()
        stripes = np.broadcast_to(128 + 50 * np.sin(np.arange(HEIGHT) / 3)[:, None], (HEIGHT, WIDTH)).astype(np.float32)
        assert not np.any(_match(stripes, stripes, points, guess, mask).found)


class TestInvariances:
    @settings(max_examples=8, deadline=None)
    @given(seed=st.integers(0, 2**16))
    def test_order_of_points(self, seed):
        left, right, points, guess, mask = _pair()
        order = np.random.default_rng(seed).permutation(N)
        alone = _match(left, right, points, guess, mask)
        other = _match(left, right, points[:, order], guess[order], mask)
        for one, expected in zip(other, alone, strict=True):
            np.testing.assert_allclose(one, np.asarray(expected)[order], atol=1e-3)

    @pytest.mark.parametrize("brighter", [-20.0, 20.0])
    def test_brightness(self, brighter):
        """Of one camera: the other exposes by itself."""
        left, right, points, guess, mask = _pair()
        alone, other = (_match(left, image, points, guess, mask) for image in (right, right + np.float32(brighter)))
        np.testing.assert_array_equal(other.found, alone.found)
        np.testing.assert_allclose(other.disparity, alone.disparity, atol=5e-3)
