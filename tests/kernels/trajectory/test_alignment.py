"""Alignment, ATE and RPE against NumPy and SciPy in float64; their derivatives, also where they are delicate."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxlie import SE3
from jaxslam_kernels.trajectory.alignment import AlignmentStatus, align, ate, nearest_rotation, rpe
from quick_compile import quick_compile_nested
from scipy.spatial.transform import Rotation

N = 12
ONES = np.ones(N)
IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _cloud(seed, scales=(3.0, 2.0, 1.0)):
    return np.random.default_rng(seed).normal(size=(3, N)) * np.array(scales)[:, None]


def _similarity(seed):
    rng = np.random.default_rng(seed)
    return Rotation.random(rng=rng).as_matrix(), rng.normal(size=(3, 1)) * 5, rng.uniform(0.2, 4)


def _poses(seed, n=N):
    rng = np.random.default_rng(seed)
    wxyz = Rotation.random(n, rng=rng).as_quat(scalar_first=True)
    return np.hstack([wxyz, rng.normal(size=(n, 3))])


def _matrices(poses):
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(poses[:, :4], scalar_first=True).as_matrix()
    T[:, :3, 3] = poses[:, 4:]
    return T


def _flat(alignment):
    T = alignment.T_reference_estimate
    return jnp.concatenate([T.rotation().as_matrix().ravel(), T.translation(), alignment.scale[None]])


_align = {kind: quick_compile_nested(partial(align, with_scale=kind == "sim3")) for kind in ("se3", "sim3")}
_ate = {kind: quick_compile_nested(partial(ate, alignment=kind)) for kind in ("none", "se3", "sim3")}
_fit = quick_compile_nested(lambda x, y, w: _flat(align(x, y, w, with_scale=True)))


@quick_compile_nested
def _fit_and_gradients(x, y, w):
    """Everything at once, for the finiteness of all of it; a NaN in any derivative reaches the sum."""
    fit = lambda x, y, w: _flat(align(x, y, w, with_scale=True)).sum()
    error = lambda x, y, w: sum(ate(x, y, w, alignment="sim3").statistics)
    return (
        align(x, y, w, with_scale=True),
        ate(x, y, w, alignment="sim3"),
        jax.grad(fit, argnums=(0, 1, 2))(x, y, w),
        jax.grad(error, argnums=(0, 1, 2))(x, y, w),
    )


_rpe = quick_compile_nested(lambda P, Q, i, j, mask: rpe(SE3(P), SE3(Q), i, j, mask))
_FIRST, _SECOND = np.arange(N - 2, dtype=np.int32), np.arange(2, N, dtype=np.int32)
_PAIRS = (_FIRST, _SECOND, np.ones(N - 2, bool))


@quick_compile_nested
def _rpe_loss(P, Q, i, j, mask):
    errors = rpe(SE3(P), SE3(Q), i, j, mask)
    return errors.translation.rmse + errors.rotation.rmse + errors.rotation.median


@quick_compile_nested
def _rpe_outputs(P, Q):
    errors = rpe(SE3(P), SE3(Q), jnp.asarray(_FIRST), jnp.asarray(_SECOND), jnp.arange(N - 2) % 3 > 0)
    return errors.translations, errors.rotations, errors.translation.std, errors.rotation.median


_rpe_gradient = quick_compile_nested(jax.grad(_rpe_loss, argnums=(0, 1)))


def _finite(tree):
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


def _umeyama(x, y, w, with_scale):
    """Umeyama's equations as printed, in NumPy."""
    w = w / w.sum()
    x_mean, y_mean = x @ w[:, None], y @ w[:, None]
    x, y = x - x_mean, y - y_mean
    U, d, Vt = np.linalg.svd((w * y) @ x.T)
    S = np.diag([1, 1, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    scale = (d @ np.diag(S)) / (w @ (x**2).sum(axis=0)) if with_scale else 1.0
    return R, y_mean - scale * R @ x_mean, scale


class TestAlign:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_shapes(self, dtype):
        with jax.enable_x64(dtype == np.float64):
            result = _align["sim3"](_cloud(0).astype(dtype), _cloud(1).astype(dtype), ONES.astype(dtype))
        assert result.T_reference_estimate.wxyz_xyz.shape == (7,)
        assert result.T_reference_estimate.wxyz_xyz.dtype == result.scale.dtype == dtype
        assert result.scale.shape == result.status.shape == ()
        assert result.status.dtype == np.int32

    @pytest.mark.parametrize("kind", ["se3", "sim3"])
    @pytest.mark.parametrize("seed", range(5))
    def test_matches_reference(self, x64, kind, seed):
        """Unrelated clouds on purpose: for every other seed the best orthogonal matrix is a reflection."""
        x, y = _cloud(seed), _cloud(seed + 100, (1.0, 1.0, 1.0))
        weights = np.random.default_rng(seed).uniform(0, 2, N)
        result = _align[kind](x, y, weights)
        R, t, scale = _umeyama(x, y, weights, kind == "sim3")
        share = weights / weights.sum()
        scipy_R, *_ = Rotation.align_vectors((y - y @ share[:, None]).T, (x - x @ share[:, None]).T, weights)
        np.testing.assert_allclose(result.T_reference_estimate.rotation().as_matrix(), R, atol=1e-12)
        np.testing.assert_allclose(scipy_R.as_matrix(), R, atol=1e-7)
        np.testing.assert_allclose(result.T_reference_estimate.translation(), t[:, 0], atol=1e-12)
        np.testing.assert_allclose(result.scale, scale, rtol=1e-12)
        np.testing.assert_allclose(result.apply(jnp.asarray(x)), scale * R @ x + t, atol=1e-12)
        assert result.status == AlignmentStatus.OK

    def test_recovers_in_float32_far_from_the_origin(self):
        R, t, scale = _similarity(3)
        x = _cloud(3) + 2000.0
        result = _align["sim3"](*(np.float32(a) for a in (x, scale * R @ x + t, ONES)))
        np.testing.assert_allclose(result.T_reference_estimate.rotation().as_matrix(), R, atol=3e-4)
        np.testing.assert_allclose(result.scale, scale, rtol=3e-4)

    @pytest.mark.parametrize(
        "scales",
        [(3, 2, 1), (3, 2, 0), (3, 2, 1e-4), (3, 1e-2, 1e-3)],
        ids=["general", "planar", "nearly planar", "nearly straight"],
    )
    def test_gradient(self, x64, scales):
        R, t, scale = _similarity(1)
        x = _cloud(1, scales)
        y = scale * R @ x + t + 1e-3 * scales[1] * _cloud(2)
        eps = 1e-3 * min(scales[1], 1e-2)
        check_grads(_fit, (x, y, ONES), order=1, modes=("fwd", "rev"), eps=eps, rtol=1e-5, atol=1e-5)

    @pytest.mark.parametrize("signs", [(1, 1, 1), (1, 1, -1)], ids=["proper", "mirrored"])
    def test_gradient_with_equal_singular_values(self, x64, signs):
        """An octahedron: its covariance is a multiple of the identity, and the derivative of the SVD is NaN."""
        x = np.hstack([np.eye(3), -np.eye(3)])
        y = x * np.array(signs)[:, None] * np.array([[1.0], [2.0], [0.5]] if signs[2] < 0 else [[1.0]] * 3)
        check_grads(_fit, (x, y, np.ones(6)), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6)

    def test_second_derivative(self, x64):
        matrix, direction = _umeyama(_cloud(5), _cloud(6), ONES, False)[0] + 0.3, _cloud(7)[:, :3]
        slope = quick_compile_nested(jax.grad(lambda m: jnp.sum(nearest_rotation(m) * direction)))
        check_grads(slope, (matrix,), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6)

    def test_gradient_of_a_straight_line(self, x64):
        """What the line determines has a derivative; the roll about it has derivative zero."""
        direction, axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14), np.array([0.3, -1.0, 0.5])
        line = np.outer(direction, np.linspace(-1, 1, N))
        turned = quick_compile_nested(
            lambda angle: _align["se3"](
                jnp.asarray(line) + angle * jnp.asarray(np.cross(axis, line.T).T), jnp.asarray(line), jnp.ones(N)
            ).T_reference_estimate.rotation()
        )
        R, dR = jax.jvp(lambda a: turned(a).as_matrix(), (jnp.zeros(()),), (jnp.ones(()),))
        np.testing.assert_allclose(dR @ direction, -R @ np.cross(axis, direction), atol=1e-9)
        spin = R.T @ dR
        assert abs(np.array([spin[2, 1], spin[0, 2], spin[1, 0]]) @ direction) < 1e-9

    def test_vmap_equals_loop(self, x64):
        x, y = np.stack([_cloud(s) for s in range(3)]), np.stack([_cloud(s) for s in range(3, 6)])
        w = np.stack([ONES, 2 * ONES, np.linspace(0, 1, N)])
        batched = quick_compile_nested(jax.vmap(_fit))(x, y, w)
        for k in range(3):
            np.testing.assert_allclose(batched[k], _fit(x[k], y[k], w[k]), atol=1e-12)

    def test_single_trace(self):
        fit = quick_compile_nested(eqx.debug.assert_max_traces(partial(align, with_scale=True), max_traces=1))
        for seed in range(3):
            fit(*(np.float32(a) for a in (_cloud(seed), _cloud(seed + 1), ONES)))

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize(
        ("case", "status"),
        [
            ("all masked", AlignmentStatus.TOO_FEW),
            ("all NaN", AlignmentStatus.TOO_FEW),
            ("two poses", AlignmentStatus.TOO_FEW),
            ("one pose", AlignmentStatus.TOO_FEW),
            ("bad weights", AlignmentStatus.TOO_FEW),
            ("some NaN", AlignmentStatus.OK),
            ("infinite and huge", AlignmentStatus.OK),
            ("standing still", AlignmentStatus.ROTATION_UNDETERMINED),
            ("reference still", AlignmentStatus.ROTATION_UNDETERMINED),
            ("straight line", AlignmentStatus.ROTATION_UNDETERMINED),
            ("perfect", AlignmentStatus.OK),
        ],
    )
    def test_degenerate(self, case, status, dtype):
        x, y, w = _degenerate(case)
        x, y, w = (a.astype(dtype) for a in (x, y, w))
        with jax.enable_x64(dtype == np.float64):
            results = _fit_and_gradients(x, y, w)
        assert results[0].status == status
        assert _finite(results)

    def test_one_pose_is_only_moved(self, x64):
        x, y, w = _degenerate("one pose")
        result = _align["sim3"](x, y, w)
        np.testing.assert_allclose(result.apply(jnp.asarray(x))[:, 4], y[:, 4], atol=1e-12)
        np.testing.assert_array_equal(result.T_reference_estimate.wxyz_xyz[:4], [1, 0, 0, 0])
        assert result.scale == 1

    def test_nothing_is_the_identity(self, x64):
        result = _align["sim3"](*_degenerate("all masked"))
        np.testing.assert_array_equal(result.T_reference_estimate.wxyz_xyz, IDENTITY)

    def test_standing_still_is_not_turned(self, x64):
        result = _align["sim3"](*_degenerate("standing still"))
        np.testing.assert_array_equal(result.T_reference_estimate.wxyz_xyz[:4], [1, 0, 0, 0])
        assert result.scale == 1


def _degenerate(case):
    x, y, w = _cloud(10), _cloud(11), ONES.copy()
    match case:
        case "all masked":
            w[:] = 0
        case "all NaN":
            x[:] = np.nan
        case "two poses" | "one pose":
            w[:] = 0
            w[4 : 6 if case == "two poses" else 5] = 1
        case "bad weights":
            w[:6], w[6:9], w[9] = np.nan, -1, np.inf
        case "some NaN":
            x[1, 2], y[0, 5], w[7] = np.nan, np.nan, np.nan
        case "infinite and huge":
            x[1, 2], y[0, 5], y[2, 7] = np.inf, -np.inf, 1e30
        case "standing still":
            x[:], y[:] = np.array([[0.1], [0.7], [-33.3]]), np.array([[-70.3], [1.1], [0.3]])
            w[:] = np.linspace(0.1, 1.3, N)
        case "reference still":
            y[:] = 0.1
        case "straight line":
            x = np.outer([0.1, 2, -1], np.linspace(0, 3, N)) + 7
            y = np.outer([1, -2, 5], np.linspace(0, 1, N) ** 2) - 1
        case "perfect":
            y = x.copy()
    return x, y, w


class TestAte:
    def test_shapes(self):
        errors = _ate["se3"](*(np.float32(a) for a in (_cloud(0), _cloud(1), ONES)))
        assert errors.distances.shape == (N,)
        assert errors.distances.dtype == np.float32
        assert all(figure.shape == () and figure.dtype == np.float32 for figure in errors.statistics)
        assert errors.num_poses == N

    @pytest.mark.parametrize("kind", ["none", "se3", "sim3"])
    @pytest.mark.parametrize("used", [N, N - 1])
    def test_matches_reference(self, x64, kind, used):
        x, y, mask = _cloud(0), _cloud(1), np.arange(N) < used
        errors = _ate[kind](x, y, mask.astype(float))
        x, y = x[:, mask], y[:, mask]
        R, t, scale = (np.eye(3), 0, 1) if kind == "none" else _umeyama(x, y, np.ones(used), kind == "sim3")
        expected = np.linalg.norm(scale * R @ x + t - y, axis=0)
        np.testing.assert_allclose(errors.distances[:used], expected, atol=1e-12)
        np.testing.assert_array_equal(errors.distances[used:], 0)
        figures = [np.sqrt((expected**2).mean()), expected.mean(), np.median(expected), expected.max(), expected.std()]
        np.testing.assert_allclose(errors.statistics, figures, rtol=1e-12)
        assert errors.num_poses == used

    def test_gradient(self, x64):
        def figures(x, y, w):
            errors = ate(x, y, w, alignment="sim3")
            return jnp.stack(errors.statistics), errors.distances

        arguments = (_cloud(0), _cloud(1), np.linspace(1.0, 2.0, N))
        check_grads(
            quick_compile_nested(figures), arguments, order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6, atol=1e-6
        )

    def test_vmap_equals_loop(self, x64):
        x, y = np.stack([_cloud(s) for s in range(3)]), np.stack([_cloud(s) for s in range(3, 6)])
        batched = quick_compile_nested(jax.vmap(lambda x, y: ate(x, y, jnp.ones(N)).statistics.median))(x, y)
        for k in range(3):
            np.testing.assert_allclose(batched[k], _ate["se3"](x[k], y[k], ONES).statistics.median, rtol=1e-12)

    def test_single_trace(self):
        compute = quick_compile_nested(eqx.debug.assert_max_traces(partial(ate, alignment="none"), max_traces=1))
        for seed in range(3):
            compute(*(np.float32(a) for a in (_cloud(seed), _cloud(seed + 1), ONES)))

    def test_degenerate(self, x64):
        """A perfect estimate has error and gradient zero, not NaN; without poses the figures are zero."""
        x, y, w = _degenerate("perfect")
        for gradient in quick_compile_nested(jax.grad(lambda *a: sum(ate(*a, alignment="none").statistics), (0, 1, 2)))(
            x, y, w
        ):
            np.testing.assert_array_equal(gradient, 0)
        np.testing.assert_allclose(_ate["sim3"](x, y, w).statistics, 0, atol=1e-14)
        empty = _ate["sim3"](*_degenerate("all NaN"))
        np.testing.assert_array_equal(empty.statistics, 0)
        assert empty.num_poses == 0
        assert _ate["none"](x, np.full_like(y, np.nan), w).num_poses == 0

    def test_far_from_the_origin_in_float32(self):
        """Coordinates that float32 holds exactly, turned by a right angle: the error is that of a small cloud."""
        x = np.round(_cloud(0, (0.1, 0.1, 0.1)) * 4096) / 4096
        y = x[[1, 0, 2]] * np.array([[-1.0], [1.0], [1.0]])
        errors = _ate["sim3"](np.float32(x + 2048), np.float32(y - 2048), np.linspace(0.1, 1.3, N, dtype=np.float32))
        assert errors.statistics.maximum < 2e-7

    @given(st.integers(0, 2**31), st.sampled_from(["se3", "sim3"]))
    @settings(max_examples=20, deadline=None)
    def test_ignores_the_frames(self, seed, kind):
        """Moving the estimate (scaling it too, for Sim(3)) and the reference changes nothing."""
        x, y = _cloud(seed), _cloud(seed + 1)
        (R_x, t_x, scale), (R_y, t_y, _) = _similarity(seed), _similarity(seed + 1)
        moved = (scale if kind == "sim3" else 1.0) * R_x @ x + t_x
        with jax.enable_x64(True):
            before, after = _ate[kind](x, y, ONES), _ate[kind](moved, R_y @ y + t_y, ONES)
        np.testing.assert_allclose(after.distances, before.distances, rtol=1e-8, atol=1e-10)

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_ignores_order_and_poses_without_weight(self, seed):
        rng = np.random.default_rng(seed)
        x, y, w = _cloud(seed), _cloud(seed + 1), rng.integers(0, 2, N).astype(float)
        order = rng.permutation(N)
        wild = x + (w == 0) * rng.normal(size=x.shape) * 1e6
        with jax.enable_x64(True):
            before, after = _ate["sim3"](x, y, w), _ate["sim3"](wild[:, order], y[:, order], w[order])
        np.testing.assert_allclose(after.statistics, before.statistics, rtol=1e-8, atol=1e-10)

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_alignment_is_the_best(self, seed):
        """No nearby similarity does better, and neither does leaving out the scale or all of it."""
        x, y = _cloud(seed), _cloud(seed + 1)
        rng = np.random.default_rng(seed)
        with jax.enable_x64(True):
            errors = {kind: _ate[kind](x, y, ONES) for kind in _ate}
        rmse = {kind: float(e.statistics.rmse) for kind, e in errors.items()}
        assert rmse["sim3"] <= rmse["se3"] + 1e-12
        assert rmse["se3"] <= rmse["none"] + 1e-12
        R, t, scale = _umeyama(x, y, ONES, True)
        R = R @ Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix()
        nudged = scale * rng.normal(1, 0.01) * R @ x + t + rng.normal(size=(3, 1)) * 0.01
        assert rmse["sim3"] <= np.sqrt(((nudged - y) ** 2).sum(axis=0).mean()) + 1e-12


class TestRpe:
    def test_shapes(self):
        errors = _rpe(_poses(0).astype(np.float32), _poses(1).astype(np.float32), *_PAIRS)
        assert errors.translations.shape == errors.rotations.shape == (N - 2,)
        assert errors.translations.dtype == errors.rotations.dtype == errors.rotation.rmse.dtype == np.float32
        assert errors.num_pairs == N - 2

    def test_type_follows_the_input_where_float64_is_enabled(self, x64):
        P, Q = (_poses(seed).astype(np.float32) for seed in (0, 1))
        errors = jax.eval_shape(_rpe, P, Q, *_PAIRS)
        assert errors.translations.dtype == errors.rotations.dtype == errors.rotation.rmse.dtype == np.float32

    def test_matches_reference(self, x64):
        P, Q, mask = _poses(0), _poses(1), np.arange(N - 2) % 3 > 0
        errors = _rpe(P, Q, _FIRST, _SECOND, mask)
        P, Q = _matrices(P), _matrices(Q)
        motion = lambda T: np.linalg.inv(T[_FIRST]) @ T[_SECOND]
        E = np.linalg.inv(motion(Q)) @ motion(P)
        angles = Rotation.from_matrix(E[:, :3, :3]).magnitude()
        lengths = np.linalg.norm(E[:, :3, 3], axis=1)
        np.testing.assert_allclose(errors.translations, np.where(mask, lengths, 0), atol=1e-12)
        np.testing.assert_allclose(errors.rotations, np.where(mask, angles, 0), atol=1e-12)
        np.testing.assert_allclose(errors.rotation.median, np.median(angles[mask]), rtol=1e-12)
        np.testing.assert_allclose(errors.translation.rmse, np.sqrt((lengths[mask] ** 2).mean()), rtol=1e-12)
        assert errors.num_pairs == int(mask.sum())

    @pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, np.pi - 1e-7, np.pi - 1e-12, np.pi])
    def test_angle_is_accurate_at_both_ends(self, x64, angle):
        P, Q = np.tile(IDENTITY, (N, 1)), np.tile(IDENTITY, (N, 1))
        P[5:, :4] = np.array([np.cos(angle / 2), 0, 0.6 * np.sin(angle / 2), 0.8 * np.sin(angle / 2)])
        errors = _rpe(P, Q, *_PAIRS)
        np.testing.assert_allclose(errors.rotations[3], angle, rtol=1e-12, atol=1e-15)
        assert _finite(_rpe_gradient(P, Q, *_PAIRS))

    @pytest.mark.parametrize("noise", [1.0, 1e-6], ids=["far", "nearly equal"])
    def test_gradient(self, x64, noise):
        Q = _poses(1)
        P = jnp.asarray(Q + noise * (_poses(2) - Q))
        check_grads(_rpe_outputs, (P, Q), order=1, modes=("fwd", "rev"), eps=1e-6 * noise, rtol=1e-4, atol=1e-4)

    def test_vmap_equals_loop(self, x64):
        P, Q = np.stack([_poses(s) for s in range(3)]), np.stack([_poses(s) for s in range(3, 6)])
        batched = quick_compile_nested(jax.vmap(lambda P, Q: rpe(SE3(P), SE3(Q), *(jnp.asarray(a) for a in _PAIRS))))(
            P, Q
        )
        for k in range(3):
            single = _rpe(P[k], Q[k], *_PAIRS)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a[k], b, atol=1e-12), batched, single)  # noqa: B023

    def test_single_trace(self):
        compute = quick_compile_nested(eqx.debug.assert_max_traces(_rpe_loss, max_traces=1))
        for seed in range(3):
            compute(_poses(seed).astype(np.float32), _poses(seed + 1).astype(np.float32), *_PAIRS)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize(
        ("case", "pairs"), [("NaN", 0), ("some NaN", 7), ("masked", 0), ("zero motion", 10), ("no quaternion", 8)]
    )
    def test_degenerate(self, case, pairs, dtype):
        P, Q, mask = _poses(0), _poses(1), np.ones(N - 2, bool)
        match case:
            case "NaN":
                P[:] = np.nan
            case "some NaN":
                P[0], Q[4, 6] = np.nan, np.inf
            case "masked":
                mask[:] = False
            case "zero motion":
                P[:], Q[:] = P[0], Q[0]
            case "no quaternion":
                P[5, :4] = 0
        P, Q = P.astype(dtype), Q.astype(dtype)
        with jax.enable_x64(dtype == np.float64):
            errors, gradient = _rpe(P, Q, _FIRST, _SECOND, mask), _rpe_gradient(P, Q, _FIRST, _SECOND, mask)
        assert errors.num_pairs == pairs
        assert _finite(errors)
        assert _finite(gradient)

    def test_pairs_out_of_range_do_not_count(self, x64):
        first, second = _FIRST.copy(), _SECOND.copy()
        first[0], second[1] = -1, N
        assert _rpe(_poses(0), _poses(1), first, second, _PAIRS[2]).num_pairs == N - 4

    @given(st.integers(0, 2**31))
    @settings(max_examples=20, deadline=None)
    def test_ignores_the_world_frames_and_the_length_of_quaternions(self, seed):
        P, Q = _poses(seed), _poses(seed + 1)
        T = _matrices(_poses(seed + 2, 1))[0]
        moved = T @ _matrices(P)
        wxyz = Rotation.from_matrix(moved[:, :3, :3]).as_quat(scalar_first=True)
        lengths = np.random.default_rng(seed).uniform(0.5, 2, (N, 1)) * np.where(np.arange(N) % 2, 1, -1)[:, None]
        moved = np.hstack([wxyz * lengths, moved[:, :3, 3]])
        with jax.enable_x64(True):
            before, after = _rpe(P, Q, *_PAIRS), _rpe(moved, Q, *_PAIRS)
        np.testing.assert_allclose(after.translations, before.translations, atol=1e-10)
        np.testing.assert_allclose(after.rotations, before.rotations, atol=1e-7)

    @pytest.mark.slow
    def test_far_from_the_origin_in_float32(self):
        """Positions are subtracted before they are rotated."""
        P, Q = _poses(0), _poses(1)
        P[:, 4:] = np.round(P[:, 4:] * 64) / 64
        near = _rpe(P.astype(np.float32), Q.astype(np.float32), *_PAIRS)
        P[:, 4:] += 2.0**16
        far = _rpe(P.astype(np.float32), Q.astype(np.float32), *_PAIRS)
        np.testing.assert_allclose(far.translations, near.translations, atol=1e-6)
