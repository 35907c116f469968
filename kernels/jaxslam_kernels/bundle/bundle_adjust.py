"""Weighted windowed bundle adjustment: many poses and points at once, differentiably.

Levenberg-Marquardt with Marquardt's scaling. No two points share a residual, so the points are eliminated and what is
left to factorize is the Schur complement, dense, six numbers a camera: right for a window of up to some 64 cameras.
A camera may have a lens to be found with its pose, three numbers more (`bundle_lens`).
`levenberg_marquardt` holds its Hessian as one matrix, which here would have thousands of rows; hence a loop of its own.

The result is differentiable, forward and reverse, by the implicit function theorem at the optimum, with one more
elimination of the exact Hessian, however many steps the solver took. Where a solve starts has no derivative, apart
from what is held fixed. Of a weight that is exactly 0 the derivative is the one-sided limit from above; see
`zero_weight_points` for points that have no weight at all. Higher derivatives are right as well.

Source: Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6.
"""

from enum import IntEnum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.bundle.cost import (
    BundleProblem,
    Observations,
    Plane,
    Poses,
    Views,
    bundle_cost,
    bundle_problem,
    bundle_views,
    clean_weights,
    free_cameras,
)
from jaxslam_kernels.bundle.edges import edge_cost, edge_gradient, edge_hessian, exact_edge_hessian
from jaxslam_kernels.bundle.equations import BundleEquations, exact_blocks, normal_equations
from jaxslam_kernels.bundle.lens import Cameras, Lenses, move_cameras, shift_cameras, usable_lenses
from jaxslam_kernels.bundle.schur import Reduced, eliminate, is_determined, points_determined, solve_reduced
from jaxslam_kernels.bundle.zero_weight_points import idle_points
from jaxslam_kernels.checks import checked
from jaxslam_kernels.derivative_rules import implicit_shift, only_derivative
from jaxslam_kernels.pose.pose_cost import UNKNOWN_CHI2
from jaxslam_kernels.pose.pose_refine import usable_pose
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges, graph_problem
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import Loss
from jaxslam_kernels.types import Code, Flag, Mask, Points, Scalar, Weights

_INITIAL_DAMPING = 1e-4  # relative to the diagonal of the Hessian: nearly a Gauss-Newton step
_DAMPING_FACTOR = 10.0
_MAX_DAMPING = 1e6


class BundleStatus(IntEnum):
    """Quality of an adjustment. Poses and points are finite for every status."""

    OK = 0
    NOT_CONVERGED = 1
    """The steps ran out, or none lowered the cost; the values are the best ones found."""
    NOTHING_TO_ADJUST = 2
    """Nothing free has an observation or an edge that counts; the values are the initial ones."""
    DEGENERATE = 3
    """The poses can move together at no cost, as a whole or in scale. The values lower the cost; which of the equal
    ones they are depends on the start, and nothing has a derivative."""


class BundleAdjustment(NamedTuple):
    """Adjusted poses and points with their quality.

    Attributes:
        poses: `wxyz_xyz` of T_world_cam; the identity where the initial one was not finite.
        X_world: Points in meters; the origin where the initial one was not finite.
        initial_cost: Cost `½ Σ w ρ(s)` before the adjustment, that of the edges included.
        cost: The same cost after it.
        status: A `BundleStatus`.
        num_steps: Number of steps tried.
        determined: Points whose observations leave no direction free.
        used: Observations that have weight, a slot of their own, and lie in front of the camera.
        robust_weights: `ρ'(s)` in [0, 1] of every observation, whatever its weight; 0 where it has no value.
        chi2: Squared whitened residual s of every observation, `UNKNOWN_CHI2` where it has no value.
        lenses: Adjusted lenses, focal length one where the initial one was not usable; `None` without.
    """

    poses: Poses
    X_world: Points
    initial_cost: Scalar
    cost: Scalar
    status: Code
    num_steps: Int[Array, ""]
    determined: Mask
    used: Bool[Array, " m"]
    robust_weights: Float[Array, " m"]
    chi2: Float[Array, " m"]
    lenses: Lenses | None = None


