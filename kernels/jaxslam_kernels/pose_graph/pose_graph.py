"""Optimizes a pose graph, SE(3) or Sim(3): closes loops over thousands of nodes, differentiably.

Levenberg-Marquardt on the cost of `pose_graph_cost`; each step solves the sparse normal equations, by the conjugate
gradients of `block_band` or, much faster for graphs of thousands of nodes, on the host by `pose_graph_sparse`. The
result is differentiable, forward and reverse, by the implicit function theorem at the optimum, with respect to measured
poses, scales, information, weights and loss scale: one sparse solve with the exact Hessian. The initial poses have no
derivative, but for nodes that are fixed or otherwise stay where they were. Of a weight that is exactly 0 the derivative
is the one-sided limit from above. Higher derivatives are right as well.

Source: Grisetti et al., "A Tutorial on Graph-Based SLAM", 2010; Strasdat et al., "Scale Drift-Aware Large Scale
Monocular SLAM", 2010, for Sim(3); Madsen, Nielsen and Tingleff, "Methods for Non-Linear Least Squares Problems", 2004,
section 3.2, for the damping.
"""

from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import Annotated, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.checks import checked
from jaxslam_kernels.derivative_rules import implicit_shift
from jaxslam_kernels.pose_graph.block_tridiagonal_cg import (
    GraphMatrix,
    Vector,
    conjugate_gradients,
    factorize,
    multiply,
    solve_factor,
)
from jaxslam_kernels.pose_graph.cost import (
    GraphEquations,
    GraphProblem,
    Nodes,
    PoseGraphEdges,
    Steps,
    graph_cost,
    graph_equations,
    graph_gradient,
    graph_nodes,
    graph_problem_and_idle,
    idle_cost,
    idle_gradient,
    move_nodes,
    shift_nodes,
)
from jaxslam_kernels.pose_graph.sparse_solve import solve_on_host
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import Loss
from jaxslam_kernels.types import Code, Flag, Scalar

GROUP_SIZE = 32
"""Nodes in a group of the preconditioner; at the largest `|rank[source] - rank[target]|` the factor is exact."""

Elimination = Literal["band", "host"]
"""How the normal equations are solved: in compiled code, within a band; or on the host, whatever the structure."""

_INITIAL_DAMPING = 1e-5  # relative to the diagonal of the Hessian
_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e9
_STEP_TOLERANCE = 1e-2  # of the conjugate gradients in a step


class PoseGraphStatus(IntEnum):
    """Quality of the poses. Only `OK`, `NOT_CONVERGED` and `DISCONNECTED` carry new ones."""

    OK = 0
    NOT_CONVERGED = 1
    """The steps ran out; the poses are the best found."""
    DISCONNECTED = 2
    """Some nodes have no path of edges to a fixed one: those stayed, the rest is optimal."""
    NOTHING_TO_DO = 3
    """No edge counts that leads to a free node with a path to a fixed one: no edges, no free or no fixed nodes."""
    BAD_INITIAL = 4
    """The initial pose or scale of a node in use is not finite: nothing moved, and that node came back as identity."""


class PoseGraph(NamedTuple):
    """An optimized pose graph.

    Attributes:
        T_world_cam: k poses, `wxyz_xyz` `(k, 7)`.
        scales: `(k,)` scales, all ones in SE(3).
        cost_before: `½ Σ w ρ(s)` at the initial poses.
        cost: The same at the result.
        chi2: `(e,)` squared whitened error s of every edge; 0 where there is none.
        robust_weights: `(e,)` the loss's weight `ρ'(s)` in [0, 1]; 0 where there is no edge.
        anchored: `(k,)` which nodes are fixed, or have a path of edges to a fixed one.
        status: A `PoseGraphStatus`.
        num_steps: Steps of Levenberg-Marquardt tried.
        num_iterations: Iterations of conjugate gradients, all steps together.
    """

    T_world_cam: SE3
    scales: Float[Array, " k"]
    cost_before: Scalar
    cost: Scalar
    chi2: Float[Array, " e"]
    robust_weights: Float[Array, " e"]
    anchored: Bool[Array, " k"]
    status: Code
    num_steps: Int[Array, ""]
    num_iterations: Int[Array, ""]


class _Graph(NamedTuple):
    """Constants of a solve."""

    problem: GraphProblem
    free: Bool[Array, " k"]
    rank: Int[Array, " k"]


