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


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _flow(method, num_levels, plan=DEFAULT_PLAN):
    """A compiled function of images, as a user calls it."""
    build = partial(build_pyramid, num_levels=num_levels)

    def run(previous, current, points, guess, mask, min_texture):
        return method(build(previous), build(current), points, guess, mask, min_texture=min_texture, plan=plan)

    return run


def _compiled(run):
    """Refuses a second trace; `min_texture` may be left out."""
    once = jax.jit(assert_max_traces(run, max_traces=1))

    def call(previous, current, points, guess, mask, min_texture=1.0):
        return once(previous, current, points, guess, mask, jnp.asarray(min_texture, points.dtype))

    return call


_fast = _compiled(_flow(lk_flow, 2))
_both_ways = _compiled(_flow(lk_flow_forward_backward, 2))
_exact = _compiled(_flow(lk_flow, 2, EXACT))


def _weighted(flow, weights):
    """A loss that touches every differentiable output of every point."""
    terms = (weights[:2] * flow.points, weights[2:3] * flow.residual[None], weights[3:] * flow.texture[None])
    return sum(jnp.sum(term) for term in terms)


def _gradient(run):
    """The flow, and the gradient of a loss along images, points and guess."""

    def loss(moving, mask, weights, *rest):
        flow = run(*moving, mask, *rest)
        return _weighted(flow, weights), flow

    return jax.jit(jax.grad(loss, has_aux=True))


_fast_gradient = _gradient(_fast)
_exact_gradient = _gradient(_exact)


@jax.jit
def _exact_derivative(moving, directions, guess, mask, min_texture):
    return jax.jvp(lambda *moving: _exact(*moving, guess, mask, min_texture), moving, directions)[1]


def _weights(seed):
    return np.random.default_rng(seed).normal(size=(4, N)) * np.array([[1.0], [1.0], [0.1], [0.01]])


def _pair(seed=0, shift_px=4.0, dtype: type = np.float32):
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


