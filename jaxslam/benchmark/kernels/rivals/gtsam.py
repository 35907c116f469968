"""A pose graph as gtsam solves it."""

import gtsam
import numpy as np

from jaxslam.benchmark.kernels.scenes.loop_graph import Graph

_ROTATION_FIRST = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
"""From our order of an error, translation and rotation, to gtsam's."""


def gtsam_problem(graph: Graph) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Factors and where to start; the first node is fixed."""
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, node in enumerate(graph.nodes):
        start.insert(i, _pose(node))
    factors.add(gtsam.NonlinearEqualityPose3(0, _pose(graph.nodes[0])))
    for i, j, measured, information in zip(graph.source, graph.target, graph.measured, graph.information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information[:6, :6][_ROTATION_FIRST])
        factors.add(gtsam.BetweenFactorPose3(int(i), int(j), _pose(measured), noise))
    return factors, start


def solve(factors: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """Levenberg-Marquardt until a step changes the error by less than a billionth."""
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-9)
    return gtsam.LevenbergMarquardtOptimizer(factors, start, params).optimize()


def _pose(node: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Quaternion(*node[:4]), node[4:7])
