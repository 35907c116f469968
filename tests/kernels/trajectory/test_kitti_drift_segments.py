"""Drift over segments of a path against KITTI's formula in NumPy, its derivatives, and what must not matter."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxlie import SE3
from jaxslam_kernels.trajectory.kitti_drift import segment_errors
from kitti_drift import kitti_drift
from quick_compile import quick_compile_nested
from scipy.spatial.transform import Rotation

N, STEP = 41, 3
LENGTHS = np.array([2.0, 5.0, 9.0, 1000.0])
ALL = np.ones(N, bool)

_jitted = quick_compile_nested(lambda P, Q, mask, lengths: segment_errors(SE3(P), SE3(Q), mask, lengths, step=STEP))


def _errors(P, Q, mask, lengths):
    return jax.tree.map(np.asarray, _jitted(P, Q, mask, lengths))


@quick_compile_nested
def _loss(P, Q, mask, lengths):
    errors = segment_errors(SE3(P), SE3(Q), mask, lengths, step=STEP)
    return errors.translation + errors.rotation


_gradient = quick_compile_nested(jax.grad(_loss, argnums=(0, 1)))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _drive(seed, n=N):
    """Poses along a winding road, about half a meter apart."""
    rng = np.random.default_rng(seed)
    turned = Rotation.from_rotvec(np.cumsum(rng.normal(size=(n, 3)) * [0.02, 0.1, 0.02], axis=0))
    steps = turned.apply(np.array([0, 0, 0.5]) + 0.05 * rng.normal(size=(n, 3)))
    return np.hstack([turned.as_quat(scalar_first=True), np.cumsum(steps, axis=0)])


def _drifting(Q, seed, noise=0.02):
    """The same drive with errors in every step."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.cumsum(noise * rng.normal(size=(len(Q), 3)), axis=0))
    turned = turn * Rotation.from_quat(Q[:, :4], scalar_first=True)
    positions = Q[:, 4:] + np.cumsum(noise * rng.normal(size=(len(Q), 3)), axis=0)
    return np.hstack([turned.as_quat(scalar_first=True), positions])


