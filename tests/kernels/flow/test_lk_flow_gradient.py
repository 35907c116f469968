"""The derivative of optical flow against finite differences, and its invariances, in float64."""

import jax
import numpy as np
import pytest
from flow_cases import (
    HEIGHT,
    WIDTH,
    Inputs,
    N,
    all_finite,
    flow_of,
    image_pair,
    one_of_each,
    random_weights,
    weighted_sum,
    with_gradient,
    within,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.flow.lk_flow import FlowPlan, FlowStatus, LevelPlan, lk_flow
from quick_compile import quick_compile

from jaxslam.benchmark.kernels.scenes.image_warps import corners, picture, warp

EXACT = FlowPlan(LevelPlan(21, 40, 1e-3), LevelPlan(11, 5, 0.2), LevelPlan(21, 100, 1e-12), chunk=32)
"""Iterates until the slope is zero to rounding, as the derivative presumes."""

_exact = jax.jit(flow_of(lk_flow, 2, EXACT))
_exact_gradient = quick_compile(with_gradient(_exact))


@quick_compile
def _exact_derivative(moving, directions, fixed):
    return jax.jvp(lambda *moving: _exact(Inputs(*moving, *fixed)), moving, directions)[1]


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _smooth_pair(seed, shift_px):
    """Away from the kinks of the derivative: points between pixels, and no difference is exactly zero."""
    inputs, _ = image_pair(seed, shift_px, np.float64)
    inputs.current[:] += np.random.default_rng(seed).uniform(-0.5, 0.5, inputs.current.shape)
    inputs.points[:] += np.array([[0.37], [0.21]])
    return inputs


class TestGradient:
    @staticmethod
    def _check(inputs):
        """Forward, reverse and central differences along a random direction of each input."""
        tracked = np.asarray(_exact(inputs).ok)
        weights = np.where(tracked[None], random_weights(5), 0)
        gradient, _ = _exact_gradient(inputs, weights)
        assert all_finite(gradient)
        assert not np.any(gradient[3]), "the guess has no influence"
        rng, eps = np.random.default_rng(5), 1e-6
        for which in range(3):
            direction = rng.normal(size=inputs[which].shape)
            directions = tuple(direction if i == which else np.zeros_like(inputs[i]) for i in range(4))
            forward = _exact_derivative(inputs[:4], directions, inputs[4:])
            reverse = np.sum(gradient[which] * direction)
            np.testing.assert_allclose(reverse, weighted_sum(forward, weights), rtol=1e-9)
            name = inputs._fields[which]
            ahead, behind = (_exact(inputs._replace(**{name: inputs[which] + e * direction})) for e in (eps, -eps))
            for output, atol in (("points", 1e-7), ("residual", 1e-6), ("texture", 1e-5), ("correlation", 1e-8)):
                numeric = (getattr(ahead, output) - getattr(behind, output))[..., tracked] / (2 * eps)
                np.testing.assert_allclose(getattr(forward, output)[..., tracked], numeric, rtol=1e-6, atol=atol)

    def test_gradient(self, x64):
        inputs = _smooth_pair(1, 4.0)
        assert np.mean(_exact(inputs).ok) > 0.8
        self._check(inputs)

    def test_gradient_near_the_singular_case(self, x64):
        """Stripes: the gradient along them is hundreds of times weaker than across, and just enough."""
        inputs = _smooth_pair(2, 0.5)
        stripes = 40 * np.sin(np.arange(WIDTH) / 3)[None, :]
        for image in inputs[:2]:
            image[:] = 128 + stripes + 0.03 * image
        texture = np.asarray(_exact(inputs._replace(min_texture=np.array(1e-9))).texture)
        least = np.median(texture)
        assert least < 0.01 * np.mean(np.square(np.gradient(stripes[0])))
        inputs = inputs._replace(min_texture=np.array(0.999 * least))
        assert np.any(_exact(inputs).ok & (texture < 1.001 * least)), "no point is at the limit"
        self._check(inputs)

    def test_points_not_tracked_have_none(self, x64):
        inputs, expected = one_of_each(np.float64)
        weights, lost = random_weights(0), expected != FlowStatus.OK
        gradient, flow = _exact_gradient(inputs, weights)
        np.testing.assert_array_equal(flow.status, expected)
        assert all_finite((gradient, flow))
        assert np.any(gradient[2][:, ~lost], axis=0).all()
        assert not np.any(gradient[2][:, lost])
        without, _ = _exact_gradient(inputs, np.where(lost[None], 0, weights))
        for full, part in zip(gradient, without, strict=True):
            np.testing.assert_array_equal(full, part)


few = settings(max_examples=8, deadline=None)
seeds = st.integers(0, 2**16)


class TestInvariances:
    @few
    @given(seed=seeds)
    def test_order_of_points(self, seed):
        with jax.enable_x64(True):
            inputs, _ = image_pair(dtype=np.float64)
            order = np.random.default_rng(seed).permutation(N)
            reordered = {name: getattr(inputs, name)[..., order] for name in ("points", "guess", "mask")}
            flow, shuffled = _exact(inputs), _exact(inputs._replace(**reordered))
            np.testing.assert_array_equal(shuffled.status, flow.status[order])
            for one, expected in zip(shuffled, flow, strict=True):
                np.testing.assert_allclose(one, expected[..., order], rtol=1e-9, atol=1e-9)

    @few
    @given(brightness=st.integers(-100, 100))
    def test_brightness(self, brightness):
        with jax.enable_x64(True):
            inputs, _ = image_pair(dtype=np.float64)
            flow = _exact(inputs)
            brighter = _exact(
                inputs._replace(previous=inputs.previous + brightness, current=inputs.current + brightness)
            )
            np.testing.assert_array_equal(brighter.status, flow.status)
            ok = np.asarray(flow.ok)
            np.testing.assert_allclose(brighter.points[:, ok], flow.points[:, ok], atol=1e-6)

    @few
    @given(du=st.integers(-8, 8), dv=st.integers(-8, 8))
    def test_integer_shift(self, du, dv):
        """The same scene cut out of larger pictures at another place."""
        known = warp(picture(WIDTH + 16, HEIGHT + 16), 3.0, 4)
        points = corners(known.previous, N)
        points = np.where(within(points, (40, 40), (136, 96)), points, [[80], [60]]) + 0.3
        flows = []
        with jax.enable_x64(True):
            for left, top in ((8, 8), (8 + du, 8 + dv)):
                origin = np.array([[left], [top]])
                first, second = (image[top : top + HEIGHT, left : left + WIDTH].astype(float) for image in known[:2])
                start = points - origin
                flow = _exact(Inputs(first, second, start, start, np.ones(N, bool), np.array(1.0)))
                flows.append(flow._replace(points=np.asarray(flow.points) + origin))
        here, there = flows
        ok = np.asarray(here.ok & there.ok)
        assert np.mean(ok) > 0.8
        np.testing.assert_allclose(there.points[:, ok], here.points[:, ok], atol=1e-6)
