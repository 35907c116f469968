"""Pose graphs against a plain sparse Gauss-Newton in NumPy and SciPy, and against known optima."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxlie import SE3
from jaxslam_kernels.pose_graph.block_tridiagonal_cg import (
    GraphMatrix,
    conjugate_gradients,
    factorize,
    multiply,
    solve_factor,
)
from jaxslam_kernels.pose_graph.cost import (
    PoseGraphEdges,
    edge_errors,
    edge_jacobians,
    graph_nodes,
    graph_problem,
    shift_nodes,
)
from jaxslam_kernels.pose_graph.elimination_order import band_rank, suitable_group_size
from jaxslam_kernels.pose_graph.pose_graph import Elimination, PoseGraph, PoseGraphStatus, optimize_pose_graph
from jaxslam_kernels.pose_graph.sparse_solve import solve_on_host
from jaxslam_kernels.robust import Loss
from pose_graph_cases import isotropic, move, read_g2o, scipy_optimum
from quick_compile import quick_compile

from jaxslam.benchmark.kernels.scenes.loop_graph import Graph, between, loop_graph

GROUP = 4  # small, so that the loop does not fit into the band and iterations are needed


class Inputs(NamedTuple):
    """Everything the optimum can be differentiated by, and where the solver starts."""

    poses: Any
    scales: Any
    edges: PoseGraphEdges
    fixed: Any


def _inputs(graph: Graph, dtype: Any = jnp.float32, *, sim3: bool = False) -> Inputs:
    d, m = 7 if sim3 else 6, len(graph.source)
    edges = PoseGraphEdges(
        source=jnp.asarray(graph.source, jnp.int32),
        target=jnp.asarray(graph.target, jnp.int32),
        T_source_target=SE3(jnp.asarray(graph.measured[:, :7], dtype)),
        information=jnp.asarray(graph.information[:, :d, :d], dtype),
        weights=jnp.asarray(np.linspace(0.5, 1.5, m), dtype),
        mask=jnp.ones(m, bool),
        scales=jnp.asarray(graph.measured[:, 7], dtype) if sim3 else None,
    )
    poses, scales = jnp.asarray(graph.nodes[:, :7], dtype), jnp.asarray(graph.nodes[:, 7], dtype)
    return Inputs(poses, scales if sim3 else None, edges, jnp.zeros(len(poses), bool).at[0].set(True))


def _optimize(
    inputs: Inputs, loss: Loss = "squared", max_steps: int = 50, elimination: Elimination = "band"
) -> PoseGraph:
    return optimize_pose_graph(
        SE3(inputs.poses),
        inputs.edges,
        inputs.fixed,
        scales=inputs.scales,
        loss=loss,
        loss_scale=2.0,
        max_steps=max_steps,
        group_size=GROUP,
        elimination=elimination,
    )


def _summary(result: PoseGraph) -> jax.Array:
    """One number that every output has a part in."""
    rng = np.random.default_rng(9)
    probe = lambda x: jnp.sum(x * jnp.asarray(rng.normal(size=x.shape), x.dtype))
    return (
        probe(result.T_world_cam.wxyz_xyz)
        + probe(result.scales)
        + 1e-2 * (result.cost + probe(result.chi2) + probe(result.robust_weights))
    )


def _differentiate(inputs: Inputs, loss: Loss):
    def f(edges, poses):
        result = _optimize(inputs._replace(edges=edges, poses=poses), loss)
        return _summary(result), result

    by_inputs = jax.value_and_grad(f, argnums=(0, 1), has_aux=True, allow_int=True)
    (_, result), gradient = by_inputs(inputs.edges, inputs.poses)
    floats = [x for x in jax.tree.leaves(gradient) if x.dtype != jax.dtypes.float0]
    return result, floats


_differentiated = quick_compile(_differentiate, static_argnums=1)
_optimized = quick_compile(_optimize, static_argnums=(1, 2, 3))


def _largest_difference(a: Any, b: Any) -> float:
    """Over all nodes, of positions in meters and of rotations as twice the sine of half the angle."""
    e = between(np.asarray(a, float), np.asarray(b, float))
    return max(np.abs(e[:, 4:]).max(), 2 * np.abs(e[:, 1:4]).max())


def test_shapes():
    graph = loop_graph(0, 12)
    for sim3 in (False, True):
        result = jax.eval_shape(_optimize, _inputs(graph, sim3=sim3))
        assert result.T_world_cam.wxyz_xyz.shape == (12, 7)
        assert result.scales.shape == result.anchored.shape == (12,)
        assert result.chi2.shape == result.robust_weights.shape == graph.source.shape
        assert result.cost.dtype == result.T_world_cam.wxyz_xyz.dtype == jnp.float32
        assert result.status.dtype == result.num_steps.dtype == result.num_iterations.dtype == jnp.int32


class TestMatchesReference:
    @pytest.mark.parametrize(
        ("sim3", "loss"),
        [
            (True, "cauchy"),
            pytest.param(False, "squared", marks=pytest.mark.slow),
            pytest.param(False, "cauchy", marks=pytest.mark.slow),
            pytest.param(True, "squared", marks=pytest.mark.slow),
        ],
    )
    def test_matches_reference(self, sim3, loss):
        """The optimum of `scipy.optimize.least_squares` with differences for derivatives."""
        graph = loop_graph(1, 14, sim3=sim3)
        with jax.enable_x64(True):
            inputs = _inputs(graph, jnp.float64, sim3=sim3)
            result = _optimized(inputs, loss)
            nodes, cost, chi2 = scipy_optimum(graph, np.asarray(inputs.edges.weights), loss, 2.0, sim3=sim3)
        assert PoseGraphStatus(int(result.status)) == PoseGraphStatus.OK
        assert float(result.cost_before) > 10 * float(result.cost)
        np.testing.assert_allclose(result.cost, cost, rtol=1e-9)
        np.testing.assert_allclose(result.chi2, chi2, rtol=1e-4, atol=1e-6)
        assert _largest_difference(result.T_world_cam.wxyz_xyz, nodes[:, :7]) < 1e-5
        np.testing.assert_allclose(result.scales, nodes[:, 7], rtol=1e-5)

    def test_single_precision(self):
        graph = loop_graph(2, 14)
        single = _optimized(_inputs(graph), "squared")
        with jax.enable_x64(True):
            double = _optimized(_inputs(graph, jnp.float64), "squared")
        assert int(single.status) == int(double.status) == PoseGraphStatus.OK
        np.testing.assert_allclose(single.cost, double.cost, rtol=1e-4)
        assert _largest_difference(single.T_world_cam.wxyz_xyz, double.T_world_cam.wxyz_xyz) < 1e-3

    @pytest.mark.slow
    @pytest.mark.parametrize("sim3", [False, True])
    def test_jacobians(self, sim3):
        """The written-out derivatives are those of the errors."""
        with jax.enable_x64(True):
            inputs = _inputs(loop_graph(3, 8, sim3=sim3), jnp.float64, sim3=sim3)
            nodes, usable = graph_nodes(SE3(inputs.poses), inputs.scales)
            d = 7 if sim3 else 6
            problem = graph_problem(inputs.edges, usable, 1.0, d)
            whole = jax.jacfwd(lambda steps: edge_errors(shift_nodes(nodes, steps), problem))(jnp.zeros((8, d)))
            m = jnp.arange(len(problem.source))
            by_source, by_target = edge_jacobians(nodes, problem)
            np.testing.assert_allclose(by_source, whole[m, :, problem.source], atol=1e-12)
            np.testing.assert_allclose(by_target, whole[m, :, problem.target], atol=1e-12)

    @pytest.mark.slow
    def test_published_optima(self, data_dir: Path, posegraph_case):
        """`χ²` as Ceres or gtsam reports it, or as the sparse Gauss-Newton in this folder finds it."""
        name, simplified, published, tolerance = posegraph_case
        path = data_dir / "posegraph" / name
        if not path.is_file():
            pytest.skip(f"no {path.name} here")
        graph = read_g2o(path)
        graph = graph._replace(information=isotropic(graph.information)) if simplified else graph
        with jax.enable_x64(True):
            inputs = _inputs(graph, jnp.float64)
            edges = inputs.edges._replace(weights=jnp.ones_like(inputs.edges.weights))
            optimize = jax.jit(partial(optimize_pose_graph, elimination="host"))
            result = optimize(SE3(inputs.poses), edges, inputs.fixed)
        assert PoseGraphStatus(int(result.status)) == PoseGraphStatus.OK
        np.testing.assert_allclose(2.0 * float(result.cost), published, rtol=tolerance)


@pytest.fixture(
    params=[
        ("parking-garage.g2o", False, 2 * 6.341883e-1, 1e-4),  # Ceres, gtsam issue 248
        ("sphere2500.g2o", True, 1687.0058142821, 1e-8),  # sparse Gauss-Newton with SciPy's splu
        ("sphere2500.g2o", False, 1351.2156973866, 1e-8),  # the same
        ("input_M3500_g2o.g2o", False, 137.91487825, 1e-4),  # gtsam 4.3, with angles: not quite the same errors
    ],
    ids=["garage", "sphere, isotropic", "sphere", "M3500"],
)
def posegraph_case(request):
    return request.param


def _value(values, inputs, loss):
    return _summary(_optimize(inputs._replace(edges=inputs.edges._replace(**values)), loss))


def _forward(values, direction, inputs, loss):
    return jax.jvp(lambda v: _value(v, inputs, loss), (values,), (direction,))[1]


# Here, so that graphs of one size are compiled once.
_compiled_value = quick_compile(_value, static_argnames="loss")
_compiled_forward = quick_compile(_forward, static_argnames="loss")
_compiled_gradient = quick_compile(jax.grad(_value), static_argnames="loss")


@pytest.mark.slow
class TestGradient:
    @pytest.mark.parametrize(("sim3", "loss"), [(False, "squared"), (True, "cauchy")])
    def test_gradient(self, sim3, loss):
        """Forward, reverse and central differences agree, for measured poses, scales, weights and information."""
        self._check(loop_graph(4, 9, sim3=sim3), sim3, loss)

    def test_gradient_at_zero_error(self):
        """Perfect measurements: the error and its rotation are at zero, where a logarithm has no derivative."""
        self._check(loop_graph(5, 9, noise=0.0), False, "squared")

    @staticmethod
    def _check(graph: Graph, sim3: bool, loss: Loss):
        with jax.enable_x64(True):
            inputs = _inputs(graph, jnp.float64, sim3=sim3)
            names = ("T_source_target", "information", "weights", *(("scales",) if sim3 else ()))
            differentiable = {name: getattr(inputs.edges, name) for name in names}
            rng = np.random.default_rng(0)
            direction = jax.tree.map(lambda x: 0.1 * jnp.asarray(rng.normal(size=x.shape)), differentiable)

            def value(h):
                there = jax.tree.map(lambda x, v: x + h * v, differentiable, direction)
                return float(_compiled_value(there, inputs, loss))

            h = 1e-4
            difference = (value(h) - value(-h)) / (2 * h)
            forward = _compiled_forward(differentiable, direction, inputs, loss)
            gradient = _compiled_gradient(differentiable, inputs, loss)
            reverse = sum(jnp.vdot(g, v) for g, v in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True))
        np.testing.assert_allclose(forward, difference, rtol=2e-5, atol=1e-7)
        np.testing.assert_allclose(reverse, forward, rtol=1e-7, atol=1e-9)
        assert abs(difference) > 1e-3


@pytest.mark.slow
def test_vmap_equals_loop():
    several = [_inputs(loop_graph(seed, 10)) for seed in range(3)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *several)
    together = quick_compile(jax.vmap(_optimize))(batch)
    for i, inputs in enumerate(several):
        alone = _optimized(inputs, "squared")
        assert int(alone.status) == int(together.status[i]) == PoseGraphStatus.OK
        assert _largest_difference(together.T_world_cam.wxyz_xyz[i], alone.T_world_cam.wxyz_xyz) < 1e-3
        np.testing.assert_allclose(together.cost[i], alone.cost, rtol=1e-4)


def test_single_trace():
    """Values, masks, weights, fixed nodes and the order change; nothing is traced again."""

    def solve(inputs, mask, rank, loss_scale):
        return optimize_pose_graph(
            SE3(inputs.poses), inputs.edges, inputs.fixed, mask=mask, rank=rank, loss_scale=loss_scale, group_size=GROUP
        )

    once = quick_compile(eqx.debug.assert_max_traces(solve, max_traces=1))
    for seed in range(3):
        graph = loop_graph(seed, 10)
        inputs = _inputs(graph)
        inputs = inputs._replace(
            edges=inputs.edges._replace(mask=inputs.edges.mask.at[seed].set(False)),
            fixed=inputs.fixed.at[seed + 2].set(True),
        )
        rank = jnp.asarray(band_rank(graph.source, graph.target, 10))
        result = once(inputs, jnp.ones(10, bool).at[-seed].set(seed == 0), rank, jnp.float32(1.0 + seed))
        assert np.isfinite(result.cost)


def _degenerate(change: str) -> Inputs:
    inputs = _inputs(loop_graph(6, 10))
    edges, nan = inputs.edges, jnp.nan
    changes = {
        "no edges": {"mask": jnp.zeros_like(edges.mask)},
        "zero information": {"information": jnp.zeros_like(edges.information)},
        "indefinite information": {"information": edges.information.at[:, 2, 2].set(-1.0)},
        "weights zero": {"weights": jnp.zeros_like(edges.weights)},
        "weights NaN": {"weights": edges.weights * nan},
        "measured NaN": {"T_source_target": SE3(edges.T_source_target.wxyz_xyz * nan)},
        "quaternions zero": {"T_source_target": SE3(edges.T_source_target.wxyz_xyz.at[:, :4].set(0.0))},
        "to itself": {"target": edges.source},
        "out of range": {"target": edges.target + 100},
    }
    if change in changes:
        return inputs._replace(edges=edges._replace(**changes[change]))
    if change == "all fixed":
        return inputs._replace(fixed=jnp.ones_like(inputs.fixed))
    if change == "none fixed":
        return inputs._replace(fixed=jnp.zeros_like(inputs.fixed))
    assert change == "initial NaN"
    return inputs._replace(poses=inputs.poses.at[3, 5].set(nan))


class TestDegenerate:
    @pytest.mark.parametrize(
        ("change", "status"),
        [
            ("no edges", PoseGraphStatus.NOTHING_TO_DO),
            ("zero information", PoseGraphStatus.NOTHING_TO_DO),
            ("indefinite information", PoseGraphStatus.NOTHING_TO_DO),
            ("weights zero", PoseGraphStatus.NOTHING_TO_DO),
            ("weights NaN", PoseGraphStatus.NOTHING_TO_DO),
            ("measured NaN", PoseGraphStatus.NOTHING_TO_DO),
            ("quaternions zero", PoseGraphStatus.NOTHING_TO_DO),
            ("to itself", PoseGraphStatus.NOTHING_TO_DO),
            ("out of range", PoseGraphStatus.NOTHING_TO_DO),
            ("all fixed", PoseGraphStatus.NOTHING_TO_DO),
            ("none fixed", PoseGraphStatus.NOTHING_TO_DO),
            ("initial NaN", PoseGraphStatus.BAD_INITIAL),
        ],
    )
    def test_degenerate(self, change, status):
        """Nothing moves, and everything is finite, derivatives too."""
        inputs = _degenerate(change)
        result, gradient = _differentiated(inputs, "squared")
        assert PoseGraphStatus(int(result.status)) == status
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        expected = np.array(inputs.poses)
        if status == PoseGraphStatus.BAD_INITIAL:
            expected[3] = [1, 0, 0, 0, 0, 0, 0]
        np.testing.assert_allclose(result.T_world_cam.wxyz_xyz, expected, atol=1e-6)

    @pytest.mark.slow
    def test_degenerate_disconnected(self):
        """A part without a fixed node stays; the other is as if it were alone."""
        inputs = _inputs(loop_graph(7, 10))
        edges = inputs.edges
        across = (edges.source < 6) != (edges.target < 6)
        cut = inputs._replace(edges=edges._replace(mask=~across))
        alone = inputs._replace(edges=edges._replace(mask=(edges.source < 6) & (edges.target < 6)))
        result, gradient = _differentiated(cut, "squared")
        assert PoseGraphStatus(int(result.status)) == PoseGraphStatus.DISCONNECTED
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        np.testing.assert_array_equal(result.anchored, np.arange(10) < 6)
        np.testing.assert_allclose(result.T_world_cam.wxyz_xyz[6:], inputs.poses[6:], atol=1e-6)
        expected = _optimized(alone, "squared").T_world_cam.wxyz_xyz
        assert _largest_difference(result.T_world_cam.wxyz_xyz, expected) < 1e-3

    @pytest.mark.parametrize("what", ["pose", "information", "weight"])
    def test_degenerate_in_part(self, what):
        """One edge with a NaN is as good as no edge."""
        inputs = _inputs(loop_graph(8, 10))
        edges, nan = inputs.edges, jnp.nan
        last = len(edges.mask) - 1
        bad = {
            "pose": edges._replace(T_source_target=SE3(edges.T_source_target.wxyz_xyz.at[last, 1].set(nan))),
            "information": edges._replace(information=edges.information.at[last, 1, 1].set(nan)),
            "weight": edges._replace(weights=edges.weights.at[last].set(nan)),
        }[what]
        result, gradient = _differentiated(inputs._replace(edges=bad), "squared")
        without = _optimized(inputs._replace(edges=edges._replace(mask=edges.mask.at[last].set(False))), "squared")
        assert int(result.status) == PoseGraphStatus.OK
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        np.testing.assert_allclose(result.T_world_cam.wxyz_xyz, without.T_world_cam.wxyz_xyz, atol=1e-5)
        assert float(result.chi2[last]) == 0.0

    def test_degenerate_zero_motion(self):
        """Started at a perfect solution: it stays."""
        graph = loop_graph(9, 10, noise=0.0)
        inputs = _inputs(graph._replace(nodes=graph.truth))
        result, gradient = _differentiated(inputs, "squared")
        assert int(result.status) == PoseGraphStatus.OK
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((result, gradient)))
        assert _largest_difference(result.T_world_cam.wxyz_xyz, graph.truth[:, :7]) < 1e-4

    @pytest.mark.slow
    def test_steps_run_out(self):
        result = _optimized(_inputs(loop_graph(10, 14)), "squared", 1)
        assert PoseGraphStatus(int(result.status)) == PoseGraphStatus.NOT_CONVERGED
        assert float(result.cost) < float(result.cost_before)


@pytest.mark.slow
def test_wrong_loop_is_rejected_by_a_robust_loss():
    """An edge that is meters off pulls in least squares and not under Geman and McClure's loss."""
    graph = loop_graph(11, 14)
    wrong = graph.measured.copy()
    wrong[-1, 4:7] += 3.0
    truth = graph.truth[:, :7]
    errors = {}
    for loss in ("squared", "geman_mcclure"):
        result = _optimized(_inputs(graph._replace(measured=wrong)), loss)
        errors[loss] = _largest_difference(result.T_world_cam.wxyz_xyz, truth)
        weight = float(result.robust_weights[-1])
        assert (weight == 1.0) if loss == "squared" else (weight < 1e-3)
    assert errors["geman_mcclure"] < 0.5 * errors["squared"]