@checked
def bundle_adjust(
    poses: Poses,
    X_world: Points,
    observations: Observations,
    *,
    fixed_poses: Bool[Array, " k"],
    num_movable: int | None = None,
    fixed_points: Mask | None = None,
    point_weights: Weights | None = None,
    lenses: Lenses | None = None,
    fixed_lenses: Bool[Array, " k"] | None = None,
    edges: PoseGraphEdges | None = None,
    two_sided: bool = False,
    loss: Loss = "cauchy",
    scale: Scalar | float = 2.0,
    tolerance: Scalar | float = 1e-6,
    max_steps: int = 20,
) -> BundleAdjustment:
    """Find the poses and points that explain all observations together.

    Hold at least one pose fixed (two, without depths): otherwise the whole can move freely, see
    `BundleStatus.DEGENERATE`. A pose or point that nothing sees stays where it is; an observation of a pose or point
    that is not finite does not count.

    Args:
        poses: Initial poses, `wxyz_xyz` of T_world_cam.
        X_world: Initial points, meters.
        observations: Observations of the points in the cameras.
        fixed_poses: Poses that do not move.
        num_movable: Number of poses that may move, static: the first ones, so that those after them take part in less
            of the work; they are taken for fixed. `None` for all.
        fixed_points: Points that do not move; `None` for none.
        point_weights: Factor of all observations of a point, not negative; `None` for one each. A point of weight 0
            stays where it starts and has no influence; the derivative by its weight is the limit from above.
        lenses: Initial lens of each camera (focal length, k1, k2), estimated with the poses; the observations are then
            pixels from the principal point, see `Observations`. `None` for ideal cameras.
        fixed_lenses: Lenses that do not change; `None` for none.
        edges: Measured relative poses of the cameras, with squared loss whatever `loss` is; `None` for none. They
            count as `optimize_pose_graph` says; one of weight 0 has neither influence nor derivative.
        two_sided: Whether a point behind a camera is seen too, where its line of sight meets the image, static. Data
            sets whose residuals ignore the side need it, as Bundle Adjustment in the Large.
        loss: The robust loss, static.
        scale: Its scale in standard deviations, traced.
        tolerance: Ends the solve when a step changes the cost by less than this fraction, traced; rounding ends it
            at the latest. Derivatives are as good as the optimum is.
        max_steps: Bound on the steps, static.

    Returns:
        A `BundleAdjustment`; everything in it is finite, and so are its derivatives.
    """
    dtype, (k, n) = X_world.dtype, (poses.shape[0], X_world.shape[1])
    if num_movable is not None:
        fixed_poses = fixed_poses | (np.arange(k) >= num_movable)
    fixed_points = jnp.zeros(n, bool) if fixed_points is None else fixed_points
    point_weights = jnp.ones(n, dtype) if point_weights is None else point_weights

    def prepare() -> tuple[Cameras, Points, Observations, BundleProblem, Int[Array, " m"]]:
        cameras, points, seen, usable = _usable(Cameras(poses, lenses), X_world, observations)
        problem, slot = bundle_problem(seen, point_weights, jnp.asarray(scale, dtype), ~fixed_poses, ~fixed_points)
        if lenses is not None:
            free_lens = jnp.ones_like(fixed_poses) if fixed_lenses is None else ~fixed_lenses
            problem = problem._replace(free_lens=free_lens)
        problem = problem._replace(
            two_sided=jnp.array(True) if two_sided else None,
            edges=None if edges is None else apart(partial(graph_problem, edges, usable, 1.0, 6)),
        )
        return cameras, points, seen, problem, slot

    # Apart, with the edges by themselves: else more than nine parts could run at once before the solve.
    cameras, X_world, observations, problem, slot = apart(prepare)
    solution = solve_bundle(cameras, X_world, problem, loss, jnp.asarray(tolerance, dtype), max_steps, num_movable)
    # What is fixed keeps its derivative, what is free gets that of the optimum.
    relative = _on_grid(clean_weights(observations.weights), slot, problem)
    inputs = _Inputs(cameras, X_world, problem, relative)
    start, start_points = _start(solution, inputs)
    c = 6 if lenses is None else 9
    like = jnp.zeros((k, c), dtype), jnp.zeros_like(X_world)
    tangents, shifts = implicit_shift(partial(_slope, loss), partial(_solve_exact, loss), like, solution, inputs)
    optimum, optimal_points = shift_cameras(start, tangents), start_points + shifts
    initial_cost = _cost(cameras, bundle_views(cameras, X_world, problem, loss), problem, loss)
    result = _report(optimum, optimal_points, problem, slot, loss, initial_cost, solution, num_movable)
    more_cost = only_derivative(partial(_idle_cost, loss), result.cost, optimum, optimal_points, inputs)
    return result._replace(cost=result.cost + more_cost)


