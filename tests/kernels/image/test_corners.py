"""Corner scores against OpenCV and NumPy in float64; the best pixel of every cell against a loop."""

from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxslam_kernels.image.corners import corner_score, grid_corners, occupied_cells

H, W, CELL = 40, 52, 8
ROWS, COLUMNS = H // CELL, W // CELL

_score = jax.jit(corner_score)
_best = jax.jit(lambda score, allowed: grid_corners(score, allowed, cell=CELL))
_occupied = jax.jit(lambda points, valid: occupied_cells(points, valid, (H, W), cell=CELL))


@jax.jit
def _pipeline(image, allowed):
    """Score, corners, and the derivative of all scores."""
    score, pull_back = jax.vjp(corner_score, image)
    return score, grid_corners(score, allowed, cell=CELL), pull_back(jnp.ones_like(score))[0]


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _image(seed=0, shape=(H, W), dtype: Any = np.float64):
    noise = np.random.default_rng(seed).uniform(0, 255, shape)
    return cv2.GaussianBlur(noise, (0, 0), 1.0).astype(dtype)


def _allowed(seed=0, share=0.5):
    return np.random.default_rng(seed).uniform(size=(H, W)) < share


def _score_by_loop(image):
    dv, du = np.gradient(image)
    score = np.zeros_like(image)
    for v in range(4, image.shape[0] - 4):
        for u in range(4, image.shape[1] - 4):
            near = np.s_[v - 2 : v + 3, u - 2 : u + 3]
            gradients = np.stack([du[near].ravel(), dv[near].ravel()])
            score[v, u] = np.linalg.eigvalsh(gradients @ gradients.T / 25)[0]
    return score


def _best_by_loop(score, allowed):
    points, scores = [], []
    for row in range(ROWS):
        for column in range(COLUMNS):
            cell = np.s_[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]
            offered = np.where(allowed[cell], score[cell], 0)
            v, u = np.unravel_index(np.argmax(offered), offered.shape)
            points.append((column * CELL + u, row * CELL + v))
            scores.append(offered[v, u])
    return np.array(points).T, np.array(scores)


def _finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


class TestCornerScore:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_shapes(self, dtype):
        with jax.enable_x64(dtype == np.float64):
            score = _score(_image(dtype=dtype))
        assert score.shape == (H, W)
        assert score.dtype == dtype

    @pytest.mark.parametrize("shape", [(8, 30), (30, 3), (1, 1)])
    def test_an_image_smaller_than_its_edges_has_no_corner(self, shape):
        np.testing.assert_array_equal(corner_score(jnp.ones(shape)), np.zeros(shape))

    def test_matches_reference(self, x64):
        np.testing.assert_allclose(_score(_image()), _score_by_loop(_image()), rtol=1e-9, atol=1e-9)

    def test_matches_opencv(self):
        """With the aperture that takes central differences; OpenCV sums them, undivided, over a window of 5x5 / 5."""
        image = _image(dtype=np.float32)
        expected = cv2.cornerMinEigenVal(image, blockSize=5, ksize=1) * (25 / 4 / 25)
        inner = np.s_[4:-4, 4:-4]
        np.testing.assert_allclose(_score(image)[inner], expected[inner], rtol=1e-4, atol=1e-3)

    def test_only_corners_score(self, x64):
        """A flat image and a straight edge do not, a corner does, and most where it fills the window."""
        flat, edge, corner = (np.full((H, W), 50.0) for _ in range(3))
        edge[:, 20:] = 150
        corner[20:, 30:] = 150
        for image in (flat, edge):
            np.testing.assert_allclose(_score(image), 0, atol=1e-9)
        v, u = np.unravel_index(np.argmax(_score(corner)), (H, W))
        assert max(abs(u - 29.5), abs(v - 19.5)) <= 2

    def test_edges_score_nothing(self, x64):
        score = np.array(_score(_image()))
        assert (score[4:-4, 4:-4] > 0).all()
        score[4:-4, 4:-4] = 0
        np.testing.assert_array_equal(score, 0)

    def test_gradient(self, x64):
        check_grads(jax.jit(corner_score), (_image(1, (13, 12)),), order=1, modes=("fwd", "rev"), eps=1e-4, rtol=1e-6)

    def test_gradient_where_eigenvalues_are_equal(self, x64):
        """The center of a symmetric blob of whole numbers: the smaller eigenvalue has a kink there."""
        distance = np.abs(np.arange(9) - 4)
        blob = np.float64(100 - 4 * np.add.outer(distance**2, distance**2))
        center = jax.jit(lambda image: corner_score(image)[4, 4])
        assert center(blob) > 1
        check_grads(center, (blob,), order=1, modes=("fwd", "rev"), eps=1e-5, rtol=1e-6)

    def test_gradient_of_a_flat_image_is_zero(self, x64):
        np.testing.assert_array_equal(_pipeline(np.full((H, W), 7.0), _allowed())[2], 0)

    def test_vmap_equals_loop(self, x64):
        images, allowed = np.stack([_image(s) for s in range(3)]), np.stack([_allowed(s) for s in range(3)])
        batched = jax.jit(jax.vmap(_pipeline))(images, allowed)
        for k in range(3):
            one = _pipeline(images[k], allowed[k])
            jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-9, atol=1e-9), batched, one)

    def test_single_trace(self):
        compute = jax.jit(eqx.debug.assert_max_traces(_pipeline, max_traces=1))
        for seed in range(3):
            compute(_image(seed, dtype=np.float32), _allowed(seed))

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("case", ["all NaN", "flat", "infinite", "huge", "NaN pixels"])
    def test_degenerate(self, case, dtype):
        image = _image(dtype=dtype)
        match case:
            case "all NaN":
                image[:] = np.nan
            case "flat":
                image[:] = 0.1
            case "infinite":
                image[20:, :20], image[5, 40] = np.inf, -np.inf
            case "huge":
                image[10:15, 10:15] = np.finfo(dtype).max / 2
            case "NaN pixels":
                image[10, 10:20], image[30, 4] = np.nan, np.nan
        with jax.enable_x64(dtype == np.float64):
            score, corners, gradient = _pipeline(image, np.ones((H, W), bool))
        assert _finite((score, corners, gradient))
        if case in ("all NaN", "flat"):
            np.testing.assert_allclose(score, 0, atol=1e-12)

    def test_a_bad_pixel_reaches_no_further_than_its_window(self, x64):
        image, expected = _image(), np.array(_score(_image()))
        image[20, 30] = np.nan
        touched = np.zeros((H, W), bool)
        touched[18:23, 27:34] = touched[17:24, 28:33] = True
        expected[touched] = 0
        np.testing.assert_allclose(_score(image), expected, rtol=1e-12)

    @given(st.integers(0, 2**31), st.floats(-100, 100), st.floats(0.1, 3), st.integers(0, 3), st.booleans())
    @settings(max_examples=20, deadline=None)
    def test_turning_and_brightness(self, seed, offset, gain, turns, flip):
        """A turned or mirrored image has turned scores; brightness does not count, contrast does squared."""
        turned = lambda image: np.rot90(image[:, ::-1] if flip else image, turns)
        image = _image(seed, (20, 20))
        with jax.enable_x64(True):
            before, after = _score(image), _score(gain * turned(image) + offset)
        np.testing.assert_allclose(after, gain**2 * turned(np.asarray(before)), rtol=1e-7, atol=1e-7)


