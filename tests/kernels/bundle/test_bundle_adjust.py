"""Bundle adjustment against SciPy, and its derivatives against finite differences."""

from functools import partial
from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.bundle.bundle_adjust import BundleAdjustment, BundleStatus, bundle_adjust
from jaxslam_kernels.bundle.cost import Observations, observe
from jaxslam_kernels.camera import make_intrinsics
from jaxslam_kernels.pose.pose_cost import UNKNOWN_CHI2
from jaxslam_kernels.robust import Loss
from linearized import differentiate
from quick_compile import quick_compile
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.single_view import pose_error, to_wxyz_xyz

K, N = 4, 25
SPARE = 5  # slots without an observation
FOCAL, CENTER = 500.0, np.array([[320.0], [240.0]])
SIGMA_PX, SIGMA_DEPTH = 1.3, 0.03


class Inputs(NamedTuple):
    """Everything the optimum can be differentiated by, with the start in place of what is not fixed."""

    poses: Any
    X_world: Any
    uv: Any
    depth: Any
    weights: Any
    point_weights: Any
    scale: Any


class Links(NamedTuple):
    """Who sees whom, and what is fixed: constants."""

    camera: Any
    point: Any
    valid: Any
    fixed_poses: Any
    fixed_points: Any


class Window(NamedTuple):
    """A made-up window; `truth` is `(K, 7)`."""

    truth: np.ndarray
    inputs: Inputs
    links: Links


def make_window(seed: int, *, noise: float = 1.0, outliers: float = 0.1, baseline: float = 0.3) -> Window:
    """Cameras side by side before a cloud of points, most of which each of them sees. All float64."""
    rng = np.random.default_rng(seed)
    X_world = rng.uniform([[-1.5], [-1.0], [2.0]], [[1.5], [1.0], [4.0]], (3, N))
    rotations = [Rotation.from_rotvec(0.1 * rng.normal(size=3)) for _ in range(K)]
    positions = [np.array([baseline * i, 0, 0]) + 0.2 * baseline * rng.normal(size=3) for i in range(K)]
    camera, point = np.nonzero((np.arange(K)[:, None] + np.arange(N)) % K != rng.integers(0, K, N))
    X_cam = np.stack([_into(rotations[i], positions[i], X_world[:, j]) for i, j in zip(camera, point, strict=True)], 1)
    uv = FOCAL * X_cam[:2] / X_cam[2] + CENTER + noise * SIGMA_PX * rng.normal(size=(2, camera.size))
    uv[:, rng.random(camera.size) < outliers] += 30.0
    depth = X_cam[2] + noise * SIGMA_DEPTH * rng.normal(size=camera.size)
    depth[::7] = 0.0
    starts = [r * Rotation.from_rotvec(0.02 * rng.normal(size=3)) for r in rotations]
    truth = np.stack([to_wxyz_xyz(r, t) for r, t in zip(rotations, positions, strict=True)])
    start = np.stack([to_wxyz_xyz(r, t + 0.02 * rng.normal(size=3)) for r, t in zip(starts, positions, strict=True)])
    start[0] = truth[0]
    spare = lambda values, fill: np.concatenate([values, np.full((*values.shape[:-1], SPARE), fill)], axis=-1)
    inputs = Inputs(
        poses=start,
        X_world=X_world + 0.03 * rng.normal(size=X_world.shape),
        uv=spare(uv, np.nan),
        depth=spare(depth, np.nan),
        weights=spare(rng.uniform(0.3, 1.0, camera.size), np.nan),
        point_weights=rng.uniform(0.5, 1.0, N),
        scale=np.array(2.0),
    )
    links = Links(
        camera=spare(camera, -1).astype(np.int32),
        point=spare(point, N + 7).astype(np.int32),
        valid=spare(np.ones(camera.size, bool), False),
        fixed_poses=np.arange(K) == 0,
        fixed_points=np.arange(N) < 2,
    )
    return Window(truth, inputs, links)


def _into(rotation: Rotation, position: np.ndarray, X: np.ndarray) -> np.ndarray:
    return rotation.inv().apply(X - position)