class Solution(NamedTuple):
    """Result of the solver, a constant for differentiation."""

    cameras: Cameras
    X_world: Points
    converged: Flag
    num_steps: Int[Array, ""]


class _State(NamedTuple):
    cameras: Cameras
    X_world: Points
    cost: Scalar
    damping: Scalar
    converged: Flag
    stuck: Flag
    num_steps: Int[Array, ""]


def solve_bundle(
    cameras: Cameras,
    X_world: Points,
    problem: BundleProblem,
    loss: Loss,
    tolerance: Scalar,
    max_steps: int,
    num_movable: int | None,
) -> Solution:
    """The optimum from finite cameras and points."""
    cameras, X_world, problem, tolerance = lax.stop_gradient((cameras, X_world, problem, tolerance))
    epsilon = float(jnp.finfo(X_world.dtype).eps)

    def step(state: _State) -> _State:
        views = bundle_views(state.cameras, state.X_world, problem, loss)
        equations = _equations(state.cameras, views, problem, num_movable)
        reduced = eliminate(equations, problem, state.damping)
        tangents, shifts = solve_reduced(reduced, equations.camera_gradient, equations.point_gradient)
        predicted = _predicted_decrease(equations, tangents, shifts, state.damping)
        num_fixed = problem.free_pose.shape[0] - tangents.shape[0]
        moved = move_cameras(state.cameras, jnp.pad(tangents, ((0, num_fixed), (0, 0))))
        cameras = _where_free(problem, moved, state.cameras)
        X_world = state.X_world + shifts
        cost = _cost(cameras, bundle_views(cameras, X_world, problem, loss), problem, loss)
        finite = jnp.isfinite(cost) & jnp.isfinite(X_world).all()
        finite = finite & jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(cameras)]).all()
        accept = finite & (cost <= (1.0 + 32.0 * epsilon) * state.cost)  # a sum is no better than its rounding
        # The promised gain is the square of the step in standard deviations: it tells steps far below what the cost
        # can show, down to the rounding of the values themselves.
        enough = jnp.maximum(tolerance * state.cost, (1e4 * epsilon) ** 2 * jnp.maximum(state.cost, 1.0))
        level = (finite & (predicted <= enough)) | (accept & (jnp.abs(state.cost - cost) < tolerance * state.cost))
        damping = jnp.where(accept, state.damping / _DAMPING_FACTOR, state.damping * _DAMPING_FACTOR)
        cameras, X_world, cost = jax.tree.map(
            lambda new, old: jnp.where(accept, new, old), (cameras, X_world, cost), state[:3]
        )
        return _State(
            cameras=cameras,
            X_world=X_world,
            cost=cost,
            damping=jnp.maximum(damping, 4.0 * epsilon),
            converged=level,
            stuck=damping > _MAX_DAMPING,
            num_steps=state.num_steps + 1,
        )

    cost = _cost(cameras, bundle_views(cameras, X_world, problem, loss), problem, loss)
    no = jnp.zeros((), bool)
    damping = jnp.full_like(cost, _INITIAL_DAMPING)
    start = _State(cameras, X_world, cost, damping, no, no, jnp.zeros((), jnp.int32))
    end = lax.while_loop(lambda s: ~s.converged & ~s.stuck & (s.num_steps < max_steps), step, start)
    return Solution(end.cameras, end.X_world, end.converged, end.num_steps)


def _cost(cameras: Cameras, views: Views, problem: BundleProblem, loss: Loss) -> Scalar:
    """The cost of the observations and of the edges."""
    cost, edges = bundle_cost(views, problem, loss), problem.edges
    return cost if edges is None else cost + apart(lambda: edge_cost(cameras, edges))


def _equations(
    cameras: Cameras, views: Views, problem: BundleProblem, num_movable: int | None = None
) -> BundleEquations:
    """The exact gradient of the cost, and the Hessian of iteratively reweighted least squares."""
    equations, edges, m = normal_equations(views, num_movable), problem.edges, num_movable
    if edges is None:
        return equations
    gradient, hessian = apart(lambda: (edge_gradient(cameras, edges)[:m], edge_hessian(cameras, edges)[:m, :, :m]))
    return equations._replace(camera_gradient=equations.camera_gradient + gradient, edges=hessian)


