"""Optical flow against OpenCV's and against known warps; its derivative, its invariances, its failures."""

from functools import partial
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox.debug import assert_max_traces
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.image import build_pyramid
from jaxslam_kernels.lk_flow import (
    DEFAULT_PLAN,
    Flow,
    FlowPlan,
    FlowStatus,
    LevelPlan,
    lk_flow,
    lk_flow_forward_backward,
)
from known_warps import corners, picture, warp

WIDTH, HEIGHT = 160, 120
N = 45  # not a multiple of the chunk
EXACT = FlowPlan(LevelPlan(21, 40, 1e-3), LevelPlan(11, 5, 0.2), LevelPlan(21, 100, 1e-12), chunk=32)
"""Iterates until the slope is zero to rounding, as the derivative presumes."""


class Inputs(NamedTuple):
    """What a flow is computed from."""

    previous: Any
    current: Any
    points: Any
    guess: Any
    mask: Any
    min_texture: Any


def _flow(method, num_levels, plan=DEFAULT_PLAN):
    """A function of images, traced no more than once."""
    build = partial(build_pyramid, num_levels=num_levels)

    def run(inputs: Inputs) -> Flow:
        previous, current, points, guess, mask, min_texture = inputs
        return method(build(previous), build(current), points, guess, mask, min_texture=min_texture, plan=plan)

    return assert_max_traces(run, max_traces=1)


# Compiling is what these tests cost; the code LLVM leaves as it is runs as correctly.
_compile = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})

_fast = jax.jit(_flow(lk_flow, 2))
_both_ways = _compile(_flow(lk_flow_forward_backward, 2))
_exact = jax.jit(_flow(lk_flow, 2, EXACT))


def _weighted(flow, weights):
    """A loss that touches every differentiable output of every point."""
    terms = (weights[:2] * flow.points, weights[2:3] * flow.residual[None], weights[3:] * flow.texture[None])
    return sum(jnp.sum(term) for term in terms)


def _with_gradient(run):
    """The flow, and the gradient of a loss along images, points and guess."""

    def loss(moving, fixed, weights):
        flow = run(Inputs(*moving, *fixed))
        return _weighted(flow, weights), flow

    return lambda inputs, weights: jax.grad(loss, has_aux=True)(inputs[:4], inputs[4:], weights)


_fast_gradient = _compile(_with_gradient(_fast))
_fast_gradients = _compile(jax.vmap(_with_gradient(_fast), in_axes=(0, None)))
_exact_gradient = _compile(_with_gradient(_exact))


@_compile
def _exact_derivative(moving, directions, fixed):
    return jax.jvp(lambda *moving: _exact(Inputs(*moving, *fixed)), moving, directions)[1]


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _weights(seed, dtype: type = np.float64):
    scale = np.array([[1.0], [1.0], [0.1], [0.01]])
    return (np.random.default_rng(seed).normal(size=(4, N)) * scale).astype(dtype)


def _pair(seed=0, shift_px=4.0, dtype: type = np.float32):
    """Fresh arrays; they may be written to until they are given to JAX, which reads them when it gets to it."""
    known = warp(picture(WIDTH, HEIGHT), shift_px, seed)
    previous, current = known.previous.astype(dtype), known.current.astype(dtype)
    points = corners(known.previous, N).astype(dtype)
    return Inputs(previous, current, points, points.copy(), np.ones(N, bool), np.array(1, dtype)), known


def _smooth_pair(seed, shift_px):
    """Away from the kinks of the derivative: points between pixels, and no difference is exactly zero."""
    inputs, _ = _pair(seed, shift_px, np.float64)
    inputs.current[:] += np.random.default_rng(seed).uniform(-0.5, 0.5, inputs.current.shape)
    inputs.points[:] += np.array([[0.37], [0.21]])
    return inputs


def _one_of_each(dtype: type):
    """Points for every way a search can end, over and over, and the status each should get."""
    inputs, _ = _pair(shift_px=2.0, dtype=dtype)
    inputs.previous[60:110, 10:60] = 90  # no texture
    steep = inputs.current[0:70, 90:160]
    steep[:] = 128 + 3 * (steep - 128)  # Gauss-Newton steps three times too long
    inputs.previous[100:102, 140] = np.nan
    places = {
        FlowStatus.OK: (80, 40),
        FlowStatus.MASKED: (80, 40),
        FlowStatus.OUTSIDE: (-3, 40),
        FlowStatus.NO_TEXTURE: (35, 85),
        FlowStatus.NOT_CONVERGED: (124, 30),
        FlowStatus.BAD_INPUT: (138, 98),
    }
    turn = np.arange(N) % len(places)
    points = np.array(list(places.values()), dtype).T[:, turn]
    expected = np.array(list(places))[turn]
    return inputs._replace(points=points, guess=points, mask=expected != FlowStatus.MASKED), expected


