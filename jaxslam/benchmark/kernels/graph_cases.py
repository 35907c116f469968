"""Many poses at once, beside Ceres and gtsam: bundle adjustment and pose graphs."""

from functools import cache, partial
from typing import Any

import jax.numpy as jnp
from jaxlie import SE3
from jaxslam_kernels.bundle.bundle_adjust import bundle_adjust
from jaxslam_kernels.pose_graph.cost import PoseGraphEdges
from jaxslam_kernels.pose_graph.elimination_order import band_rank
from jaxslam_kernels.pose_graph.pose_graph import Elimination, optimize_pose_graph

from jaxslam.benchmark.kernels.case import Case, Problem
from jaxslam.benchmark.kernels.scenes.bundle_window import make_window, without_depth
from jaxslam.benchmark.kernels.scenes.loop_graph import loop_graph

_POINTS_A_KEYFRAME, _VIEWS_A_POINT = 125, 4
_STEPS, _NUM_FIXED = 10, 2


def _adjust(num_keyframes: int) -> Problem:
    num_points = _POINTS_A_KEYFRAME * num_keyframes
    window = without_depth(make_window(num_keyframes, num_points, _VIEWS_A_POINT * num_points))

    def ours(poses: Any, X_world: Any, observations: Any, fixed: Any) -> Any:
        return bundle_adjust(poses, X_world, observations, fixed_poses=fixed, tolerance=0.0, max_steps=_STEPS)

    def prepare() -> tuple[Any, ...]:
        from jaxslam.benchmark.kernels.rivals import ceres as ceres_window  # noqa: PLC0415 - a development tool

        adjuster, model = ceres_window.ceres_problem(window, _NUM_FIXED)
        return partial(ceres_window.solve, adjuster, _STEPS), model  # on whose memory Ceres works

    return Problem(
        ours,
        (window.poses, window.X_world, window.observations, jnp.arange(num_keyframes) < _NUM_FIXED),
        lambda solve, model: solve(),
        lambda ours, theirs: abs(float(ours.cost) / theirs.final_cost - 1),
        prepare,
    )


def _optimize(num_keyframes: int, elimination: Elimination) -> Problem:
    graph = loop_graph(0, num_keyframes)
    m, single = len(graph.source), lambda x: jnp.asarray(x, jnp.float32)
    edges = PoseGraphEdges(
        jnp.asarray(graph.source, jnp.int32),
        jnp.asarray(graph.target, jnp.int32),
        SE3(single(graph.measured[:, :7])),
        single(graph.information[:, :6, :6]),
        jnp.ones(m, jnp.float32),
        jnp.ones(m, bool),
    )
    rank = jnp.asarray(band_rank(graph.source, graph.target, num_keyframes))

    def ours(T: Any, edges: Any, fixed: Any, rank: Any) -> Any:
        return optimize_pose_graph(T, edges, fixed, rank=rank, elimination=elimination)

    @cache
    def prepare() -> tuple[Any, ...]:
        from jaxslam.benchmark.kernels.rivals import gtsam as gtsam_graph  # noqa: PLC0415 - a development tool

        return gtsam_graph.solve, *gtsam_graph.gtsam_problem(graph)

    return Problem(
        ours,
        (SE3(single(graph.nodes[:, :7])), edges, jnp.arange(num_keyframes) == 0, rank),
        lambda solve, factors, start: (factors, solve(factors, start)),
        lambda ours, theirs: abs(float(ours.cost) / theirs[0].error(theirs[1]) - 1),
        prepare,
    )


_ROUND_TRIP = (
    "a round trip with three loop closings, from poses that are off by 0.08 m and rad a direction until it has"
    " converged; gtsam has the angle where ours has twice the sine of its half, its factors are made beforehand"
)

GRAPH_CASES = (
    Case(
        name="bundle_adjust",
        axis="keyframes",
        sizes=(4, 12, 24, 48),
        reference="Ceres",
        compared=f"{_STEPS} steps of Levenberg-Marquardt with Cauchy's loss, {_POINTS_A_KEYFRAME} points a keyframe,"
        f" each seen {_VIEWS_A_POINT} times on average, no depths, {_NUM_FIXED} poses fixed; Ceres with COLMAP's cost"
        " functions in C++ and a dense Schur complement, its problem made beforehand",
        difference="relative difference of the final cost",
        limit=0.01,
        problem=_adjust,
        packages=("pyceres", "pycolmap"),
    ),
    Case(
        name="pose_graph",
        axis="keyframes",
        sizes=(50, 200, 800, 3200),
        reference="gtsam.LevenbergMarquardtOptimizer",
        compared=f"{_ROUND_TRIP}; ours with SciPy's sparse factors, `elimination='host'`",
        difference="relative difference of the final cost",
        limit=0.01,
        problem=partial(_optimize, elimination="host"),
        packages=("gtsam",),
    ),
    Case(
        name="pose_graph_band",
        axis="keyframes",
        sizes=(25, 50, 100, 200),
        reference="gtsam.LevenbergMarquardtOptimizer",
        compared=f"{_ROUND_TRIP}; ours compiled whole, `elimination='band'`",
        difference="relative difference of the final cost",
        limit=0.01,
        problem=partial(_optimize, elimination="band"),
        packages=("gtsam",),
    ),
)
