"""The pose graph of a submap, and whether it can bear a loop.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III-C, for the edges: tree, strong covisibility, loops.
"""

import threading
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxslam_kernels.pose_graph.pose_graph import PoseGraphStatus, band_rank, optimize_pose_graph

from jaxslam.geometry.se3 import IDENTITY, angle, between
from jaxslam.map.types import NONE, Map, has, rows, visibility
from jaxslam.runtime.compile_cache import FAST_COMPILE
from jaxslam.runtime.padding import padded
from jaxslam.runtime.trace_cache import cached_trace

_STRONG = 100
"""Points in common from which covisible keyframes are tied (ORB-SLAM's essential graph)."""
_EDGE_M, _EDGE_M_PER_M, _EDGE_RAD, _EDGE_RAD_PER_RAD = 0.005, 0.005, 0.002, 0.005
"""Standard deviation of the relative pose of two keyframes, and its growth with distance and angle, for the errors of
calibration. In the synthetic room it is 3 mm and 0.7 mrad at 0.6 m and 20 degrees; recordings are worse."""
_MAX_CHI2 = 16.8
"""Most that a loop may add to the squared whitened error of the graph: 99 % of six degrees of freedom. At the optimum
that is the square of its contradiction, in standard deviations of loop and graph together."""
_SIZES = (64, 256, 1024, 4096)
"""Keyframes a graph has room for; each size is compiled once."""
_EDGES_A_NODE = 6
_FEWEST, _AHEAD = 4, 2.0
"""Keyframes of a map from which graphs are compiled, and for how many times as many as there are."""
_ONE_AT_A_TIME = {size: threading.Lock() for size in _SIZES}
"""Two threads would each compile the same; those of different sizes need not wait for each other."""


class _Graph(NamedTuple):
    source: np.ndarray
    target: np.ndarray
    T_source_target: np.ndarray
    information: np.ndarray


