"""Points of a textured plane looked up from another pose: the picture is known at every point, so is the truth."""

from functools import partial
from typing import Any, NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.flow.lk_search import LevelPlan
from jaxslam_kernels.flow.patch_align import DEFAULT_PLAN, align_patches, warped_patches
from jaxslam_kernels.image.pyramid import build_pyramid
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

H, W, FOCAL, N = 96, 128, 140.0, 24
K = np.array([[FOCAL, 0, (W - 1) / 2], [0, FOCAL, (H - 1) / 2], [0, 0, 1]])
EXACT = LevelPlan(7, 200, 1e-13)
"""A small window, searched until nothing moves, for derivatives."""
DIFFERENTIATED = ("pictures", "center", "warp", "current", "guess")


class _Scene(NamedTuple):
    pictures: np.ndarray
    picture: np.ndarray
    center: np.ndarray
    warp: np.ndarray
    current: np.ndarray
    guess: np.ndarray
    mask: np.ndarray
    truth: np.ndarray


@partial(jax.jit, static_argnames=("plan", "chunk"))
def _align(pictures, picture, center, warp, current, guess, mask, *, plan=DEFAULT_PLAN, chunk=32, min_texture=1.0):
    pyramid = build_pyramid(current, num_levels=1)
    settings = {"plan": plan, "chunk": chunk, "min_texture": min_texture}
    return align_patches(pictures, picture, center, warp, pyramid, guess, mask, **settings)


@jax.jit
def _derivatives(inputs, tangents, picture, mask):
    """The match with a small window; the change of points and correlation, and the gradient of their sum."""

    def place(pictures, center, warp, current, guess):
        match = _align(pictures, picture, center, warp, current, guess, mask, plan=EXACT, min_texture=1e-3)
        return match[:2], match

    out, pushforward, match = jax.linearize(place, *inputs, has_aux=True)
    pull_back = jax.linear_transpose(pushforward, *inputs)
    return match, pushforward(*tangents), pull_back(jax.tree.map(jnp.ones_like, out))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _texture(seed):
    """An intensity defined everywhere: waves of 7 to 50 pixels in all directions."""
    rng = np.random.default_rng(seed)
    angle, length, phase = rng.uniform(0, 2 * np.pi, 60), rng.uniform(7, 50, 60), rng.uniform(0, 2 * np.pi, 60)
    wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    return lambda uv: 128 + 6 * np.cos(np.tensordot(wave, uv, (0, 0)) + phase.reshape(-1, *[1] * (uv.ndim - 1))).sum(0)


def _homography(turn_deg, scale, tilt_deg):
    """Current pixels to pixels of the picture, whose camera faces a plane 2 m away; both see its middle."""
    R = Rotation.from_euler("zx", [turn_deg, tilt_deg], degrees=True).as_matrix()
    middle, normal = np.array([0, 0, 2.0]), np.array([0, 0, 1.0])
    t = middle - R @ middle / scale
    # X_picture = R X_current + t lies on the plane: n . X_picture = 2.
    return K @ (R + np.outer(t, normal @ R) / (2 - normal @ t)) @ np.linalg.inv(K)


def _apply(homography, uv):
    u, v, w = np.tensordot(homography, np.stack([*uv, np.ones_like(uv[0])]), (1, 0))
    return np.stack([u, v]) / w