def _where_free(problem: BundleProblem, new: Cameras, old: Cameras) -> Cameras:
    """New poses and lenses, but for those that are fixed."""
    poses = jnp.where(problem.free_pose[:, None], new.poses, old.poses)
    if problem.free_lens is None or new.lenses is None or old.lenses is None:
        return Cameras(poses)
    return Cameras(poses, jnp.where(problem.free_lens[:, None], new.lenses, old.lenses))


def _on_grid(values: Float[Array, " m"], slot: Int[Array, " m"], problem: BundleProblem) -> Plane:
    """Scatter values of observations to their slots; 0 elsewhere."""
    k, n = problem.weights.shape
    return jnp.zeros(k * n + 1, values.dtype).at[slot].set(values)[:-1].reshape(k, n)


class _Inputs(NamedTuple):
    """Inputs of the cost at the optimum.

    Attributes:
        cameras: Initial cameras, of which those that are fixed count.
        X_world: Initial points, of which those that are fixed count.
        problem: The problem.
        relative: Weights of the observations on the grid, without those of the points.
    """

    cameras: Cameras
    X_world: Points
    problem: BundleProblem
    relative: Plane


def _start(solution: Solution, inputs: _Inputs) -> tuple[Cameras, Points]:
    """Return the solution, with what is fixed as it was given."""
    problem = inputs.problem
    cameras = _where_free(problem, solution.cameras, inputs.cameras)
    return cameras, jnp.where(problem.free_point[None, :], solution.X_world, inputs.X_world)


@partial(jax.jit, static_argnums=0)  # traced once: derivatives need it many times
def _slope(
    loss: Loss, steps: tuple[Float[Array, "k c"], Points], solution: Solution, inputs: _Inputs
) -> tuple[Float[Array, "k c"], Points]:
    """Gradient of the cost a step away from the solution. Points without weight count where they would go."""
    start, points = _start(solution, inputs)
    cameras, X_world = shift_cameras(start, steps[0]), points + steps[1]
    idle = idle_points(cameras, X_world, inputs.problem, inputs.relative, loss)
    heard = idle.heard(inputs.problem)
    equations = _equations(cameras, bundle_views(cameras, idle.X_world, heard, loss), heard)
    return equations.camera_gradient, equations.point_gradient


def _solve_exact(
    loss: Loss, solution: Solution, inputs: _Inputs, right: tuple[Float[Array, "k c"], Points]
) -> tuple[Float[Array, "k c"], Points]:
    """Solve for a step with the exact Hessian; zero if that does not determine the cameras."""
    reduced, determined = _at_optimum(*_start(solution, inputs), inputs.problem, loss)
    camera_step, point_step = solve_reduced(reduced, *(jnp.where(determined, part, 0.0) for part in right))
    return -camera_step, -point_step


def _idle_cost(loss: Loss, cameras: Cameras, X_world: Points, inputs: _Inputs) -> Scalar:
    """Cost that a rising weight of points without any would add where they would go, less that where they are."""
    problem = inputs.problem
    idle = idle_points(cameras, X_world, problem, inputs.relative, loss)

    def cost_at(X_world: Points, weights: Plane) -> Scalar:
        counted = problem._replace(weights=jnp.where(idle.mask[None, :], weights, 0.0))
        return bundle_cost(bundle_views(cameras, X_world, problem, loss), counted, loss)

    return cost_at(idle.X_world, idle.heard(problem).weights) - cost_at(X_world, problem.weights)


def _at_optimum(cameras: Cameras, X_world: Points, problem: BundleProblem, loss: Loss) -> tuple[Reduced, Flag]:
    """The exact Hessian, eliminated, and whether it determines the cameras.

    At a strict minimum it is positive definite. A point where it is not (the solver stopped short of one, or a
    direction is free) gets its reweighted Hessian; all of them do if the cameras are undetermined still.
    """
    reweighted = _equations(cameras, bundle_views(cameras, X_world, problem, loss), problem)
    blocks = exact_blocks(cameras, X_world, problem, loss)
    convex = points_determined(blocks.point.sum(axis=2), problem.free_point) | ~problem.free_point
    rest = problem._replace(weights=jnp.where(convex[None, :], 0.0, problem.weights))
    others = normal_equations(bundle_views(cameras, X_world, rest, loss))
    mixed = BundleEquations(
        camera_gradient=reweighted.camera_gradient,
        camera_hessian=others.camera_hessian + jnp.where(convex, blocks.camera, 0.0).sum(axis=3),
        point_gradient=reweighted.point_gradient,
        point_hessian=others.point_hessian + jnp.where(convex, blocks.point.sum(axis=2), 0.0),
        cross=others.cross + jnp.where(convex, blocks.cross, 0.0),
        edges=None if problem.edges is None else exact_edge_hessian(cameras, problem.edges),
    )
    first, second = (eliminate(equations, problem, jnp.zeros_like(problem.scale)) for equations in (mixed, reweighted))
    reduced = jax.tree.map(lambda a, b: jnp.where(is_determined(first), a, b), first, second)
    determined = is_determined(reduced)
    identity = jnp.eye(reduced.factor.shape[0], dtype=reduced.factor.dtype)
    return reduced._replace(factor=jnp.where(determined, reduced.factor, identity)), determined