class TestHostElimination:
    """The steps are solved elsewhere; the answer and its derivatives are the same."""

    @pytest.mark.slow
    @pytest.mark.parametrize("sim3", [False, True])
    def test_matches_reference(self, sim3):
        with jax.enable_x64(True):
            inputs = _inputs(loop_graph(1, 14, sim3=sim3), jnp.float64, sim3=sim3)
            band, host = (_optimized(inputs, "cauchy", 50, way) for way in ("band", "host"))
        assert int(host.status) == PoseGraphStatus.OK
        np.testing.assert_allclose(host.cost, band.cost, rtol=1e-10)
        assert _largest_difference(host.T_world_cam.wxyz_xyz, band.T_world_cam.wxyz_xyz) < 1e-6
        assert int(host.num_iterations) == int(host.num_steps) <= int(band.num_iterations)

    @pytest.mark.slow
    def test_gradient(self):
        with jax.enable_x64(True):
            inputs = _inputs(loop_graph(4, 9), jnp.float64)

            def gradient(way):
                def f(information, measured):
                    edges = inputs.edges._replace(information=information, T_source_target=SE3(measured))
                    return _summary(_optimize(inputs._replace(edges=edges), "cauchy", 50, way))

                by = quick_compile(jax.grad(f, argnums=(0, 1)))
                return by(inputs.edges.information, inputs.edges.T_source_target.wxyz_xyz)

            for band, host in zip(gradient("band"), gradient("host"), strict=True):
                assert np.abs(band).max() > 1e-6
                np.testing.assert_allclose(host, band, rtol=1e-5, atol=1e-6 * float(np.abs(band).max()))

    @pytest.mark.slow
    def test_vmap_equals_loop(self):
        several = [_inputs(loop_graph(seed, 10)) for seed in range(2)]
        batch = jax.tree.map(lambda *x: jnp.stack(x), *several)
        together = quick_compile(jax.vmap(partial(_optimize, elimination="host")))(batch)
        for i, inputs in enumerate(several):
            alone = _optimized(inputs, "squared", 50, "host")
            assert _largest_difference(together.T_world_cam.wxyz_xyz[i], alone.T_world_cam.wxyz_xyz) < 1e-4

    @pytest.mark.parametrize("change", ["no edges", "measured NaN", "all fixed", "none fixed", "initial NaN"])
    def test_degenerate(self, change):
        result = _optimized(_degenerate(change), "squared", 50, "host")
        expected = PoseGraphStatus.BAD_INITIAL if change == "initial NaN" else PoseGraphStatus.NOTHING_TO_DO
        assert PoseGraphStatus(int(result.status)) == expected
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(result))

    def test_one_solve(self):
        """Against a dense solve, in single precision too; what has no solution is not finite."""
        with jax.enable_x64(True):
            edges = [(2, 1), (0, 2), (3, 5), (6, 4), (4, 0), (5, 6)]
            matrix, dense = TestBlockBand._matrix(7, edges)
            right = jnp.asarray(np.random.default_rng(1).normal(size=(7, 2)))
            expected = np.linalg.solve(dense, right.ravel())
            np.testing.assert_allclose(jax.jit(solve_on_host)(matrix, right).ravel(), expected, rtol=1e-12)
            single = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, (matrix, right))
            found = solve_on_host(*single)
            assert found.dtype == jnp.float32
            np.testing.assert_allclose(found.ravel(), expected, rtol=1e-5)
            for diagonal in (matrix.diagonal.at[3].set(jnp.nan), jnp.zeros_like(matrix.diagonal)):
                bad = matrix._replace(diagonal=diagonal, coupling=0.0 * matrix.coupling)
                assert not np.isfinite(solve_on_host(bad, right)).any()