def _scene(
    turn_deg=0.0,
    scale=1.0,
    tilt_deg=0.0,
    gain=1.0,
    offset=0.0,
    seed=0,
    dtype: Any = np.float32,
    image_dtype: Any = np.uint8,
):
    """Two pictures of two planes; half of the points are in each, and both planes are seen in the current image."""
    rng = np.random.default_rng(seed)
    pixels = np.stack(np.meshgrid(np.arange(W), np.arange(H))).astype(float)
    homography = _homography(turn_deg, scale, tilt_deg)
    textures = [_texture(seed), _texture(seed + 1)]
    pictures = np.stack([texture(pixels) for texture in textures])
    left = pixels[0] < W / 2
    current = np.where(left, *(texture(_apply(homography, pixels)) for texture in textures))
    truth = rng.uniform([[14], [14]], [[W / 2 - 14], [H - 14]], (2, N))
    picture = np.arange(N) % 2
    truth[0] += picture * W / 2
    center, step = _apply(homography, truth), 1e-4
    shift = lambda du, dv: _apply(homography, truth + step * np.array([[du], [dv]]))
    warp = np.stack([shift(1, 0) - shift(-1, 0), shift(0, 1) - shift(0, -1)], axis=1) / (2 * step)
    current = gain * current + offset
    if image_dtype == np.uint8:
        pictures, current = (np.clip(images, 0, 255).round() for images in (pictures, current))
    guess = truth + rng.uniform(-1.5, 1.5, (2, N))
    center, warp, current, guess = (array.astype(dtype) for array in (center, warp, current, guess))
    pictures, picture = pictures.astype(image_dtype), picture.astype(np.int32)
    return _Scene(pictures, picture, center, warp, current, guess, np.ones(N, bool), truth)


def _error(match, scene):
    return np.linalg.norm(match.points - scene.truth, axis=0)


def _small():
    """What derivatives are taken of: 5 points, one of them masked, pictures of floating point."""
    scene = _scene(15, 1.1, 5, 0.8, 10, 0, np.float64, np.float64)
    arrays = {name: getattr(scene, name)[..., :5] for name in ("picture", "center", "warp", "guess", "mask", "truth")}
    arrays["mask"][4] = False
    return scene._replace(**arrays)


DEGENERATE = (
    *("all masked", "center NaN", "warp infinite", "guess NaN", "picture NaN", "current NaN"),
    *("flat picture", "flat current", "warp zero", "far outside"),
)


def _spoil(scene, case):
    match case:
        case "all masked":
            scene.mask[:] = False
        case "center NaN":
            scene.center[1] = np.nan
        case "warp infinite":
            scene.warp[0, 1] = np.inf
        case "guess NaN":
            scene.guess[0] = np.nan
        case "picture NaN":
            scene.pictures[:, ::4, ::4] = np.nan
        case "current NaN":
            scene.current[::4, ::4] = np.nan
        case "flat picture":
            scene.pictures[:] = 77
        case "flat current":
            scene.current[:] = 77
        case "warp zero":
            scene.warp[:] = 0
        case "far outside":
            scene.guess[:] = 1e5


def _differentiate(scene, along=None):
    """`_derivatives` along a change of one of the inputs, or of all of them alike."""
    inputs = tuple(getattr(scene, name) for name in DIFFERENTIATED)
    tangents = along or {name: np.ones_like(array) for name, array in zip(DIFFERENTIATED, inputs, strict=True)}
    tangents = tuple(tangents.get(name, np.zeros_like(a)) for name, a in zip(DIFFERENTIATED, inputs, strict=True))
    return _derivatives(inputs, tangents, scene.picture, scene.mask)


def _finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