def _opencv(known, points, max_level):
    """Positions and which were found, with OpenCV's default criteria."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        known.previous, known.current, points.T.copy(), points.T.copy(), winSize=(21, 21), maxLevel=max_level
    )
    return found.T, status[:, 0] > 0


def _within(points, low, high, margin=0):
    low, high = np.array(low)[:, None] - margin, np.array(high)[:, None] + margin
    return np.all((points >= low) & (points <= high), axis=0)


def _distance(a, b):
    return np.linalg.norm(np.asarray(a) - b, axis=0)


def _finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


def _zero(tree):
    return not any(np.any(leaf) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(dtype == np.float64):
        flow = (_fast if dtype == np.float32 else _exact)(_pair(dtype=dtype)[0])
    assert isinstance(flow, Flow)
    assert flow.points.shape == (2, N)
    assert flow.status.shape == flow.residual.shape == flow.texture.shape == flow.ok.shape == (N,)
    assert flow.points.dtype == flow.residual.dtype == flow.texture.dtype == dtype
    assert flow.status.dtype == np.int32


class TestMatchesReference:
    def test_matches_reference(self):
        """Where both converge to the same texture, both find the same minimum, to OpenCV's tolerance."""
        inputs, known = _pair()
        expected, found = _opencv(known, inputs.points, max_level=1)
        flow = _fast(inputs)
        # Where the whole window is in both images, how their borders are treated makes no difference.
        inner = _within(inputs.points, (12, 12), (WIDTH - 13, HEIGHT - 13))
        inner &= _within(expected, (12, 12), (WIDTH - 13, HEIGHT - 13))
        both = np.asarray(flow.ok) & found & inner
        distance = _distance(flow.points, expected)[both]
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
            visible, truth = known.visible(points), known.move(points)
            previous, current = known.previous.astype(np.float32), known.current.astype(np.float32)
            flow = track(Inputs(previous, current, points, points, visible, np.float32(1)))
            assert _finite(flow)
            ours.append(_distance(flow.points, truth)[visible])
            theirs.append(_distance(_opencv(known, points, max_level=3)[0], truth)[visible])
        ours, theirs = np.concatenate(ours), np.concatenate(theirs)
        assert np.mean(ours < 1) >= np.mean(theirs < 1)
        assert np.median(ours) <= np.median(theirs) * 1.02  # both are limited by the rotation of the window

    def test_guess_carries_a_large_motion(self):
        """From a good guess a motion is found that is out of reach otherwise."""
        inputs, known = _pair(seed=6, shift_px=20.0)
        truth, visible = known.move(inputs.points), known.visible(inputs.points)
        alone = _distance(_fast(inputs).points, truth)[visible] < 1
        inputs = inputs._replace(guess=(truth + 1.5).astype(np.float32))
        guided = _distance(_fast(inputs).points, truth)[visible] < 1
        assert guided.mean() > 0.9
        assert alone.mean() < 0.5

    def test_forward_backward_keeps_what_is_right(self):
        inputs, known = _pair()
        both_ways = _both_ways(inputs)
        right = _distance(both_ways.points, known.move(inputs.points)) < 0.5
        assert np.mean(np.asarray(both_ways.ok)[right]) > 0.95

    def test_forward_backward_finds_what_was_covered(self):
        other, found = picture(WIDTH, HEIGHT)[::-1, ::-1], 0
        for seed in range(5):
            inputs, known = _pair(seed)
            inputs.current[30:110, 40:130] = other[30:110, 40:130]
            covered = _within(known.move(inputs.points), (46, 36), (123, 103))
            forward, both_ways = _fast(inputs), _both_ways(inputs)
            assert not np.any(both_ways.ok & covered)
            found += np.sum(forward.ok & covered)
            changed = np.asarray(both_ways.status != forward.status)
            assert np.all(np.asarray(both_ways.status)[changed] == FlowStatus.INCONSISTENT)
            np.testing.assert_allclose(both_ways.points, forward.points, atol=1e-3)
        assert found >= 5, "nothing to find"