def _report(
    cameras: Cameras,
    X_world: Points,
    problem: BundleProblem,
    slot: Int[Array, " m"],
    loss: Loss,
    initial_cost: Scalar,
    solution: Solution,
    num_movable: int | None,
) -> BundleAdjustment:
    """Everything that is said of the final values, evaluated there."""
    views = bundle_views(cameras, X_world, problem, loss)
    equations = lax.stop_gradient(_equations(cameras, views, problem, num_movable))
    counts = (problem.weights > 0) & (views.robust_weights > 0)
    free_camera = free_cameras(problem).any(axis=1)
    adjusts = (counts & (free_camera[:, None] | problem.free_point[None, :])).any()
    if problem.edges is not None:
        ends = free_camera[problem.edges.source] | free_camera[problem.edges.target]
        adjusts = adjusts | (ends & (problem.edges.weights > 0)).any()
    determined = is_determined(eliminate(equations, problem, jnp.zeros_like(problem.scale)))
    status = jnp.select(
        [~adjusts, ~determined, ~solution.converged],
        [BundleStatus.NOTHING_TO_ADJUST, BundleStatus.DEGENERATE, BundleStatus.NOT_CONVERGED],
        BundleStatus.OK,
    )
    of_slot = lambda plane, none: jnp.append(plane.reshape(-1), jnp.asarray(none, plane.dtype))[slot]
    return BundleAdjustment(
        poses=cameras.poses,
        X_world=X_world,
        initial_cost=initial_cost,
        cost=_cost(cameras, views, problem, loss),
        status=status.astype(jnp.int32),
        num_steps=solution.num_steps,
        determined=points_determined(equations.point_hessian, jnp.ones_like(problem.free_point)),
        used=of_slot(counts, False),
        robust_weights=of_slot(views.robust_weights, 0.0),
        chi2=of_slot(views.chi2, UNKNOWN_CHI2),
        lenses=cameras.lenses,
    )


def _usable(
    cameras: Cameras, X_world: Points, observations: Observations
) -> tuple[Cameras, Points, Observations, Bool[Array, " k"]]:
    """Finite poses with unit quaternions and finite points; what observes others is no longer valid.

    Also which cameras were usable.
    """
    clean, usable = jax.vmap(usable_pose)(SE3(cameras.poses))
    lenses = cameras.lenses
    if lenses is not None:
        lenses, usable_lens = usable_lenses(lenses)
        usable = usable & usable_lens
    finite = jnp.isfinite(X_world).all(axis=0)
    camera = jnp.clip(observations.camera, 0, usable.shape[0] - 1)
    point = jnp.clip(observations.point, 0, X_world.shape[1] - 1)
    valid = observations.valid & usable[camera] & finite[point]
    X_world = jnp.where(finite[None, :], X_world, 0.0)
    return Cameras(clean.wxyz_xyz, lenses), X_world, observations._replace(valid=valid), usable


def _predicted_decrease(
    equations: BundleEquations, tangents: Float[Array, "k c"], shifts: Points, damping: Scalar
) -> Scalar:
    """Decrease of the cost that the quadratic model predicts for a damped step."""
    slope = jnp.sum(equations.camera_gradient * tangents) + jnp.sum(equations.point_gradient * shifts)
    camera_diagonal = equations.camera_diagonal()
    point_diagonal = jnp.stack([equations.point_hessian[j, j] for j in range(3)])
    raised = jnp.sum(camera_diagonal * jnp.square(tangents)) + jnp.sum(point_diagonal * jnp.square(shifts))
    return 0.5 * (damping * raised - slope)