class TestAlignPatches:
    @pytest.mark.parametrize("image_dtype", [np.uint8, np.float32])
    def test_shapes(self, image_dtype):
        match = _align(*_scene(image_dtype=image_dtype)[:-1])
        assert match.points.shape == (2, N)
        assert match.correlation.shape == match.converged.shape == (N,)
        assert match.points.dtype == match.correlation.dtype == np.float32

    def test_border_too_narrow(self):
        scene = jax.tree.map(jnp.asarray, _scene())
        pyramid = build_pyramid(scene.current, num_levels=1, border=15)
        with pytest.raises(ValueError, match="at least 16 pixels needed, got 15"):
            align_patches(scene.pictures, scene.picture, scene.center, scene.warp, pyramid, scene.guess, scene.mask)

    @pytest.mark.parametrize(
        ("turn_deg", "scale", "tilt_deg", "gain", "offset"),
        [
            (0, 1.0, 0, 1.0, 0),
            (0, 1.0, 0, 0.7, 30),
            (20, 1.0, 0, 1.0, 0),
            (-40, 1.0, 0, 1.1, -15),
            (40, 1.2, 10, 0.8, 20),
            (10, 0.8, -10, 0.6, 60),
            (0, 1.25, 15, 1.0, 0),
        ],
    )
    def test_finds_the_truth(self, turn_deg, scale, tilt_deg, gain, offset):
        scene = _scene(turn_deg, scale, tilt_deg, gain, offset)
        match = _align(*scene[:-1])
        u, v = scene.center
        expected = (u > 2) & (v > 2) & (u < W - 3) & (v < H - 3)
        assert expected.sum() > 0.9 * N
        assert match.converged[expected].all()
        assert _error(match, scene)[expected].max() < 0.15
        assert match.correlation[expected].min() > 0.99

    def test_the_guess_does_not_matter(self):
        """Though the brightness there, which the search starts from, is that of another place."""
        scene, found = _scene(15, 1.1, 5, 0.8, 10), []
        for shift in ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2)):
            guess = scene.truth + np.array(shift)[:, None]
            found.append(_align(*scene._replace(guess=guess.astype(np.float32))[:-1]).points)
        assert np.ptp(np.stack(found), axis=0).max() < 0.03

    def test_a_patch_that_leaves_its_picture(self):
        """What lies outside does not count: at the edge a point is still found, without half of its patch not."""
        scene = _scene(10, 0.8)
        shifted = np.linspace(-4, 8, N)
        moved = np.array(scene.center, float)
        moved[0] = shifted + (W - 1 - 2 * shifted) * scene.picture
        truth = _apply(np.linalg.inv(_homography(10, 0.8, 0)), moved)
        in_view = (truth > 11).all(axis=0) & (truth < [[W - 12], [H - 12]]).all(axis=0)
        match = _align(*scene._replace(center=np.float32(moved), guess=np.float32(truth + 1))[:-1])
        found = in_view & (shifted > 0.5)
        assert found.sum() > N / 3
        assert match.converged[found].all()
        assert np.linalg.norm(match.points - truth, axis=0)[found].max() < 0.1
        assert not match.converged[shifted < -0.5].any()

    def test_matches_reference(self):
        """Where nothing but a shift happened it is OpenCV's flow on one level."""
        shift = np.array([[0.37], [-0.6]])
        pixels = np.stack(np.meshgrid(np.arange(W), np.arange(H))).astype(float)
        current = np.clip(_texture(0)(pixels + shift[:, :, None]), 0, 255).round().astype(np.float32)
        scene = _scene()._replace(current=current)
        both = scene.picture == 0
        expected, status, _ = cv2.calcOpticalFlowPyrLK(
            scene.pictures[0],
            scene.current.astype(np.uint8),
            scene.center.T[both].reshape(-1, 1, 2),
            scene.guess.T[both].reshape(-1, 1, 2),
            winSize=(21, 21),
            maxLevel=0,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        assert status.all()
        found = _align(*scene[:-1]).points[:, both]
        np.testing.assert_allclose(found, expected[:, 0].T, atol=0.02)
        np.testing.assert_allclose(found, scene.truth[:, both] - shift, atol=0.02)

    @pytest.mark.parametrize("direction", [(30, 0), (0, -30), (-21, 21)])
    def test_a_guess_far_away_is_refused(self, direction):
        scene = _scene(20, 1.1, 5, 0.9, 10)
        guess = scene.truth + np.array(direction)[:, None]
        match = _align(*scene._replace(guess=guess.astype(np.float32))[:-1])
        wrong = match.converged & (_error(match, scene) > 1)
        assert not (wrong & (match.correlation > 0.9)).any()
        assert (wrong & (match.correlation > 0.8)).sum() <= 1
        assert wrong.mean() < 0.3

    def test_the_wrong_picture_is_refused(self):
        scene = _scene()
        match = _align(*scene._replace(picture=1 - scene.picture)[:-1])
        assert not (match.converged & (match.correlation > 0.8)).any()

    @pytest.mark.parametrize("moved", DIFFERENTIATED)
    @pytest.mark.parametrize("texture", [1.0, 0.05], ids=["general", "nearly one wave only"])
    def test_gradient(self, x64, texture, moved):
        """Forward, reverse and by differences; the second case is close to the aperture problem."""
        scene = _small()
        pixels, homography = np.stack(np.meshgrid(np.arange(W), np.arange(H))).astype(float), _homography(15, 1.1, 5)
        wave = lambda uv: (1 - texture) * (128 + 50 * np.sin(0.5 * uv[0] + 0.2 * uv[1]))
        scene = scene._replace(
            pictures=texture * scene.pictures + wave(pixels),
            current=texture * scene.current + wave(_apply(homography, pixels)),
            guess=scene.truth,
        )
        start, eps = getattr(scene, moved), 1e-6
        change = np.random.default_rng(0).normal(size=start.shape)
        match, forward, gradients = _differentiate(scene, {moved: change})
        after, before = (_differentiate(scene._replace(**{moved: start + d * change}))[0] for d in (eps, -eps))
        for found in (match, after, before):
            np.testing.assert_array_equal(found.converged, scene.mask)
        for slope, new, old in zip(forward, after, before, strict=False):
            np.testing.assert_allclose(slope, (new - old) / (2 * eps), rtol=1e-5, atol=1e-5)
        reverse = float(jnp.sum(gradients[DIFFERENTIATED.index(moved)] * change))
        np.testing.assert_allclose(reverse, sum(float(jnp.sum(slope)) for slope in forward), rtol=1e-8, atol=1e-8)
        assert (np.abs(forward[0]).max() > 1e-3) == (moved != "guess")

    def test_vmap_equals_loop(self):
        scenes = [_scene(turn, 1.0, 0, gain, seed=turn) for turn, gain in ((0, 1.0), (10, 0.9))]
        batch = [np.stack(arrays) for arrays in zip(*(scene[:-1] for scene in scenes), strict=True)]
        batched = jax.jit(jax.vmap(_align))(*batch)
        for k, scene in enumerate(scenes):
            one = _align(*scene[:-1])
            np.testing.assert_allclose(batched.points[k], one.points, atol=1e-4)
            np.testing.assert_allclose(batched.correlation[k], one.correlation, atol=1e-5)
            np.testing.assert_array_equal(batched.converged[k], one.converged)

    def test_chunks_and_order_do_not_matter(self):
        scene, order = _scene(20, 1.1), np.random.default_rng(0).permutation(N)
        whole = _align(*scene[:-1])
        in_parts = _align(*scene[:-1], chunk=7)
        shuffled = {name: getattr(scene, name)[..., order] for name in ("picture", "center", "warp", "guess")}
        mixed = _align(*scene._replace(**shuffled)[:-1])
        np.testing.assert_allclose(in_parts.points, whole.points, atol=1e-4)
        np.testing.assert_allclose(mixed.points, whole.points[:, order], atol=1e-4)

    def test_single_trace(self):
        compute = jax.jit(eqx.debug.assert_max_traces(_align, max_traces=1))
        for seed in range(2):
            compute(*_scene(seed=seed)[:-1])

    def test_pictures_of_any_type(self):
        scene = _scene(20)
        same = scene._replace(pictures=np.float32(scene.pictures))
        # Up to rounding: XLA fuses what follows the conversion of integers in another way.
        np.testing.assert_allclose(_align(*same[:-1]).points, _align(*scene[:-1]).points, rtol=3e-7)

    def test_masked(self):
        """A masked point says so and does not touch the others."""
        scene, mask = _scene(20), np.arange(N) % 3 > 0
        whole, part = _align(*scene[:-1]), _align(*scene._replace(mask=mask)[:-1])
        np.testing.assert_allclose(part.points, np.where(mask, whole.points, 0), atol=1e-4)
        np.testing.assert_allclose(part.correlation, np.where(mask, whole.correlation, -1), atol=1e-5)
        np.testing.assert_array_equal(part.converged, mask)

    @pytest.mark.parametrize("case", DEGENERATE)
    def test_degenerate(self, x64, case):
        """Nothing is found, everything is finite, every derivative is zero."""
        scene = _small()
        _spoil(scene, case)
        match, forward, gradients = _differentiate(scene)
        assert _finite(match)
        assert not match.converged.any()
        for derivative in (*forward, *gradients):
            np.testing.assert_array_equal(derivative, 0)
        if case not in ("far outside", "flat current"):
            np.testing.assert_array_equal(match.correlation, -1)

    @pytest.mark.parametrize("case", DEGENERATE)
    def test_degenerate_in_float32(self, case):
        scene = _scene(15, 1.1, 5, 0.8, 10, image_dtype=np.float32)
        _spoil(scene, case)
        match = _align(*scene[:-1])
        assert _finite(match)
        assert not match.converged.any()

    def test_a_bad_pixel_spoils_only_points_that_see_it(self, x64):
        scene = _small()
        scene.current[tuple(np.round(scene.truth[::-1, 1]).astype(int))] = np.nan
        (match, _, gradients), (clean, _, expected) = _differentiate(scene), _differentiate(_small())
        np.testing.assert_array_equal(match.converged, [True, False, True, True, False])
        np.testing.assert_allclose(match.points[:, 2:4], clean.points[:, 2:4], atol=1e-9)
        assert _finite(gradients)
        np.testing.assert_allclose(gradients[1][:, 2:4], expected[1][:, 2:4], rtol=1e-6)

    @given(st.integers(0, 2**31), st.floats(0.6, 1.6), st.floats(-30, 30))
    @settings(max_examples=10, deadline=None)
    def test_brightness_does_not_matter(self, seed, gain, offset):
        scene = _scene(10, 1.1, seed=seed % 1000, image_dtype=np.float32)
        before, after = _align(*scene[:-1]), _align(*scene._replace(current=gain * scene.current + offset)[:-1])
        both = before.converged & after.converged
        assert both.mean() > 0.9
        np.testing.assert_allclose(after.points[:, both], before.points[:, both], atol=0.02)
        np.testing.assert_allclose(after.correlation[both], before.correlation[both], atol=1e-3)


class TestWarpedPatches:
    def test_matches_reference(self, x64):
        """SciPy's bilinear sampling, also past the edges, which repeat."""
        scene, side, stride = _scene(30, 1.1, image_dtype=np.float64, dtype=np.float64), 9, 11
        scene.center[:, :4] = [[0, W - 1, -5, W + 3], [0, H - 1, 40, 40]]
        sample = jax.jit(partial(warped_patches, side=side, stride=stride))
        patches, inside = (np.asarray(a).reshape(N, side, stride) for a in sample(*scene[:4]))
        dv, du = np.mgrid[:side, :stride] - side // 2
        for n in range(N):
            u, v = scene.center[:, n, None, None] + np.tensordot(scene.warp[:, :, n], np.stack([du, dv]), (1, 0))
            # Held a thousandth inside the picture.
            at = np.stack([np.clip(v, 0, H - 1.001), np.clip(u, 0, W - 1.001)])
            expected = map_coordinates(scene.pictures[scene.picture[n]], at, order=1)
            np.testing.assert_allclose(patches[n], expected, atol=1e-9)
            np.testing.assert_array_equal(inside[n], (u >= 0) & (v >= 0) & (u <= W - 1) & (v <= H - 1))

    def test_degenerate(self):
        scene = _scene()
        scene.center[0, 0], scene.warp[1, 0, 1], scene.center[:, 2] = np.nan, np.inf, 1e30
        sample = lambda center, warp: warped_patches(
            jnp.asarray(scene.pictures), jnp.asarray(scene.picture), center, warp, side=5, stride=5
        )
        center, warp = jnp.asarray(scene.center), jnp.asarray(scene.warp)
        both = lambda *a: (sample(*a), jax.grad(lambda *a: jnp.sum(sample(*a)[0]), (0, 1))(*a))
        (patches, inside), gradients = jax.jit(both)(center, warp)
        assert _finite((patches, gradients))
        assert not inside[:3].any()
        assert inside[3:].all()