def _opencv(known, points, max_level):
    """Positions and which were found, with OpenCV's default criteria."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        known.previous, known.current, points.T.copy(), points.T.copy(), winSize=(21, 21), maxLevel=max_level
    )
    return found.T, status[:, 0] > 0


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
        expected, found = _opencv(known, arguments[2], max_level=1)
        flow = _fast(*arguments)
        margin = 12  # where the whole window is in both images, their borders make no difference
        inner = np.all([_inner(points, margin) for points in (arguments[2], expected)], axis=0)
        both = np.asarray(flow.ok) & found & inner
        distance = np.linalg.norm(flow.points - expected, axis=0)[both]
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
            opencv, _ = _opencv(known, points, max_level=3)
            ours.append(_distance(flow.points, known.move(points))[visible])
            theirs.append(_distance(opencv, known.move(points))[visible])
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

    def test_forward_backward_keeps_what_is_right(self):
        arguments, known = _pair()
        both_ways = _both_ways(*arguments)
        right = _distance(both_ways.points, known.move(arguments[2])) < 0.5
        assert np.mean(np.asarray(both_ways.ok)[right]) > 0.95

    def test_forward_backward_finds_what_was_covered(self):
        other, found = picture(WIDTH, HEIGHT)[::-1, ::-1], 0
        for seed in range(5):
            arguments, known = _pair(seed)
            arguments[1][30:110, 40:130] = other[30:110, 40:130]
            covered = _within(known.move(arguments[2]), (40, 30), (129, 109), margin=-6)
            forward, both_ways = _fast(*arguments), _both_ways(*arguments)
            assert not np.any(both_ways.ok & covered)
            found += np.sum(forward.ok & covered)
            changed = np.asarray(both_ways.status != forward.status)
            assert np.all(np.asarray(both_ways.status)[changed] == FlowStatus.INCONSISTENT)
            np.testing.assert_array_equal(both_ways.points, forward.points)
        assert found >= 5, "nothing to find"


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
        constants = (guess, mask, min_texture)
        tracked = np.asarray(_exact(*moving, *constants).ok)
        weights = np.where(tracked[None], _weights(5), 0)
        gradient, _ = _exact_gradient([*moving, guess], mask, weights, min_texture)
        assert _finite(gradient)
        assert not np.any(gradient[3]), "the guess has no influence"
        rng, eps = np.random.default_rng(5), 1e-6
        for which in range(3):
            directions = [np.zeros_like(array) for array in moving]
            directions[which] = rng.normal(size=moving[which].shape)
            forward = _exact_derivative(moving, directions, *constants)
            np.testing.assert_allclose(
                np.sum(gradient[which] * directions[which]), _weighted(forward, weights), rtol=1e-9
            )
            ahead, behind = (
                _exact(*(a + step * d for a, d in zip(moving, directions, strict=True)), *constants)
                for step in (eps, -eps)
            )
            for name, atol in (("points", 1e-7), ("residual", 1e-6), ("texture", 1e-5)):
                numeric = (getattr(ahead, name) - getattr(behind, name)) / (2 * eps)
                np.testing.assert_allclose(
                    numeric[..., tracked], getattr(forward, name)[..., tracked], rtol=1e-6, atol=atol
                )

    def test_gradient(self, x64):
        arguments = _smooth_pair(1, 4.0)
        assert np.mean(_exact(*arguments, 1.0).ok) > 0.8
        self._check(arguments, min_texture=1.0)

    def test_gradient_near_the_singular_case(self, x64):
        """Stripes: the gradient along them is hundreds of times weaker than across, and just enough."""
        arguments = _smooth_pair(2, 0.5)
        stripes = 40 * np.sin(np.arange(WIDTH) / 3)[None, :]
        for image in arguments[:2]:
            image[:] = 128 + stripes + 0.03 * image
        texture = np.asarray(_exact(*arguments, 1e-9).texture)
        least = np.median(texture)
        across = np.mean(np.square(np.gradient(stripes[0])))
        assert least < 0.01 * across
        flow = _exact(*arguments, 0.999 * least)
        assert np.any(flow.ok & (texture < 1.001 * least)), "no point is at the limit"
        self._check(arguments, min_texture=0.999 * least)

    def test_points_not_tracked_have_none(self, x64):
        arguments, expected = _one_of_each(np.float64)
        weights, lost = _weights(0), expected != FlowStatus.OK
        gradient, flow = _exact_gradient(arguments[:4], arguments[4], weights, 1.0)
        np.testing.assert_array_equal(flow.status, expected)
        assert _finite((gradient, flow))
        assert np.any(gradient[2][:, ~lost], axis=0).all()
        assert not np.any(gradient[2][:, lost])
        silent = np.where(lost[None], 0, weights)
        without, _ = _exact_gradient(arguments[:4], arguments[4], silent, 1.0)
        for full, part in zip(gradient, without, strict=True):
            np.testing.assert_array_equal(full, part)


def _one_of_each(dtype):
    """Points for every way a search can end, over and over, and the status each should get."""
    (previous, current, *_), _ = _pair(shift_px=2.0, dtype=dtype)
    previous[60:110, 10:60] = 90  # no texture
    current[0:70, 90:160] = 128 + 3 * (current[0:70, 90:160] - 128)  # Gauss-Newton steps three times too long
    previous[100:102, 140] = np.nan
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
    return [previous, current, points, points.copy(), expected != FlowStatus.MASKED], expected


def test_vmap_equals_loop():
    """Flows and gradients of a batch of image pairs."""
    batch = [_pair(seed)[0] for seed in range(3)]
    batch[1], _ = _one_of_each(np.float32)
    weights = _weights(0).astype(np.float32)
    moving, mask = [np.stack(arrays) for arrays in zip(*(each[:4] for each in batch), strict=True)], batch[0][4]
    batched = jax.jit(jax.vmap(_fast_gradient, in_axes=(0, None, None)))(moving, mask, weights)
    for index, each in enumerate(batch):
        alone = _fast_gradient(each[:4], mask, weights)
        for one, expected in zip(jax.tree.leaves(batched), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(one[index], expected, rtol=1e-4, atol=1e-4)


def test_single_trace():
    """`_fast` refuses a second trace; here everything that may change without one does."""
    for seed in range(3):
        arguments, _ = _pair(seed)
        arguments[3] += np.float32(seed)
        arguments[4][seed] = False
        _fast(*arguments, min_texture=seed + 1.0)


class TestDegenerate:
    @staticmethod
    def _run(arguments):
        """The flow; all that came out, and its gradient, is finite."""
        gradient, flow = _fast_gradient(arguments[:4], arguments[4], _weights(0).astype(np.float32))
        assert _finite((gradient, flow))
        return flow, gradient

    def test_degenerate(self):
        arguments, expected = _one_of_each(np.float32)
        flow, _ = self._run(arguments)
        np.testing.assert_array_equal(flow.status, expected)

    def test_all_masked(self):
        arguments, _ = _pair()
        arguments[4][:] = False
        flow, gradient = self._run(arguments)
        assert np.all(flow.status == FlowStatus.MASKED)
        np.testing.assert_array_equal(flow.points, arguments[3])
        assert not any(np.any(leaf) for leaf in gradient)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("which", [0, 1, 2, 3])
    def test_not_a_number(self, which, bad):
        """All of an image, of the points, of the guess."""
        arguments, _ = _pair()
        arguments[which][:] = bad
        flow, gradient = self._run(arguments)
        assert np.all(flow.status == FlowStatus.BAD_INPUT)
        assert not any(np.any(leaf) for leaf in gradient)

    def test_one_bad_point_harms_no_other(self):
        arguments, _ = _pair()
        clean = _fast(*arguments)
        arguments[2][0, 5] = np.nan
        flow, _ = self._run(arguments)
        others = np.arange(N) != 5
        assert flow.status[5] == FlowStatus.BAD_INPUT
        for one, expected in zip(flow, clean, strict=True):
            np.testing.assert_array_equal(one[..., others], expected[..., others])

    def test_bad_pixel_far_away_does_no_harm(self):
        arguments, _ = _pair()
        clean = _fast(*arguments)
        arguments[1][60, 80] = np.nan
        flow, _ = self._run(arguments)
        near = np.max(np.abs(np.asarray(clean.points) - [[80], [60]]), axis=0) < 12
        far = np.max(np.abs(np.asarray(clean.points) - [[80], [60]]), axis=0) > 40
        assert np.all(np.asarray(flow.status)[near] == FlowStatus.BAD_INPUT)
        np.testing.assert_array_equal(flow.points[:, far], clean.points[:, far])

    def test_no_texture(self):
        arguments, _ = _pair()
        arguments[0][:], arguments[1][:] = 50, 50
        flow, _ = self._run(arguments)
        assert np.all(flow.status == FlowStatus.NO_TEXTURE)
        np.testing.assert_array_equal(flow.points, arguments[2])

    def test_edge_without_corner(self):
        """Straight stripes leave the motion along them unknown, and that is said."""
        arguments, _ = _pair()
        arguments[0][:] = arguments[1][:] = 128 + 50 * np.sin(np.arange(WIDTH) / 3)[None, :]
        flow, _ = self._run(arguments)
        assert np.all(flow.status == FlowStatus.NO_TEXTURE)

    def test_zero_motion(self):
        arguments, _ = _pair()
        arguments[1] = arguments[0]
        flow, _ = self._run(arguments)
        assert np.all(flow.ok)
        np.testing.assert_allclose(flow.points, arguments[2], atol=1e-5)
        np.testing.assert_allclose(flow.residual, 0, atol=1e-3)

    def test_borders(self):
        """Points on the outermost pixels are inside, a hair further is not, and all are searched or left in peace."""
        arguments, _ = _pair()
        arguments[1] = arguments[0]
        right, bottom, hair = WIDTH - 1, HEIGHT - 1, 0.01
        inside = [(0, 0), (right, 0), (0, bottom), (right, bottom), (80, 0), (0, 60)]
        outside = [(-hair, 60), (right + hair, 60), (80, -hair), (80, bottom + hair), (1e9, 0), (0, -1e9)]
        points = np.array(inside + outside, np.float32).T
        arguments[2][:, : points.shape[1]] = arguments[3][:, : points.shape[1]] = points
        flow, _ = self._run(arguments)
        status = np.asarray(flow.status)
        assert np.all(status[6:12] == FlowStatus.OUTSIDE)
        tracked = np.isin(status[:6], [FlowStatus.OK, FlowStatus.NO_TEXTURE])
        assert np.all(tracked)
        np.testing.assert_allclose(flow.points[:, :12], points, atol=1e-4)

    def test_leaves_the_image(self):
        arguments, known = _pair()
        previous = arguments[0]
        arguments[1] = np.roll(previous, -60, axis=1)
        arguments[3] = arguments[2] - np.array([[60], [0]], np.float32)
        leaving = arguments[3][0] < -1
        flow, _ = self._run(arguments)
        assert np.sum(leaving) > 3
        assert not np.any(np.asarray(flow.ok) & leaving)
        assert np.mean(np.asarray(flow.ok)[~leaving]) > 0.8

    def test_guess_far_away(self):
        arguments, _ = _pair()
        arguments[3] = arguments[3] + np.float32(1e6)
        flow, _ = self._run(arguments)
        assert np.all(flow.status == FlowStatus.OUTSIDE)

    def test_one_point(self):
        arguments, _ = _pair()
        one = [*arguments[:2], *(array[..., :1] for array in arguments[2:])]
        flow = _compiled(_flow(lk_flow, 2))(*one)
        np.testing.assert_allclose(flow.points, _fast(*arguments).points[:, :1], atol=1e-3)
        assert np.all(flow.ok)

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
        arguments, _ = _pair()
        order = np.random.default_rng(seed).permutation(N)
        flow = _fast(*arguments)
        shuffled = _fast(*arguments[:2], *(array[..., order] for array in arguments[2:]))
        np.testing.assert_array_equal(shuffled.status, flow.status[order])
        for one, expected in zip(shuffled, flow, strict=True):
            np.testing.assert_allclose(one, expected[..., order], rtol=1e-5, atol=1e-3)

    @few
    @given(seed=seeds)
    def test_masked_points(self, seed):
        arguments, _ = _pair()
        flow = _fast(*arguments)
        rng = np.random.default_rng(seed)
        keep = arguments[4] = rng.uniform(size=N) < 0.5
        for array in arguments[2:4]:
            array[:, ~keep] = rng.uniform(-50, 200, (2, N))[:, ~keep]
        for one, expected in zip(_fast(*arguments), flow, strict=True):
            np.testing.assert_array_equal(one[..., keep], expected[..., keep])

    @few
    @given(brightness=st.integers(-100, 100))
    def test_brightness(self, brightness):
        arguments, _ = _pair()
        flow = _fast(*arguments)
        arguments[:2] = [image + np.float32(brightness) for image in arguments[:2]]
        brighter = _fast(*arguments)
        ok = np.asarray(flow.ok & brighter.ok)
        assert np.mean(ok) > 0.9
        np.testing.assert_allclose(brighter.points[:, ok], flow.points[:, ok], atol=0.01)

    @few
    @given(du=st.integers(-8, 8), dv=st.integers(-8, 8))
    def test_integer_shift(self, du, dv):
        """The same scene cut out of larger pictures at another place."""
        known = warp(picture(WIDTH + 16, HEIGHT + 16), 3.0, 4)
        points = corners(known.previous, N)[:, _within(corners(known.previous, N), (40, 40), (136, 96), 0)]
        points = np.resize(points.T, (N, 2)).T.astype(float) + 0.3
        with jax.enable_x64(True):
            flows = []
            for left, top in ((8, 8), (8 + du, 8 + dv)):
                cuts = [image[top : top + HEIGHT, left : left + WIDTH].astype(float) for image in known[:2]]
                origin = np.array([[left], [top]])
                flow = _exact(*cuts, points - origin, points - origin, np.ones(N, bool), 1.0)
                assert np.mean(flow.ok) > 0.8
                flows.append((np.asarray(flow.points) + origin, np.asarray(flow.ok)))
            (here, ok), (there, also) = flows
        np.testing.assert_allclose(there[:, ok & also], here[:, ok & also], atol=1e-6)
