"""Epipolar distances, seven points and robust fundamental matrices against OpenCV and known poses."""

from typing import Any, NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics, project
from jaxslam_kernels.se3 import retract, to_camera, to_world
from jaxslam_kernels.two_view.epipolar import (
    epipolar_distances,
    fundamental_of_poses,
    sampson_distances,
    sampson_squared,
    seven_point,
)
from jaxslam_kernels.two_view.fundamental import (
    FundamentalResult,
    FundamentalStatus,
    _agree,
    _in_pixels,
    _of_clean_points,
    _two_views,
    ransac_fundamental,
)
from jaxslam_kernels.two_view.fundamental_refine import FramedMatrix, _equations, _framed, _retract
from linearized import differentiate
from quick_compile import quick_compile

from jaxslam.benchmark.kernels.scenes.two_views import KINDS, TwoViewScene, make_two_views

N = 150
seeded = given(seed=st.integers(0, 2**32 - 1))
few_examples = settings(max_examples=6, deadline=None, derandomize=True)

_seven, _distances, _sampson = map(quick_compile, (seven_point, epipolar_distances, sampson_distances))


def _homogeneous(uv: np.ndarray) -> np.ndarray:
    return np.concatenate([uv, np.ones((1, uv.shape[1]))])


def _to_line(F: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Distances of the second points to the epipolar lines of the first."""
    lines = F @ _homogeneous(before)
    return np.abs((_homogeneous(after) * lines).sum(axis=0)) / np.linalg.norm(lines[:2], axis=0)


def _apart(F: np.ndarray, G: np.ndarray) -> float:
    """How far two matrices are apart, whatever their scales and signs."""
    F, G = F / np.linalg.norm(F), G / np.linalg.norm(G)
    return float(min(np.abs(F - G).max(), np.abs(F + G).max()))


class TestDistances:
    def test_matches_reference(self):
        scene = make_two_views(0, N)
        before, after = scene.uv_before, scene.uv_after
        with jax.enable_x64(True):
            ours = _distances(*map(jnp.asarray, (scene.F, before, after)))
            sampson = np.asarray(_sampson(*map(jnp.asarray, (scene.F, before, after))))
            many = sampson_squared(jnp.asarray(scene.F)[:, :, None], jnp.asarray(before), jnp.asarray(after))
        theirs = [
            cv2.sampsonDistance(p[:, None].copy(), q[:, None].copy(), scene.F)
            for p, q in zip(_homogeneous(before).T, _homogeneous(after).T, strict=True)
        ]
        np.testing.assert_allclose(ours, _to_line(scene.F, before, after), rtol=1e-9)
        np.testing.assert_allclose(sampson**2, theirs, rtol=1e-9)
        np.testing.assert_allclose(np.asarray(many)[0], theirs, rtol=1e-9)

    def test_gradient(self):
        """Forward = reverse = finite differences, also close to the epipole, where lines turn quickly."""
        scene = make_two_views(1, 20)
        with jax.enable_x64(True):
            _, _, Vt = np.linalg.svd(scene.F)
            before = scene.uv_before.copy()
            before[:, 0] = Vt[2, :2] / Vt[2, 2] + 1e-2
            inputs = tuple(map(jnp.asarray, (scene.F, before, scene.uv_after)))
            rng = np.random.default_rng(0)
            direction = tuple(jnp.asarray(rng.normal(size=x.shape) * np.abs(x) * 1e-2) for x in inputs)
            for f in (epipolar_distances, sampson_distances):
                total = lambda *a, f=f: jnp.sum(jnp.sin(f(*a)))
                _, forward = jax.jvp(total, inputs, direction)
                gradient = jax.grad(total, argnums=(0, 1, 2))(*inputs)
                reverse = sum(float(jnp.vdot(g, d)) for g, d in zip(gradient, direction, strict=True))
                h = 1e-8
                after, behind = (total(*(x + s * d for x, d in zip(inputs, direction, strict=True))) for s in (h, -h))
                np.testing.assert_allclose(reverse, forward, rtol=1e-9)
                np.testing.assert_allclose((after - behind) / (2 * h), forward, rtol=1e-4)

    def test_degenerate(self):
        """No matrix, points at an epipole, points not finite: 0, with finite derivatives."""
        F = jnp.asarray([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # the epipoles are at (0, 0)
        before = jnp.asarray([[0.0, 3.0, jnp.nan, 2.0], [0.0, 4.0, 1.0, jnp.inf]])
        after = jnp.asarray([[5.0, 6.0, 1.0, 1.0], [0.0, 8.0, 1.0, 1.0]])
        for f in (epipolar_distances, sampson_distances):
            for matrix in (F, jnp.zeros((3, 3))):
                value = f(matrix, before, after)
                gradients = jax.grad(lambda *a, f=f: f(*a).sum(), argnums=(0, 1, 2))(matrix, before, after)
                np.testing.assert_array_equal(value if f is epipolar_distances else value[1:], 0.0)
                assert all(np.isfinite(x).all() for x in (value, *gradients))


def _camera() -> Intrinsics:
    return Intrinsics(*(jnp.asarray(value) for value in (517.0, 516.0, 318.6, 255.3)), distortion=jnp.zeros(5))


def _poses(seed: int) -> tuple[SE3, SE3]:
    rng = np.random.default_rng(seed)
    first = retract(SE3(jnp.asarray([1.0, 0, 0, 0, 0, 0, 0])), jnp.asarray(rng.normal(size=6)))
    return first, retract(first, jnp.asarray(0.1 * rng.normal(size=6)))


class TestOfPoses:
    def test_shapes(self):
        F = jax.eval_shape(fundamental_of_poses, SE3.identity(), SE3.identity(), _camera())
        assert F.shape == (3, 3)
        assert F.dtype == jnp.float32

    def test_matches_reference(self):
        """What both cameras see of a point is on one line, and the epipole is where one sees the other."""
        rng = np.random.default_rng(0)
        with jax.enable_x64(True):
            camera = _camera()
            for seed in range(5):
                before, after = _poses(seed)
                X_before = np.concatenate([rng.normal(size=(2, 20)), rng.uniform(3.0, 6.0, (1, 20))])
                X_world = to_world(before, jnp.asarray(X_before))
                uv = [project(camera, to_camera(pose, X_world)) for pose in (before, after)]
                F = fundamental_of_poses(before, after, camera)
                np.testing.assert_allclose(_to_line(np.asarray(F), *map(np.asarray, uv)), 0, atol=1e-8)
                epipole = to_camera(before, after.translation()[:, None])
                K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
                np.testing.assert_allclose(np.asarray(F) @ K @ np.asarray(epipole), 0, atol=1e-12)

    def test_vmap_equals_loop(self):
        with jax.enable_x64(True):
            pairs = [_poses(seed) for seed in range(3)]
            before, after = (SE3(jnp.stack([pair[k].wxyz_xyz for pair in pairs])) for k in (0, 1))
            batch = jax.vmap(fundamental_of_poses, in_axes=(0, 0, None))(before, after, _camera())
            for one, pair in zip(batch, pairs, strict=True):
                np.testing.assert_allclose(one, fundamental_of_poses(*pair, _camera()), rtol=1e-12)

    def test_gradient(self):
        """By the second pose, forward = reverse = finite differences."""
        with jax.enable_x64(True):
            before, after = _poses(1)
            weights = jnp.asarray(np.random.default_rng(2).normal(size=(3, 3)))
            f = lambda tangent: jnp.vdot(weights, fundamental_of_poses(before, retract(after, tangent), _camera()))
            zero, direction = jnp.zeros(6), jnp.asarray(np.random.default_rng(3).normal(size=6))
            _, forward = quick_compile(lambda: jax.jvp(f, (zero,), (direction,)))()
            value, h = quick_compile(f), 1e-6
            numeric = (value(h * direction) - value(-h * direction)) / (2 * h)
            np.testing.assert_allclose(forward, numeric, rtol=1e-6)
            np.testing.assert_allclose(jnp.vdot(quick_compile(jax.grad(f))(zero), direction), forward, rtol=1e-9)

    def test_degenerate(self):
        """A camera that only turns or stands has no lines."""
        with jax.enable_x64(True):
            pose, _ = _poses(4)
            turned = retract(pose, jnp.asarray([0.0, 0, 0, 0.1, -0.2, 0.05]))
            for after in (pose, turned):
                np.testing.assert_allclose(fundamental_of_poses(pose, after, _camera()), 0, atol=1e-15)


def _samples(seed: int, h: int) -> tuple[np.ndarray, np.ndarray]:
    scenes = [make_two_views(seed * 1000 + k, 7, outliers=0.0) for k in range(h)]
    return np.stack([s.uv_before for s in scenes], axis=-1), np.stack([s.uv_after for s in scenes], axis=-1)


class TestSevenPoint:
    def test_shapes(self):
        F, real = jax.eval_shape(seven_point, jnp.zeros((2, 7, 5)), jnp.zeros((2, 7, 5)))
        assert F.shape == (3, 3, 3, 5)
        assert real.shape == (3, 5)
        assert F.dtype == jnp.float32

    def test_matches_reference(self):
        """As many solutions as OpenCV finds, and the same ones."""
        before, after = (x.astype(np.float32).astype(float) for x in _samples(0, 100))  # OpenCV rounds them so
        with jax.enable_x64(True):
            F, real = map(np.asarray, _seven(jnp.asarray(before), jnp.asarray(after)))
        for h in range(100):
            theirs, _ = cv2.findFundamentalMat(before[:, :, h].T.copy(), after[:, :, h].T.copy(), cv2.FM_7POINT)
            ours = [F[:, :, k, h] for k in range(3) if real[k, h]]
            expected = theirs.reshape(-1, 3, 3)
            assert len(ours) == len(expected)
            assert all(min(_apart(f, e) for f in ours) < 1e-6 for e in expected)

    def test_matches_known_motion(self):
        """Without noise, one of the solutions is that of the poses."""
        scenes = [make_two_views(k, 7, outliers=0.0, noise_px=0.0) for k in range(50)]
        before, after = (np.stack([getattr(s, k) for s in scenes], axis=-1) for k in ("uv_before", "uv_after"))
        with jax.enable_x64(True):
            F, _ = map(np.asarray, _seven(jnp.asarray(before), jnp.asarray(after)))
        for h, scene in enumerate(scenes):
            assert min(_apart(F[:, :, k, h], scene.F) for k in range(3) if F[:, :, k, h].any()) < 1e-6

    def test_float32(self):
        """Every solution goes through its seven points, with rank two, at single precision."""
        before, after = (jnp.asarray(x, jnp.float32) for x in _samples(1, 300))
        F, real = map(np.asarray, _seven(before, after))
        assert np.isfinite(F).all()
        F, before, after = (x.astype(float) for x in (F, np.asarray(before), np.asarray(after)))
        worst = [
            _to_line(F[:, :, k, h], before[:, :, h], after[:, :, h]).max()
            for h in range(300)
            for k in range(3)
            if real[k, h]
        ]
        assert np.median(worst) < 1e-2
        assert np.mean(np.array(worst) < 0.3) > 0.98

    def test_vmap_equals_loop(self):
        with jax.enable_x64(True):
            before, after = map(jnp.asarray, _samples(2, 6))
            F, real = _seven(before, after)
            for h in range(6):
                one, one_real = _seven(before[:, :, h : h + 1], after[:, :, h : h + 1])
                np.testing.assert_allclose(one[..., 0], F[..., h], atol=1e-9)
                np.testing.assert_array_equal(one_real[..., 0], real[..., h])

    def test_degenerate(self):
        """Points in one place, the same in both views, or not finite: finite, nothing claimed of what is unknown."""
        before, after = (jnp.asarray(x, jnp.float32) for x in _samples(3, 4))
        before = before.at[:, :, 0].set(5.0).at[0, 1, 1].set(jnp.nan)
        after = after.at[:, :, 0].set(5.0).at[:, :, 2].set(before[:, :, 2])
        F, real = _seven(before, after)
        assert np.isfinite(F).all()
        assert not real[:, 1].any()
        assert real[0, 3]


class Inputs(NamedTuple):
    """Everything the refined matrix can be differentiated by."""

    uv_before: Any
    uv_after: Any
    weights: Any
    threshold_px: Any


def _inputs(scene: TwoViewScene, dtype: Any = None) -> Inputs:
    dtype = jnp.zeros(()).dtype if dtype is None else dtype
    before, after = jnp.asarray(scene.uv_before, dtype), jnp.asarray(scene.uv_after, dtype)
    return Inputs(before, after, jnp.ones(before.shape[1], dtype), jnp.asarray(1.0, dtype))


def _solve(key: jax.Array, inputs: Inputs) -> FundamentalResult:
    before, after, weights, threshold = inputs
    return ransac_fundamental(key, before, after, weights=weights, threshold_px=threshold, max_steps=60)


def _mixture(F: jax.Array) -> jax.Array:
    """A mean of distances of fixed points to the epipolar lines of others."""
    before, after = jnp.asarray([[[50.0, 300, 600], [100, 400, 200]], [[80.0, 250, 500], [300, 50, 420]]], F.dtype)
    return epipolar_distances(F, before, after).mean()


def _differentiate(key: jax.Array, inputs: Inputs, direction: Inputs):
    def f(inputs):
        result = _solve(key, inputs)
        return _mixture(result.F), result

    return differentiate(f, inputs, direction)


# Compiled once for float32 and once for float64, whatever changes from call to call.
_differentiated = quick_compile(eqx.debug.assert_max_traces(_differentiate, max_traces=2))


def _run(seed: int, inputs: Inputs, direction: Inputs | None = None):
    direction = jax.tree.map(jnp.zeros_like, inputs) if direction is None else direction
    return jax.tree.map(np.asarray, _differentiated(jax.random.key(seed), inputs, direction))


@quick_compile
def _polished(F: jax.Array, inputs: Inputs) -> jax.Array:
    """The mixture at the optimum on the inliers of a matrix, by forty Gauss-Newton steps from there.

    The solver itself ends where the cost is level to rounding, up to 1e-7 px short of the optimum: too early to
    divide a difference of two of its results by 2e-4.
    """
    views, _, shift, scale = _two_views(*inputs)
    start, _ = _of_clean_points(F, shift, scale)
    views = views._replace(weights=jnp.where(_agree(start, views), views.weights, 0.0))

    def step(F: FramedMatrix, _: None) -> tuple[FramedMatrix, None]:
        equations = _equations(F, views, "huber", 0.5)[1]
        return _retract(F, -jnp.linalg.solve(equations.hessian, equations.gradient)), None

    return _mixture(_in_pixels(lax.scan(step, _framed(start), length=40)[0].matrix(), shift, scale))


def _all_finite(tree: Any) -> bool:
    return all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


class TestRansac:
    @pytest.mark.parametrize("x64", [False, True])
    def test_shapes(self, x64):
        """The type follows the input, also where float64 is enabled."""
        with jax.enable_x64(x64):
            inputs = _inputs(make_two_views(0, 20), jnp.float32)
            result = jax.eval_shape(_solve, jax.random.key(0), inputs)
        assert result.F.shape == (3, 3)
        assert result.inliers.shape == (20,)
        assert result.inliers.dtype == jnp.bool_
        assert result.status.dtype == result.num_inliers.dtype == jnp.int32
        assert result.score.dtype == result.F.dtype == jnp.float32

    def test_matches_reference(self):
        """A third of the matches wrong: nearer to the truth than OpenCV's eight points on the same inliers."""
        ours, theirs = [], []
        for seed in range(20):
            scene = make_two_views(seed, N, outliers=0.33)
            result, *_ = _run(seed, _inputs(scene))
            good = ~scene.outlier
            agree = result.inliers
            F, _ = cv2.findFundamentalMat(scene.uv_before.T[agree], scene.uv_after.T[agree], cv2.FM_8POINT)
            ours.append(np.median(_to_line(result.F.astype(float), scene.exact_before, scene.exact_after)[good]))
            theirs.append(np.median(_to_line(F, scene.exact_before, scene.exact_after)[good]))
            assert result.status <= FundamentalStatus.NOT_CONVERGED
            assert result.inliers[good].mean() > 0.75
            assert result.inliers[~good].mean() < 0.1
            assert np.linalg.norm(result.F) == pytest.approx(1.0, abs=1e-5)
            assert np.linalg.svd(result.F.astype(float))[1][2] < 1e-6
            assert result.F.max() == np.abs(result.F).max()
        assert np.median(ours) < np.median(theirs)
        assert np.max(ours) < 1.0

    @pytest.mark.slow
    def test_matches_known_motion(self):
        """Without noise the matrix is that of the poses."""
        with jax.enable_x64(True):
            for seed in range(3):
                scene = make_two_views(seed, N, noise_px=0.0, outliers=0.3)
                result, *_ = _run(seed, _inputs(scene)._replace(threshold_px=jnp.asarray(1e-3, jnp.float64)))
                assert _apart(result.F, scene.F) < 1e-6
                assert result.inliers[~scene.outlier].all()

    @pytest.mark.slow
    def test_gradient(self):
        """The inliers are constant; forward = reverse = finite differences through the refinement."""
        scene = make_two_views(3, N, noise_px=0.3, outliers=0.3)
        rng = np.random.default_rng(5)
        with jax.enable_x64(True):
            inputs = _inputs(scene)
            direction = jax.tree.map(lambda x: jnp.asarray(0.1 * rng.normal(size=x.shape), x.dtype), inputs)
            result, gradient, forward = _run(0, inputs, direction)
            h = 1e-4
            moved = [jax.tree.map(lambda x, d, h=h: x + h * d, inputs, direction) for h in (h, -h)]
            after, before = (_run(0, i)[0] for i in moved)
            ahead, behind = (_polished(jnp.asarray(r.F), i) for r, i in zip((after, before), moved, strict=True))
            numeric = float(ahead - behind) / (2 * h)
        pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
        reverse = sum(np.sum(g * np.asarray(d)) for g, d in pairs)
        assert result.status == FundamentalStatus.OK
        np.testing.assert_array_equal(after.inliers, before.inliers)
        np.testing.assert_allclose(forward, numeric, rtol=1e-5)
        np.testing.assert_allclose(reverse, forward, rtol=1e-9)

    def test_vmap_equals_loop(self):
        scenes = [make_two_views(seed, N, outliers=0.3) for seed in (10, 11)]
        keys = jax.random.split(jax.random.key(0), 2)
        with jax.enable_x64(True):
            batch = jax.tree.map(lambda *x: jnp.stack(x), *map(_inputs, scenes))
            batched = quick_compile(jax.vmap(_solve))(keys, batch)
            for k, scene in enumerate(scenes):
                one = jax.tree.map(np.asarray, quick_compile(_solve)(keys[k], _inputs(scene)))
                np.testing.assert_allclose(batched.F[k], one.F, atol=1e-7)
                np.testing.assert_array_equal(batched.inliers[k], one.inliers)
                assert batched.status[k] == one.status

    def test_single_trace(self):
        """Nothing that may change from frame to frame compiles again: key, weights, threshold, missing points."""
        for seed in range(3):
            inputs = _inputs(make_two_views(seed, N))
            _run(
                seed, inputs._replace(threshold_px=inputs.threshold_px + seed, weights=inputs.weights * float(seed > 0))
            )

    def test_float32_is_finite(self):
        """No NaN over many scenes of every kind."""
        kinds = sorted(KINDS)
        for seed in range(60):
            scene = make_two_views(seed, N, kind=kinds[seed % len(kinds)], outliers=0.5 * (seed % 3 > 0))
            assert _all_finite(_run(seed, _inputs(scene)))

    @pytest.mark.slow
    def test_initial(self):
        """Six matches of ten wrong, and eight samples: lost without a matrix to begin with, found with the true one."""

        def solve(key: jax.Array, inputs: Inputs, initial: jax.Array) -> FundamentalResult:
            few = {"num_hypotheses": 8, "num_improved": 1, "improving_steps": 4}
            before, after, weights, threshold = inputs
            return ransac_fundamental(
                key, before, after, weights=weights, threshold_px=threshold, initial=initial, **few
            )

        compiled = quick_compile(solve)
        shares: dict[str, list[float]] = {"true": [], "zero": [], "NaN": []}
        for seed in range(10):
            scene = make_two_views(seed, N, outliers=0.6)
            true = jnp.asarray(7.0 * scene.F, jnp.float32)
            for name, initial in (("true", true), ("zero", 0 * true), ("NaN", true.at[0, 0].set(jnp.nan))):
                result = compiled(jax.random.key(seed), _inputs(scene), initial)
                assert _all_finite(result)
                shares[name].append(float(np.asarray(result.inliers)[~scene.outlier].mean()))
        assert np.min(shares["true"]) > 0.75
        assert np.median(shares["zero"]) < 0.6
        assert shares["NaN"] == shares["zero"]

    @pytest.mark.slow
    def test_wrong_initial_changes_nothing(self):
        """One matrix more to try, that few matches agree with."""
        scene, other = (make_two_views(seed, N, outliers=0.3) for seed in (3, 4))
        plain, *_ = _run(0, _inputs(scene))
        before, after, weights, threshold = _inputs(scene)
        tried = quick_compile(ransac_fundamental)(
            jax.random.key(0), before, after, weights=weights, threshold_px=threshold, initial=jnp.asarray(other.F)
        )
        np.testing.assert_array_equal(tried.inliers, plain.inliers)
        assert _apart(np.asarray(tried.F), plain.F) < 1e-4

    def test_same_key_same_bytes(self):
        inputs = _inputs(make_two_views(5, N))
        first, again = (_run(7, inputs)[0] for _ in range(2))
        assert all(a.tobytes() == b.tobytes() for a, b in zip(*map(jax.tree.leaves, (first, again)), strict=True))


DEGENERATE = {
    "all masked": (lambda i: i._replace(weights=jnp.zeros(N)), FundamentalStatus.TOO_FEW_POINTS),
    "six points": (lambda i: i._replace(weights=jnp.zeros(N).at[60:66].set(1.0)), FundamentalStatus.TOO_FEW_POINTS),
    "nine points": (lambda i: i._replace(weights=jnp.zeros(N).at[60:69].set(1.0)), FundamentalStatus.NO_CONSENSUS),
    "all NaN": (lambda i: i._replace(uv_after=jnp.full((2, N), jnp.nan)), FundamentalStatus.TOO_FEW_POINTS),
    "threshold zero": (lambda i: i._replace(threshold_px=jnp.asarray(0.0)), FundamentalStatus.TOO_FEW_POINTS),
    "threshold NaN": (lambda i: i._replace(threshold_px=jnp.asarray(jnp.nan)), FundamentalStatus.TOO_FEW_POINTS),
    "zero motion": (lambda i: i._replace(uv_after=i.uv_before), FundamentalStatus.DEGENERATE),
    "in one place": (lambda i: i._replace(uv_before=jnp.ones((2, N)), uv_after=jnp.ones((2, N))), None),
}


class TestDegenerate:
    @pytest.mark.parametrize("name", DEGENERATE)
    def test_degenerate(self, name):
        """Nothing is claimed, and everything is finite."""
        change, status = DEGENERATE[name]
        original = _inputs(make_two_views(20, N))
        inputs = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), change(original), original)
        result, gradient, _ = _run(0, inputs)
        assert result.status == (FundamentalStatus.DEGENERATE if status is None else status)
        assert _all_finite((result, gradient))
        assert result.num_inliers == result.inliers.sum()
        if result.status != FundamentalStatus.DEGENERATE:
            assert not result.F.any()
            assert not result.inliers.any()

    @pytest.mark.parametrize("outliers", [0.0, 0.3])
    @pytest.mark.parametrize("kind", sorted(KINDS))
    def test_degenerate_motion(self, kind, outliers):
        """Pure rotation, one plane and no motion are told from ordinary motion."""
        for seed in range(8):
            result, *_ = _run(seed, _inputs(make_two_views(500 + seed, N, kind=kind, outliers=outliers)))
            assert (result.status == FundamentalStatus.DEGENERATE) == (kind != "ordinary")

    def test_degenerate_in_part(self):
        """Points with something missing do not count, and the rest goes on."""
        inputs = _inputs(make_two_views(21, N, outliers=0.2))
        inputs = inputs._replace(
            uv_before=inputs.uv_before.at[1, 100].set(jnp.nan),
            uv_after=inputs.uv_after.at[0, 101].set(jnp.inf),
            weights=inputs.weights.at[102].set(jnp.nan).at[103].set(-1.0),
        )
        result, gradient, _ = _run(1, inputs)
        assert result.status <= FundamentalStatus.NOT_CONVERGED
        assert not result.inliers[100:104].any()
        assert result.inliers[30:].mean() > 0.8
        assert _all_finite((result, gradient))


