"""Measured relative poses between the cameras of a bundle adjustment: the edges of a pose graph, with squared loss.

They hold together what few points connect, as odometry does for a camera that turns away. Their errors and
derivatives are those of `pose_graph.cost`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam_kernels.bundle.lens import Cameras
from jaxslam_kernels.pose_graph.cost import (
    GraphProblem,
    Nodes,
    graph_cost,
    graph_equations,
    graph_gradient,
    shift_nodes,
)
from jaxslam_kernels.types import Scalar

EdgeHessian = Float[Array, "k c k c"]
"""Second derivatives of the edges' cost by every two cameras."""


def edge_cost(cameras: Cameras, edges: GraphProblem) -> Scalar:
    """Half the sum of the squared whitened errors of the edges."""
    return graph_cost(_nodes(cameras), edges, "squared")[0]


def edge_gradient(cameras: Cameras, edges: GraphProblem) -> Float[Array, "k c"]:
    """Gradient of the edges' cost along the right tangents of the poses; 0 by the lenses."""
    return jnp.pad(graph_gradient(_nodes(cameras), edges, "squared"), ((0, 0), (0, _num_lens_values(cameras))))


def edge_hessian(cameras: Cameras, edges: GraphProblem) -> EdgeHessian:
    """The Gauss-Newton Hessian of the edges' cost."""
    equations = graph_equations(_nodes(cameras), edges, "squared")
    k, d = equations.gradient.shape
    every = jnp.arange(k)
    blocks = jnp.zeros((k, k, d, d), equations.gradient.dtype).at[every, every].set(equations.diagonal)
    blocks = blocks.at[edges.source, edges.target].add(equations.coupling)
    blocks = blocks.at[edges.target, edges.source].add(equations.coupling.swapaxes(1, 2))
    return _with_lens_values(blocks.transpose(0, 2, 1, 3), cameras)


def exact_edge_hessian(cameras: Cameras, edges: GraphProblem) -> EdgeHessian:
    """The exact Hessian of the edges' cost, at an optimum: elsewhere the turning of the tangents would add to it."""
    nodes = _nodes(cameras)

    def gradient(steps: Float[Array, "k 6"]) -> Float[Array, "k 6"]:
        return graph_gradient(shift_nodes(nodes, steps), edges, "squared")

    hessian = jax.jacfwd(gradient)(jnp.zeros((nodes.shape[0], 6), nodes.dtype))
    return _with_lens_values(0.5 * (hessian + hessian.transpose(2, 3, 0, 1)), cameras)


def _nodes(cameras: Cameras) -> Nodes:
    return jnp.pad(cameras.poses, ((0, 0), (0, 1)))  # the logarithm of a scale of one


def _num_lens_values(cameras: Cameras) -> int:
    return 0 if cameras.lenses is None else cameras.lenses.shape[1]


def _with_lens_values(hessian: Float[Array, "k 6 k 6"], cameras: Cameras) -> EdgeHessian:
    more = _num_lens_values(cameras)
    return jnp.pad(hessian, ((0, 0), (0, more), (0, 0), (0, more)))
