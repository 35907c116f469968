"""Points of a textured plane looked up from another pose: the picture is known at every point, so is the truth."""

from functools import partial
from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxslam_kernels.image import build_pyramid
from jaxslam_kernels.lk_search import LevelPlan
from jaxslam_kernels.patch_align import align_patches, warped_patches
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

H, W, FOCAL, N = 96, 128, 140.0, 24
K = np.array([[FOCAL, 0, (W - 1) / 2], [0, FOCAL, (H - 1) / 2], [0, 0, 1]])
EXACT = LevelPlan(7, 200, 1e-13)
"""A small window, searched until nothing moves, for derivatives."""


class _Scene(NamedTuple):
    pictures: np.ndarray
    picture: np.ndarray
    centre: np.ndarray
    warp: np.ndarray
    current: np.ndarray
    guess: np.ndarray
    mask: np.ndarray
    truth: np.ndarray


@partial(jax.jit, static_argnames=("plan", "chunk"))
def _align(pictures, picture, centre, warp, current, guess, mask, plan=LevelPlan(21, 8, 0.05), chunk=64):  # noqa: B008
    pyramid = build_pyramid(current, num_levels=1)
    return align_patches(pictures, picture, centre, warp, pyramid, guess, mask, plan=plan, chunk=chunk)


@jax.jit
def _small_align_and_gradients(pictures, picture, centre, warp, current, guess, mask):
    """With a small window, and the derivative of everything by everything."""

    def loss(pictures, centre, warp, current, guess):
        match = _align(pictures, picture, centre, warp, current, guess, mask, plan=EXACT)
        return jnp.sum(match.points) + jnp.sum(match.correlation), match

    gradients, match = jax.grad(loss, range(5), has_aux=True)(pictures, centre, warp, current, guess)
    return match, gradients


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


def _scene(turn_deg=0.0, scale=1.0, tilt_deg=0.0, gain=1.0, offset=0.0, seed=0, dtype=np.float32, image_dtype=np.uint8):
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
    centre, step = _apply(homography, truth), 1e-4
    shift = lambda du, dv: _apply(homography, truth + step * np.array([[du], [dv]]))
    warp = np.stack([shift(1, 0) - shift(-1, 0), shift(0, 1) - shift(0, -1)], axis=1) / (2 * step)
    current = gain * current + offset
    if image_dtype == np.uint8:
        pictures, current = (np.clip(images, 0, 255).round() for images in (pictures, current))
    guess = truth + rng.uniform(-1.5, 1.5, (2, N))
    floats = [array.astype(dtype) for array in (centre, warp, current, guess)]
    return _Scene(pictures.astype(image_dtype), picture.astype(np.int32), *floats, np.ones(N, bool), truth)


def _error(match, scene):
    return np.linalg.norm(match.points - scene.truth, axis=0)


