"""The cost of a pose graph: measured relative poses, SE(3) or Sim(3), robust, with exact derivatives.

A node is a pose `T_world_cam` and, in Sim(3), a scale: camera coordinates times the scale lie in the world's unit. An
edge measures `T_source_target`, and in Sim(3) the ratio of the scales. With E the measured relative pose inverted
times the estimated one, the error of an edge and its squared norm are

    e = (translation of E, 2 sgn(q_w) q_xyz of E, log scale of E),    s = eᵀ Λ e,

so translation comes first, and the rotation has `2 sin(θ/2)` in place of the angle, smooth everywhere below π: no
logarithm, whose reverse derivative at the identity is NaN in jaxlie. It is the error of Ceres' pose-graph example and,
with isotropic information, of SE-Sync's objective; g2o's leaves out the 2. The cost is `½ Σ w ρ(s)`.
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from jaxslam_kernels.derivative_rules import only_derivative
from jaxslam_kernels.pose.pose_cost import retract, shifted
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import LARGEST_SQUARED, Loss, loss_value, loss_weight
from jaxslam_kernels.se3 import between, cross_matrix
from jaxslam_kernels.types import Scalar

Nodes = Float[Array, "k 8"]
"""`wxyz_xyz` of each `T_world_cam`, and the logarithm of its scale, 0 in SE(3)."""
Steps = Float[Array, "k d"]
"""A tangent a node, d = 6 or 7: translation in the camera's axes (world's unit), rotation, log scale."""
Blocks = Float[Array, "e d d"]

_SMALLEST_PIVOT = 1e-6  # of an information matrix scaled to unit diagonal; below it a direction is unmeasured


class PoseGraphEdges(NamedTuple):
    """Relative measurements between nodes, in arrays of fixed length e.

    Attributes:
        source: `(e,)` indices of the nodes in whose frame is measured.
        target: `(e,)` indices of the nodes that are measured.
        T_source_target: e measured poses, `wxyz_xyz` `(e, 7)`, translation in the unit of the source's camera.
        information: `(e, 6, 6)` inverse covariances of the error, or `(e, 7, 7)` with scales. The symmetric part
            counts.
        weights: `(e,)` non-negative factors of each edge's cost.
        mask: `(e,)` which slots hold an edge.
        scales: `(e,)` measured scale of the target over that of the source, all positive; `None` in SE(3).
    """

    source: Int[Array, " e"]
    target: Int[Array, " e"]
    T_source_target: Annotated[SE3, "e"]
    information: Blocks
    weights: Float[Array, " e"]
    mask: Bool[Array, " e"]
    scales: Float[Array, " e"] | None = None


class GraphProblem(NamedTuple):
    """Clean edges: everything finite and in range, weight 0 where there is none.

    Attributes:
        source: Index of the first node, 0 without an edge.
        target: Index of the second node, 0 without an edge.
        measured: `wxyz_xyz` and log scale.
        information: Symmetric, positive definite.
        weights: Factor of each edge's cost.
        loss_scale: Scale of the robust loss, in standard deviations.
    """

    source: Int[Array, " e"]
    target: Int[Array, " e"]
    measured: Float[Array, "e 8"]
    information: Blocks
    weights: Float[Array, " e"]
    loss_scale: Scalar


class GraphEquations(NamedTuple):
    """Normal equations of the graph by blocks, of iteratively reweighted least squares.

    Attributes:
        gradient: Gradient of the cost, one tangent per node.
        diagonal: `(k, d, d)`, the block of each node.
        coupling: `(e, d, d)`, rows of the source and columns of the target.
    """

    gradient: Steps
    diagonal: Float[Array, "k d d"]
    coupling: Blocks


def graph_nodes(T_world_cam: SE3, scales: Float[Array, " k"] | None) -> tuple[Nodes, Bool[Array, " k"]]:
    """Poses and scales in one array, and which of them are usable; the others become the identity."""
    return _similarities(T_world_cam, scales)


def graph_problem(
    edges: PoseGraphEdges, usable_node: Bool[Array, " k"], loss_scale: Scalar | float, dimension: int
) -> GraphProblem:
    """Cleans the edges: one that is not finite, leads nowhere or to itself, or measures less than all, has weight 0."""
    return graph_problem_and_idle(edges, usable_node, loss_scale, dimension)[0]


def graph_problem_and_idle(
    edges: PoseGraphEdges, usable_node: Bool[Array, " k"], loss_scale: Scalar | float, dimension: int
) -> tuple[GraphProblem, GraphProblem]:
    """The problem of `graph_problem`, and the idle edges: those of weight exactly 0 that are usable otherwise.

    Idle edges have no influence on the optimum, but the derivative by their weight is not zero. The second problem
    holds them alone, in their rows; its weights are all 0 and carry the derivative.
    """
    k, dtype = usable_node.shape[0], edges.information.dtype
    scale = jnp.asarray(loss_scale, dtype)
    usable_scale = jnp.isfinite(scale) & (scale > 0)
    measured, finite = _similarities(edges.T_source_target, edges.scales)
    ends = jnp.stack([edges.source, edges.target])
    inside = (ends >= 0) & (ends < k)
    source, target = jnp.where(inside.all(axis=0), ends, 0)
    information = 0.5 * (edges.information + edges.information.swapaxes(1, 2))
    used = edges.mask & finite & inside.all(axis=0) & (source != target) & usable_node[source] & usable_node[target]
    finite = used & jnp.isfinite(edges.weights)
    identity = jnp.zeros(8, dtype).at[0].set(1.0)

    def problem_of(used: Bool[Array, " e"]) -> GraphProblem:
        return GraphProblem(
            source=jnp.where(used, source, 0),
            target=jnp.where(used, target, 0),
            measured=jnp.where(used[:, None], measured, identity[None, :]),
            information=jnp.where(used[:, None, None], information, jnp.eye(dimension, dtype=dtype)[None]),
            weights=jnp.where(used, edges.weights, 0.0),
            loss_scale=jnp.where(usable_scale, scale, 1.0),
        )

    measures_all = _measures_all(information)
    used, idle = (finite & chosen & usable_scale & measures_all for chosen in (edges.weights > 0, edges.weights == 0))
    return problem_of(used), problem_of(idle)


def edge_errors(nodes: Nodes, problem: GraphProblem) -> Float[Array, "e d"]:
    """The error of every edge, the first d of (translation, rotation, log scale)."""
    errors = jax.vmap(_error)(nodes[problem.source], nodes[problem.target], problem.measured)
    return errors[:, : problem.information.shape[1]]


def edge_jacobians(nodes: Nodes, problem: GraphProblem) -> tuple[Blocks, Blocks]:
    """Derivatives of the errors along the tangents of source and target."""
    d = problem.information.shape[1]
    by_source, by_target = jax.vmap(_jacobians)(nodes[problem.source], nodes[problem.target], problem.measured)
    return by_source[:, :d, :d], by_target[:, :d, :d]


def graph_cost(
    nodes: Nodes, problem: GraphProblem, loss: Loss
) -> tuple[Scalar, Float[Array, " e"], Float[Array, " e"]]:
    """The cost, and of every edge the squared norm of its error and `ρ'` of that; 0 and 0 where there is no edge."""
    errors = edge_errors(nodes, problem)
    used = problem.weights > 0
    chi2 = jnp.where(used, jnp.einsum("mi,mij,mj->m", errors, problem.information, errors), 0.0)
    robust = jnp.where(used, loss_weight(chi2, problem.loss_scale, loss), 0.0)
    return 0.5 * jnp.sum(problem.weights * loss_value(chi2, problem.loss_scale, loss)), chi2, robust


def graph_gradient(nodes: Nodes, problem: GraphProblem, loss: Loss) -> Steps:
    """The exact derivative of the cost along the tangent of every node."""
    by_source, by_target, weighted = _weighted(nodes, problem, loss)
    pull = jnp.einsum("mij,mj->mi", weighted, edge_errors(nodes, problem))
    return _gather_gradient(nodes, problem, by_source, by_target, pull)


def idle_gradient(nodes: Nodes, idle: GraphProblem, change: Float[Array, " e"], loss: Loss) -> Steps:
    """The gradient of the idle edges for the weights `change`, linear in those."""
    heard = _heard(nodes, idle, loss)
    of_weights = lambda weights: graph_gradient(nodes, idle._replace(weights=weights), loss)
    return jax.jvp(of_weights, (heard,), (jnp.where(heard > 0, change, 0.0),))[1]


def idle_cost(nodes: Nodes, idle: GraphProblem, loss: Loss) -> Scalar:
    """The cost of the idle edges: zero, with its derivatives by their weights."""
    return only_derivative(partial(_idle_cost, loss), jnp.zeros((), nodes.dtype), nodes, idle)


def _idle_cost(loss: Loss, nodes: Nodes, idle: GraphProblem) -> Scalar:
    heard = _heard(nodes, idle, loss)
    _, chi2, _ = graph_cost(nodes, idle._replace(weights=heard), loss)
    return 0.5 * jnp.sum(jnp.where(heard > 0, idle.weights, 0.0) * loss_value(chi2, idle.loss_scale, loss))


def _heard(nodes: Nodes, idle: GraphProblem, loss: Loss) -> Float[Array, " e"]:
    """1 for each edge whose error the loss can tell from an overflow, 0 for others."""
    _, chi2, _ = graph_cost(nodes, idle._replace(weights=jnp.ones_like(idle.weights)), loss)
    return lax.stop_gradient(jnp.where(chi2 < LARGEST_SQUARED, 1.0, 0.0).astype(chi2.dtype))


def graph_equations(nodes: Nodes, problem: GraphProblem, loss: Loss) -> GraphEquations:
    """Gradient and Gauss-Newton Hessian."""
    by_source, by_target, weighted = _weighted(nodes, problem, loss)
    pull = jnp.einsum("mij,mj->mi", weighted, edge_errors(nodes, problem))
    left, right = weighted @ by_source, weighted @ by_target
    d = weighted.shape[1]
    diagonal = jnp.zeros((nodes.shape[0], d, d), nodes.dtype)
    diagonal = diagonal.at[problem.source].add(by_source.swapaxes(1, 2) @ left)
    diagonal = diagonal.at[problem.target].add(by_target.swapaxes(1, 2) @ right)
    gradient = _gather_gradient(nodes, problem, by_source, by_target, pull)
    return GraphEquations(gradient, diagonal, by_source.swapaxes(1, 2) @ right)


def move_nodes(nodes: Nodes, steps: Steps) -> Nodes:
    """The nodes a step further, quaternions of unit length."""
    poses = jax.vmap(lambda node, step: retract(SE3(node[:7]), step[:6]).wxyz_xyz)(nodes, steps)
    return _with_log_scale(poses, nodes, steps)


def shift_nodes(nodes: Nodes, steps: Steps) -> Nodes:
    """`move_nodes` for steps that are zero but for their derivatives: the nodes stay as they are, to the last bit."""
    poses = jax.vmap(lambda node, step: shifted(SE3(node[:7]), step[:6]).wxyz_xyz)(nodes, steps)
    return _with_log_scale(poses, nodes, steps)


def _with_log_scale(poses: Array, nodes: Nodes, steps: Steps) -> Nodes:
    log_scale = nodes[:, 7] + steps[:, 6] if steps.shape[1] == 7 else nodes[:, 7]
    return jnp.concatenate([poses, log_scale[:, None]], axis=1)


def _error(source: Array, target: Array, measured: Array) -> Float[Array, "7"]:
    E, _, _ = _difference(source, target, measured)
    q = E.wxyz_xyz[:4]
    sign = jnp.where(q[0] < 0, -1.0, 1.0)  # q and -q are the same rotation
    log_scale = target[7] - source[7] - measured[7]
    return jnp.concatenate([E.translation() * jnp.exp(-measured[7]), 2.0 * sign * q[1:], log_scale[None]])


def _jacobians(source: Array, target: Array, measured: Array) -> tuple[Float[Array, "7 7"], Float[Array, "7 7"]]:
    """With u the target in the source's frame: `u' = u - v + u × ω - u σ` for a step (v, ω, σ) of the source."""
    E, T_ab, u = _difference(source, target, measured)
    w, v = E.wxyz_xyz[0], E.wxyz_xyz[1:4]
    sign = jnp.where(w < 0, -1.0, 1.0)
    identity, zero, column = np.eye(3, dtype=w.dtype), jnp.zeros((3, 3), w.dtype), jnp.zeros((3, 1), w.dtype)
    R_measured = apart(SE3(measured[:7]).rotation().as_matrix).T
    to_error = R_measured * jnp.exp(-measured[7])
    shrink = jnp.exp(-source[7])
    one = jnp.ones((1, 1), w.dtype)
    by_source = [
        [-shrink * to_error, to_error @ cross_matrix(u), -(to_error @ u)[:, None]],
        [zero, -sign * (w * identity - cross_matrix(v)) @ R_measured, column],
        [column.T, column.T, -one],
    ]
    by_target = [
        [shrink * to_error @ apart(T_ab.rotation().as_matrix), zero, column],
        [zero, sign * (w * identity + cross_matrix(v)), column],
        [column.T, column.T, one],
    ]
    return jnp.block(by_source), jnp.block(by_target)


def _difference(source: Array, target: Array, measured: Array) -> tuple[SE3, SE3, Float[Array, "3"]]:
    T_ab = between(SE3(source[:7]), SE3(target[:7]))
    u = T_ab.translation() * jnp.exp(-source[7])
    return between(SE3(measured[:7]), SE3(jnp.concatenate([T_ab.wxyz_xyz[:4], u]))), T_ab, u


def _weighted(nodes: Nodes, problem: GraphProblem, loss: Loss) -> tuple[Blocks, Blocks, Blocks]:
    """Jacobians of both sides, and the information times all weights."""
    _, _, robust = graph_cost(nodes, problem, loss)
    weighted = problem.information * (problem.weights * robust)[:, None, None]
    return *edge_jacobians(nodes, problem), weighted


def _gather_gradient(nodes: Nodes, problem: GraphProblem, by_source: Blocks, by_target: Blocks, pull: Array) -> Steps:
    gradient = jnp.zeros((nodes.shape[0], pull.shape[1]), nodes.dtype)
    gradient = gradient.at[problem.source].add(jnp.einsum("mij,mi->mj", by_source, pull))
    return gradient.at[problem.target].add(jnp.einsum("mij,mi->mj", by_target, pull))


def _similarities(T: SE3, scales: Array | None) -> tuple[Float[Array, "n 8"], Bool[Array, " n"]]:
    parameters = T.wxyz_xyz
    scales = jnp.ones(parameters.shape[0], parameters.dtype) if scales is None else scales
    length2 = jnp.sum(jnp.square(parameters[:, :4]), axis=1)
    usable = jnp.isfinite(parameters).all(axis=1) & (length2 > 1e-6) & jnp.isfinite(scales) & (scales > 0)
    identity = jnp.zeros(7, parameters.dtype).at[0].set(1.0)
    safe = jnp.where(usable[:, None], parameters, identity[None, :])
    q = safe[:, :4] * lax.rsqrt(jnp.sum(jnp.square(safe[:, :4]), axis=1, keepdims=True))
    log_scale = jnp.log(jnp.where(usable, scales, 1.0))
    return jnp.concatenate([q, safe[:, 4:], log_scale[:, None]], axis=1), usable


def _measures_all(information: Blocks) -> Bool[Array, " e"]:
    """Whether no direction of an edge is free: finite and positive definite, clear of rounding."""
    information = lax.stop_gradient(information)
    diagonal = jnp.diagonal(information, axis1=1, axis2=2)
    usable = jnp.isfinite(information).all(axis=(1, 2)) & (diagonal > 0).all(axis=1)
    unit = lax.rsqrt(jnp.where(usable[:, None], diagonal, 1.0))
    eye = jnp.eye(information.shape[1], dtype=information.dtype)[None]
    scaled = jnp.where(usable[:, None, None], information * unit[:, :, None] * unit[:, None, :], eye)
    pivots = jnp.square(jnp.diagonal(jnp.linalg.cholesky(scaled), axis1=1, axis2=2))
    return usable & (pivots > _SMALLEST_PIVOT).all(axis=1)  # NaN compares false