class TestSuitableGroupSize:
    @pytest.mark.parametrize(("jump", "expected"), [(1, 16), (16, 16), (17, 32), (64, 64), (65, None)])
    def test_is_the_least_that_holds_every_edge(self, jump, expected):
        rank = np.arange(100, dtype=np.int32)
        assert suitable_group_size(np.array([0, 5]), np.array([jump, 6]), rank) == expected

    def test_without_edges(self):
        nothing = np.array([], int)
        assert suitable_group_size(nothing, nothing, np.arange(3, dtype=np.int32)) == 16


class TestBlockBand:
    @staticmethod
    def _matrix(k: int, edges: list[tuple[int, int]]) -> tuple[GraphMatrix, np.ndarray]:
        rng = np.random.default_rng(0)
        dense, coupling, diagonal = np.zeros((k, 2, k, 2)), [], np.zeros((k, 2, 2))
        for a, b in edges:
            coupling.append(rng.normal(size=(2, 2)))
            dense[a, :, b], dense[b, :, a] = coupling[-1], coupling[-1].T
        for i in range(k):
            dense[i, :, i] = diagonal[i] = 8.0 * np.eye(2) + 0.3
        source, target = (jnp.asarray(x, jnp.int32) for x in zip(*edges, strict=True))
        return GraphMatrix(jnp.asarray(diagonal), jnp.asarray(np.array(coupling)), source, target), dense.reshape(
            2 * k, 2 * k
        )

    def test_exact_within_neighboring_groups(self):
        """Seven nodes in groups of three, in an order of their own: the factor alone solves."""
        with jax.enable_x64(True):
            rank = jnp.asarray([3, 1, 0, 2, 6, 5, 4])
            matrix, dense = self._matrix(7, [(2, 1), (0, 2), (3, 5), (6, 4), (4, 0)])
            right = jnp.asarray(np.random.default_rng(1).normal(size=(7, 2)))
            found = quick_compile(lambda: solve_factor(factorize(matrix, rank, 3), right))()
            product = quick_compile(multiply)(matrix, right)
            np.testing.assert_allclose(product.ravel(), dense @ right.ravel(), rtol=1e-12)
            np.testing.assert_allclose(found.ravel(), np.linalg.solve(dense, right.ravel()), rtol=1e-10)

    def test_iterations_make_up_for_what_is_left_out(self):
        with jax.enable_x64(True):
            matrix, dense = self._matrix(9, [(i, i + 1) for i in range(8)] + [(0, 8), (7, 1)])
            right = jnp.asarray(np.random.default_rng(1).normal(size=(9, 2)))
            factor = quick_compile(lambda: factorize(matrix, jnp.arange(9), 2))()
            solve = quick_compile(partial(solve_factor, factor))
            exact = np.linalg.solve(dense, right.ravel())
            found, steps = conjugate_gradients(
                partial(multiply, matrix), partial(solve_factor, factor), right, tolerance=1e-12, max_steps=50
            )
            assert np.abs(np.asarray(solve(right)).ravel() - exact).max() > 1e-3
            np.testing.assert_allclose(found.ravel(), exact, rtol=1e-9)
            assert 1 < int(steps) <= 18

    def test_indefinite(self):
        """A matrix that is not positive definite ends the search with something finite."""
        with jax.enable_x64(True):
            matrix, _ = self._matrix(4, [(0, 1), (2, 3)])
            factor = quick_compile(lambda: factorize(matrix, jnp.arange(4), 2))()
            found, _ = conjugate_gradients(
                lambda x: -multiply(matrix, x),
                partial(solve_factor, factor),
                jnp.ones((4, 2)),
                tolerance=1e-9,
                max_steps=50,
            )
            np.testing.assert_array_equal(found, 0.0)


