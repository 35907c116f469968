"""The equations of the keyframes in global bundle adjustment: a sparse matrix of blocks, summed chunk by chunk."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.bundle.point_chunk import EliminatedChunk
from jaxslam_kernels.pose_graph.cost import (
    GraphEquations,
    PoseGraphEdges,
    graph_cost,
    graph_equations,
    graph_nodes,
    graph_problem,
)
from jaxslam_kernels.pose_graph.sparse_solve import solve_blocks
from jaxslam_kernels.types import Scalar
from jaxtyping import Array, Float, Int

from jaxslam.geometry.se3 import IDENTITY, between
from jaxslam.geometry.types import Ids, Poses
from jaxslam.map.graph_edges import padded_edges
from jaxslam.map.point_records import NONE, Observations, has, rows
from jaxslam.map.types import Map
from jaxslam.mapping.local_bundle_adjustment import EDGE_PX, STRONG
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE, SINGLE_THREAD
from jaxslam.runtime.padding import padded

_EDGES = 256
"""Number of edges that are evaluated at a time."""


class WeakEdges(NamedTuple):
    """Relative poses of keyframes that share few points: those of the spanning tree, and those measured by loops.

    Attributes:
        source: `(e,)` rows of the keyframes in whose frame is measured.
        target: `(e,)` rows of the keyframes that are measured.
        T_source_target: `(e, 7)` relative poses.
        information: `(e, 6, 6)` inverse covariances: translation (m), then rotation (rad).
    """

    source: Int[np.ndarray, " e"]
    target: Int[np.ndarray, " e"]
    T_source_target: Poses
    information: Float[np.ndarray, "e 6 6"]

    def renumbered(self, place: Int[np.ndarray, " k"]) -> "WeakEdges":
        """Return the edges with other row numbers, given the new one of each row."""
        return self._replace(source=place[self.source], target=place[self.target])

    def cost(self, T_world_cam: Poses) -> float:
        """Return half the sum of the squared whitened errors."""
        starts = range(0, len(self.source), _EDGES)
        return sum((float(_edge_cost(*self._part(start, T_world_cam))) for start in starts), 0.0)

    def equations(self, start: int, T_world_cam: Poses) -> GraphEquations:
        """Return the equations of some edges, in which every end of an edge is a node of its own, first all sources."""
        return jax.device_get(_edge_equations(*self._part(start, T_world_cam)))

    def _part(self, start: int, T_world_cam: Poses) -> tuple[PoseGraphEdges, Poses]:
        some = slice(start, start + _EDGES)
        ends = np.arange(len(self.source[some]))
        poses = [padded(T_world_cam[end[some]], _EDGES, fill=IDENTITY) for end in (self.source, self.target)]
        edges = padded_edges(
            ends, _EDGES + ends, self.T_source_target[some], self.information[some], _EDGES, np.float64
        )
        return edges, np.concatenate(poses)


def weak_edges(slam_map: Map, keyframe_ids: Ids, seen: Observations) -> WeakEdges:
    """Return the edges between keyframes that share fewer than `STRONG` points, their rows those of `keyframe_ids`.

    Those of the spanning tree are as they are in the map, and as certain as in local bundle adjustment: the keyframe
    may move what it sees by a pixel.

    Args:
        slam_map: The map.
        keyframe_ids: Ascending ids of the keyframes.
        seen: Their observations of common points.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415 - see `runtime.preload`

    poses = slam_map.T_world_cam[rows(slam_map.ids, keyframe_ids)]
    points, column = np.unique(seen.point, return_inverse=True)
    row = rows(keyframe_ids, seen.keyframe)
    shape = len(keyframe_ids), len(points)
    sees = csr_array((np.ones(len(row), np.int32), (row, column)), shape=shape)
    share_few = lambda a, b: np.asarray(sees[a].multiply(sees[b]).sum(axis=1)).ravel() < STRONG
    parents = slam_map.parent[rows(slam_map.ids, keyframe_ids)]
    child = np.flatnonzero((parents != NONE) & has(keyframe_ids, parents))
    parent = rows(keyframe_ids, parents[child])
    few = share_few(parent, child)
    parent, child = parent[few], child[few]
    apart = np.linalg.norm(slam_map.points.X_world[:, rows(slam_map.points.ids, seen.point)].T - poses[row, 4:], axis=1)
    sigma = EDGE_PX / slam_map.camera.fx
    sigmas = np.array([[sigma * _median(apart[np.isin(row, ends)]), sigma] for ends in zip(parent, child, strict=True)])
    information = np.eye(6) / np.square(np.repeat(sigmas.reshape(-1, 2), 3, axis=1))[:, None, :]
    loops = slam_map.loops
    inside = np.flatnonzero(has(keyframe_ids, loops.source) & has(keyframe_ids, loops.target))
    ends = rows(keyframe_ids, loops.source[inside]), rows(keyframe_ids, loops.target[inside])
    few = share_few(*ends)
    inside = inside[few]
    return WeakEdges(
        source=np.concatenate([parent, ends[0][few]]),
        target=np.concatenate([child, ends[1][few]]),
        T_source_target=np.concatenate([between(poses[parent], poses[child]), loops.T_source_target[inside]]),
        information=np.concatenate([information, loops.information[inside]]),
    )


