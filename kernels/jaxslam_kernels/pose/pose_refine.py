"""Refines one camera pose by robust, weighted Levenberg-Marquardt, differentiably.

The solver is optimistix's loop around fused normal equations (`levenberg_marquardt`), or any of its least-squares
solvers on residuals of the same cost; the cost is `pose_cost`'s. The result is differentiable, forward and reverse, by
the implicit function theorem at the optimum: its derivative with respect to points, pixels, weights, depths,
deviations, intrinsics, scale and prior costs one 6 x 6 solve, however many steps the solver took. Higher derivatives
are right as well. The initial pose has no derivative, since the optimum does not depend on it. Of a weight that is
exactly 0 the derivative is the one-sided limit from above: what letting the point back in would do.
"""

from enum import IntEnum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Float, Int

from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.checks import checked
from jaxslam_kernels.derivative_rules import custom_jvp, implicit_shift
from jaxslam_kernels.levenberg_marquardt import ManifoldLevenbergMarquardt, NormalEquations
from jaxslam_kernels.pose.pose_cost import (
    PoseCost,
    PosePrior,
    PoseProblem,
    pose_cost,
    pose_problem,
    pose_residuals,
    retract,
    shifted,
    with_idle,
)
from jaxslam_kernels.positive_definite import is_determined, solve_determined, solve_exact
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import Loss
from jaxslam_kernels.types import Code, Flag, Pixels, Points, Scalar, Weights

MIN_POINTS = 3
"""Fewer points than this leave a pose undetermined, whatever they measure."""

UNKNOWN_VARIANCE = 1e6
"""The variance, in m² and rad², reported for a pose that the observations do not determine."""


class PoseStatus(IntEnum):
    """Quality of an estimated pose. Only `OK` and `NOT_CONVERGED` carry a new pose."""

    OK = 0
    NOT_CONVERGED = 1
    """The steps ran out; the pose is the best one found."""
    TOO_FEW_POINTS = 2
    DEGENERATE = 3
    """The points leave a direction free: all on one line, or all in one place."""
    NO_CONSENSUS = 4
    """RANSAC found no pose that enough points agree on."""
    BAD_INITIAL = 5
    """The initial pose is not finite; the identity came back."""


class PoseRefinement(NamedTuple):
    """A refined pose and what it is worth.

    Attributes:
        T_world_cam: The optimum, or the initial pose if `status` says so.
        covariance: In the right tangent (translation m, rotation rad), for the given standard deviations: the
            inverse of the reweighted information, prior included. `UNKNOWN_VARIANCE` on the diagonal if undetermined.
        residual_scale: Standard deviation of unit weight: how much larger the inliers' residuals are than the given
            deviations, `sqrt(Σ w ρ' s / Σ w ρ' k)` with k residuals a point; 0 without points.
        cost: `½ Σ w ρ(s)` plus the prior's share, at `T_world_cam`.
        num_valid: Number of points that have weight and lie in front of the camera.
        status: A `PoseStatus`.
        num_steps: Evaluations of the cost.
        robust_weights: `ρ'(s)` in [0, 1] of every point, whatever its weight; 0 where it has no value.
        chi2: Squared whitened residual s of every point, `UNKNOWN_CHI2` where it has no value.
    """

    T_world_cam: SE3
    covariance: Float[Array, "6 6"]
    residual_scale: Scalar
    cost: Scalar
    num_valid: Int[Array, ""]
    status: Code
    num_steps: Int[Array, ""]
    robust_weights: Weights
    chi2: Weights


class SolverReport(NamedTuple):
    """Result of a solve: the reweighted Hessian at the end (up to scale), steps, and whether it converged."""

    hessian: Float[Array, "6 6"]
    num_steps: Int[Array, ""]
    converged: Flag