class TestGradient:
    @staticmethod
    def _check(inputs):
        """Forward, reverse and central differences along a random direction of each input."""
        tracked = np.asarray(_exact(inputs).ok)
        weights = np.where(tracked[None], _weights(5), 0)
        gradient, _ = _exact_gradient(inputs, weights)
        assert _finite(gradient)
        assert not np.any(gradient[3]), "the guess has no influence"
        rng, eps = np.random.default_rng(5), 1e-6
        for which in range(3):
            direction = rng.normal(size=inputs[which].shape)
            directions = tuple(direction if i == which else np.zeros_like(inputs[i]) for i in range(4))
            forward = _exact_derivative(inputs[:4], directions, inputs[4:])
            reverse = np.sum(gradient[which] * direction)
            np.testing.assert_allclose(reverse, _weighted(forward, weights), rtol=1e-9)
            name = inputs._fields[which]
            ahead, behind = (_exact(inputs._replace(**{name: inputs[which] + e * direction})) for e in (eps, -eps))
            for output, atol in (("points", 1e-7), ("residual", 1e-6), ("texture", 1e-5)):
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
        inputs, expected = _one_of_each(np.float64)
        weights, lost = _weights(0), expected != FlowStatus.OK
        gradient, flow = _exact_gradient(inputs, weights)
        np.testing.assert_array_equal(flow.status, expected)
        assert _finite((gradient, flow))
        assert np.any(gradient[2][:, ~lost], axis=0).all()
        assert not np.any(gradient[2][:, lost])
        without, _ = _exact_gradient(inputs, np.where(lost[None], 0, weights))
        for full, part in zip(gradient, without, strict=True):
            np.testing.assert_array_equal(full, part)


