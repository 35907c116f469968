"""Essential graph: optimize the poses of a submap with a loop, and reject the loop if it contradicts them.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III-C (edges: spanning tree, strong covisibility, loops).
"""

import threading
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxslam_kernels.pose_graph.elimination_order import band_rank
from jaxslam_kernels.pose_graph.pose_graph import PoseGraphStatus, optimize_pose_graph

from jaxslam.geometry.se3 import IDENTITY, angle, between
from jaxslam.geometry.types import Pose
from jaxslam.map.graph_edges import padded_edges
from jaxslam.map.point_records import NONE, has, rows
from jaxslam.map.types import Map, visibility
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.runtime.padding import padded
from jaxslam.runtime.worker import step_back

_STRONG = 100
"""Common points from which two covisible keyframes get an edge (ORB-SLAM's essential graph)."""
_EDGE_REACH, _EDGE_M_PER_M, _EDGE_RAD, _EDGE_RAD_PER_RAD = 1 / 1200, 0.005, 0.002, 0.005
"""Standard deviation of the relative pose of two keyframes, as a share of the largest valid depth, and its growth with
distance and angle to allow for calibration errors. It is 5 mm for a sensor that measures up to 6 m. In the synthetic
room it is 3 mm and 0.7 mrad at 0.6 m and 20 degrees; recordings are worse."""
_MAX_CHI2 = 16.8
"""Maximum that a loop may add to the squared whitened error of the graph: the 99 % quantile for six degrees of freedom.
At the optimum, that is the squared contradiction in standard deviations of loop and graph together."""
_SIZES = (64, 256, 1024, 4096)
"""Numbers of keyframes that a graph is padded to; each size is compiled once."""
_EDGES_A_NODE = 6
_FEWEST, _AHEAD = 4, 2.0
"""Number of keyframes from which graphs are compiled ahead, and for which multiple of the current number."""
COMPILE_THREAD = "jaxslam-compile-graph"
"""Name of the threads that compile graphs ahead."""
_ONE_AT_A_TIME = {size: threading.Lock() for size in _SIZES}
"""One lock per size: two threads would compile the same program twice, while different sizes need not wait."""


class _Graph(NamedTuple):
    source: np.ndarray
    target: np.ndarray
    T_source_target: Pose
    information: np.ndarray


def poses_with_loop(
    slam_map: Map, source: int, target: int, T_source_target: Pose, information: np.ndarray, farthest_m: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Optimize the poses of a submap with a loop; `None` if the loop is not within the uncertainty of the graph.

    Args:
        slam_map: The map.
        source: Id of the first keyframe of the loop.
        target: Id of the second keyframe, in the same submap.
        T_source_target: `(7,)` measured relative pose.
        information: `(6, 6)` inverse covariance of the measurement.
        farthest_m: Largest valid depth of the sensor, meters, with which the errors of relative poses grow.

    Returns:
        Ids of the keyframes of the submap and their optimized poses, with the first keyframe's unchanged; `None` if the
        loop contradicts the graph, or if the submap has more than 4096 keyframes.
    """
    inside = np.flatnonzero(slam_map.submap == slam_map.submap[slam_map.row(target)])
    if len(inside) > _SIZES[-1]:
        return None
    ids, poses = slam_map.ids[inside], slam_map.T_world_cam[inside]
    ends = rows(ids, np.array([source, target]))[:, None]
    graph = _graph(slam_map, inside, farthest_m)
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
    """Compile the optimization for the graph size that this number of keyframes needs."""
    graph = _Graph(np.array([0]), np.array([1]), IDENTITY[None], np.eye(6)[None])
    _solved(graph, np.tile(IDENTITY, (num_keyframes, 1)), np.arange(num_keyframes) == 0)


class GraphCompiler:
    """Compile the optimization of larger graphs in a separate thread, before a loop needs it.

    When a loop needed it first, that frame took 2.9 s on an EPYC, 2.3 s of them for compilation.
    """

    def __init__(self) -> None:
        """Start with nothing compiled."""
        self._size = 0

    def compile_now(self, num_keyframes: int) -> None:
        """Compile the graphs that a map of this many keyframes needs now or soon, at least the smallest, and wait.

        Submaps are graphs too, so that those smaller than the map's are among them.
        """
        largest = next((size for size in _SIZES if size >= _AHEAD * num_keyframes), _SIZES[-1])
        for size in _SIZES[: _SIZES.index(largest) + 1]:
            compile_graph(size)
        self._size = largest

    def keep_ahead(self, num_keyframes: int) -> None:
        """Start compiling the next size that a map of this many keyframes will need soon; return at once."""
        size = next((size for size in _SIZES if size >= _AHEAD * num_keyframes), 0)
        if num_keyframes >= _FEWEST and size > self._size:
            self._size = size
            # Not a daemon thread: on exit the interpreter then waits for the compiler instead of cutting it off.
            threading.Thread(target=_compile_beside, args=(size,), name=COMPILE_THREAD).start()


def _compile_beside(num_keyframes: int) -> None:
    step_back()
    compile_graph(num_keyframes)


def _graph(slam_map: Map, inside: np.ndarray, farthest_m: float) -> _Graph:
    """Build the edges of a submap: spanning tree, strong covisibility, and earlier loops."""
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
    sigma_m = _EDGE_REACH * farthest_m + _EDGE_M_PER_M * np.linalg.norm(relative[:, 4:], axis=1)
    sigma_rad = _EDGE_RAD + _EDGE_RAD_PER_RAD * angle(relative)
    # Covisibility edges come from the same observations as the tree and are no further evidence: they share its weight.
    share = max(tree.shape[1], 1) / max(pairs.shape[1], 1)
    sigmas = np.repeat(np.stack([sigma_m, sigma_rad], axis=1), 3, axis=1) / np.sqrt(share)
    return _Graph(
        source,
        target,
        np.concatenate([relative, slam_map.loops.T_source_target[old]]),
        np.concatenate([np.eye(6) / np.square(sigmas)[:, None, :], slam_map.loops.information[old]]),
    )


def _solved(graph: _Graph, poses: np.ndarray, fixed: np.ndarray) -> Any:
    num = len(poses)
    size = next(size for size in _SIZES if size >= num)
    edges = padded_edges(*graph, size * _EDGES_A_NODE)
    initial: Any = padded(poses, size, fill=IDENTITY).astype(np.float32)
    rank = band_rank(graph.source, graph.target, size)
    with _ONE_AT_A_TIME[size]:
        solved = jax.device_get(
            _optimize(SE3(initial), edges, padded(fixed, size, fill=False), np.arange(size) < num, rank)
        )
    return solved._replace(chi2=solved.chi2[: len(graph.source)])


@compiled(when="warm-up", options=FAST_COMPILE)
def _optimize(T_world_cam: SE3, edges: PoseGraphEdges, fixed: Any, mask: Any, rank: Any) -> Any:
    return optimize_pose_graph(T_world_cam, edges, fixed, mask=mask, rank=rank, loss="squared", max_steps=30)
