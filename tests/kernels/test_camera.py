"""The camera against OpenCV, and its derivatives."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.camera import (
    Intrinsics,
    back_project,
    depth_from_disparity,
    disparity_from_depth,
    distort,
    in_front,
    make_intrinsics,
    normalize,
    project,
    to_pixels,
    undistort_pixels,
    without_distortion,
)

WIDTH, HEIGHT, N = 640, 480, 400
CAMERAS = {
    "tum_fr1": (517.306408, 516.469215, 318.64304, 255.313989, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "tum_fr2": (520.90862, 521.007327, 325.141442, 249.701764, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "bonn": (542.822841, 542.57687, 315.59352, 237.756098, (0.039903, -0.099343, -0.00073, -0.000144, 0.0)),
    "rectified": (535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0, 0.0)),
}

_project, _back_project, _normalize = jax.jit(project), jax.jit(back_project), jax.jit(normalize)


def _camera(name: str, dtype=jnp.float64) -> Intrinsics:
    return make_intrinsics(*CAMERAS[name], dtype=dtype)


def _opencv(name: str) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy, distortion = CAMERAS[name]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(distortion)


def _pixels(seed: int) -> np.ndarray:
    """Pixels all over the image, its corners among them."""
    uv = np.random.default_rng(seed).uniform([[0.0], [0.0]], [[WIDTH - 1], [HEIGHT - 1]], (2, N))
    uv[:, :4] = [[0, WIDTH - 1, 0, WIDTH - 1], [0, 0, HEIGHT - 1, HEIGHT - 1]]
    return uv


def _points(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.3, 8.0, N)
    return np.stack([rng.uniform(-0.6, 0.6, N) * z, rng.uniform(-0.45, 0.45, N) * z, z])


def test_shapes():
    camera = make_intrinsics(500.0, 500.0, 320.0, 240.0, (0.1, 0.2))
    assert camera.distortion is not None
    assert camera.distortion.shape == (5,)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(camera))
    uv, depth = jnp.zeros((2, 7)), jnp.ones(7)
    X_cam = jax.eval_shape(back_project, camera, uv, depth)
    assert X_cam.shape == (3, 7)
    assert jax.eval_shape(in_front, X_cam).shape == (7,)
    for f in (normalize, undistort_pixels, distort, to_pixels):
        assert jax.eval_shape(f, camera, uv).shape == (2, 7)
    assert jax.eval_shape(project, camera, X_cam).dtype == jnp.float32
    assert jax.eval_shape(depth_from_disparity, depth, camera.fx, 0.1).shape == (7,)


@pytest.mark.parametrize("name", CAMERAS)
class TestAgainstOpenCV:
    def test_matches_reference_project(self, name):
        X_cam, (matrix, distortion) = _points(0), _opencv(name)
        expected = cv2.projectPoints(X_cam.T.copy(), np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0].T
        with jax.enable_x64(True):
            np.testing.assert_allclose(_project(_camera(name), jnp.asarray(X_cam)), expected, atol=1e-9)

    def test_matches_reference_undistort(self, name):
        uv, (matrix, distortion) = _pixels(1), _opencv(name)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 1000, 1e-15)
        undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4 and 5
        src = np.ascontiguousarray(uv.T[:, None])
        expected = undistort(src, matrix, distortion, R=None, P=None, criteria=criteria)[:, 0].T
        with jax.enable_x64(True):
            np.testing.assert_allclose(_normalize(_camera(name), jnp.asarray(uv)), expected, atol=1e-9)

    def test_round_trip_over_the_whole_image(self, name):
        uv, depth = _pixels(2), np.random.default_rng(2).uniform(0.3, 8.0, N)
        with jax.enable_x64(True):
            camera = _camera(name)
            X_cam = _back_project(camera, jnp.asarray(uv), jnp.asarray(depth))
            np.testing.assert_allclose(_project(camera, X_cam), uv, atol=1e-9)
        camera = _camera(name, jnp.float32)
        X_cam = _back_project(camera, jnp.asarray(uv, jnp.float32), jnp.asarray(depth, jnp.float32))
        np.testing.assert_allclose(_project(camera, X_cam), uv, atol=3e-4)


class TestGradient:
    """Forward, reverse and finite differences along a random direction of intrinsics and points."""

    @staticmethod
    def _check(f, *primals, rtol: float = 1e-7):
        rng = np.random.default_rng(3)
        leaves, tree = jax.tree.flatten(primals)
        tangents = jax.tree.unflatten(
            tree, [jnp.asarray(rng.normal(size=x.shape)) * jnp.maximum(jnp.abs(x), 0.1) for x in leaves]
        )
        moved = jax.jit(lambda h: f(*jax.tree.map(lambda p, t: p + h * t, primals, tangents)))
        value, forward = jax.jit(lambda p, t: jax.jvp(f, p, t))(primals, tangents)
        probe = jnp.asarray(rng.normal(size=value.shape))
        pulled = jax.jit(lambda p, probe: jax.vjp(f, *p)[1](probe))(primals, probe)
        reverse = sum(jnp.sum(g * t) for g, t in zip(*map(jax.tree.leaves, (pulled, tangents)), strict=True))
        numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6
        scale = float(jnp.abs(numeric).max())
        np.testing.assert_allclose(forward, numeric, atol=rtol * scale)
        np.testing.assert_allclose(reverse, jnp.sum(probe * forward), rtol=1e-10)

    def test_gradient_project(self):
        with jax.enable_x64(True):
            self._check(project, _camera("tum_fr1"), jnp.asarray(_points(4)))

    def test_gradient_back_project(self):
        """Through Newton's method: the derivative of the implicit function, not of the iterations."""
        with jax.enable_x64(True):
            depth = jnp.asarray(np.random.default_rng(5).uniform(0.3, 8.0, N))
            self._check(back_project, _camera("tum_fr1"), jnp.asarray(_pixels(5)), depth)

    def test_gradient_near_the_singular_case(self):
        """Points a little in front of where the camera ends."""
        with jax.enable_x64(True):
            X_cam = jnp.asarray(_points(6)).at[2].set(0.02) * jnp.asarray([[0.01], [0.01], [1.0]])
            self._check(project, _camera("tum_fr1"), X_cam)


