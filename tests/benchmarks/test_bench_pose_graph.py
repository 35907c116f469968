"""Pose graphs of thousands of nodes: one linear solve within the band against SciPy's SuperLU, the whole against gtsam.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_pose_graph.py -s`
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.pose_graph.block_tridiagonal_cg import GraphMatrix, factorize, solve_factor
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges, graph_equations, graph_nodes, graph_problem
from jaxslam_kernels.pose_graph.elimination_order import band_rank
from jaxslam_kernels.pose_graph.pose_graph import PoseGraphStatus, optimize_pose_graph
from pose_graph_cases import read_g2o
from scipy.sparse import bsr_array, coo_array
from scipy.sparse.linalg import splu

from jaxslam.benchmark.kernels.scenes.loop_graph import Graph
from jaxslam.benchmark.timing import compare, compile_seconds

pytestmark = pytest.mark.benchmark


def _load(data_dir: Path, name: str) -> tuple[Graph, SE3, PoseGraphEdges, np.ndarray, int]:
    path = data_dir / "posegraph" / name
    if not path.is_file():
        pytest.skip(f"no {name} here")
    graph = read_g2o(path)
    m = len(graph.source)
    edges = PoseGraphEdges(
        jnp.asarray(graph.source, jnp.int32),
        jnp.asarray(graph.target, jnp.int32),
        SE3(jnp.asarray(graph.measured[:, :7])),
        jnp.asarray(graph.information),
        jnp.ones(m),
        jnp.ones(m, bool),
    )
    rank = band_rank(graph.source, graph.target, len(graph.nodes))
    group = int(np.abs(rank[graph.source] - rank[graph.target]).max())
    return graph, SE3(jnp.asarray(graph.nodes[:, :7])), edges, rank, group


@pytest.mark.parametrize("name", ["sphere2500.g2o", "parking-garage.g2o", "input_M3500_g2o.g2o"])
def test_one_linear_solve_against_scipy(data_dir, name):
    """Factorizing and solving the first damped system, in float64; the solutions agree."""
    with jax.enable_x64(True):
        graph, poses, edges, rank, group = _load(data_dir, name)
        k = len(graph.nodes)
        nodes, usable = graph_nodes(poses, None)
        problem = graph_problem(edges, usable, 1.0, 6)
        equations = graph_equations(nodes, problem, "squared")
        diagonal = equations.diagonal + 1e-3 * jnp.max(equations.diagonal) * jnp.eye(6)[None]
        matrix = GraphMatrix(diagonal, equations.coupling, problem.source, problem.target)
        ours = jax.jit(lambda matrix, b: solve_factor(factorize(matrix, jnp.asarray(rank), group), b))
        b = equations.gradient
        blocks = bsr_array((np.asarray(diagonal), np.arange(k), np.arange(k + 1)), shape=(6 * k, 6 * k)).tocoo()
        rows = (6 * np.asarray(problem.source)[:, None, None] + np.arange(6)[None, :, None]) + np.zeros((1, 1, 6), int)
        columns = (6 * np.asarray(problem.target)[:, None, None] + np.arange(6)[None, None, :]) + np.zeros(
            (1, 6, 1), int
        )
        upper = coo_array((np.asarray(equations.coupling).ravel(), (rows.ravel(), columns.ravel())), shape=blocks.shape)
        sparse = (blocks + upper + upper.T).tocsc()
        options = {"SymmetricMode": True}

        def theirs():
            lu = splu(sparse, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
            return lu.solve(np.asarray(b).ravel())

        np.testing.assert_allclose(np.asarray(ours(matrix, b)).ravel(), theirs(), rtol=1e-6, atol=1e-8)
        comparison = compare(lambda: ours(matrix, b), theirs, rounds=10, warm_up=2)
    print(f"\none linear solve of {name}, groups of {group}, against SciPy's SuperLU\n{comparison}")
    assert comparison.processor_ratio < 4.0


@pytest.mark.parametrize("name", ["sphere2500.g2o", "parking-garage.g2o", "input_M3500_g2o.g2o"])
def test_whole_solve_against_gtsam(data_dir, name):
    """From the file's poses to the optimum, in single and double precision, steps eliminated on the host.

    gtsam has the angle where we have twice the sine of its half, and solves M3500 in the plane, half as many unknowns.
    """
    gtsam = pytest.importorskip("gtsam")
    single = _load(data_dir, name)
    with jax.enable_x64(True):
        double = _load(data_dir, name)

    def solve(poses, edges):
        fixed = jnp.arange(poses.wxyz_xyz.shape[0]) == 0
        return optimize_pose_graph(poses, edges, fixed, elimination="host")

    optimize = jax.jit(partial(solve))
    with jax.enable_x64(True):
        reference = jax.block_until_ready(optimize(*double[1:3]))
    result = jax.block_until_ready(optimize(*single[1:3]))
    graph, initial = gtsam.readG2o(str(data_dir / "posegraph" / name), "M3500" not in name)
    anchored = gtsam.NonlinearFactorGraph(graph)
    if "M3500" in name:
        anchored.add(gtsam.NonlinearEqualityPose2(0, initial.atPose2(0)))
    else:
        anchored.add(gtsam.NonlinearEqualityPose3(0, initial.atPose3(0)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-9)
    theirs = lambda: graph.error(gtsam.LevenbergMarquardtOptimizer(anchored, initial, params).optimize())
    comparison = compare(lambda: optimize(*single[1:3]), theirs, rounds=3, warm_up=1)
    print(f"\n{name} whole, single precision, against gtsam\n{comparison}")
    for what, r in (("single", result), ("double", reference)):
        print(f"  {what}: χ² {2 * float(r.cost):.6f}, status {int(r.status)}, {int(r.num_steps)} steps")
    print(f"  gtsam: χ² {2 * theirs():.6f}; compile {compile_seconds(solve, *single[1:3]):.1f} s of processor time")
    assert int(result.status) == int(reference.status) == PoseGraphStatus.OK
    assert float(reference.cost) == pytest.approx(theirs(), rel=1e-3)
    assert float(result.cost) < 1.01 * float(reference.cost)
