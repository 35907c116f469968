"""Optical flow against OpenCV's and against known warps; its derivative, its invariances, its failures."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox.debug import assert_max_traces
from hypothesis import given, settings
from hypothesis import strategies as st
from known_warps import corners, picture, warp

from jaxslam_kernels.image import build_pyramid
from jaxslam_kernels.lk_flow import Flow, FlowPlan, FlowStatus, LevelPlan, lk_flow, lk_flow_forward_backward

WIDTH, HEIGHT = 160, 120
N = 45  # not a multiple of the chunk
EXACT = FlowPlan(LevelPlan(21, 40, 1e-3), LevelPlan(11, 5, 0.2), LevelPlan(21, 100, 1e-12), chunk=32)
"""Iterates until the slope is zero to rounding, as the derivative presumes."""
OPENCV = {"winSize": (21, 21), "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)}


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _flow(method, num_levels, plan=None):
    """A compiled function of images, as a user calls it."""
    build = partial(build_pyramid, num_levels=num_levels)
    chosen = {} if plan is None else {"plan": plan}

    def run(previous, current, points, guess, mask, min_texture=None):
        least = jnp.ones((), points.dtype) if min_texture is None else min_texture
        return method(build(previous), build(current), points, guess, mask, min_texture=least, **chosen)

    return run


_fast = jax.jit(_flow(lk_flow, 2))
_both_ways = jax.jit(_flow(lk_flow_forward_backward, 2))
_exact = jax.jit(_flow(lk_flow, 2, EXACT))


def _weighted(flow, weights):
    """A loss that touches every differentiable output of every point."""
    terms = (weights[:2] * flow.points, weights[2:3] * flow.residual[None], weights[3:] * flow.texture[None])
    return sum(jnp.sum(term) for term in terms)


def _exact_loss(previous, current, points, guess, mask, weights, min_texture):
    return _weighted(_flow(lk_flow, 2, EXACT)(previous, current, points, guess, mask, min_texture), weights)


_exact_gradient = jax.jit(jax.grad(_exact_loss, argnums=(0, 1, 2, 3)))


@jax.jit
def _exact_derivative(arguments, directions, *constants):
    return jax.jvp(lambda *moving: _exact_loss(*moving, *constants), arguments, directions)[1]


@partial(jax.jit, static_argnums=0)
def _fast_gradient(method, previous, current, points, guess, mask, weights):
    def loss(previous, current, points):
        flow = method(previous, current, points, guess, mask)
        return _weighted(flow, weights), flow

    return jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(previous, current, points)


def _weights(seed, n):
    return np.random.default_rng(seed).normal(size=(4, n)) * np.array([[1.0], [1.0], [0.1], [0.01]])


def _pair(seed=0, shift_px=4.0, dtype=np.float32):
    """Arguments of a flow: two images, points, guess, mask; and the truth."""
    known = warp(picture(WIDTH, HEIGHT), shift_px, seed)
    points = corners(known.previous, N)
    arguments = [array.astype(dtype) for array in (known.previous, known.current, points, points)]
    return [*arguments, np.ones(N, bool)], known


def _smooth_pair(seed, shift_px):
    """The same away from the kinks of the derivative: between pixels, and no difference is exactly zero."""
    (previous, current, points, guess, mask), _ = _pair(seed, shift_px, np.float64)
    current += np.random.default_rng(seed).uniform(-0.5, 0.5, current.shape)
    return [previous, current, points + np.array([[0.37], [0.21]]), guess, mask]


def _finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(dtype == np.float64):
        arguments, _ = _pair(dtype=dtype)
        flow = (_fast if dtype == np.float32 else _exact)(*arguments)
    assert isinstance(flow, Flow)
    assert flow.points.shape == (2, N)
    assert flow.status.shape == flow.residual.shape == flow.texture.shape == flow.ok.shape == (N,)
    assert flow.points.dtype == flow.residual.dtype == flow.texture.dtype == dtype
    assert flow.status.dtype == np.int32


class TestMatchesReference:
    def test_matches_reference(self):
        """Where both converge to the same texture, both find the same minimum, to OpenCV's tolerance."""
        arguments, known = _pair()
        expected, found, _ = cv2.calcOpticalFlowPyrLK(
            known.previous, known.current, arguments[2].T.copy(), None, maxLevel=1, **OPENCV
        )
        flow = _fast(*arguments)
        margin = 12  # where the whole window is in both images, their borders make no difference
        inner = np.all([_inner(points, margin) for points in (arguments[2], expected.T)], axis=0)
        both = np.asarray(flow.ok) & (found[:, 0] > 0) & inner
        distance = np.linalg.norm(flow.points - expected.T, axis=0)[both]
        assert both.sum() > 0.5 * N
        assert np.median(distance) < 0.005
        assert np.mean(distance < 0.05) > 0.95

    def test_matches_reference_of_known_warps(self):
        """Motions of up to 25 pixels: at least as many points within a pixel as OpenCV, and as close."""
        image = picture(320, 240)
        points = corners(image, 300, distance=5)
        track = jax.jit(_flow(lk_flow, 4))
        ours, theirs = [], []
        for seed, shift_px in enumerate((0, 2, 5, 8, 12, 16, 20, 25)):
            known = warp(image, shift_px, seed)
            visible = known.visible(points)
            flow = track(*(a.astype(np.float32) for a in (image, known.current, points, points)), visible)
            assert _finite(flow)
            opencv = cv2.calcOpticalFlowPyrLK(image, known.current, points.T.copy(), None, maxLevel=3, **OPENCV)[0]
            ours.append(_distance(flow.points, known.move(points))[visible])
            theirs.append(_distance(opencv.T, known.move(points))[visible])
        ours, theirs = np.concatenate(ours), np.concatenate(theirs)
        assert np.mean(ours < 1) >= np.mean(theirs < 1)
        assert np.median(ours) <= np.median(theirs) * 1.02  # both are limited by the rotation of the window

    def test_guess_carries_a_large_motion(self):
        """From a good guess a motion is found that is out of reach otherwise."""
        arguments, known = _pair(seed=6, shift_px=20.0)
        truth, visible = known.move(arguments[2]), known.visible(arguments[2])
        alone = _distance(_fast(*arguments).points, truth)[visible] < 1
        arguments[3] = (truth + 1.5).astype(np.float32)
        guided = _distance(_fast(*arguments).points, truth)[visible] < 1
        assert guided.mean() > 0.9
        assert alone.mean() < 0.5

    def test_forward_backward_finds_what_was_covered(self):
        arguments, known = _pair()
        other = picture(WIDTH, HEIGHT)[::-1, ::-1]
        arguments[1][20:80, 30:90] = other[20:80, 30:90]
        truth = known.move(arguments[2])
        covered = _within(truth, (30, 20), (90, 80), margin=-10)
        free = ~_within(truth, (30, 20), (90, 80), margin=14) & _inner(truth, 5)
        forward, both_ways = _fast(*arguments), _both_ways(*arguments)
        assert covered.sum() > 5
        assert free.sum() > 10
        assert np.any(forward.ok & covered), "nothing to find"
        assert not np.any(both_ways.ok & covered)
        assert np.mean(np.asarray(both_ways.ok)[free]) > 0.9
        changed = np.asarray(both_ways.status != forward.status)
        assert np.all(np.asarray(both_ways.status)[changed] == FlowStatus.INCONSISTENT)
        np.testing.assert_array_equal(both_ways.points, forward.points)


