"""Bundle adjustment with a lens of each camera's own, against SciPy and finite differences."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.bundle.bundle_adjust import BundleAdjustment, BundleStatus, bundle_adjust
from jaxslam_kernels.bundle.cost import Observations
from jaxslam_kernels.robust import Loss
from linearized import differentiate
from quick_compile import quick_compile
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.single_view import pose_error, to_wxyz_xyz

K, N = 4, 25
M = K * N
CAMERA, POINT = np.divmod(np.arange(M), N)
FIXED_POSES, FIXED_POINTS, FIXED_LENSES = np.arange(K) == 0, np.arange(N) < 6, np.arange(K) == 3


class Inputs(NamedTuple):
    """Everything the optimum can be differentiated by, with the start in place of what is not fixed."""

    poses: Any
    X_world: Any
    lenses: Any
    uv: Any
    weights: Any


class Scene(NamedTuple):
    truth: np.ndarray
    true_lenses: np.ndarray
    inputs: Inputs


def make_scene(seed: int, *, noise: float = 1.0) -> Scene:
    """Cameras side by side, every point in each of them; pixels from the principal point, noise a pixel."""
    rng = np.random.default_rng(seed)
    X_world = rng.uniform([[-1.5], [-1.0], [2.0]], [[1.5], [1.0], [4.0]], (3, N))
    rotations = Rotation.from_rotvec(0.1 * rng.normal(size=(K, 3)))
    positions = 0.4 * np.arange(K)[:, None] * [1, 0, 0] + 0.1 * rng.normal(size=(K, 3))
    lenses = np.array([500.0, -0.1, 0.03]) * (1.0 + 0.1 * rng.normal(size=(K, 3)))
    uv = _project(rotations, positions, X_world, lenses) + noise * rng.normal(size=(2, M))
    truth = np.stack([to_wxyz_xyz(r, t) for r, t in zip(rotations, positions, strict=True)])
    turned = rotations * Rotation.from_rotvec(0.02 * rng.normal(size=(K, 3)))
    start = np.stack([to_wxyz_xyz(r, t) for r, t in zip(turned, positions + 0.02, strict=True)])
    start_lenses = np.repeat([[480.0, 0.0, 0.0]], K, axis=0)
    inputs = Inputs(
        poses=np.where(FIXED_POSES[:, None], truth, start),
        X_world=np.where(FIXED_POINTS, X_world, X_world + 0.03 * rng.normal(size=X_world.shape)),
        lenses=np.where(FIXED_LENSES[:, None], lenses, start_lenses),
        uv=uv,
        weights=rng.uniform(0.3, 1.0, M),
    )
    return Scene(truth, lenses, inputs)


def _project(rotations: Rotation, positions: np.ndarray, X_world: np.ndarray, lenses: np.ndarray) -> np.ndarray:
    into: Any = rotations.inv()
    X, Y, Z = into[CAMERA].apply(X_world[:, POINT].T - positions[CAMERA]).T
    x, y, (f, k1, k2) = X / Z, Y / Z, lenses[CAMERA].T
    r2 = x * x + y * y
    return f * (1 + k1 * r2 + k2 * r2**2) * np.stack([x, y])


def _adjust(inputs: Inputs, loss: Loss = "cauchy", **options) -> BundleAdjustment:
    number = inputs.uv.dtype
    observations = Observations(
        camera=jnp.asarray(CAMERA, jnp.int32),
        point=jnp.asarray(POINT, jnp.int32),
        xy=inputs.uv,
        depth=jnp.zeros(M, number),
        precision=jnp.ones((3, M), number),
        weights=inputs.weights,
        valid=jnp.ones(M, bool),
    )
    fixed: dict[str, Any] = {
        "fixed_poses": jnp.asarray(FIXED_POSES),
        "fixed_points": jnp.asarray(FIXED_POINTS),
        "fixed_lenses": jnp.asarray(FIXED_LENSES),
    }
    settings = {"lenses": inputs.lenses, "tolerance": 0.0, "max_steps": 200, **fixed, **options}
    return bundle_adjust(inputs.poses, inputs.X_world, observations, loss=loss, **settings)


def _summary(result: BundleAdjustment) -> jax.Array:
    """One number that every output has a part in."""
    rng, dtype = np.random.default_rng(9), result.cost.dtype
    probe = lambda like: jnp.sum(jnp.asarray(rng.normal(size=like.shape), dtype) * like)
    assert result.lenses is not None
    moved = probe(result.poses) + probe(result.X_world) + probe(result.lenses * jnp.array([[1e-2, 1.0, 1.0]], dtype))
    return moved + 1e-2 * (result.cost + 1e-2 * result.initial_cost) + 1e-3 * jnp.sum(jnp.minimum(result.chi2, 9.0))


def _differentiate(inputs: Inputs, direction: Inputs):
    def f(inputs):
        result = _adjust(inputs)
        return _summary(result), result

    return differentiate(f, inputs, direction)


# Compiled once for float32 and once for float64, whatever changes from call to call.
_differentiated = quick_compile(eqx.debug.assert_max_traces(_differentiate, max_traces=2))


def _arrays(tree: Any) -> Any:
    """For JAX, in its default precision."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.zeros(()).dtype), tree)