def test_vmap_equals_loop():
    """Flows and gradients of a batch of image pairs."""
    weights = _weights(0, np.float32)
    batch = [_pair(0)[0], _one_of_each(np.float32)[0], _pair(1)[0]]
    batched = _fast_gradients(jax.tree.map(lambda *arrays: np.stack(arrays), *batch), weights)
    for index, inputs in enumerate(batch):
        alone = _fast_gradient(inputs, weights)
        for one, expected in zip(jax.tree.leaves(batched), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(one[index], expected, rtol=1e-4, atol=1e-4)


def test_single_trace():
    """`_flow` refuses a second trace; here everything changes that may without one."""
    for seed in range(3):
        inputs, _ = _pair(seed)
        inputs.guess[:] += seed
        inputs.mask[seed] = False
        _fast(inputs._replace(min_texture=np.float32(seed + 1)))


class TestDegenerate:
    @staticmethod
    def _run(inputs):
        """The flow, and its gradient; all is finite."""
        gradient, flow = _fast_gradient(inputs, _weights(0, np.float32))
        assert _finite((gradient, flow))
        return flow, gradient

    def test_degenerate(self):
        inputs, expected = _one_of_each(np.float32)
        flow, _ = self._run(inputs)
        np.testing.assert_array_equal(flow.status, expected)

    def test_all_masked(self):
        inputs, _ = _pair()
        inputs.mask[:] = False
        flow, gradient = self._run(inputs)
        assert np.all(flow.status == FlowStatus.MASKED)
        np.testing.assert_array_equal(flow.points, inputs.guess)
        assert _zero(gradient)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("which", [0, 1, 2, 3])
    def test_not_a_number(self, which, bad):
        """All of an image, of the points, of the guess."""
        inputs, _ = _pair()
        inputs[which][:] = bad
        flow, gradient = self._run(inputs)
        assert np.all(flow.status == FlowStatus.BAD_INPUT)
        assert _zero(gradient)

    def test_one_bad_point_harms_no_other(self):
        clean, _ = self._run(_pair()[0])
        inputs, _ = _pair()
        inputs.points[0, 5] = np.nan
        flow, _ = self._run(inputs)
        others = np.arange(N) != 5
        assert flow.status[5] == FlowStatus.BAD_INPUT
        for one, expected in zip(flow, clean, strict=True):
            np.testing.assert_array_equal(one[..., others], expected[..., others])

    def test_bad_pixel_far_away_does_no_harm(self):
        clean = np.asarray(self._run(_pair()[0])[0].points)
        inputs, _ = _pair()
        inputs.current[60, 80] = np.nan
        flow, _ = self._run(inputs)
        away = np.max(np.abs(clean - [[80], [60]]), axis=0)
        assert np.any(away < 10)
        assert np.all(np.asarray(flow.status)[away < 10] == FlowStatus.BAD_INPUT)
        np.testing.assert_array_equal(flow.points[:, away > 40], clean[:, away > 40])

    @pytest.mark.parametrize("across", [0.0, 50.0])
    def test_no_texture(self, across):
        """A plain picture; and straight stripes, which leave the motion along them unknown."""
        inputs, _ = _pair()
        for image in inputs[:2]:
            image[:] = 128 + across * np.sin(np.arange(WIDTH) / 3)[None, :]
        flow, _ = self._run(inputs)
        assert np.all(flow.status == FlowStatus.NO_TEXTURE)
        np.testing.assert_array_equal(flow.points, inputs.points)

    def test_zero_motion(self):
        inputs, _ = _pair()
        flow, _ = self._run(inputs._replace(current=inputs.previous))
        assert np.all(flow.ok)
        np.testing.assert_allclose(flow.points, inputs.points, atol=1e-5)
        np.testing.assert_allclose(flow.residual, 0, atol=1e-3)

    def test_borders(self):
        """Points on the outermost pixels are inside, a hair further they are not; none is dragged away."""
        inputs, _ = _pair()
        right, bottom, hair = WIDTH - 1, HEIGHT - 1, 0.01
        inside = [(0, 0), (right, 0), (0, bottom), (right, bottom), (80, 0), (0, 60)]
        outside = [(-hair, 60), (right + hair, 60), (80, -hair), (80, bottom + hair), (1e9, 0), (0, -1e9)]
        inputs.points[:, :12] = inputs.guess[:, :12] = np.array(inside + outside).T
        flow, _ = self._run(inputs._replace(current=inputs.previous))
        assert np.all(np.isin(flow.status[:6], [FlowStatus.OK, FlowStatus.NO_TEXTURE]))
        assert np.all(flow.status[6:12] == FlowStatus.OUTSIDE)
        np.testing.assert_allclose(flow.points[:, :12], inputs.points[:, :12], atol=1e-4)

    def test_leaves_the_image(self):
        """The right part of a picture moves to the left border; of the left part, what is close goes a bit too far."""
        inputs, _ = _pair()
        inputs.points[:, :20] = [np.linspace(58.2, 59.8, 20), np.linspace(20, 100, 20)]
        inputs.guess[:] = inputs.points - np.array([[60], [0]])
        flow, gradient = self._run(inputs._replace(current=np.roll(inputs.previous, -60, axis=1)))
        status, leaving = np.asarray(flow.status), inputs.guess[0] < 0
        near = leaving & _within(np.asarray(flow.points), (-2, 0), (0, HEIGHT - 1))
        assert np.sum(near & (status == FlowStatus.OUTSIDE)) > 5
        assert not np.any(status[leaving] == FlowStatus.OK)
        assert np.mean(status[~leaving] == FlowStatus.OK) > 0.8
        assert not np.any(gradient[2][:, status != FlowStatus.OK])

    def test_guess_far_away(self):
        inputs, _ = _pair()
        inputs.guess[:] += 1e6
        flow, _ = self._run(inputs)
        assert np.all(flow.status == FlowStatus.OUTSIDE)

    def test_one_point(self):
        inputs, _ = _pair()
        first = {name: getattr(inputs, name)[..., :1] for name in ("points", "guess", "mask")}
        flow = _compile(_flow(lk_flow, 2))(inputs._replace(**first))
        assert np.all(flow.ok)
        np.testing.assert_allclose(flow.points, _fast(inputs).points[:, :1], atol=1e-3)

    def test_refuses_pyramids_that_do_not_fit(self):
        points = jnp.zeros((2, 1))
        small, large = (build_pyramid(jnp.zeros((32, width)), num_levels=2) for width in (40, 42))
        narrow = build_pyramid(jnp.zeros((32, 40)), num_levels=2, border=15)
        with pytest.raises(ValueError, match="same levels"):
            lk_flow(small, large, points)
        with pytest.raises(ValueError, match="border: at least 16"):
            lk_flow(narrow, narrow, points)


few = settings(max_examples=8, deadline=None)
seeds = st.integers(0, 2**16)


class TestInvariances:
    @few
    @given(seed=seeds)
    def test_order_of_points(self, seed):
        with jax.enable_x64(True):
            inputs, _ = _pair(dtype=np.float64)
            order = np.random.default_rng(seed).permutation(N)
            reordered = {name: getattr(inputs, name)[..., order] for name in ("points", "guess", "mask")}
            flow, shuffled = _exact(inputs), _exact(inputs._replace(**reordered))
            np.testing.assert_array_equal(shuffled.status, flow.status[order])
            for one, expected in zip(shuffled, flow, strict=True):
                np.testing.assert_allclose(one, expected[..., order], rtol=1e-9, atol=1e-9)

    @few
    @given(seed=seeds)
    def test_masked_points(self, seed):
        flow, (inputs, _) = _fast(_pair()[0]), _pair()
        rng = np.random.default_rng(seed)
        keep = rng.uniform(size=N) < 0.5
        for array in inputs[2:4]:
            array[:, ~keep] = rng.uniform(-50, 200, (2, N))[:, ~keep]
        for one, expected in zip(_fast(inputs._replace(mask=keep)), flow, strict=True):
            np.testing.assert_array_equal(one[..., keep], expected[..., keep])

    @few
    @given(brightness=st.integers(-100, 100))
    def test_brightness(self, brightness):
        with jax.enable_x64(True):
            inputs, _ = _pair(dtype=np.float64)
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
        points = np.where(_within(points, (40, 40), (136, 96)), points, [[80], [60]]) + 0.3
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