def _small(seed=0, dtype=np.float64):
    """What the derivative is taken of: 5 points, one of them masked, pictures of floating point."""
    scene = _scene(15, 1.1, 5, 0.8, 10, seed, dtype, dtype)
    some = np.s_[..., :5]
    arrays = {name: getattr(scene, name)[some] for name in ("picture", "centre", "warp", "guess", "mask", "truth")}
    arrays["mask"][4] = False
    return scene._replace(**arrays)


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
        scene = _scene()
        pyramid = build_pyramid(jnp.asarray(scene.current), num_levels=1, border=15)
        with pytest.raises(ValueError, match="at least 16 pixels needed, got 15"):
            align_patches(*(jnp.asarray(a) for a in scene[:4]), pyramid, jnp.asarray(scene.guess), jnp.ones(N, bool))

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
        assert match.converged.all()
        assert _error(match, scene).max() < 0.15
        assert np.median(_error(match, scene)) < 0.05
        assert match.correlation.min() > 0.9

    def test_matches_reference(self):
        """Without turn and scale it is OpenCV's flow on one level."""
        scene = _scene(scale=1.0, image_dtype=np.uint8)
        both = scene.picture == 0
        expected, status, _ = cv2.calcOpticalFlowPyrLK(
            scene.pictures[0],
            scene.current.astype(np.uint8),
            np.ascontiguousarray(scene.centre.T[both, None]),
            np.ascontiguousarray(scene.guess.T[both, None]),
            winSize=(21, 21),
            maxLevel=0,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        assert status.all()
        np.testing.assert_allclose(_align(*scene[:-1]).points[:, both], expected[:, 0].T, atol=0.02)

    @pytest.mark.parametrize("direction", [(30, 0), (0, -30), (-21, 21)])
    def test_a_guess_far_away_is_refused(self, direction):
        scene = _scene(20, 1.1, 5, 0.9, 10)
        guess = scene.truth + np.array(direction)[:, None]
        match = _align(*scene._replace(guess=guess.astype(np.float32))[:-1])
        accepted = match.converged & (match.correlation > 0.8)
        assert not (accepted & (_error(match, scene) > 1)).any()
        assert accepted.mean() < 0.1

    def test_the_wrong_picture_is_refused(self):
        scene = _scene()
        match = _align(*scene._replace(picture=1 - scene.picture)[:-1])
        assert not (match.converged & (match.correlation > 0.8)).any()

    @pytest.mark.parametrize("case", ["general", "nearly one wave only"])
    def test_gradient(self, x64, case):
        """By pictures, centre, warp, current image and guess; the second case is next to the aperture problem."""
        scene = _small()
        if case != "general":
            weak = [1e-2 * (image - 128) for image in (scene.pictures, scene.current)]
            across = np.array([[0.5], [0.2]])
            wave = lambda uv: 128 + 50 * np.sin(np.tensordot(across[:, 0], uv, (0, 0)))
            pixels = np.stack(np.meshgrid(np.arange(W), np.arange(H))).astype(float)
            homography = _homography(15, 1.1, 5)
            scene = scene._replace(
                pictures=weak[0] + wave(pixels), current=weak[1] + wave(_apply(homography, pixels)), guess=scene.truth
            )
        fixed = (scene.picture, scene.mask)
        check = lambda *a: _align(a[0], fixed[0], *a[1:], fixed[1], plan=EXACT)[:2]
        arguments = (scene.pictures, scene.centre, scene.warp, scene.current, scene.guess)
        match = _align(*scene[:-1], plan=EXACT)
        np.testing.assert_array_equal(match.converged, scene.mask)
        check_grads(check, arguments, order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-5, atol=1e-5)

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
        shuffled = {name: getattr(scene, name)[..., order] for name in ("picture", "centre", "warp", "guess")}
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
        np.testing.assert_array_equal(_align(*same[:-1]).points, _align(*scene[:-1]).points)

    def test_masked(self):
        """A masked point says so and does not touch the others."""
        scene, mask = _scene(20), np.arange(N) % 3 > 0
        whole, part = _align(*scene[:-1]), _align(*scene._replace(mask=mask)[:-1])
        np.testing.assert_allclose(part.points, np.where(mask, whole.points, 0), atol=1e-4)
        np.testing.assert_allclose(part.correlation, np.where(mask, whole.correlation, -1), atol=1e-5)
        np.testing.assert_array_equal(part.converged, mask)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize(
        ("case", "searched"),
        [
            ("all masked", False),
            ("centre NaN", False),
            ("warp infinite", False),
            ("guess NaN", False),
            ("picture NaN", False),
            ("current NaN", False),
            ("flat picture", False),
            ("warp zero", False),
            ("far outside", True),
            ("flat current", True),
        ],
    )
    def test_degenerate(self, case, searched, dtype):
        scene = _small(dtype=dtype)
        match case:
            case "all masked":
                scene.mask[:] = False
            case "centre NaN":
                scene.centre[1] = np.nan
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
            case "warp zero":
                scene.warp[:] = 0
            case "far outside":
                scene.guess[:] = 1e5
            case "flat current":
                scene.current[:] = 77
        with jax.enable_x64(dtype == np.float64):
            match, gradients = _small_align_and_gradients(*scene[:-1])
        assert _finite(match)
        assert not match.converged.any()
        for gradient in gradients:
            np.testing.assert_array_equal(gradient, 0)
        np.testing.assert_array_equal(np.asarray(match.correlation)[scene.mask] > -1, searched)

    def test_a_bad_pixel_spoils_only_points_that_see_it(self):
        scene = _small()
        scene.current[tuple(np.round(scene.truth[::-1, 1]).astype(int))] = np.nan
        with jax.enable_x64(True):
            (match, gradients), (clean, expected) = (_small_align_and_gradients(*s[:-1]) for s in (scene, _small()))
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
        scene.centre[:, :4] = [[0, W - 1, -5, W + 3], [0, H - 1, 40, 40]]
        sample = jax.jit(partial(warped_patches, side=side, stride=stride))
        result = np.asarray(sample(*scene[:4])).reshape(N, side, stride)
        dv, du = np.mgrid[:side, :stride] - side // 2
        for n in range(N):
            u, v = scene.centre[:, n, None, None] + np.tensordot(scene.warp[:, :, n], np.stack([du, dv]), (1, 0))
            # Held a thousandth inside the picture.
            at = np.stack([np.clip(v, 0, H - 1.001), np.clip(u, 0, W - 1.001)])
            expected = map_coordinates(scene.pictures[scene.picture[n]], at, order=1)
            np.testing.assert_allclose(result[n], expected, atol=1e-9)

    def test_degenerate(self):
        scene = _scene()
        scene.centre[0, 0], scene.warp[1, 0, 1], scene.centre[:, 2] = np.nan, np.inf, 1e30
        sample = lambda centre, warp: warped_patches(
            jnp.asarray(scene.pictures), jnp.asarray(scene.picture), centre, warp, side=5, stride=5
        )
        patches, pull_back = jax.vjp(jax.jit(sample), jnp.asarray(scene.centre), jnp.asarray(scene.warp))
        assert _finite((patches, pull_back(jnp.ones_like(patches))))
        for n in range(2):
            np.testing.assert_array_equal(patches[n], scene.pictures[scene.picture[n], 0, 0])