def _run(inputs: Inputs, direction: Inputs | None = None):
    """The result, a gradient and a directional derivative, as NumPy arrays."""
    direction = jax.tree.map(np.zeros_like, inputs) if direction is None else direction
    return jax.tree.map(np.asarray, _differentiated(_arrays(inputs), _arrays(direction)))


def _pose_errors(poses, others) -> float:
    return max(max(pose_error(a, b)) for a, b in zip(poses, others, strict=True))


def _scipy_optimum(inputs: Inputs, loss: Loss) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    start = Rotation.from_quat(np.roll(inputs.poses[:, :4], -1, axis=1))

    def unpack(x):
        tangents, shifts, change = np.zeros((K, 6)), np.zeros((3, N)), np.zeros((K, 3))
        a, b = 6 * (K - 1), 6 * (K - 1) + 3 * (K - 1)
        tangents[~FIXED_POSES], change[~FIXED_LENSES] = x[:a].reshape(-1, 6), x[a:b].reshape(-1, 3)
        shifts[:, ~FIXED_POINTS] = x[b:].reshape(3, -1)
        turned = start * Rotation.from_rotvec(tangents[:, 3:])
        return turned, inputs.poses[:, 4:] + tangents[:, :3], inputs.X_world + shifts, inputs.lenses + change

    def residuals(x):
        r = _project(*unpack(x)) - inputs.uv
        s = (r**2).sum(0)
        rho = s if loss == "squared" else 4.0 * np.log1p(s / 4.0)
        return (r * np.sqrt(inputs.weights * rho / s)).ravel()

    count = 9 * (K - 1) + 3 * int((~FIXED_POINTS).sum())
    tight: Any = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    fit = least_squares(residuals, np.zeros(count), method="lm", jac="3-point", x_scale="jac", **tight)
    rotations, positions, X_world, lenses = unpack(fit.x)
    poses = np.stack([to_wxyz_xyz(r, t) for r, t in zip(rotations, positions, strict=True)])
    return poses, X_world, lenses, float(fit.cost)