def _observations(inputs: Inputs, links: Links) -> Observations:
    return observe(
        links.camera,
        links.point,
        inputs.uv,
        make_intrinsics(FOCAL, FOCAL, *CENTER[:, 0], dtype=inputs.uv.dtype),
        depth=inputs.depth,
        sigma_px=SIGMA_PX,
        sigma_depth=SIGMA_DEPTH,
        weights=inputs.weights,
        valid=links.valid,
    )


def _adjust(inputs: Inputs, links: Links, loss: Loss = "cauchy", **options) -> BundleAdjustment:
    return bundle_adjust(
        inputs.poses,
        inputs.X_world,
        _observations(inputs, links),
        fixed_poses=links.fixed_poses,
        fixed_points=links.fixed_points,
        point_weights=inputs.point_weights,
        loss=loss,
        scale=inputs.scale,
        **{"tolerance": 0.0, "max_steps": 400, **options},
    )


def _summary(result: BundleAdjustment) -> jax.Array:
    """One number that every output has a part in."""
    rng, dtype = np.random.default_rng(9), result.cost.dtype
    probe = lambda like: jnp.asarray(rng.normal(size=like.shape), dtype)
    return (
        jnp.sum(probe(result.poses) * result.poses)
        + jnp.sum(probe(result.X_world) * result.X_world)
        + 1e-2 * (result.cost + 1e-2 * result.initial_cost + jnp.sum(result.robust_weights))
        + 1e-3 * jnp.sum(jnp.minimum(result.chi2, 9.0))
    )


def _differentiate(inputs: Inputs, links: Links, direction: Inputs):
    """The result, the gradient of its summary, and the change of the summary along a direction."""

    def f(inputs):
        result = _adjust(inputs, links)
        return _summary(result), result

    return differentiate(f, inputs, direction)


# Compiled once for float32 and once for float64, whatever changes from call to call.
_differentiated = quick_compile(eqx.debug.assert_max_traces(_differentiate, max_traces=2))


def _arrays(tree: Any, dtype=None) -> Any:
    """For JAX, numbers in its default precision."""
    number = jnp.zeros(()).dtype if dtype is None else dtype
    return jax.tree.map(lambda x: jnp.asarray(x, number if np.asarray(x).dtype.kind == "f" else None), tree)


def _run(inputs: Inputs, links: Links, direction: Inputs | None = None):
    """The result, a gradient and a directional derivative, as NumPy arrays."""
    direction = jax.tree.map(np.zeros_like, inputs) if direction is None else direction
    return jax.tree.map(np.asarray, _differentiated(_arrays(inputs), _arrays(links), _arrays(direction)))


def _summary_of(inputs: Inputs, links: Links) -> float:
    return float(_summary(_run(inputs, links)[0]))


def _all_finite(*trees) -> bool:
    return all(np.isfinite(x).all() for x in jax.tree.leaves(trees))