class _Solver(NamedTuple):
    """Static settings."""

    loss: Loss
    max_steps: int
    max_iterations: int
    group_size: int
    elimination: Elimination


class _Search(NamedTuple):
    nodes: Nodes
    cost: Scalar
    equations: GraphEquations
    damping: Scalar
    growth: Scalar
    num_steps: Int[Array, ""]
    num_iterations: Int[Array, ""]
    converged: Flag


@checked
def optimize_pose_graph(
    T_world_cam: Annotated[SE3, "k"],
    edges: PoseGraphEdges,
    fixed: Bool[Array, " k"],
    *,
    scales: Float[Array, " k"] | None = None,
    mask: Bool[Array, " k"] | None = None,
    rank: Int[Array, " k"] | None = None,
    loss: Loss = "squared",
    loss_scale: Scalar | float = 1.0,
    max_steps: int = 50,
    max_iterations: int = 200,
    group_size: int = GROUP_SIZE,
    elimination: Elimination = "band",
) -> PoseGraph:
    """The poses that agree best with the measured relative poses.

    An edge does not count if anything in it is not finite, if it leads to no node in use or from a node to itself, or
    if its information is not positive definite: what would be undetermined stays where it was, and is not moved.

    Args:
        T_world_cam: k initial poses, `wxyz_xyz` `(k, 7)`.
        edges: e measured relative poses; with scales and 7 x 7 information for Sim(3).
        fixed: `(k,)` nodes that stay. At least one in every connected part, or the part stays as a whole.
        scales: `(k,)` positive initial scales: Sim(3). `None`: SE(3).
        mask: `(k,)` which slots hold a node; all by default.
        rank: `(k,)` a permutation, each node's place in the order of elimination, from `band_rank`; the given order
            by default, which suits a chain with few loops. It changes the time and not the result.
        loss: The robust loss, static.
        loss_scale: Its scale in standard deviations, traced.
        max_steps: Bound on the steps, static.
        max_iterations: Bound on the iterations of conjugate gradients in a step, static.
        group_size: Nodes in a group of the preconditioner, static; see `suitable_group_size`.
        elimination: Solver of the normal equations, static. "host" calls back to SciPy from compiled code, and
            then `rank`, `max_iterations` and `group_size` matter to derivatives only, or not at all.

    Returns:
        A `PoseGraph`; everything in it is finite, and so are its derivatives.
    """
    mask = jnp.ones_like(fixed) if mask is None else mask
    initial, usable = graph_nodes(T_world_cam, scales)
    dimension = 6 if scales is None else 7
    problem, idle = apart(lambda: graph_problem_and_idle(edges, mask & usable, loss_scale, dimension))
    anchored = _anchored(problem, fixed & mask & usable)
    solver = _Solver(loss, max_steps, max_iterations, group_size, elimination)
    bad_initial = (mask & ~usable).any()
    graph = _Graph(problem, anchored & ~fixed & ~bad_initial, jnp.arange(fixed.size) if rank is None else rank)
    end = _solve(lax.stop_gradient(initial), lax.stop_gradient(graph), solver)
    idle = _within_anchored(idle, anchored)
    found, inputs = _Optimum(end.nodes, end.converged, graph), (initial, problem, idle)
    like = jnp.zeros((fixed.size, problem.information.shape[1]), initial.dtype)
    optimum = found.shifted(
        implicit_shift(partial(_slope, solver), partial(_solve_exact, solver), like, found, inputs), initial
    )
    status = _status(graph, bad_initial, end.converged, (mask & ~anchored).any())
    cost, chi2, robust_weights = graph_cost(optimum, problem, loss)
    return PoseGraph(
        T_world_cam=SE3(optimum[:, :7]),
        scales=jnp.exp(optimum[:, 7]),
        cost_before=graph_cost(initial, problem, loss)[0] + idle_cost(initial, idle, loss),
        cost=cost + idle_cost(optimum, idle, loss),
        chi2=chi2,
        robust_weights=robust_weights,
        anchored=anchored,
        status=status,
        num_steps=end.num_steps,
        num_iterations=end.num_iterations,
    )


def _within_anchored(idle: GraphProblem, anchored: Bool[Array, " k"]) -> GraphProblem:
    """Take out the edges of weight 0 that would connect nodes without a path to a fixed one.

    Such an edge is fitted exactly, however small its weight.
    """
    counts = anchored[idle.source] == anchored[idle.target]
    return idle._replace(weights=jnp.where(counts, idle.weights, 0.0))