class TestReference:
    @pytest.mark.parametrize("loss", ["cauchy", pytest.param("squared", marks=pytest.mark.slow)])
    def test_matches_reference(self, loss):
        inputs = make_scene(1).inputs
        with jax.enable_x64(True):
            result = jax.tree.map(np.asarray, quick_compile(partial(_adjust, loss=loss))(_arrays(inputs)))
        poses, X_world, lenses, cost = _scipy_optimum(inputs, loss)
        assert result.status == BundleStatus.OK
        assert result.cost == pytest.approx(cost, rel=1e-9)
        assert result.cost < 0.1 * result.initial_cost
        assert _pose_errors(result.poses, poses) < 1e-5
        np.testing.assert_allclose(result.X_world, X_world, atol=1e-5)
        np.testing.assert_allclose(result.lenses, lenses, rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(result.lenses[3], inputs.lenses[3])

    @pytest.mark.slow
    def test_truth_without_noise(self):
        scene = make_scene(2, noise=0.0)
        with jax.enable_x64(True):
            result, *_ = _run(scene.inputs)
        assert result.status == BundleStatus.OK
        assert _pose_errors(result.poses, scene.truth) < 1e-8
        np.testing.assert_allclose(result.lenses, scene.true_lenses, rtol=1e-6)

    @pytest.mark.slow
    def test_float32_is_within_a_hundredth(self):
        inputs = make_scene(3).inputs
        single, gradient, _ = _run(inputs)
        with jax.enable_x64(True):
            double, *_ = _run(inputs)
        assert single.status == double.status == BundleStatus.OK
        assert float(single.cost) == pytest.approx(float(double.cost), rel=0.01)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((single, gradient)))

    @pytest.mark.slow
    def test_fixed_lens_without_distortion_is_an_ideal_camera(self):
        """Of the same focal length: the same poses from pixels as from directions."""
        inputs = make_scene(4).inputs
        inputs = inputs._replace(lenses=np.repeat([[500.0, 0.0, 0.0]], K, axis=0))
        ideal = inputs._replace(uv=inputs.uv / 500.0)
        with jax.enable_x64(True):
            ours, theirs = _arrays(inputs), _arrays(ideal)
            result = quick_compile(partial(_adjust, fixed_lenses=jnp.ones(K, bool)))(ours)
            observations = Observations(
                camera=jnp.asarray(CAMERA, jnp.int32),
                point=jnp.asarray(POINT, jnp.int32),
                xy=theirs.uv,
                depth=jnp.zeros(M),
                precision=jnp.full((3, M), 500.0),
                weights=theirs.weights,
                valid=jnp.ones(M, bool),
            )
            fixed: Any = {"fixed_poses": jnp.asarray(FIXED_POSES), "fixed_points": jnp.asarray(FIXED_POINTS)}
            plain = quick_compile(partial(bundle_adjust, tolerance=0.0, max_steps=200, **fixed))
            expected = plain(theirs.poses, theirs.X_world, observations)
        assert expected.lenses is None
        np.testing.assert_allclose(result.cost, expected.cost, rtol=1e-10)
        assert _pose_errors(result.poses, expected.poses) < 1e-7

    @pytest.mark.parametrize("two_sided", [pytest.param(False, marks=pytest.mark.slow), True])
    def test_behind(self, two_sided):
        """A camera that looks the other way: its pixels are where the lines of sight meet the image."""
        scene = make_scene(5)
        rotations = Rotation.from_quat(np.roll(scene.truth[:, :4], -1, axis=1))
        # Half a round about y: x and z change sign, and so x / z stays and y / z does not.
        turned, uv = scene.truth.copy(), scene.inputs.uv.copy()
        turned[1] = to_wxyz_xyz(rotations[1] * Rotation.from_rotvec([0, np.pi, 0]), scene.truth[1, 4:])
        uv[1, CAMERA == 1] *= -1.0
        inputs = scene.inputs._replace(poses=turned, lenses=scene.true_lenses, uv=uv)
        with jax.enable_x64(True):
            result = quick_compile(partial(_adjust, loss="squared", two_sided=two_sided))(_arrays(inputs))
        assert bool(np.asarray(result.used)[CAMERA == 1].all()) == two_sided
        if two_sided:
            assert result.status == BundleStatus.OK
            assert float(result.cost) < 2 * M


@pytest.mark.parametrize("x64", [False, True])
def test_shapes(x64):
    with jax.enable_x64(x64):
        single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), make_scene(0).inputs)
        result = jax.eval_shape(_adjust, single)
    assert result.lenses is not None
    assert result.lenses.shape == (K, 3)
    assert result.poses.shape == (K, 7)
    assert {str(x.dtype) for x in jax.tree.leaves(result)} == {"float32", "int32", "bool"}