@checked
def refine_pose(
    T_world_cam: SE3,
    X_world: Points,
    uv: Pixels,
    intrinsics: Intrinsics,
    *,
    weights: Weights | None = None,
    depth: Weights | None = None,
    sigma_px: Weights | Scalar | float = 1.0,
    sigma_depth: Weights | Scalar | float = 0.02,
    loss: Loss = "cauchy",
    scale: Scalar | float = 2.0,
    prior: PosePrior | None = None,
    max_steps: int = 25,
    tolerance: float | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> PoseRefinement:
    """Finds the pose that explains where points are seen, and how far away.

    Needs at least `MIN_POINTS` points that are not on one line. A point counts if its weight is positive and its
    position, pixel and deviation are finite; its depth counts if positive and finite.

    Args:
        T_world_cam: Initial pose, close to the solution.
        X_world: Points in the world, meters.
        uv: Their image positions, pixels of the distorted image.
        intrinsics: The camera.
        weights: Factor of each point's cost, `None` for one each. Points of weight 0 have no influence; the derivative
            by their weight is the limit from above.
        depth: Measured depths in meters, 0 or NaN where missing; `None` for pixels alone.
        sigma_px: Standard deviation of a pixel, each coordinate, in pixels.
        sigma_depth: Standard deviation of a depth, meters.
        loss: The robust loss, static.
        scale: Its scale in standard deviations, traced.
        prior: A pose known beforehand, with its information.
        max_steps: Bound on the evaluations of the cost, static.
        tolerance: Length of the next step, in standard deviations of the estimate, at which the solver stops, static;
            `None` for what the floating-point type resolves.
        solver: Least-squares solver of optimistix, such as `optimistix.Dogleg(rtol=1e-6, atol=1e-6)`, static; `None`
            for `ManifoldLevenbergMarquardt`, which is faster. It changes neither the optimum nor its derivatives, which
            are those of the optimum: they are as exact as its tolerances. Give it tolerances that the floating-point
            type resolves: in single precision, `optimistix.LevenbergMarquardt(1e-3, 1e-3)` may run out of steps at the
            optimum (`NOT_CONVERGED`), where it rejects each step for a rounding error of the cost.

    Returns:
        A `PoseRefinement`; everything in it is finite, and so are its derivatives.

    Raises:
        ValueError: If both `tolerance` and `solver` are given: a solver has tolerances of its own.
    """
    if solver is not None and tolerance is not None:
        raise ValueError(f"refine_pose: tolerance: expected None, as the solver has its own, got {tolerance:g}")
    problem, idle = apart(
        lambda: pose_problem(X_world, uv, intrinsics, weights, depth, sigma_px, sigma_depth, scale, prior)
    )
    return refine_problem(T_world_cam, problem, idle, loss, max_steps, tolerance, solver)


def refine_problem(
    T_world_cam: SE3,
    problem: PoseProblem,
    idle: PoseProblem,
    loss: Loss,
    max_steps: int,
    tolerance: float | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> PoseRefinement:
    """`refine_pose` on a problem that is already clean; the idle points matter to derivatives only."""
    initial, finite_initial = usable_pose(T_world_cam)
    if solver is None:
        optimum, report = solve_pose(initial, problem, loss, max_steps, tolerance)
    else:
        optimum, report = _solve_with(solver, initial, problem, loss, max_steps)
    step = implicit_shift(
        partial(_slope, loss), partial(_solve, loss), jnp.zeros(6, problem.xy.dtype), optimum, (problem, idle)
    )
    optimum = shifted(optimum, step)
    status = jnp.select(
        [
            ~finite_initial,
            jnp.sum(problem.weights > 0) < MIN_POINTS,
            ~is_determined(report.hessian),
            ~report.converged,
        ],
        [PoseStatus.BAD_INITIAL, PoseStatus.TOO_FEW_POINTS, PoseStatus.DEGENERATE, PoseStatus.NOT_CONVERGED],
        PoseStatus.OK,
    ).astype(jnp.int32)
    found = status <= PoseStatus.NOT_CONVERGED
    pose = SE3(jnp.where(found, optimum.wxyz_xyz, initial.wxyz_xyz))
    return _report(pose, problem, idle, loss, status, report.num_steps)


def solve_pose(
    initial: SE3, problem: PoseProblem, loss: Loss, max_steps: int, tolerance: float | None = None
) -> tuple[SE3, SolverReport]:
    """The optimum from a finite initial pose; constant for differentiation."""
    initial, problem = lax.stop_gradient((initial, problem))
    epsilon = float(jnp.finfo(problem.xy.dtype).eps)
    atol = 3.0 * epsilon**0.5 if tolerance is None else tolerance

    def cost(T_world_cam: SE3, problem: PoseProblem) -> tuple[Scalar, NormalEquations]:
        return pose_cost(T_world_cam, problem, loss)[:2]

    solution = optx.minimise(
        cost,
        ManifoldLevenbergMarquardt(retract=retract, atol=atol, rtol=64.0 * epsilon),
        initial,
        problem,
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    converged = solution.result == optx.RESULTS.successful
    hessian = solution.state.model.hessian.as_matrix()
    return solution.value, SolverReport(hessian, solution.stats["num_steps"].astype(jnp.int32), converged)


def _solve_with(
    solver: optx.AbstractLeastSquaresSolver, initial: SE3, problem: PoseProblem, loss: Loss, max_steps: int
) -> tuple[SE3, SolverReport]:
    """The optimum that a solver of optimistix finds from a finite initial pose; constant for differentiation."""
    initial, problem = lax.stop_gradient((initial, problem))

    def residuals(
        tangent: Float[Array, "6"], args: tuple[SE3, PoseProblem]
    ) -> tuple[Float[Array, "3 n"], Float[Array, "6"]]:
        start, problem = args
        return pose_residuals(retract(start, tangent), problem, loss)

    still = jnp.zeros(6, problem.xy.dtype)
    solution = optx.least_squares(residuals, solver, still, (initial, problem), max_steps=max_steps, throw=False)
    tangent = lax.stop_gradient(solution.value)
    found = retract(initial, jnp.where(jnp.isfinite(tangent).all(), tangent, 0.0))
    hessian = pose_cost(found, problem, loss).equations.hessian
    converged = solution.result == optx.RESULTS.successful
    return found, SolverReport(hessian, jnp.asarray(solution.stats["num_steps"], jnp.int32), converged)


def _slope(loss: Loss, step: Float[Array, "6"], optimum: SE3, inputs: tuple[PoseProblem, PoseProblem]) -> Array:
    """Gradient of the cost a step away from the optimum. Points of weight zero take part with their weights."""
    everything = with_idle(*inputs, optimum, loss)
    return pose_cost(shifted(optimum, step), everything, loss).equations.gradient


def _solve(loss: Loss, optimum: SE3, inputs: tuple[PoseProblem, PoseProblem], right: Array) -> Array:
    """Solve for a step."""
    exact = jax.jacfwd(partial(_slope, loss))(jnp.zeros_like(right), optimum, inputs)
    return solve_exact(exact, pose_cost(optimum, inputs[0], loss).equations.hessian, right)


class _Figures(NamedTuple):
    """Sums over all points at the final pose."""

    cost: Scalar
    covariance: Float[Array, "6 6"]
    residual_scale: Scalar


def _report(
    pose: SE3, problem: PoseProblem, idle: PoseProblem, loss: Loss, status: Array, num_steps: Array
) -> PoseRefinement:
    """Everything that is said of the final pose, evaluated there."""
    at_pose = pose_cost(pose, problem, loss)
    figures = _figures(at_pose, pose, problem, idle, status, loss)
    return PoseRefinement(
        T_world_cam=pose,
        covariance=figures.covariance,
        residual_scale=figures.residual_scale,
        cost=figures.cost,
        num_valid=jnp.sum(problem.weights * at_pose.robust_weights > 0, dtype=jnp.int32),
        status=status,
        num_steps=num_steps,
        robust_weights=at_pose.robust_weights,
        chi2=at_pose.chi2,
    )


def _figures_at(at_pose: PoseCost, problem: PoseProblem, status: Array) -> _Figures:
    total = problem.weights * at_pose.robust_weights
    residuals_a_point = jnp.where(problem.precision[2] > 0, 3.0, 2.0)
    freedom = jnp.sum(total * residuals_a_point)
    variance = jnp.sum(total * at_pose.chi2) / jnp.where(freedom > 0, freedom, 1.0)
    hessian, identity = at_pose.equations.hessian, jnp.eye(6, dtype=total.dtype)
    determined = is_determined(hessian) & (status <= PoseStatus.NOT_CONVERGED)
    covariance = jnp.where(determined, solve_determined(hessian, determined, identity), UNKNOWN_VARIANCE * identity)
    residual_scale = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    return _Figures(at_pose.cost, covariance, residual_scale)


@partial(custom_jvp, nondiff_argnums=(5,))
def _figures(
    at_pose: PoseCost, pose: SE3, problem: PoseProblem, idle: PoseProblem, status: Array, loss: Loss
) -> _Figures:
    """The figures at the pose, whose derivatives see points of weight zero too."""
    del pose, idle, loss
    return _figures_at(at_pose, problem, status)


@_figures.defjvp
def _figures_jvp(loss: Loss, primals: tuple, tangents: tuple) -> tuple[_Figures, _Figures]:
    _, pose, problem, idle, status = primals

    def figures(pose: SE3, problem: PoseProblem, idle: PoseProblem) -> _Figures:
        everything = with_idle(problem, idle, pose, loss)
        return _figures_at(pose_cost(pose, everything, loss), everything, status)

    return _figures(*primals, loss), jax.jvp(figures, (pose, problem, idle), tuple(tangents[1:4]))[1]


@checked
def usable_pose(T: SE3) -> tuple[SE3, Flag]:
    """The pose with a unit quaternion, or the identity and false if it is not finite."""
    parameters = T.wxyz_xyz
    usable = jnp.isfinite(parameters).all() & (jnp.sum(jnp.square(parameters[:4])) > 1e-6)
    identity = jnp.zeros_like(parameters).at[0].set(1.0)
    return SE3(jnp.where(usable, parameters, identity)).normalize(), usable
