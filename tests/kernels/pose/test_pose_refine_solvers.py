"""Pose refinement with a least-squares solver of optimistix: the same optimum, and derivatives of any order."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jaxlie import SE3
from jaxslam_kernels.pose.pose_cost import PosePrior, pose_cost, pose_problem, pose_residuals
from jaxslam_kernels.pose.pose_refine import PoseRefinement, PoseStatus, refine_pose
from quick_compile import quick_compile

from jaxslam.benchmark.kernels.scenes.single_view import camera, make_scene, pose_error, pose_of

N = 40
EXACT = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
SCENE = make_scene(31, N, outliers=0.1)


def _refine(solver: Any, T: SE3, X_world: Any, uv: Any, depth: Any, weights: Any, scale: Any) -> PoseRefinement:
    # Turning is known beforehand, moving is not: the information is singular.
    prior = PosePrior(pose_of(SCENE.initial), jnp.diag(jnp.asarray([0.0, 0, 0, 400, 400, 400], uv.dtype)))
    return refine_pose(
        T, X_world, uv, camera(), weights=weights, depth=depth, scale=scale, prior=prior, max_steps=60, solver=solver
    )


def _inputs() -> tuple[Any, ...]:
    X_world, uv, depth, _ = SCENE.arrays()
    weights = jnp.asarray(np.random.default_rng(0).uniform(0.2, 1.0, N), uv.dtype).at[-3:].set(0.0)
    return X_world, uv, depth.at[10:20].set(0.0), weights, jnp.asarray(2.0, uv.dtype)


def _slope_and_bend(solver: Any, T: SE3, inputs: tuple, direction: tuple) -> tuple[PoseRefinement, Any, Any]:
    """The result, the gradient of a number that sees pose and covariance, and how it changes along a direction."""

    def number(inputs: tuple) -> tuple[Any, PoseRefinement]:
        result = _refine(solver, T, *inputs)
        return jnp.sum(jnp.sin(result.T_world_cam.wxyz_xyz)) + 1e3 * jnp.sum(result.covariance), result

    gradient, bend, result = jax.jvp(jax.grad(number, has_aux=True), (inputs,), (direction,), has_aux=True)
    return result, gradient, bend


@pytest.mark.slow
def test_matches_reference() -> None:
    """Optimum, report, gradient and its derivative are those of the default solver."""
    with jax.enable_x64(True):
        inputs = _inputs()
        rng = np.random.default_rng(1)
        direction = jax.tree.map(lambda x: jnp.asarray(1e-2 * rng.normal(size=x.shape), x.dtype), inputs)
        direction = (*direction[:2], jnp.where(inputs[2] > 0, direction[2], 0.0), *direction[3:])
        ours, theirs = (
            quick_compile(partial(_slope_and_bend, solver))(pose_of(SCENE.initial), inputs, direction)
            for solver in (None, EXACT)
        )
    assert ours[0].status == theirs[0].status == PoseStatus.OK
    for name in ("T_world_cam", "covariance", "cost", "chi2", "robust_weights"):
        expected, got = (jax.tree.leaves(getattr(each[0], name))[0] for each in (ours, theirs))
        np.testing.assert_allclose(got, expected, atol=1e-6 * np.abs(expected).max(), err_msg=name)
    for order in (1, 2):
        for expected, got in zip(*map(jax.tree.leaves, (ours[order], theirs[order])), strict=True):
            np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("loss", ["cauchy", "huber"])
def test_residuals_have_the_cost(loss: Any) -> None:
    """Also of points behind the camera or of no weight, and of perfect ones."""
    X_world, uv, depth, weights, scale = _inputs()
    X_world = X_world.at[2, :2].set(-50.0)
    prior = PosePrior(pose_of(SCENE.pose), jnp.diag(jnp.asarray([9.0, 0, 4, 100, 100, 0], uv.dtype)))
    problem, _ = pose_problem(X_world, uv, camera(), weights, depth, 1.3, 0.02, scale, prior)
    rows, of_prior = pose_residuals(pose_of(SCENE.initial), problem, loss)
    expected = pose_cost(pose_of(SCENE.initial), problem, loss).cost
    np.testing.assert_allclose(0.5 * (jnp.sum(rows**2) + jnp.sum(of_prior**2)), expected, rtol=1e-5)


def test_degenerate() -> None:
    """A batch of problems: one that is fine, two points, no finite pose, all points in one place.

    In double precision: in single, on some processors, rounding keeps this solver from its tolerances.
    """
    with jax.enable_x64(True):
        T = pose_of(SCENE.initial)
        X_world, uv, depth, weights, _ = _inputs()
        cases = {
            PoseStatus.OK: (T.wxyz_xyz, X_world, weights),
            PoseStatus.TOO_FEW_POINTS: (T.wxyz_xyz, X_world, weights.at[2:].set(0.0)),
            PoseStatus.BAD_INITIAL: (jnp.full(7, jnp.nan), X_world, weights),
            PoseStatus.DEGENERATE: (T.wxyz_xyz, jnp.broadcast_to(X_world[:, :1], X_world.shape), weights),
        }

        def refined(wxyz_xyz: Any, X_world: Any, weights: Any) -> PoseRefinement:
            solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
            return refine_pose(SE3(wxyz_xyz), X_world, uv, camera(), weights=weights, depth=depth, solver=solver)

        stacked = jax.tree.map(lambda *arrays: jnp.stack(arrays), *cases.values())
        result = quick_compile(jax.vmap(refined))(*stacked)
    assert [PoseStatus(int(code)) for code in result.status] == list(cases)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
    assert max(pose_error(result.T_world_cam.wxyz_xyz[0], SCENE.pose)) < 0.01


def test_wrong_solvers() -> None:
    X_world, uv, depth, *_ = _inputs()
    refine: Any = partial(refine_pose, pose_of(SCENE.initial), X_world, uv, camera(), depth=depth)
    with pytest.raises(TypeError, match="solver: expected AbstractLeastSquaresSolver, got BFGS"):
        refine(solver=optx.BFGS(rtol=1e-4, atol=1e-4))
    with pytest.raises(ValueError, match=r"tolerance: expected None, as the solver has its own, got 0\.01"):
        refine(solver=EXACT, tolerance=0.01)