def _scipy_optimum(window: Window, loss: Loss) -> tuple[np.ndarray, np.ndarray, float]:
    """Poses, points and cost from `least_squares` on whitened residuals scaled to give the robust cost."""
    inputs, links = window.inputs, window.links
    valid, c2 = links.valid, float(inputs.scale) ** 2
    camera, point = links.camera[valid], links.point[valid]
    uv, depth = inputs.uv[:, valid], inputs.depth[valid]
    weights = inputs.weights[valid] * inputs.point_weights[point]
    free_pose, free_point = ~links.fixed_poses, ~links.fixed_points
    rho = {
        "squared": lambda s: s,
        "huber": lambda s: np.where(s <= c2, s, 2.0 * np.sqrt(c2 * s) - c2),
        "cauchy": lambda s: c2 * np.log1p(s / c2),
        "geman_mcclure": lambda s: s / (1.0 + s / c2),
    }[loss]
    start = Rotation.from_quat(np.roll(inputs.poses[:, :4], -1, axis=1))

    def unpack(x):
        tangents, shifts = np.zeros((K, 6)), np.zeros((3, N))
        split = 6 * free_pose.sum()
        tangents[free_pose], shifts[:, free_point] = x[:split].reshape(-1, 6), x[split:].reshape(3, -1)
        turned = start * Rotation.from_rotvec(tangents[:, 3:])
        return turned, inputs.poses[:, 4:] + tangents[:, :3], inputs.X_world + shifts

    def residuals(x):
        rotations, positions, X_world = unpack(x)
        X, Y, Z = rotations[camera].inv().apply(X_world[:, point].T - positions[camera]).T
        pixel = (FOCAL * np.stack([X / Z, Y / Z]) + CENTER - uv) / SIGMA_PX
        r = np.stack([*pixel, np.where(depth > 0, (Z - depth) / SIGMA_DEPTH, 0.0)])
        s = (r**2).sum(0)
        return (r * np.sqrt(weights * rho(s) / s)).ravel()

    count = 6 * int(free_pose.sum()) + 3 * int(free_point.sum())
    fit = least_squares(residuals, np.zeros(count), method="lm", jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    rotations, positions, X_world = unpack(fit.x)
    poses = np.stack([to_wxyz_xyz(r, t) for r, t in zip(rotations, positions, strict=True)])
    return poses, X_world, float(fit.cost)


def _pose_errors(poses, others) -> float:
    """The largest difference in meters or radians."""
    return max(max(pose_error(a, b)) for a, b in zip(poses, others, strict=True))


LOSSES = [loss if loss == "cauchy" else pytest.param(loss, marks=pytest.mark.slow) for loss in get_args(Loss)]
"""SciPy takes a minute with `geman_mcclure`."""


@pytest.fixture(params=[True, pytest.param(False, marks=pytest.mark.slow)], ids=["double", "single"])
def precision(request):
    """Each is a program of 14 s to compile; most tests need the double one."""
    with jax.enable_x64(request.param):
        yield


class TestReference:
    @pytest.mark.parametrize("loss", LOSSES)
    def test_matches_reference(self, loss):
        window = make_window(1)
        if loss == "geman_mcclure":  # has many minima: from where a convex enough one ends, as it is used
            poses, X_world, _ = _scipy_optimum(window, "cauchy")
            start = window.inputs._replace(poses=poses, X_world=X_world, scale=np.array(4.0))
            window = window._replace(inputs=start)
        with jax.enable_x64(True):
            adjust = quick_compile(partial(_adjust, loss=loss))
            result = jax.tree.map(np.asarray, adjust(_arrays(window.inputs), _arrays(window.links)))
        poses, X_world, cost = _scipy_optimum(window, loss)
        assert BundleStatus(int(result.status)) == BundleStatus.OK
        assert _pose_errors(result.poses, poses) < 1e-6
        np.testing.assert_allclose(result.X_world, X_world, atol=1e-5)
        assert result.cost == pytest.approx(cost, rel=1e-9)
        assert result.cost < (1.0 if loss == "geman_mcclure" else 0.5) * result.initial_cost

    @pytest.mark.slow
    def test_truth_without_noise(self):
        window = make_window(2, noise=0.0, outliers=0.0)
        with jax.enable_x64(True):
            inputs = window.inputs._replace(X_world=window.inputs.X_world.copy())
            links = window.links._replace(fixed_points=np.zeros(N, bool))
            result, *_ = _run(inputs, links)
        assert result.status == BundleStatus.OK
        assert _pose_errors(result.poses, window.truth) < 1e-9
        assert result.cost < 1e-15
        assert result.chi2[window.links.valid].max() < 1e-12

    @pytest.mark.slow
    @pytest.mark.parametrize("outliers", [0.0, 0.1])
    @pytest.mark.parametrize("seed", range(4))
    def test_float32_is_within_a_hundredth(self, seed, outliers):
        """Of the cost. With outliers its valley can be so flat that the poses differ, and that no number of steps
        takes float64 to its end.
        """
        window = make_window(seed, outliers=outliers)
        single, gradient, _ = _run(window.inputs, window.links)
        with jax.enable_x64(True):
            double, *_ = _run(window.inputs, window.links)
        assert single.status == BundleStatus.OK
        assert outliers or double.status == BundleStatus.OK
        assert float(single.cost) == pytest.approx(float(double.cost), rel=0.01)
        assert outliers or _pose_errors(single.poses, double.poses) < 1e-3
        assert _all_finite(single, gradient)

    @pytest.mark.usefixtures("precision")
    def test_fixed_stays(self):
        window = make_window(3)
        result, *_ = _run(window.inputs, window.links)
        np.testing.assert_allclose(result.poses[0], window.inputs.poses[0], atol=1e-6)
        np.testing.assert_allclose(result.X_world[:, :2], window.inputs.X_world[:, :2], atol=1e-6)
        assert np.abs(result.X_world[:, 2:] - window.inputs.X_world[:, 2:]).min() > 0

    def test_poses_after_the_movable_ones_stay(self):
        """`num_movable` is less work for the same optimum as with these poses fixed."""
        window, movable = make_window(8), K - 1
        fixed = window.links._replace(fixed_poses=window.links.fixed_poses | (np.arange(K) >= movable))
        with jax.enable_x64(True):
            usual, *_ = _run(window.inputs, fixed)
            adjust = quick_compile(partial(_adjust, num_movable=movable))
            result = adjust(_arrays(window.inputs), _arrays(window.links))
        assert result.status == usual.status == BundleStatus.OK
        np.testing.assert_allclose(result.poses[movable:], window.inputs.poses[movable:], atol=1e-12)
        np.testing.assert_allclose(result.poses, usual.poses, atol=1e-9)
        np.testing.assert_allclose(result.X_world, usual.X_world, atol=1e-9)

    @pytest.mark.usefixtures("precision")
    def test_point_seen_twice_counts_once(self):
        """The last observation with weight has the slot, whatever others say."""
        window = make_window(4)
        inputs, links = window.inputs, window.links
        alone, *_ = _run(inputs, links)
        first = int(np.argmax(links.valid))
        extra = np.flatnonzero(~links.valid)[0]
        camera, point, valid = links.camera.copy(), links.point.copy(), links.valid.copy()
        camera[extra], point[extra], valid[extra] = camera[first], point[first], True
        twice = links._replace(camera=camera, point=point, valid=valid)
        uv, depth, weights = inputs.uv.copy(), inputs.depth.copy(), inputs.weights.copy()
        uv[:, extra], depth[extra], weights[extra] = 1.0, 0.0, 0.0
        ignored, *_ = _run(inputs._replace(uv=uv, depth=depth, weights=weights), twice)
        np.testing.assert_allclose(ignored.poses, alone.poses, atol=1e-6)
        assert ignored.used[first]
        assert not ignored.used[extra]
        weights[extra] = 1.0
        taken, *_ = _run(inputs._replace(uv=uv, depth=depth, weights=weights), twice)
        assert taken.used[extra]
        assert not taken.used[first]
        assert taken.chi2[first] == UNKNOWN_CHI2


@pytest.mark.parametrize("x64", [False, True])
def test_shapes(x64):
    """The type follows the input, also where float64 is enabled."""
    window = make_window(0)
    with jax.enable_x64(x64):
        inputs, links = _arrays((window.inputs, window.links), jnp.float32)
        result = jax.eval_shape(_adjust, inputs, links)
    m = window.links.valid.size
    assert result.poses.shape == (K, 7)
    assert result.X_world.shape == (3, N)
    assert result.determined.shape == (N,)
    assert result.used.shape == result.chi2.shape == result.robust_weights.shape == (m,)
    assert all(x.shape == () for x in (result.cost, result.initial_cost, result.status, result.num_steps))
    assert {str(x.dtype) for x in jax.tree.leaves(result)} == {"float32", "int32", "bool"}


def _direction(window: Window, seed: int) -> Inputs:
    """A random direction in which every measurement, weight and fixed value moves; the rest of the start does not."""
    rng = np.random.default_rng(seed)
    moved = jax.tree.map(lambda x: rng.normal(size=x.shape), window.inputs)
    links, inputs = window.links, window.inputs
    return moved._replace(
        poses=np.where(links.fixed_poses[:, None], 0.1 * moved.poses, 0.0) * [0, 0, 0, 0, 1, 1, 1],
        X_world=np.where(links.fixed_points, 0.1 * moved.X_world, 0.0),
        uv=np.where(links.valid, 10.0 * moved.uv, 0.0),
        depth=np.where(inputs.depth > 0, 0.1 * moved.depth, 0.0),
        weights=np.where(links.valid, moved.weights, 0.0),
    )


class TestGradient:
    @pytest.mark.parametrize("case", ["general", "little parallax"])
    def test_gradient(self, case):
        """Forward = reverse = finite differences, for every input and through every output."""
        window = make_window(5)
        if case == "little parallax":
            window = make_window(5, noise=0.2, outliers=0.0, baseline=0.03)
            sparse = np.where(np.arange(window.inputs.depth.size) % 3 == 0, window.inputs.depth, 0.0)
            window = window._replace(inputs=window.inputs._replace(depth=sparse))
        direction, h = _direction(window, 6), 1e-6
        with jax.enable_x64(True):
            result, gradient, forward = _run(window.inputs, window.links, direction)
            reverse = sum(np.sum(g * t) for g, t in zip(gradient, direction, strict=True))
            moved = (jax.tree.map(lambda x, t, s=s: x + s * h * t, window.inputs, direction) for s in (1, -1))
            after, before = (_summary_of(inputs, window.links) for inputs in moved)
        assert result.status == BundleStatus.OK
        np.testing.assert_allclose(forward, (after - before) / (2 * h), rtol=1e-4)
        np.testing.assert_allclose(reverse, forward, rtol=1e-8)

    @pytest.mark.parametrize("name", ["uv", "depth", "weights", "point_weights", "scale"])
    def test_gradient_by_each(self, name):
        window = make_window(7)
        direction, h = _direction(window, 8), 1e-5
        still = jax.tree.map(np.zeros_like, direction)._replace(**{name: getattr(direction, name)})
        with jax.enable_x64(True):
            _, _, forward = _run(window.inputs, window.links, still)
            moved = (jax.tree.map(lambda x, t, s=s: x + s * h * t, window.inputs, still) for s in (1, -1))
            after, before = (_summary_of(inputs, window.links) for inputs in moved)
        np.testing.assert_allclose(forward, (after - before) / (2 * h), rtol=1e-4)

    def test_gradient_of_a_zero_weight(self):
        """Says what letting the observation back in would do."""
        window = make_window(7)
        weights, h = window.inputs.weights.copy(), 1e-6
        weights[3] = 0.0
        step = np.zeros_like(weights)
        step[3] = 1.0
        still = jax.tree.map(np.zeros_like, window.inputs)._replace(weights=step)
        with jax.enable_x64(True):
            inputs = window.inputs._replace(weights=weights)
            _, gradient, forward = _run(inputs, window.links, still)
            before, after, twice = (
                _summary_of(inputs._replace(weights=weights + s * h * step), window.links) for s in (0, 1, 2)
            )
        one_sided = (4 * after - 3 * before - twice) / (2 * h)
        np.testing.assert_allclose(forward, one_sided, rtol=1e-4)
        np.testing.assert_allclose(gradient.weights[3], forward, rtol=1e-6)


def test_vmap_equals_loop():
    windows = [make_window(seed) for seed in (10, 11, 12)]
    batch = jax.tree.map(lambda *x: np.stack(x), *windows)
    counts = {w.links.valid.size for w in windows}
    assert len(counts) == 1
    with jax.enable_x64(True):
        batched = quick_compile(jax.vmap(_adjust))(_arrays(batch.inputs), _arrays(batch.links))
        for k, window in enumerate(windows):
            looped, *_ = _run(window.inputs, window.links)
            assert _pose_errors(batched.poses[k], looped.poses) < 1e-8
            np.testing.assert_allclose(batched.X_world[k], looped.X_world, atol=1e-7)
            np.testing.assert_allclose(batched.chi2[k], looped.chi2, rtol=1e-4, atol=1e-6)
            assert batched.status[k] == looped.status


@pytest.mark.usefixtures("precision")
def test_single_trace():
    """Nothing that may change from window to window compiles again: who sees whom, what is fixed, all values."""
    for seed in range(3):
        window = make_window(seed)
        links = window.links._replace(fixed_poses=np.arange(K) <= seed, fixed_points=np.arange(N) < 4 * seed)
        _run(window.inputs._replace(scale=np.array(1.0 + seed)), links)


def _degenerate(change: str) -> tuple[Inputs, Links]:
    """A window with one thing wrong with it."""
    window = make_window(20)
    inputs, links = window.inputs, window.links
    first = links.camera == 0
    filled = np.full_like
    changes = {
        "no observations": (inputs, links._replace(valid=np.zeros_like(links.valid))),
        "indices out of range": (inputs, links._replace(point=filled(links.point, -1))),
        "all masked": (inputs._replace(weights=filled(inputs.weights, 0.0)), links),
        "points masked": (inputs._replace(point_weights=filled(inputs.point_weights, 0.0)), links),
        "all fixed": (inputs, links._replace(fixed_poses=np.ones(K, bool), fixed_points=np.ones(N, bool))),
        "pixels NaN": (inputs._replace(uv=filled(inputs.uv, np.nan)), links),
        "points NaN": (inputs._replace(X_world=filled(inputs.X_world, np.nan)), links),
        "poses NaN": (inputs._replace(poses=filled(inputs.poses, np.nan)), links),
        "weights NaN": (inputs._replace(weights=filled(inputs.weights, np.nan)), links),
        "scale NaN": (inputs._replace(scale=np.array(np.nan)), links),
        "behind the cameras": (inputs._replace(X_world=inputs.X_world - [[0.0], [0.0], [20.0]]), links),
        "nothing fixed": (inputs, links._replace(fixed_poses=np.zeros(K, bool), fixed_points=np.zeros(N, bool))),
        "no scale": (
            inputs._replace(depth=filled(inputs.depth, 0.0)),
            links._replace(fixed_points=np.zeros(N, bool)),
        ),
        "one view without depth": (
            inputs._replace(depth=filled(inputs.depth, 0.0)),
            links._replace(valid=links.valid & first, fixed_points=np.zeros(N, bool)),
        ),
        "points in one place": (
            inputs._replace(X_world=np.ones_like(inputs.X_world) * [[0.0], [0.0], [3.0]], uv=filled(inputs.uv, 320.0)),
            links._replace(fixed_points=np.ones(N, bool)),
        ),
        "some NaN": (
            inputs._replace(
                X_world=np.where(np.arange(N) == 5, np.nan, inputs.X_world),
                uv=np.where(np.arange(first.size) == 7, np.inf, inputs.uv),
                depth=np.where(np.arange(first.size) == 8, np.nan, inputs.depth),
                weights=np.where(np.arange(first.size) == 9, np.nan, inputs.weights),
            ),
            links,
        ),
    }
    return changes[change]


@pytest.mark.usefixtures("precision")
class TestDegenerate:
    @pytest.mark.parametrize(
        "change",
        [
            "no observations",
            "indices out of range",
            "all masked",
            "points masked",
            "all fixed",
            "pixels NaN",
            "points NaN",
            "poses NaN",
            "weights NaN",
            "scale NaN",
            "behind the cameras",
        ],
    )
    def test_degenerate(self, change):
        """Nothing moves, and everything is finite, derivatives too."""
        inputs, links = _degenerate(change)
        result, gradient, _ = _run(inputs, links)
        assert BundleStatus(int(result.status)) == BundleStatus.NOTHING_TO_ADJUST
        assert _all_finite(result, gradient)
        expected = np.where(np.isfinite(inputs.poses), inputs.poses, np.eye(7)[0])
        np.testing.assert_allclose(result.poses, expected, atol=1e-6)
        np.testing.assert_allclose(result.X_world, np.nan_to_num(inputs.X_world), atol=1e-6)

    @pytest.mark.parametrize("change", ["nothing fixed", "no scale", "points in one place"])
    def test_degenerate_freedom(self, change):
        """What may move as a whole is said to; the cost falls all the same."""
        inputs, links = _degenerate(change)
        result, gradient, _ = _run(inputs, links)
        assert BundleStatus(int(result.status)) == BundleStatus.DEGENERATE
        assert _all_finite(result, gradient)
        assert result.cost < result.initial_cost

    def test_degenerate_one_view(self):
        """Along the ray a point is free: it says so, and the fixed camera that sees it has no part in that."""
        inputs, links = _degenerate("one view without depth")
        result, gradient, _ = _run(inputs, links)
        assert BundleStatus(int(result.status)) == BundleStatus.OK
        assert not result.determined.any()
        assert _all_finite(result, gradient)
        assert result.cost < 1e-3 * result.initial_cost
        np.testing.assert_allclose(result.poses, inputs.poses, atol=1e-6)

    def test_degenerate_in_part(self):
        """What is not finite does not count, and the rest goes on."""
        inputs, links = _degenerate("some NaN")
        result, gradient, _ = _run(inputs, links)
        assert BundleStatus(int(result.status)) == BundleStatus.OK
        assert _all_finite(result, gradient)
        lost = (links.point == 5) | np.isin(np.arange(links.valid.size), [7, 9])
        np.testing.assert_array_equal(result.used, links.valid & ~lost)
        assert _pose_errors(result.poses, make_window(20).truth) < 0.03

    def test_degenerate_zero_motion(self):
        """Perfect observations from the true poses: nothing moves."""
        window = make_window(21, noise=0.0, outliers=0.0)
        links = window.links._replace(fixed_points=np.zeros(N, bool))
        with jax.enable_x64(True):
            first, *_ = _run(window.inputs, links)
        inputs = window.inputs._replace(poses=np.asarray(first.poses), X_world=np.asarray(first.X_world))
        result, gradient, _ = _run(inputs, links)
        assert result.status == BundleStatus.OK
        assert _pose_errors(result.poses, window.truth) < 1e-5
        assert _all_finite(result, gradient)

    def test_steps_run_out(self):
        window = make_window(22)
        result = quick_compile(partial(_adjust, max_steps=1))(_arrays(window.inputs), _arrays(window.links))
        assert BundleStatus(int(result.status)) == BundleStatus.NOT_CONVERGED
        assert result.num_steps == 1
        assert result.cost < result.initial_cost


any_seed = given(seed=st.integers(0, 2**32 - 1))
few_examples = settings(max_examples=6, deadline=None, derandomize=True)


class TestInvariance:
    """One window, changed in a way that must not change the answer."""

    @few_examples
    @any_seed
    def test_rigid_motion(self, seed):
        """The world moved: everything moves with it."""
        rng = np.random.default_rng(seed)
        turn, shift = Rotation.from_quat(rng.normal(size=4)), rng.normal(size=3)
        window = make_window(seed % 1000)

        def moved(poses):
            turned = [turn * Rotation.from_quat(np.roll(p[:4], -1)) for p in poses]
            return np.stack([to_wxyz_xyz(r, turn.apply(p[4:]) + shift) for r, p in zip(turned, poses, strict=True)])

        into = lambda X: turn.apply(X.T).T + shift[:, None]
        inputs = window.inputs
        with jax.enable_x64(True):
            before, *_ = _run(inputs, window.links)
            changed = inputs._replace(poses=moved(inputs.poses), X_world=into(inputs.X_world))
            after, *_ = _run(changed, window.links)
        assert after.status == before.status == BundleStatus.OK
        assert _pose_errors(after.poses, moved(np.array(before.poses))) < 1e-6
        np.testing.assert_allclose(after.X_world, into(np.array(before.X_world)), atol=1e-5)
        np.testing.assert_allclose(after.cost, before.cost, rtol=1e-10)

    @few_examples
    @any_seed
    def test_observation_order(self, seed):
        window = make_window(seed % 1000)
        order = np.random.default_rng(seed).permutation(window.links.valid.size)
        inputs, links = window.inputs, window.links
        shuffled = {name: getattr(inputs, name)[..., order] for name in ("uv", "depth", "weights")}
        relinked = {name: getattr(links, name)[order] for name in ("camera", "point", "valid")}
        with jax.enable_x64(True):
            before, *_ = _run(inputs, links)
            after, *_ = _run(inputs._replace(**shuffled), links._replace(**relinked))
        np.testing.assert_array_equal(after.poses, before.poses)
        np.testing.assert_array_equal(after.X_world, before.X_world)
        np.testing.assert_array_equal(after.chi2, before.chi2[order])

    @few_examples
    @any_seed
    def test_observations_of_zero_weight(self, seed):
        """Outliers without weight may say what they like."""
        rng = np.random.default_rng(seed)
        window = make_window(seed % 1000)
        silent = rng.random(window.links.valid.size) < 0.15
        weights = np.where(silent, 0.0, window.inputs.weights)
        inputs = window.inputs._replace(weights=weights)
        wrong = rng.normal(scale=100.0, size=inputs.uv.shape)
        changed = inputs._replace(uv=np.where(silent, wrong, inputs.uv), depth=np.where(silent, 9.0, inputs.depth))
        with jax.enable_x64(True):
            before, *_ = _run(inputs, window.links)
            after, *_ = _run(changed, window.links)
        np.testing.assert_allclose(after.poses, before.poses, atol=1e-10)
        np.testing.assert_allclose(after.X_world, before.X_world, atol=1e-10)
        np.testing.assert_allclose(after.cost, before.cost, rtol=1e-12)
        assert not after.used[silent].any()