any_seed = given(seed=st.integers(0, 2**32 - 1))
few_examples = settings(max_examples=5, deadline=None, derandomize=True)


class TestInvariance:
    """One graph, changed in a way that must not change the answer."""

    @few_examples
    @any_seed
    @pytest.mark.slow
    def test_rigid_motion(self, seed):
        rng = np.random.default_rng(seed)
        graph = loop_graph(seed % 1000, 10)
        motion = np.concatenate([rng.normal(size=4), rng.normal(size=3), [1.0]])
        motion[:4] /= np.linalg.norm(motion[:4])
        with jax.enable_x64(True):
            before = _optimized(_inputs(graph, jnp.float64), "squared")
            after = _optimized(_inputs(graph._replace(nodes=move(motion, graph.nodes)), jnp.float64), "squared")
        ones = np.ones((10, 1))
        expected = move(motion, np.concatenate([before.T_world_cam.wxyz_xyz, ones], axis=1))[:, :7]
        np.testing.assert_allclose(after.cost, before.cost, rtol=1e-8)
        assert _largest_difference(after.T_world_cam.wxyz_xyz, expected) < 1e-5

    @pytest.mark.slow
    @few_examples
    @any_seed
    def test_order_of_edges_and_elimination(self, seed):
        graph = loop_graph(seed % 1000, 10)
        rng = np.random.default_rng(seed)
        with jax.enable_x64(True):
            inputs = _inputs(graph, jnp.float64)
            before = _optimized(inputs, "squared")
            order = rng.permutation(len(graph.source))
            edges = jax.tree.map(lambda x: x[order], inputs.edges)
            rank = jnp.asarray(rng.permutation(10))
            ordered = quick_compile(
                lambda edges, rank: optimize_pose_graph(
                    SE3(inputs.poses), edges, inputs.fixed, rank=rank, group_size=GROUP
                )
            )
            after = ordered(edges, rank)
        np.testing.assert_allclose(after.cost, before.cost, rtol=1e-8)
        assert _largest_difference(after.T_world_cam.wxyz_xyz, before.T_world_cam.wxyz_xyz) < 1e-5


_IN_ONE_THREAD = """
import jax, numpy as np
from jaxslam_kernels.pose_graph.block_tridiagonal_cg import GraphMatrix
from jaxslam_kernels.pose_graph.sparse_solve import solve_on_host

def unaligned(array):
    room = np.empty(array.nbytes + 4, np.uint8)[4:].view(array.dtype).reshape(array.shape)
    room[:] = array
    return room

eye, first = np.eye(6, dtype=np.float32), np.arange(1999, dtype=np.int32)
matrix = GraphMatrix(unaligned(np.tile(4 * eye, (2000, 1, 1))), unaligned(np.tile(eye, (1999, 1, 1))), first, first + 1)
found = np.asarray(jax.jit(solve_on_host)(matrix, unaligned(np.ones((2000, 6), np.float32))))
np.testing.assert_allclose(4 * found[1:-1] + found[:-2] + found[2:], 1.0, atol=1e-6)
"""


def test_host_elimination_in_one_thread():
    """Where XLA's one thread makes the callback, it waits for nothing that thread is to bring."""
    one = os.environ | {"NPROC": "1"}
    subprocess.run([sys.executable, "-c", _IN_ONE_THREAD], env=one, check=True, timeout=120)