@pytest.mark.slow
class TestInvariance:
    """One scene whose inliers are clear, changed in a way that must not change the answer."""

    @few_examples
    @seeded
    def test_order(self, seed):
        rng = np.random.default_rng(seed)
        order = rng.permutation(N)
        with jax.enable_x64(True):
            inputs = _inputs(make_two_views(seed % 1000, N, noise_px=0.1, outliers=0.3))
            before, *_ = _run(seed, inputs)
            after, *_ = _run(
                seed,
                inputs._replace(uv_before=inputs.uv_before[:, order], uv_after=inputs.uv_after[:, order]),
            )
        np.testing.assert_array_equal(after.inliers, before.inliers[order])
        assert _apart(after.F, before.F) < 1e-6

    @few_examples
    @seeded
    def test_points_of_zero_weight(self, seed):
        rng = np.random.default_rng(seed)
        with jax.enable_x64(True):
            inputs = _inputs(make_two_views(seed % 1000, N, outliers=0.3))
            inputs = inputs._replace(weights=inputs.weights.at[::3].set(0.0))
            changed = inputs.uv_after.at[:, ::3].add(100.0 * rng.normal(size=(2, N // 3)))
            before, *_ = _run(seed, inputs)
            after, *_ = _run(seed, inputs._replace(uv_after=changed))
        np.testing.assert_array_equal(after.inliers, before.inliers)
        np.testing.assert_array_equal(after.F, before.F)