def _moved(poses, seed):
    """The same in another world."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(rng=rng), 5 * rng.normal(size=3)
    wxyz = (R * Rotation.from_quat(poses[:, :4], scalar_first=True)).as_quat(scalar_first=True)
    return np.hstack([wxyz, R.apply(poses[:, 4:]) + t])


def _finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


class TestSegmentErrors:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_shapes(self, dtype):
        with jax.enable_x64(dtype == np.float64):
            errors = _errors(_drive(0).astype(dtype), _drive(1).astype(dtype), ALL, LENGTHS.astype(dtype))
        assert errors.translations.shape == errors.rotations.shape == (4, 14)
        assert errors.translation.shape == errors.rotation.shape == errors.num_segments.shape == ()
        assert all(array.dtype == dtype for array in errors[:4])
        assert errors.num_segments.dtype == np.int32

    def test_type_follows_the_input_where_float64_is_enabled(self, x64):
        errors = jax.eval_shape(_jitted, *(np.float32(a) for a in (_drive(0), _drive(1))), ALL, np.float32(LENGTHS))
        assert all(array.dtype == np.float32 for array in errors[:4])

    @pytest.mark.parametrize("seed", range(4))
    def test_matches_reference(self, x64, seed):
        Q = _drive(seed)
        P = _drifting(Q, seed + 100)
        errors = _errors(P, Q, ALL, LENGTHS)
        translations, rotations, count = kitti_drift(P, Q, LENGTHS, STEP)
        assert 20 < count < errors.translations.size
        assert errors.num_segments == count
        np.testing.assert_allclose(errors.translations, translations, atol=1e-12)
        np.testing.assert_allclose(errors.rotations, rotations, atol=1e-9)
        np.testing.assert_allclose(errors.translation, translations.sum() / count, rtol=1e-10)
        np.testing.assert_allclose(errors.rotation, rotations.sum() / count, rtol=1e-8)

    def test_as_long_as_kittis(self, x64):
        """The benchmark's own lengths and step, on a path of a kilometer and a half."""
        Q = _drive(5, 1500)
        Q[:, 4:] *= 2
        P, lengths = _drifting(Q, 6, 0.001), np.arange(1, 9) * 100.0
        compute = quick_compile_nested(lambda P, Q, mask, lengths: segment_errors(SE3(P), SE3(Q), mask, lengths))
        errors = compute(P, Q, np.ones(1500, bool), lengths)
        translations, rotations, count = kitti_drift(P, Q, lengths, 10)
        assert errors.num_segments == count
        np.testing.assert_allclose(errors.translations, translations, atol=1e-10)
        np.testing.assert_allclose(errors.rotations, rotations, atol=1e-9)

    @pytest.mark.parametrize(
        "noise", [pytest.param(0.02, marks=pytest.mark.slow, id="far"), pytest.param(1e-6, id="nearly equal")]
    )
    def test_gradient(self, x64, noise):
        Q, mask = _drive(1), np.arange(N) % 7 > 0
        P = _drifting(Q, 2, noise)

        def outputs(P, Q):
            errors = segment_errors(SE3(P), SE3(Q), jnp.asarray(mask), jnp.asarray(LENGTHS), step=STEP)
            return errors.translation, errors.rotation, errors.translations, errors.rotations

        check_grads(
            quick_compile_nested(outputs), (P, Q), order=1, modes=("fwd", "rev"), eps=1e-4 * noise, rtol=1e-4, atol=1e-4
        )

    def test_vmap_equals_loop(self, x64):
        Q = np.stack([_drive(s) for s in range(3)])
        P = np.stack([_drifting(q, s) for s, q in enumerate(Q)])
        masks = np.stack([ALL, np.arange(N) % 4 > 0, np.arange(N) < 30])
        batched = quick_compile_nested(jax.vmap(lambda P, Q, mask: _jitted(P, Q, mask, jnp.asarray(LENGTHS))))(
            P, Q, masks
        )
        for k in range(3):
            single = _errors(P[k], Q[k], masks[k], LENGTHS)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a[k], b, atol=1e-12), batched, single)  # noqa: B023

    def test_single_trace(self):
        """Poses, masks and lengths are values."""
        compute = quick_compile_nested(eqx.debug.assert_max_traces(_loss, max_traces=1))
        for seed in range(3):
            Q = _drive(seed)
            arrays = (a.astype(np.float32) for a in (_drifting(Q, seed), Q))
            compute(*arrays, np.arange(N) % (seed + 2) > 0, np.float32(LENGTHS + seed))

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize(
        ("case", "found"),
        [
            ("equal", True),
            ("some NaN", True),
            ("opposite", True),
            ("bad lengths", True),
            ("all NaN", False),
            ("masked", False),
            ("one pose", False),
            ("zero motion", False),
            ("too short", False),
            ("no quaternion", False),
        ],
    )
    def test_degenerate(self, case, found, dtype):
        P, Q, mask, lengths = _degenerate(case)
        P, Q, lengths = (a.astype(dtype) for a in (P, Q, lengths))
        with jax.enable_x64(dtype == np.float64):
            errors = _errors(P, Q, mask, lengths)
            gradient = [np.asarray(g) for g in _gradient(P, Q, mask, lengths)]
        assert (errors.num_segments > 0) == found
        assert _finite(errors)
        assert _finite(gradient)
        if not found or case == "equal":
            assert errors.translation == 0
            assert all((g == 0).all() for g in gradient)

    def test_lengths_that_cannot_be_do_not_count(self, x64):
        P, Q, mask, lengths = _degenerate("bad lengths")
        errors = _errors(P, Q, mask, lengths)
        assert (errors.translations[0] > 0).any()
        np.testing.assert_array_equal(errors.translations[1:], 0)

    def test_single_pose(self, x64):
        errors = _errors(_drive(0, 1), _drive(0, 1), np.ones(1, bool), LENGTHS)
        assert errors.translations.shape == (4, 1)
        assert errors.num_segments == 0

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_ignores_the_worlds(self, seed):
        """Moving either trajectory changes nothing."""
        Q = _drive(seed)
        P = _drifting(Q, seed + 1)
        with jax.enable_x64(True):
            before = _errors(P, Q, ALL, LENGTHS)
            for after in (_errors(_moved(P, seed), Q, ALL, LENGTHS), _errors(P, _moved(Q, seed), ALL, LENGTHS)):
                assert after.num_segments == before.num_segments
                np.testing.assert_allclose(after.translations, before.translations, atol=1e-10)
                np.testing.assert_allclose(after.rotations, before.rotations, atol=1e-8)

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_equal_up_to_the_world_is_zero(self, seed):
        Q = _drive(seed)
        with jax.enable_x64(True):
            errors = _errors(_moved(Q, seed), Q, ALL, LENGTHS)
        assert errors.num_segments > 0
        np.testing.assert_allclose(errors.translations, 0, atol=1e-12)
        np.testing.assert_allclose(errors.rotations, 0, atol=1e-12)

    @given(st.integers(0, 2**31), st.floats(0.9, 1.1))
    @settings(max_examples=20, deadline=None)
    def test_scale(self, seed, scale):
        """Of a straight drive too long by some percent the error is that, or more if a segment exceeds its length."""
        rng = np.random.default_rng(seed)
        Q = np.tile(_moved(_drive(0, 1), seed), (N, 1))
        steps = rng.uniform(0.01, 0.05, (N, 1))
        Q[:, 4:] += np.cumsum(steps * Rotation.random(rng=rng).apply([0, 0, 1.0]), axis=0)
        P = Q.copy()
        P[:, 4:] *= scale
        lengths = np.array([0.1, 0.2, 0.4, 1000.0])
        with jax.enable_x64(True):
            errors = _errors(P, Q, ALL, lengths)
        found = np.asarray(errors.translations) > 0
        if scale != 1:
            assert found.sum() == errors.num_segments > 0
        excess = np.broadcast_to(0.05 / lengths[:, None], found.shape)[found]
        off = abs(scale - 1)
        assert (np.asarray(errors.translations)[found] >= off * (1 - 1e-9)).all()
        assert (np.asarray(errors.translations)[found] <= off * (1 + excess) * (1 + 1e-9)).all()
        np.testing.assert_allclose(errors.rotations, 0, atol=1e-12)

    def test_two_percent(self, x64):
        """Steps of half a meter on a straight road: segments of 2 m end at 2.5 m, of 5 m at 5.5 m, of 9 m at 9.5 m."""
        Q = np.tile([1.0, 0, 0, 0, 0, 0, 0], (N, 1))
        Q[:, 6] = 0.5 * np.arange(N)
        P = Q.copy()
        P[:, 6] *= 1.02
        errors = _errors(P, Q, ALL, LENGTHS)
        for row, length in zip(errors.translations[:3], LENGTHS[:3], strict=True):
            np.testing.assert_allclose(row[row > 0], 0.02 * (length + 0.5) / length, rtol=1e-10)
            assert (row > 0).sum() == np.ceil((N - 2 * (length + 0.5)) / STEP)
        assert errors.num_segments == (errors.translations > 0).sum()

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_poses_that_do_not_count_are_not_there(self, seed):
        """As if the others were alone: the path goes past them and the steps are those of the others."""
        rng = np.random.default_rng(seed)
        mask = rng.random(N) < 0.7
        Q = _drive(seed)
        P = _drifting(Q, seed + 1)
        wild = P + ~mask[:, None] * rng.normal(size=P.shape) * 1e6
        with jax.enable_x64(True):
            errors = _errors(wild, Q, mask, LENGTHS)
        translations, rotations, count = kitti_drift(P[mask], Q[mask], LENGTHS, STEP)
        assert errors.num_segments == count
        np.testing.assert_allclose(errors.translations[:, : translations.shape[1]], translations, atol=1e-10)
        np.testing.assert_allclose(errors.rotations[:, : rotations.shape[1]], rotations, atol=1e-8)


def _degenerate(case):
    Q, mask, lengths = _drive(0), ALL.copy(), LENGTHS.copy()
    P = _drifting(Q, 1)
    match case:
        case "equal":
            P = Q.copy()
        case "some NaN":
            P[2, 1], Q[5, 6], Q[7, 4] = np.nan, np.inf, 1e30
        case "opposite":
            P[20:, :4] = Q[20:, [1, 0, 3, 2]] * [-1, 1, -1, 1]  # turned by pi
        case "bad lengths":
            lengths = np.array([2.0, -1, 0, np.nan])
        case "all NaN":
            P[:] = np.nan
        case "masked":
            mask[:] = False
        case "one pose":
            mask = np.arange(N) == 4
        case "zero motion":
            P[:], Q[:] = P[0], Q[0]
        case "too short":
            lengths = lengths + 1000
        case "no quaternion":
            Q[:, :4] = 0
    return P, Q, mask, lengths