def _status(graph: _Graph, bad_initial: Flag, converged: Flag, disconnected: Flag) -> Code:
    """Status of a result: the first condition that applies."""
    used = graph.problem.weights > 0
    touched = jnp.zeros_like(graph.free).at[graph.problem.source].max(used).at[graph.problem.target].max(used)
    return jnp.select(
        [bad_initial, ~(touched & graph.free).any(), ~converged, disconnected],
        [
            PoseGraphStatus.BAD_INITIAL,
            PoseGraphStatus.NOTHING_TO_DO,
            PoseGraphStatus.NOT_CONVERGED,
            PoseGraphStatus.DISCONNECTED,
        ],
        PoseGraphStatus.OK,
    ).astype(jnp.int32)


def _anchored(problem: GraphProblem, fixed: Bool[Array, " k"]) -> Bool[Array, " k"]:
    """Find nodes with a path to a fixed node: labels fall to the smallest label of the neighbors until none changes."""
    k, used = fixed.shape[0], problem.weights > 0
    source, target = problem.source, problem.target

    def spread(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        least = jnp.where(used, jnp.minimum(labels[source], labels[target]), k)
        new = labels.at[labels[source]].min(least).at[labels[target]].min(least)
        new = new.at[source].min(least).at[target].min(least)
        new = new[new]  # halves the way to the root
        return new, (new != labels).any()

    labels, _ = lax.while_loop(lambda state: state[1], spread, (jnp.arange(k), jnp.array(True)))
    return jnp.zeros(k, bool).at[labels].max(fixed)[labels]


def _solve(initial: Nodes, graph: _Graph, solver: _Solver) -> _Search:
    dtype, k = initial.dtype, initial.shape[0]
    epsilon = float(jnp.finfo(dtype).eps)
    one, none = jnp.ones((), dtype), jnp.zeros((), jnp.int32)
    cost, _, _ = graph_cost(initial, graph.problem, solver.loss)
    equations = graph_equations(initial, graph.problem, solver.loss)
    has_work = graph.free.any() & (graph.problem.weights > 0).any()
    start = _Search(initial, cost, equations, _INITIAL_DAMPING * one, 2.0 * one, none, none, ~has_work)

    def step(s: _Search) -> _Search:
        matrix = _system(s.equations, graph, s.damping)
        gradient = jnp.where(graph.free[:, None], s.equations.gradient, 0.0)
        steps, iterations = _linear_solve(matrix, -gradient, graph, solver)
        trial = move_nodes(s.nodes, steps)
        trial_cost, _, _ = graph_cost(trial, graph.problem, solver.loss)
        damped = s.damping * jnp.sum(steps * _diagonal(s.equations, graph) * steps)
        promised = 0.5 * (damped - jnp.sum(gradient * steps))
        won = s.cost - trial_cost
        better = (won > 0) & jnp.isfinite(trial_cost)
        gain = won / jnp.where(promised > 0, promised, 1.0)
        short = promised <= jnp.maximum(epsilon * k, 8.0 * epsilon * s.cost)
        level = jnp.abs(won) <= 8.0 * epsilon * s.cost
        eased = jnp.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        damping = jnp.clip(s.damping * jnp.where(better, eased, s.growth), _MIN_DAMPING, _MAX_DAMPING)
        nodes, cost = jnp.where(better, trial, s.nodes), jnp.where(better, trial_cost, s.cost)
        return _Search(
            nodes=nodes,
            cost=cost,
            equations=lax.cond(better, lambda: graph_equations(nodes, graph.problem, solver.loss), lambda: s.equations),
            damping=damping,
            growth=jnp.where(better, 2.0, 2.0 * s.growth),
            num_steps=s.num_steps + 1,
            num_iterations=s.num_iterations + iterations,
            converged=short | level,
        )

    return lax.while_loop(lambda s: ~s.converged & (s.num_steps < solver.max_steps), step, start)


def _linear_solve(matrix: GraphMatrix, right: Steps, graph: _Graph, solver: _Solver) -> tuple[Steps, Int[Array, ""]]:
    precondition = _preconditioner(matrix, graph, solver)
    if solver.elimination == "host":
        return precondition(right), jnp.ones((), jnp.int32)
    return conjugate_gradients(
        partial(multiply, matrix), precondition, right, tolerance=_STEP_TOLERANCE, max_steps=solver.max_iterations
    )


def _preconditioner(matrix: GraphMatrix, graph: _Graph, solver: _Solver) -> Callable[[Vector], Vector]:
    """The inverse of the matrix, exact on the host and as good as the band is otherwise."""
    if solver.elimination == "host":
        return partial(solve_on_host, matrix)
    return partial(solve_factor, factorize(matrix, graph.rank, solver.group_size))


def _diagonal(equations: GraphEquations, graph: _Graph) -> Steps:
    """Scale of the damping: the diagonal of the Hessian, and one for fixed nodes."""
    diagonal = jnp.diagonal(equations.diagonal, axis1=1, axis2=2)
    largest = jnp.max(diagonal) if diagonal.size else 0.0
    floor = jnp.finfo(diagonal.dtype).eps * largest + jnp.finfo(diagonal.dtype).tiny * 1e8
    return jnp.where(graph.free[:, None], jnp.maximum(diagonal, floor), 1.0)


def _system(equations: GraphEquations, graph: _Graph, damping: Scalar | float) -> GraphMatrix:
    """The damped normal equations, with identity rows for nodes that stay."""
    free, problem = graph.free, graph.problem
    d = equations.diagonal.shape[1]
    eye = jnp.eye(d, dtype=equations.diagonal.dtype)[None]
    blocks = equations.diagonal + eye * (damping * _diagonal(equations, graph))[:, :, None]
    both = free[problem.source] & free[problem.target] & (problem.weights > 0)
    coupling = jnp.where(both[:, None, None], equations.coupling, 0.0)
    return GraphMatrix(jnp.where(free[:, None, None], blocks, eye), coupling, problem.source, problem.target)


class _Optimum(NamedTuple):
    """The optimum that was found, a constant.

    Attributes:
        nodes: The nodes at the end of the search.
        converged: Whether the search converged.
        graph: The graph.
    """

    nodes: Nodes
    converged: Flag
    graph: _Graph

    def shifted(self, steps: Steps, initial: Nodes) -> Nodes:
        """Return the free nodes a step from the optimum, and the others as they are given."""
        return shift_nodes(self.where_free(self.nodes, initial), self.where_free(steps, jnp.zeros_like(steps)))

    def where_free(self, of_free: Array, of_others: Array) -> Array:
        """Return one array for the free nodes, and another for those that stay."""
        return jnp.where(self.graph.free[:, None], of_free, of_others)


_Inputs: TypeAlias = tuple[Nodes, GraphProblem, GraphProblem]
"""Initial nodes, of which those that stay count; the problem; and its idle edges."""


def _slope(solver: _Solver, steps: Steps, optimum: _Optimum, inputs: _Inputs) -> Steps:
    """Gradient of the cost a step away from the optimum; of nodes that stay, the step."""
    initial, problem, idle = inputs
    nodes = optimum.shifted(steps, initial)
    gradient = graph_gradient(nodes, problem, solver.loss) + idle_gradient(nodes, idle, idle.weights, solver.loss)
    return optimum.where_free(gradient, steps)


def _solve_exact(solver: _Solver, optimum: _Optimum, inputs: _Inputs, right: Steps) -> Steps:
    """Solve with the exact Hessian, preconditioned by the reweighted one; zero where the search did not converge."""
    graph, zero = optimum.graph, jnp.zeros_like(right)

    def gradient(steps: Steps) -> Steps:  # without the idle edges, whose weights are zero
        return graph_gradient(optimum.shifted(steps, inputs[0]), graph.problem, solver.loss)

    def hessian(steps: Steps) -> Steps:
        return optimum.where_free(jax.jvp(gradient, (zero,), (steps,))[1], steps)

    epsilon = float(jnp.finfo(right.dtype).eps)
    nodes = optimum.shifted(zero, inputs[0])
    matrix = _system(graph_equations(nodes, graph.problem, solver.loss), graph, _MIN_DAMPING)
    precondition = _preconditioner(matrix, graph, solver)
    right = jnp.where(graph.free[:, None] & optimum.converged, right, 0.0)
    return conjugate_gradients(
        hessian, precondition, right, tolerance=epsilon**0.75, max_steps=4 * solver.max_iterations
    )[0]