class TestIdeal:
    """A camera without distortion is one whose coefficients are all zero, and computes less."""

    def test_equals_zeros(self):
        with jax.enable_x64(True):
            ideal = without_distortion(_camera("tum_fr1"))
            zeros = ideal._replace(distortion=jnp.zeros(5))
            uv, X_cam = jnp.asarray(_pixels(8)), jnp.asarray(_points(8))
            assert ideal.distortion is None
            np.testing.assert_allclose(normalize(ideal, uv), normalize(zeros, uv), atol=1e-14)
            np.testing.assert_allclose(project(ideal, X_cam), project(zeros, X_cam), atol=1e-11)
            np.testing.assert_allclose(undistort_pixels(ideal, uv), uv, atol=1e-11)

    def test_gradient(self):
        with jax.enable_x64(True):
            ideal = without_distortion(_camera("tum_fr1"))
            TestGradient._check(project, ideal, jnp.asarray(_points(4)))
            depth = jnp.asarray(np.random.default_rng(5).uniform(0.3, 8.0, N))
            TestGradient._check(back_project, ideal, jnp.asarray(_pixels(5)), depth)


def test_vmap_equals_loop():
    cameras = jax.tree.map(lambda *x: jnp.stack(x), *(_camera(name, jnp.float32) for name in CAMERAS))
    uv = jnp.asarray(_pixels(7), jnp.float32)
    batched = jax.jit(jax.vmap(normalize, in_axes=(0, None)))(cameras, uv)
    looped = np.stack([_normalize(_camera(name, jnp.float32), uv) for name in CAMERAS])
    np.testing.assert_allclose(batched, looped, atol=1e-6)


def test_single_trace():
    traced = jax.jit(eqx.debug.assert_max_traces(lambda *a: project(a[0], back_project(*a)), max_traces=1))
    for seed, name in enumerate(CAMERAS):
        traced(_camera(name, jnp.float32), jnp.asarray(_pixels(seed), jnp.float32), jnp.ones(N))


class TestDegenerate:
    def test_points_that_cannot_be_seen(self):
        X_cam = jnp.asarray([[0.0, 1.0, np.nan, 1.0, 0.1], [0.0, 1.0, 1.0, np.inf, 0.1], [-1.0, 0.0, 1.0, 1.0, 1.0]])
        camera = _camera("tum_fr1", jnp.float32)
        np.testing.assert_array_equal(in_front(X_cam), [False, False, False, False, True])
        uv = project(camera, X_cam)
        np.testing.assert_allclose(uv[:, :4], np.array([[camera.cx], [camera.cy]]) * np.ones((1, 4)), rtol=1e-6)
        gradients = jax.jit(jax.grad(lambda c, X: project(c, X).sum(), argnums=(0, 1)))(camera, X_cam)
        assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))
        np.testing.assert_array_equal(gradients[1][:, :4], 0.0)

    def test_pixels_and_depths_that_are_missing(self):
        uv = jnp.asarray([[np.nan, 5.0, 5.0, 5.0, 5.0], [1.0, np.inf, 5.0, 5.0, 5.0]])
        depth = jnp.asarray([1.0, 1.0, 0.0, np.nan, -2.0])
        camera = _camera("tum_fr1", jnp.float32)
        np.testing.assert_array_equal(back_project(camera, uv, depth), 0.0)
        gradients = jax.jit(jax.grad(lambda *a: back_project(*a).sum(), argnums=(0, 1, 2)))(camera, uv, depth)
        assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))

    def test_far_outside_the_image(self):
        """Where the distortion cannot be inverted the result is finite."""
        uv = jnp.asarray(np.random.default_rng(8).uniform(-1e5, 1e5, (2, N)), jnp.float32)
        camera = _camera("tum_fr1", jnp.float32)
        assert np.isfinite(_normalize(camera, uv)).all()
        gradient = jax.jit(jax.grad(lambda c: normalize(c, uv).sum()))(camera)
        assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))

    def test_disparity(self):
        values = jnp.asarray([2.0, 0.0, -1.0, np.nan, np.inf])
        expected = np.array([500.0 * 0.1 / 2.0, 0.0, 0.0, 0.0, 0.0], np.float32)
        for f in (depth_from_disparity, disparity_from_depth):
            np.testing.assert_allclose(f(values, jnp.asarray(500.0), 0.1), expected, rtol=1e-6)
            gradients = jax.grad(lambda v, fx, f=f: f(v, fx, 0.1).sum(), argnums=(0, 1))(values, jnp.asarray(500.0))
            assert all(np.isfinite(g).all() for g in gradients)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 10.0))
def test_only_the_direction_of_a_point_matters(seed, scale):
    """A point moved along its ray keeps its pixel, and points come out in the order they went in."""
    rng = np.random.default_rng(seed)
    X_cam, order = _points(seed).astype(np.float32), rng.permutation(N)
    camera = _camera("tum_fr1", jnp.float32)
    uv = np.asarray(_project(camera, X_cam))
    np.testing.assert_allclose(_project(camera, X_cam * np.float32(scale)), uv, atol=1e-3)
    np.testing.assert_array_equal(_project(camera, X_cam[:, order]), uv[:, order])