class TestGridCorners:
    def test_shapes(self):
        corners = _best(_image(dtype=np.float32), _allowed())
        assert corners.points.shape == (2, ROWS * COLUMNS)
        assert corners.score.shape == (ROWS * COLUMNS,)
        assert corners.points.dtype == corners.score.dtype == np.float32

    @pytest.mark.parametrize("share", [1.0, 0.3, 0.01])
    def test_matches_reference(self, x64, share):
        score, allowed = _image(3), _allowed(3, share)
        points, scores = _best_by_loop(score, allowed)
        corners = _best(score, allowed)
        np.testing.assert_array_equal(corners.points, points)
        np.testing.assert_array_equal(corners.score, scores)
        assert (scores == 0).any() == (share < 0.1)

    def test_first_of_equals(self):
        score = np.zeros((H, W), np.float32)
        score[3, 5] = score[3, 2] = score[6, 1] = 7
        corners = _best(score, np.ones((H, W), bool))
        np.testing.assert_array_equal(corners.points[:, 0], [2, 3])

    def test_degenerate(self):
        """Cells without a corner score 0, at their top-left pixel: nothing allowed, nothing known, nothing positive."""
        wanted = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))).reshape(2, -1) * CELL
        everywhere = np.ones((H, W), bool)
        unknown = np.full((H, W), np.nan, np.float32)
        for score, allowed in ((_image(dtype=np.float32), ~everywhere), (unknown, everywhere), (-unknown, everywhere)):
            corners = _best(score, allowed)
            np.testing.assert_array_equal(corners.points, wanted)
            np.testing.assert_array_equal(corners.score, 0)
        negative = _best(_image(dtype=np.float32) - 1000, everywhere)
        np.testing.assert_array_equal(negative.score, 0)

    def test_a_cell_larger_than_the_image(self):
        assert grid_corners(jnp.ones((10, 10)), jnp.ones((10, 10), bool), cell=16).score.shape == (0,)

    def test_gradient(self, x64):
        """A choice: no derivative, also not of the scores."""
        gradient = jax.jit(jax.grad(lambda score: sum(map(jnp.sum, _best(score, _allowed())))))(_image())
        np.testing.assert_array_equal(gradient, 0)


class TestOccupiedCells:
    def test_matches_reference(self):
        rng = np.random.default_rng(5)
        points = rng.uniform(-20, 80, (2, 40)).astype(np.float32)
        valid = rng.uniform(size=40) < 0.7
        expected = np.zeros((ROWS, COLUMNS), bool)
        for (u, v), counts in zip(points.T, valid, strict=True):
            if counts and 0 <= u < COLUMNS * CELL and 0 <= v < ROWS * CELL:
                expected[int(v // CELL), int(u // CELL)] = True
        assert 0 < expected.sum() < expected.size
        np.testing.assert_array_equal(_occupied(points, valid), expected.ravel())

    def test_corners_occupy_their_own_cells(self):
        corners = _best(_image(dtype=np.float32), np.ones((H, W), bool))
        valid = np.arange(ROWS * COLUMNS) % 3 > 0
        np.testing.assert_array_equal(_occupied(corners.points, valid), valid)

    def test_degenerate(self):
        """Points that are masked, outside, infinite or not numbers occupy nothing."""
        points = np.zeros((2, 40), np.float32)
        assert not _occupied(points, np.zeros(40, bool)).any()
        points[:] = np.resize([np.nan, np.inf, -np.inf, 1e30, -1e30, -0.1, COLUMNS * CELL], 40)
        assert not _occupied(points, np.ones(40, bool)).any()

    def test_vmap_equals_loop(self):
        rng = np.random.default_rng(6)
        points = rng.uniform(0, 40, (3, 2, 4)).astype(np.float32)
        occupied = lambda points: occupied_cells(points, jnp.ones(4, bool), (H, W), cell=CELL)
        batched = jax.jit(jax.vmap(occupied))(points)
        for k in range(3):
            np.testing.assert_array_equal(batched[k], occupied(jnp.asarray(points[k])))
