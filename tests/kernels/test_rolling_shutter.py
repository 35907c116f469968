"""Image velocity and rolling shutter against exact motion of the camera, in float64."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxlie import SE3
from jaxslam_kernels.camera import MIN_DEPTH
from jaxslam_kernels.rolling_shutter import as_if_at_once, image_velocity, row_time

H, W, FOCAL = 480, 640, 517.0
N = 30

_velocity = jax.jit(image_velocity)


@jax.jit
def _corrected(xy, v, depth, twist, readout_s):
    return as_if_at_once(xy, image_velocity(xy, depth, twist), v, H, readout_s)


@jax.jit
def _corrected_and_gradients(*inputs):
    loss = lambda *inputs: jnp.sum(_corrected(*inputs))
    return _corrected(*inputs), _velocity(inputs[0], inputs[2], inputs[3]), jax.grad(loss, range(5))(*inputs)


@jax.jit
def _seen_at(seconds, X_cam, twist):
    """Normalized coordinates and depth of points, each when the camera has moved for its own time; exact."""
    move = lambda t, X: SE3.exp(-t * twist).as_matrix()[:3] @ jnp.append(X, 1.0)
    X = jax.vmap(move, in_axes=(0, 1), out_axes=1)(seconds, X_cam)
    return X[:2] / X[2:], X[2]


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _scene(seed=0):
    rng = np.random.default_rng(seed)
    uv = rng.uniform([[0], [0]], [[W - 1], [H - 1]], (2, N))
    return (uv - np.array([[W - 1], [H - 1]]) / 2) / FOCAL, rng.uniform(0.5, 5, N), rng.normal(size=6)


def _inputs(seed=0, dtype: Any = np.float64):
    xy, depth, twist = _scene(seed)
    v = FOCAL * xy[1] + (H - 1) / 2
    return tuple(np.asarray(a, dtype) for a in (xy, v, depth, twist, 0.03))


def _rolling(xy, depth, twist, readout_s):
    """What a rolling shutter sees of points that are at `xy` and `depth` when the middle row is taken."""
    X_cam, v = np.vstack([xy, np.ones(N)]) * depth, FOCAL * xy[1] + (H - 1) / 2
    seen = depth_then = np.empty(0)
    for _ in range(30):
        seen, depth_then = map(np.asarray, _seen_at((v / (H - 1) - 0.5) * readout_s, X_cam, twist))
        v = FOCAL * seen[1] + (H - 1) / 2
    return seen, v, depth_then


class TestImageVelocity:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_shapes(self, dtype):
        xy, _, depth, twist, _ = _inputs(dtype=dtype)
        with jax.enable_x64(dtype == np.float64):
            velocity = _velocity(xy, depth, twist)
        assert velocity.shape == (2, N)
        assert velocity.dtype == dtype

    @pytest.mark.parametrize("seed", range(3))
    def test_matches_reference(self, x64, seed):
        """The difference quotient of points projected while the camera moves."""
        xy, depth, twist = _scene(seed)
        X_cam, dt = np.vstack([xy, np.ones(N)]) * depth, 1e-4
        after, before = (np.asarray(_seen_at(np.full(N, sign * dt), X_cam, twist)[0]) for sign in (1, -1))
        np.testing.assert_allclose(_velocity(xy, depth, twist), (after - before) / (2 * dt), atol=1e-6)

    @pytest.mark.parametrize("unknown", [0.0, -1.0, np.nan, MIN_DEPTH / 2, 1e-300])
    def test_only_rotation_acts_where_depth_is_unknown(self, x64, unknown):
        xy, depth, twist = _scene()
        still = np.where(np.arange(6) < 3, 0, twist)
        np.testing.assert_array_equal(_velocity(xy, np.full(N, unknown), twist), _velocity(xy, depth, still))
        np.testing.assert_allclose(_velocity(xy, np.full(N, np.inf), twist), _velocity(xy, depth, still), atol=1e-15)

    @pytest.mark.parametrize("nearest", [0.5, 1.01 * MIN_DEPTH], ids=["general", "as near as can be"])
    def test_gradient(self, x64, nearest):
        xy, depth, twist = _scene(1)
        depth[0] = nearest
        check_grads(_velocity, (xy, depth, twist), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6)
        check_grads(_velocity, (xy, depth, 0 * twist), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6)

    def test_vmap_equals_loop(self, x64):
        scenes = [_scene(s) for s in range(3)]
        batched = jax.jit(jax.vmap(image_velocity))(*(np.stack(arrays) for arrays in zip(*scenes, strict=True)))
        for k, scene in enumerate(scenes):
            np.testing.assert_allclose(batched[k], _velocity(*scene), rtol=1e-12, atol=1e-14)

    def test_single_trace(self):
        compute = jax.jit(eqx.debug.assert_max_traces(image_velocity, max_traces=1))
        for seed in range(3):
            compute(*(np.float32(a) for a in _scene(seed)))

    @given(st.integers(0, 2**31), st.floats(-3, 3), st.floats(0.1, 10))
    @settings(max_examples=20, deadline=None)
    def test_is_linear_and_knows_no_scale(self, seed, factor, scale):
        (xy, depth, twist), other = _scene(seed), _scene(seed + 1)[2]
        larger = np.where(np.arange(6) < 3, scale, 1) * twist
        with jax.enable_x64(True):
            velocity = _velocity(xy, depth, twist)
            both = _velocity(xy, depth, twist + factor * other)
            np.testing.assert_allclose(both, velocity + factor * _velocity(xy, depth, other), atol=1e-11)
            np.testing.assert_allclose(_velocity(xy, scale * depth, larger), velocity, atol=1e-11)


class TestAsIfAtOnce:
    def test_shapes(self):
        corrected = _corrected(*_inputs(dtype=np.float32))
        assert corrected.shape == (2, N)
        assert corrected.dtype == np.float32

    def test_rows(self, x64):
        """First, middle and last row of an even and an odd number of them."""
        for height, readout_s in ((480, 0.02), (11, -0.1)):
            rows = jnp.array([0, (height - 1) / 2, height - 1])
            expected = np.array([-0.5, 0, 0.5]) * readout_s
            np.testing.assert_allclose(row_time(rows, height, jnp.asarray(readout_s)), expected, atol=1e-15)

    @pytest.mark.parametrize("seed", range(6))
    def test_matches_reference(self, x64, seed):
        """Exact motion at 140 degrees a second in 20 ms leaves a third of a pixel; half of that motion, a quarter."""
        xy, depth, twist = _scene(seed)
        turn = np.where(np.arange(6) < 3, 0, twist)
        turn *= np.deg2rad(140) / np.linalg.norm(turn)
        errors = []
        for readout_s in (0.02, 0.01):
            seen, v, depth_then = _rolling(xy, depth, turn, readout_s)
            corrected = np.asarray(_corrected(seen, v, depth_then, turn, np.asarray(readout_s)))
            inside = (v >= 0) & (v <= H - 1)
            errors.append(FOCAL * np.linalg.norm(corrected - xy, axis=0)[inside].max())
            assert FOCAL * np.linalg.norm(seen - xy, axis=0).max() > 20 * errors[-1]
        assert errors[0] < 1 / 3
        assert 3.5 < errors[0] / errors[1] < 4.5

    @pytest.mark.parametrize("axis", range(6))
    def test_is_of_second_order(self, x64, axis):
        """In every direction of motion, translation too."""
        xy, depth, _ = _scene()
        twist, errors = np.eye(6)[axis], []
        for readout_s in (0.02, 0.01):
            seen, v, depth_then = _rolling(xy, depth, twist, readout_s)
            corrected = np.asarray(_corrected(seen, v, depth_then, twist, np.asarray(readout_s)))
            errors.append(np.abs(corrected - xy).max())
        assert errors[0] < 4.5 * errors[1] + 1e-15
        assert errors[0] < 1e-3

    def test_a_global_shutter_changes_nothing(self, x64):
        xy, v, depth, twist, _ = _inputs()
        np.testing.assert_array_equal(_corrected(xy, v, depth, twist, np.asarray(0.0)), xy)

    def test_gradient(self, x64):
        check_grads(_corrected, _inputs(), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6)

    def test_vmap_equals_loop(self, x64):
        inputs = [_inputs(s) for s in range(3)]
        batched = jax.jit(jax.vmap(_corrected))(*(np.stack(arrays) for arrays in zip(*inputs, strict=True)))
        for k in range(3):
            np.testing.assert_allclose(batched[k], _corrected(*inputs[k]), rtol=1e-12, atol=1e-14)

    def test_single_trace(self):
        correct = lambda xy, v, readout_s: as_if_at_once(xy, xy, v, H, readout_s)
        compute = jax.jit(eqx.debug.assert_max_traces(correct, max_traces=1))
        for seed in range(3):
            xy, v, _, _, readout_s = _inputs(seed, np.float32)
            compute(xy, v, readout_s)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("which", ["points", "rows", "depth", "twist"])
    def test_degenerate(self, which, bad, dtype):
        xy, v, depth, twist, readout_s = _inputs(dtype=dtype)
        good = np.arange(N) >= 5
        match which:
            case "points":
                xy[0, :5] = bad
            case "rows":
                v[:5] = bad
            case "depth":
                depth[:5] = bad
            case "twist":
                twist[2] = bad
        with jax.enable_x64(dtype == np.float64):
            corrected, velocity, gradients = _corrected_and_gradients(xy, v, depth, twist, readout_s)
            clean = _corrected(*_inputs(dtype=dtype))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((corrected, velocity, gradients)))
        if which == "twist":
            np.testing.assert_array_equal(corrected, xy)
        else:
            np.testing.assert_array_equal(corrected[:, good], clean[:, good])
        if which == "points":
            np.testing.assert_array_equal(corrected[:, ~good], 0)
            np.testing.assert_array_equal(velocity[:, ~good], 0)
        if which == "rows":
            np.testing.assert_array_equal(corrected[:, ~good], xy[:, ~good])

    def test_without_motion_nothing_moves(self, x64):
        xy, v, depth, twist, readout_s = _inputs()
        np.testing.assert_array_equal(_velocity(xy, depth, 0 * twist), 0)
        np.testing.assert_array_equal(_corrected(xy, v, depth, 0 * twist, readout_s), xy)