def _direction(inputs: Inputs, seed: int) -> Inputs:
    """Every measurement, weight and fixed value moves; the rest of the start does not."""
    rng = np.random.default_rng(seed)
    moved = jax.tree.map(lambda x: rng.normal(size=x.shape), inputs)
    return moved._replace(
        poses=np.where(FIXED_POSES[:, None], 0.1 * moved.poses, 0.0) * [0, 0, 0, 0, 1, 1, 1],
        X_world=np.where(FIXED_POINTS, 0.1 * moved.X_world, 0.0),
        lenses=np.where(FIXED_LENSES[:, None], moved.lenses * [10.0, 0.1, 0.1], 0.0),
    )


@pytest.mark.slow
def test_gradient():
    """Forward = reverse = finite differences, for every input and through every output."""
    inputs = make_scene(6).inputs
    direction, h = _direction(inputs, 7), 1e-6
    with jax.enable_x64(True):
        result, gradient, forward = _run(inputs, direction)
        after, before = (
            float(_summary(_run(jax.tree.map(lambda x, t, s=s: x + s * h * t, inputs, direction))[0])) for s in (1, -1)
        )
    assert result.status == BundleStatus.OK
    reverse = sum(np.sum(g * t) for g, t in zip(gradient, direction, strict=True))
    np.testing.assert_allclose(forward, (after - before) / (2 * h), rtol=1e-4)
    np.testing.assert_allclose(reverse, forward, rtol=1e-7)


@pytest.mark.slow
def test_vmap_equals_loop():
    several = [make_scene(seed).inputs for seed in (10, 11)]
    with jax.enable_x64(True):
        batched = quick_compile(jax.vmap(_adjust))(_arrays(jax.tree.map(lambda *x: np.stack(x), *several)))
        for i, inputs in enumerate(several):
            alone, *_ = _run(inputs)
            assert _pose_errors(batched.poses[i], alone.poses) < 1e-7
            np.testing.assert_allclose(batched.lenses[i], alone.lenses, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_single_trace():
    for seed in range(2):
        _run(make_scene(seed).inputs)


class TestDegenerate:
    @pytest.mark.slow
    @pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -500.0])
    def test_degenerate_lenses(self, value):
        """None is usable: nothing moves, and everything is finite, derivatives too."""
        inputs = make_scene(8).inputs
        lenses = inputs.lenses.copy()
        lenses[:, 0] = value
        result, gradient, _ = _run(inputs._replace(lenses=lenses))
        assert result.status == BundleStatus.NOTHING_TO_ADJUST
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        np.testing.assert_allclose(result.poses, inputs.poses, atol=1e-6)
        np.testing.assert_allclose(result.lenses, np.repeat([[1.0, 0.0, 0.0]], K, axis=0))

    @pytest.mark.slow
    def test_degenerate_in_part(self):
        """One camera without a usable lens does not count; the others are as they would be without it."""
        inputs = make_scene(9).inputs
        lenses, weights = inputs.lenses.copy(), np.where(CAMERA == 2, 0.0, inputs.weights)
        lenses[2] = np.nan
        with jax.enable_x64(True):
            result, gradient, _ = _run(inputs._replace(lenses=lenses))
            without, *_ = _run(inputs._replace(weights=weights))
        assert result.status == BundleStatus.OK
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        others = np.arange(K) != 2
        assert _pose_errors(result.poses[others], without.poses[others]) < 1e-7
        np.testing.assert_array_equal(result.used, CAMERA != 2)

    @pytest.mark.slow
    def test_degenerate_masked(self):
        inputs = make_scene(9).inputs
        result, gradient, _ = _run(inputs._replace(weights=np.zeros(M)))
        assert result.status == BundleStatus.NOTHING_TO_ADJUST
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        np.testing.assert_allclose(result.lenses, inputs.lenses, rtol=1e-6)