def _median(distances: Float[np.ndarray, " n"]) -> float:
    """Return the median; 1 m where there is nothing to see."""
    return float(np.median(distances)) if len(distances) else 1.0


class KeyframeEquations:
    """Hessian and gradient of the keyframes, to which chunks of points and edges are added."""

    def __init__(self, num_keyframes: int) -> None:
        """Start from zero."""
        from scipy.sparse import bsr_array  # noqa: PLC0415 - see `runtime.preload`

        self._diagonal, self._gradient = np.zeros((num_keyframes, 6, 6)), np.zeros((num_keyframes, 6))
        # What eliminating the points subtracts, a block for every two keyframes that observe common points.
        self._subtracted: Any = bsr_array((6 * num_keyframes, 6 * num_keyframes), blocksize=(6, 6))
        self._edges: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add_chunk(self, part: EliminatedChunk, camera: Int[np.ndarray, " m"], point: Int[np.ndarray, " m"]) -> None:
        """Add the m observations of a chunk.

        Args:
            part: The eliminated chunk, whose arrays may be longer.
            camera: `(m,)` row of the keyframe of each observation.
            point: `(m,)` column of its point in the chunk.
        """
        from scipy.sparse import bsr_array  # noqa: PLC0415 - see `runtime.preload`

        order = np.argsort(camera, kind="stable")
        cameras, first = np.unique(camera[order], return_index=True)
        self._diagonal[cameras] += np.add.reduceat(part.hessian[order], first)
        gradient = part.gradient[order] - np.einsum("mci,im->mc", part.coupling[order], part.along[:, point[order]])
        self._gradient[cameras] += np.add.reduceat(gradient, first)
        # The matrix B of `EliminatedChunk`, without the rows of keyframes that see nothing of the chunk.
        ends = np.append(first, len(order))
        shape = 6 * len(cameras), 3 * (int(point.max()) + 1)
        B = bsr_array((part.coupling[order], point[order], ends), shape=shape)
        product = (B @ B.T).tobsr(blocksize=(6, 6))
        starts = np.zeros(len(self._gradient) + 1, np.int64)
        starts[1 + cameras] = np.diff(product.indptr)
        spread = (product.data, cameras[product.indices], np.cumsum(starts))
        self._subtracted = self._subtracted + bsr_array(spread, shape=self._subtracted.shape)

    def add_edges(self, edges: WeakEdges, T_world_cam: Poses) -> None:
        """Add edges, given the poses of all keyframes."""
        for start in range(0, len(edges.source), _EDGES):
            equations = edges.equations(start, T_world_cam)
            source, target = edges.source[start : start + _EDGES], edges.target[start : start + _EDGES]
            for at, end in ((0, source), (_EDGES, target)):
                np.add.at(self._diagonal, end, equations.diagonal[at : at + len(end)])
                np.add.at(self._gradient, end, equations.gradient[at : at + len(end)])
            self._edges.append((source, target, np.asarray(equations.coupling)[: len(source)]))

    def solve(self, fixed: int, damping: float) -> Float[np.ndarray, "k 6"]:
        """Return the step `(k, 6)` of all keyframes but a fixed one; not finite if the equations are singular.

        Args:
            fixed: Row of the keyframe that does not move.
            damping: Fraction by which the diagonal of the Hessian is raised.
        """
        every = np.arange(6)
        diagonal, gradient = self._diagonal.copy(), self._gradient.copy()
        diagonal[:, every, every] *= 1 + damping
        source = np.repeat(np.arange(len(gradient)), np.diff(self._subtracted.indptr))
        target, blocks = self._subtracted.indices, self._subtracted.data
        own = source == target
        diagonal[source[own]] -= blocks[own]
        above = source < target
        source = np.concatenate([source[above], *(edge[0] for edge in self._edges)])
        target = np.concatenate([target[above], *(edge[1] for edge in self._edges)])
        coupling = np.concatenate([-blocks[above], *(edge[2] for edge in self._edges)])
        moves = (source != fixed) & (target != fixed)
        diagonal[fixed], gradient[fixed] = np.eye(6), 0
        return solve_blocks(diagonal, coupling[moves], -gradient, source[moves], target[moves])


@compiled(when="first use", options={**FAST_COMPILE, **SINGLE_THREAD})
def _edge_cost(edges: PoseGraphEdges, T_world_cam: Float[Array, "k 7"]) -> Scalar:
    nodes, usable = graph_nodes(SE3(T_world_cam), None)
    return graph_cost(nodes, graph_problem(edges, usable, 1.0, 6), "squared")[0]


@compiled(when="first use", options={**FAST_COMPILE, **SINGLE_THREAD})
def _edge_equations(edges: PoseGraphEdges, T_world_cam: Float[Array, "k 7"]) -> GraphEquations:
    nodes, usable = graph_nodes(SE3(T_world_cam), None)
    return graph_equations(nodes, graph_problem(edges, usable, 1.0, 6), "squared")
