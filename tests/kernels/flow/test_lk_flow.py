"""Optical flow against OpenCV's and against known warps, in batches, and its failures."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flow_cases import (
    HEIGHT,
    WIDTH,
    Inputs,
    N,
    all_finite,
    distances,
    flow_of,
    image_pair,
    one_of_each,
    random_weights,
    track,
    with_gradient,
    within,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.flow.lk_flow import Flow, FlowPlan, FlowStatus, lk_flow, lk_flow_forward_backward
from jaxslam_kernels.image.pyramid import build_pyramid
from quick_compile import quick_compile

from jaxslam.benchmark.kernels.scenes.image_warps import corners, picture, warp

_both_ways = quick_compile(flow_of(lk_flow_forward_backward, 2))
_fast_gradient = quick_compile(with_gradient(track))
_fast_gradients = quick_compile(jax.vmap(with_gradient(track), in_axes=(0, None)))


def _opencv(known, points, max_level):
    """Positions and which were found, with OpenCV's default criteria."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        known.previous, known.current, points.T.copy(), points.T.copy(), winSize=(21, 21), maxLevel=max_level
    )
    return found.T, status[:, 0] > 0


def _all_zero(tree):
    return not any(np.any(leaf) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    def run(inputs):
        flow = flow_of(lk_flow, 2)(inputs)
        return flow, flow.ok

    with jax.enable_x64(True):  # the type follows the input there too
        flow, ok = jax.eval_shape(run, image_pair(dtype=dtype)[0])
    assert isinstance(flow, Flow)
    assert flow.points.shape == (2, N)
    assert {array.shape for array in (flow.status, flow.residual, flow.correlation, flow.texture, ok)} == {(N,)}
    assert {array.dtype for array in (flow.points, flow.residual, flow.correlation, flow.texture)} == {np.dtype(dtype)}
    assert flow.status.dtype == np.int32


class TestMatchesReference:
    def test_matches_reference(self):
        """Where both converge to the same texture, both find the same minimum, to OpenCV's tolerance."""
        inputs, known = image_pair()
        expected, found = _opencv(known, inputs.points, max_level=1)
        flow = track(inputs)
        # Where the whole window is in both images, how their borders are treated makes no difference.
        inner = within(inputs.points, (12, 12), (WIDTH - 13, HEIGHT - 13))
        inner &= within(expected, (12, 12), (WIDTH - 13, HEIGHT - 13))
        both = np.asarray(flow.ok) & found & inner
        distance = distances(flow.points, expected)[both]
        assert both.sum() > 0.5 * N
        assert np.median(distance) < 0.005
        assert np.mean(distance < 0.05) > 0.95

    def test_matches_reference_of_known_warps(self):
        """Motions of up to 25 pixels: at least as many points within a pixel as OpenCV, and as close."""
        image = picture(320, 240)
        points = corners(image, 300, distance=5)
        track_far = quick_compile(flow_of(lk_flow, 4))
        ours, theirs = [], []
        for seed, shift_px in enumerate((0, 2, 5, 8, 12, 16, 20, 25)):
            known = warp(image, shift_px, seed)
            visible, truth = known.visible(points), known.move(points)
            previous, current = known.previous.astype(np.float32), known.current.astype(np.float32)
            flow = track_far(Inputs(previous, current, points, points, visible, np.float32(1)))
            assert all_finite(flow)
            ours.append(distances(flow.points, truth)[visible])
            theirs.append(distances(_opencv(known, points, max_level=3)[0], truth)[visible])
        ours, theirs = np.concatenate(ours), np.concatenate(theirs)
        assert np.mean(ours < 1) >= np.mean(theirs < 1)
        assert np.median(ours) <= np.median(theirs) * 1.02  # both are limited by the rotation of the window

    @pytest.mark.slow
    def test_seeds_find_what_all_levels_find(self):
        """A camera that turns and a part of the picture that moves another way: neighbors do not mislead points."""
        image = picture(320, 240)
        points = corners(image, 300, distance=5)
        known = warp(image, 9, seed=3)
        current = known.current.astype(np.float32)
        moved = within(known.move(points), (120, 80), (199, 159))
        current[60:190, 100:220] = np.roll(current, (-9, 13), axis=(0, 1))[60:190, 100:220]
        truth = known.move(points) + np.where(moved, np.array([[13.0], [-9.0]]), 0)
        sure = known.visible(points) & (moved | ~within(known.move(points), (80, 40), (240, 210)))
        inputs = Inputs(known.previous.astype(np.float32), current, points, points, sure, np.float32(1))
        by_seeds, by_all = (quick_compile(flow_of(lk_flow, 4, FlowPlan(seeds=seeds)))(inputs) for seeds in (32, 0))
        for part in (sure & moved, sure & ~moved):
            right, expected = (distances(flow.points, truth)[part] < 1 for flow in (by_seeds, by_all))
            assert part.sum() > 15
            assert right.sum() >= 0.98 * expected.sum()
            both = np.asarray(by_seeds.ok & by_all.ok)[part] & right & expected
            apart = distances(by_seeds.points, by_all.points)[part][both]
            assert np.mean(apart < 0.05) > 0.98

    @pytest.mark.slow
    def test_few_points_are_all_searched_from_the_coarsest_level(self):
        """At most four times the number of seeds, such as masks leave, are found to the byte as without seeds."""
        image = picture(320, 240)
        points = corners(image, 300, distance=5)
        known = warp(image, 9, seed=3)
        previous, current = known.previous.astype(np.float32), known.current.astype(np.float32)
        by_seeds, by_all = (quick_compile(flow_of(lk_flow, 4, FlowPlan(seeds=seeds))) for seeds in (32, 0))
        for kept, same in ((128, True), (300, False)):
            inputs = Inputs(previous, current, points, points, np.arange(points.shape[1]) < kept, np.float32(1))
            found, expected = (np.asarray(flow(inputs).points)[:, :kept] for flow in (by_seeds, by_all))
            assert np.array_equal(found, expected) == same

    def test_an_offset_of_brightness_changes_nothing(self):
        inputs, _ = image_pair()
        plain, brighter = track(inputs), track(inputs._replace(current=inputs.current + np.float32(40)))
        np.testing.assert_array_equal(plain.status, brighter.status)
        np.testing.assert_allclose(plain.points, brighter.points, atol=5e-3)
        np.testing.assert_allclose(plain.residual, brighter.residual, atol=1e-2)

    @pytest.mark.parametrize("gain", [0.75, 1.3])
    def test_a_step_of_exposure_hardly_moves_points(self, gain):
        """OpenCV's points move by much more."""
        plain, exposed, theirs, lost, num_found = [], [], [], 0, 0
        for seed in range(8):
            inputs, known = image_pair(seed)
            current = np.clip(gain * inputs.current, 0, 255).astype(np.float32)
            flows = track(inputs), track(inputs._replace(current=current))
            found, still_found = (np.asarray(flow.ok) for flow in flows)
            truth = known.move(inputs.points)
            opencv, _ = _opencv(known._replace(current=current.astype(np.uint8)), inputs.points, 1)
            for errors, points in zip(
                (plain, exposed, theirs), (flows[0].points, flows[1].points, opencv), strict=True
            ):
                errors.append(distances(points, truth)[found])
            lost, num_found = lost + np.sum(found & ~still_found), num_found + np.sum(found)
        errors = [np.median(np.concatenate(of)) for of in (plain, exposed, theirs)]
        assert lost < 0.02 * num_found
        assert errors[1] < 1.6 * errors[0]
        assert errors[2] > 2 * errors[1]

    def test_guess_carries_a_large_motion(self):
        """From a good guess a motion is found that is out of reach otherwise."""
        inputs, known = image_pair(seed=6, shift_px=20.0)
        truth, visible = known.move(inputs.points), known.visible(inputs.points)
        alone = distances(track(inputs).points, truth)[visible] < 1
        inputs = inputs._replace(guess=(truth + 1.5).astype(np.float32))
        guided = distances(track(inputs).points, truth)[visible] < 1
        assert guided.mean() > 0.9
        assert alone.mean() < 0.5

    def test_forward_backward_keeps_what_is_right(self):
        inputs, known = image_pair()
        both_ways = _both_ways(inputs)
        right = distances(both_ways.points, known.move(inputs.points)) < 0.5
        assert np.mean(np.asarray(both_ways.ok)[right]) > 0.95

    def test_forward_backward_finds_what_was_covered(self):
        """Most are unlike what covers them; of the others, none returns."""
        other, found, unlike = picture(WIDTH, HEIGHT)[::-1, ::-1], 0, 0
        for seed in range(5):
            inputs, known = image_pair(seed)
            inputs.current[30:110, 40:130] = other[30:110, 40:130]
            covered = within(known.move(inputs.points), (46, 36), (123, 103))
            forward, both_ways = track(inputs), _both_ways(inputs)
            assert not np.any(both_ways.ok & covered)
            found += np.sum(forward.ok & covered)
            unlike += np.sum((forward.status == FlowStatus.DISSIMILAR) & covered)
            changed = np.asarray(both_ways.status != forward.status)
            assert np.all(np.asarray(both_ways.status)[changed] == FlowStatus.INCONSISTENT)
            np.testing.assert_allclose(both_ways.points, forward.points, atol=1e-3)
        assert found >= 5, "nothing to find"
        assert unlike > found


def test_vmap_equals_loop():
    """Flows and gradients of a batch of image pairs."""
    weights = random_weights(0, np.float32)
    batch = [image_pair(0)[0], one_of_each(np.float32)[0], image_pair(1)[0]]
    batched = _fast_gradients(jax.tree.map(lambda *arrays: np.stack(arrays), *batch), weights)
    for index, inputs in enumerate(batch):
        alone = _fast_gradient(inputs, weights)
        for one, expected in zip(jax.tree.leaves(batched), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(one[index], expected, rtol=1e-4, atol=1e-4)


def test_single_trace():
    """`flow_of` refuses a second trace; here everything changes that may without one."""
    for seed in range(3):
        inputs, _ = image_pair(seed)
        inputs.guess[:] += seed
        inputs.mask[seed] = False
        track(inputs._replace(min_texture=np.float32(seed + 1)))


class TestDegenerate:
    @staticmethod
    def _run(inputs):
        """The flow, and its gradient; all is finite."""
        gradient, flow = _fast_gradient(inputs, random_weights(0, np.float32))
        assert all_finite((gradient, flow))
        return flow, gradient

    def test_degenerate(self):
        inputs, expected = one_of_each(np.float32)
        flow, _ = self._run(inputs)
        np.testing.assert_array_equal(flow.status, expected)

    def test_all_masked(self):
        inputs, _ = image_pair()
        inputs.mask[:] = False
        flow, gradient = self._run(inputs)
        assert np.all(flow.status == FlowStatus.MASKED)
        np.testing.assert_array_equal(flow.points, inputs.guess)
        assert _all_zero(gradient)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("which", [0, 1, 2, 3])
    def test_not_a_number(self, which, bad):
        """All of an image, of the points, of the guess."""
        inputs, _ = image_pair()
        inputs[which][:] = bad
        flow, gradient = self._run(inputs)
        assert np.all(flow.status == FlowStatus.BAD_INPUT)
        assert _all_zero(gradient)

    def test_one_bad_point_harms_no_other(self):
        clean, _ = self._run(image_pair()[0])
        inputs, _ = image_pair()
        inputs.points[0, 5] = np.nan
        flow, _ = self._run(inputs)
        others = np.arange(N) != 5
        assert flow.status[5] == FlowStatus.BAD_INPUT
        for one, expected in zip(flow, clean, strict=True):
            np.testing.assert_array_equal(one[..., others], expected[..., others])

    @settings(max_examples=8, deadline=None)
    @given(seed=st.integers(0, 2**16))
    def test_masked_points(self, seed):
        flow, (inputs, _) = track(image_pair()[0]), image_pair()
        rng = np.random.default_rng(seed)
        keep = rng.uniform(size=N) < 0.5
        for array in inputs[2:4]:
            array[:, ~keep] = rng.uniform(-50, 200, (2, N))[:, ~keep]
        for one, expected in zip(track(inputs._replace(mask=keep)), flow, strict=True):
            np.testing.assert_array_equal(one[..., keep], expected[..., keep])

    def test_bad_pixel_far_away_does_no_harm(self):
        clean = np.asarray(self._run(image_pair()[0])[0].points)
        inputs, _ = image_pair()
        inputs.current[60, 80] = np.nan
        flow, _ = self._run(inputs)
        away = np.max(np.abs(clean - [[80], [60]]), axis=0)
        assert np.any(away < 10)
        assert np.all(np.asarray(flow.status)[away < 10] == FlowStatus.BAD_INPUT)
        np.testing.assert_array_equal(flow.points[:, away > 40], clean[:, away > 40])

    @pytest.mark.parametrize("across", [0.0, 50.0])
    def test_no_texture(self, across):
        """A plain picture; and straight stripes, which leave the motion along them unknown."""
        inputs, _ = image_pair()
        for image in inputs[:2]:
            image[:] = 128 + across * np.sin(np.arange(WIDTH) / 3)[None, :]
        flow, _ = self._run(inputs)
        assert np.all(flow.status == FlowStatus.NO_TEXTURE)
        np.testing.assert_array_equal(flow.points, inputs.points)

    @pytest.mark.parametrize("intensity", [0, 128, 255])
    def test_a_uniform_image(self, intensity):
        """Steps lead nowhere, and some are so short that they would pass for the end of a search."""
        inputs, _ = image_pair()
        inputs = inputs._replace(current=np.full_like(inputs.current, intensity))
        flow, gradient = self._run(inputs)
        status = np.asarray(flow.status)
        assert not np.any(flow.ok)
        assert np.sum(status == FlowStatus.DISSIMILAR) > 3
        np.testing.assert_allclose(flow.correlation, 0, atol=1e-3)
        assert _all_zero(gradient)
        any_will_do = quick_compile(flow_of(partial(lk_flow, min_correlation=-1.0), 2))(inputs)
        assert np.all(np.asarray(any_will_do.ok) == (status == FlowStatus.DISSIMILAR))

    def test_correlation(self):
        """It equals that of OpenCV, for windows that only move."""
        inputs, _ = image_pair()
        shift = np.array([[3], [-2]])
        current = np.roll(inputs.previous, shift[::-1, 0], axis=(0, 1))
        noise = np.random.default_rng(0).normal(0, 20, current.shape).astype(np.float32)
        inner = within(inputs.points, (14, 14), (WIDTH - 14, HEIGHT - 14))
        exact = inputs._replace(
            current=current + np.float32(40), guess=inputs.points + shift.astype(np.float32), mask=inner
        )
        flow, _ = self._run(exact)
        np.testing.assert_allclose(np.asarray(flow.correlation)[np.asarray(flow.ok)], 1, atol=1e-3)
        flow, _ = self._run(exact._replace(current=current + noise))
        checked = 0
        for place in np.flatnonzero(np.asarray(flow.ok)):
            (u, v), (x, y) = inputs.points[:, place].astype(int), np.asarray(flow.points)[:, place]
            template = inputs.previous[v - 10 : v + 11, u - 10 : u + 11]
            seen = cv2.getRectSubPix(current + noise, (21, 21), (float(x), float(y)))
            expected = cv2.matchTemplate(seen, template, cv2.TM_CCOEFF_NORMED)[0, 0]
            assert float(flow.correlation[place]) == pytest.approx(expected, abs=1e-3)
            checked += 1
        assert checked > 20

    def test_zero_motion(self):
        inputs, _ = image_pair()
        flow, _ = self._run(inputs._replace(current=inputs.previous))
        assert np.all(flow.ok)
        np.testing.assert_allclose(flow.points, inputs.points, atol=1e-5)
        np.testing.assert_allclose(flow.residual, 0, atol=1e-3)

    def test_borders(self):
        """Points on the outermost pixels are inside, a hair further they are not; none is dragged away."""
        inputs, _ = image_pair()
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
        inputs, _ = image_pair()
        inputs.points[:, :20] = [np.linspace(58.2, 59.8, 20), np.linspace(20, 100, 20)]
        inputs.guess[:] = inputs.points - np.array([[60], [0]])
        flow, gradient = self._run(inputs._replace(current=np.roll(inputs.previous, -60, axis=1)))
        status, leaving = np.asarray(flow.status), inputs.guess[0] < 0
        near = leaving & within(np.asarray(flow.points), (-2, 0), (0, HEIGHT - 1))
        assert np.sum(near & (status == FlowStatus.OUTSIDE)) > 5
        assert not np.any(status[leaving] == FlowStatus.OK)
        assert np.mean(status[~leaving] == FlowStatus.OK) > 0.8
        assert not np.any(gradient[2][:, status != FlowStatus.OK])

    def test_guess_far_away(self):
        inputs, _ = image_pair()
        inputs.guess[:] += 1e6
        flow, _ = self._run(inputs)
        assert np.all(flow.status == FlowStatus.OUTSIDE)

    def test_one_point(self):
        inputs, _ = image_pair()
        first = {name: getattr(inputs, name)[..., :1] for name in ("points", "guess", "mask")}
        flow = quick_compile(flow_of(lk_flow, 2))(inputs._replace(**first))
        assert np.all(flow.ok)
        np.testing.assert_allclose(flow.points, track(inputs).points[:, :1], atol=1e-3)

    def test_refuses_pyramids_that_do_not_fit(self):
        points = jnp.zeros((2, 1))
        small, large = (build_pyramid(jnp.zeros((32, width)), num_levels=2) for width in (40, 42))
        narrow = build_pyramid(jnp.zeros((32, 40)), num_levels=2, border=15)
        with pytest.raises(ValueError, match="same levels"):
            lk_flow(small, large, points)
        with pytest.raises(ValueError, match="border: at least 16"):
            lk_flow(narrow, narrow, points)