def _inner(points, margin):
    return _within(points, (0, 0), (WIDTH - 1, HEIGHT - 1), -margin)


def _within(points, low, high, margin):
    low, high = np.array(low)[:, None] - margin, np.array(high)[:, None] + margin
    return np.all((points >= low) & (points <= high), axis=0)


def _distance(a, b):
    return np.linalg.norm(np.asarray(a) - b, axis=0)


class TestGradient:
    @staticmethod
    def _check(arguments, min_texture):
        """Forward, reverse and central differences along a random direction of each input."""
        *moving, guess, mask = arguments
        min_texture = np.asarray(min_texture)
        tracked = np.asarray(_exact(*arguments, min_texture).ok)
        weights = np.where(tracked[None], _weights(5, N), 0)
        constants = (guess, mask, weights, min_texture)
        gradient = _exact_gradient(*moving, *constants)
        assert _finite(gradient)
        assert not np.any(gradient[3]), "the guess has no influence"
        rng, eps = np.random.default_rng(5), 1e-6
        for which, array in enumerate(moving):
            directions = [np.zeros_like(other) for other in moving]
            directions[which] = rng.normal(size=array.shape)
            forward = _exact_derivative(moving, directions, *constants)
            np.testing.assert_allclose(np.sum(gradient[which] * directions[which]), forward, rtol=1e-9)
            ends = [
                _weighted(_exact(*(a + step * d for a, d in zip(moving, directions, strict=True)), *rest), weights)
                for rest in [(guess, mask, min_texture)]
                for step in (eps, -eps)
            ]
            np.testing.assert_allclose((ends[0] - ends[1]) / (2 * eps), forward, rtol=1e-6)

    def test_gradient(self, x64):
        arguments = _smooth_pair(1, 4.0)
        assert np.mean(_exact(*arguments, np.asarray(1.0)).ok) > 0.8
        self._check(arguments, min_texture=1.0)

    def test_gradient_near_the_singular_case(self, x64):
        """Stripes: the gradient along them is hundreds of times weaker than across, and just enough."""
        arguments = _smooth_pair(2, 0.5)
        stripes = 40 * np.sin(np.arange(WIDTH) / 3)[None, :]
        for image in arguments[:2]:
            image[:] = 128 + stripes + 0.03 * image
        texture = np.asarray(_exact(*arguments, np.asarray(1e-9)).texture)
        least = np.median(texture)
        across = np.mean(np.square(np.gradient(stripes[0])))
        assert least < 0.01 * across
        flow = _exact(*arguments, np.asarray(0.999 * least))
        assert np.any(flow.ok & (texture < 1.001 * least)), "no point is at the limit"
        self._check(arguments, min_texture=0.999 * least)

    def test_points_not_tracked_have_none(self, x64):
        arguments, expected = _one_of_each(np.float64)
        flow = _exact(*arguments)
        np.testing.assert_array_equal(flow.status, expected)
        lost = ~np.asarray(flow.ok)
        weights = _weights(0, lost.size)
        gradient = _exact_gradient(*arguments, weights, np.asarray(1.0))
        assert _finite(gradient)
        assert np.any(gradient[2][:, ~lost], axis=0).all()
        assert not np.any(gradient[2][:, lost])
        without = _exact_gradient(*arguments, np.where(lost[None], 0, weights), np.asarray(1.0))
        for full, part in zip(gradient, without, strict=True):
            np.testing.assert_array_equal(full, part)


def _one_of_each(dtype):
    """A point for every way a search can end, and the status it should get."""
    (previous, current, *_), _ = _pair(shift_px=2.0, dtype=dtype)
    previous[60:110, 10:60] = 90  # no texture
    current[0:70, 90:160] = 128 + 3 * (current[0:70, 90:160] - 128)  # Gauss-Newton steps three times too long
    previous[100:102, 140] = np.nan
    columns = {
        FlowStatus.OK: (80, 40),
        FlowStatus.MASKED: (80, 40),
        FlowStatus.OUTSIDE: (-3, 40),
        FlowStatus.NO_TEXTURE: (35, 85),
        FlowStatus.NOT_CONVERGED: (124, 30),
        FlowStatus.BAD_INPUT: (138, 98),
    }
    points = np.array(list(columns.values()), dtype).T
    expected = np.array(list(columns))
    return [previous, current, points, points.copy(), expected != FlowStatus.MASKED], expected