def poses_with_loop(
    slam_map: Map, source: int, target: int, T_source_target: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The poses that suit a loop and all relative poses of its submap, if that is within their uncertainty.

    Args:
        slam_map: The map.
        source: Id of a keyframe.
        target: Id of another one of the same submap.
        T_source_target: `(7,)` measured.
        information: `(6, 6)` its inverse covariance.

    Returns:
        Ids of the keyframes of the submap and their poses, the first one's as it was; `None` if the loop contradicts
        the graph, or the submap has more than 4096 keyframes.
    """
    inside = np.flatnonzero(slam_map.submap == slam_map.submap[slam_map.row(target)])
    if len(inside) > _SIZES[-1]:
        return None
    ids, poses = slam_map.ids[inside], slam_map.T_world_cam[inside]
    ends = rows(ids, np.array([source, target]))[:, None]
    graph = _graph(slam_map, inside)
    with_loop = _Graph(
        np.append(graph.source, ends[0]),
        np.append(graph.target, ends[1]),
        np.concatenate([graph.T_source_target, T_source_target[None]]),
        np.concatenate([graph.information, information[None]]),
    )
    before, after = (_solved(g, poses, slam_map.parent[inside] == NONE) for g in (graph, with_loop))
    if after.status != PoseGraphStatus.OK or after.chi2.sum() - before.chi2.sum() > _MAX_CHI2:
        return None
    return ids, np.asarray(after.T_world_cam.wxyz_xyz[: len(ids)], np.float64)


def compile_graph(num_keyframes: int = 2) -> None:
    """Compile the optimization of graphs of the size that so many keyframes take."""
    graph = _Graph(np.array([0]), np.array([1]), IDENTITY[None], np.eye(6)[None])
    _solved(graph, np.tile(IDENTITY, (num_keyframes, 1)), np.arange(num_keyframes) == 0)


class GraphCompiler:
    """Compiles the optimization of larger graphs in a thread of its own, before a loop needs it.

    When one did first, that frame took 2.9 s on an EPYC, 2.3 of them compiling.
    """

    def __init__(self) -> None:
        """Begin with nothing compiled."""
        self._size = 0

    def compile_now(self) -> None:
        """Compile the smallest graph, and wait for it."""
        compile_graph()
        self._size = _SIZES[0]

    def keep_ahead(self, num_keyframes: int) -> None:
        """Begin to compile what a map will need soon that has so many keyframes; returns at once."""
        size = next((size for size in _SIZES if size >= _AHEAD * num_keyframes), 0)
        if num_keyframes >= _FEWEST and size > self._size:
            self._size = size
            # No daemon: at its end, the interpreter waits for it instead of pulling the compiler out of its hands.
            threading.Thread(target=compile_graph, args=(size,), name="jaxslam-compile").start()


def _graph(slam_map: Map, inside: np.ndarray) -> _Graph:
    """Rows of both ends, relative poses and information of all edges: tree, strong covisibility, loops."""
    ids, poses = slam_map.ids[inside], slam_map.T_world_cam[inside]
    child = np.flatnonzero(slam_map.parent[inside] != NONE)
    tree = np.stack([rows(ids, slam_map.parent[inside][child]), child])
    seen = visibility(slam_map)[inside]
    shared = (seen @ seen.T).tocoo()
    strong = np.flatnonzero((shared.data >= _STRONG) & (shared.row < shared.col))
    strong = strong[np.argsort(-shared.data[strong], kind="stable")]
    pairs = np.concatenate([tree, np.stack([shared.row[strong], shared.col[strong]])], axis=1)
    _, first = np.unique(np.sort(pairs, axis=0), axis=1, return_index=True)
    old = np.flatnonzero(has(ids, slam_map.loops.source) & has(ids, slam_map.loops.target))
    ends = np.stack([rows(ids, slam_map.loops.source[old]), rows(ids, slam_map.loops.target[old])])
    pairs = pairs[:, np.sort(first)[: len(inside) * _EDGES_A_NODE - len(old) - 1]]
    source, target = np.concatenate([pairs, ends], axis=1)
    relative = between(poses[pairs[0]], poses[pairs[1]])
    sigma_m = _EDGE_M + _EDGE_M_PER_M * np.linalg.norm(relative[:, 4:], axis=1)
    sigma_rad = _EDGE_RAD + _EDGE_RAD_PER_RAD * angle(relative)
    # Edges beside the tree come of the same observations and are no further evidence: they share that of the tree.
    share = max(tree.shape[1], 1) / max(pairs.shape[1], 1)
    sigmas = np.repeat(np.stack([sigma_m, sigma_rad], axis=1), 3, axis=1) / np.sqrt(share)
    return _Graph(
        source,
        target,
        np.concatenate([relative, slam_map.loops.T_source_target[old]]),
        np.concatenate([np.eye(6) / np.square(sigmas)[:, None, :], slam_map.loops.information[old]]),
    )


def _solved(graph: _Graph, poses: np.ndarray, fixed: np.ndarray) -> Any:
    num, num_edges = len(poses), len(graph.source)
    size = next(size for size in _SIZES if size >= num)
    room = size * _EDGES_A_NODE
    columns: Any = (
        padded(graph.source, room, fill=0).astype(np.int32),
        padded(graph.target, room, fill=0).astype(np.int32),
        _pose_array(padded(graph.T_source_target, room, fill=IDENTITY)),
        padded(graph.information, room, fill=np.eye(6)).astype(np.float32),
        padded(np.ones(num_edges, np.float32), room, fill=0),
        np.arange(room) < num_edges,
    )
    edges, start = PoseGraphEdges(*columns), _pose_array(padded(poses, size, fill=IDENTITY))
    rank = band_rank(graph.source, graph.target, size)
    with _ONE_AT_A_TIME[size]:
        solved = jax.device_get(_optimize(start, edges, padded(fixed, size, fill=False), np.arange(size) < num, rank))
    return solved._replace(chi2=solved.chi2[:num_edges])


@partial(jax.jit, compiler_options=FAST_COMPILE)
@cached_trace
def _optimize(T_world_cam: SE3, edges: PoseGraphEdges, fixed: Any, mask: Any, rank: Any) -> Any:
    return optimize_pose_graph(T_world_cam, edges, fixed, mask=mask, rank=rank, loss="squared", max_steps=30)


def _pose_array(T: np.ndarray) -> SE3:
    wxyz_xyz: Any = T.astype(np.float32)
    return SE3(wxyz_xyz)
