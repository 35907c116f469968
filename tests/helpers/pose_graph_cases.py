"""Pose graphs for tests: g2o files, and optima found without JAX."""

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.loop_graph import Graph, relative, rotation_of, wxyz_of


def read_g2o(path: Path) -> Graph:
    """Nodes and edges of a file.

    SE(2) is lifted to SE(3): in the plane the errors are the planar ones, out of it each direction is as well known as
    x, and the optimum stays in the plane. `2 sin(θ/2)` takes the place of the angle θ.
    """
    nodes, edges = {}, []
    for line in path.read_text().splitlines():
        tag, *words = line.split()
        values = np.array(words, float)
        match tag:
            case "VERTEX_SE3:QUAT":
                nodes[int(values[0])] = np.roll(values[4:8], 1), values[1:4]
            case "VERTEX_SE2":
                nodes[int(values[0])] = _planar(values[1:4])
            case "EDGE_SE3:QUAT":
                pose = np.roll(values[5:9], 1), values[2:5]
                edges.append((int(values[0]), int(values[1]), pose, _symmetric(values[9:], 6)))
            case "EDGE_SE2":
                information, planar = values[5] * np.eye(6), np.ix_([0, 1, 5], [0, 1, 5])
                information[planar] = _symmetric(values[5:], 3)
                edges.append((int(values[0]), int(values[1]), _planar(values[2:5]), information))
            case _:
                raise ValueError(f"{path.name}: unknown line {tag}")
    source, target, measured, information = zip(*edges, strict=True)
    poses = _array([nodes[i] for i in range(len(nodes))])
    return Graph(poses, np.array(source), np.array(target), _array(measured), np.array(information), poses)


def isotropic(information: np.ndarray) -> np.ndarray:
    """What SE-Sync makes of an information matrix: one precision of translation and one of rotation."""
    covariance = np.linalg.inv(information)
    precisions = [3.0 / np.trace(covariance[:, i : i + 3, i : i + 3], axis1=1, axis2=2) for i in (0, 3)]
    return np.repeat(np.stack(precisions, 1), 3, axis=1)[:, :, None] * np.eye(6)


def move(motion: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """A rigid motion of the world applied to all nodes."""
    R = rotation_of(motion[None])[0]
    return np.concatenate([wxyz_of(R * rotation_of(nodes)), R.apply(nodes[:, 4:7]) + motion[4:7], nodes[:, 7:]], axis=1)


def scipy_optimum(
    graph: Graph, weights: np.ndarray, loss: str, scale: float, *, sim3: bool
) -> tuple[np.ndarray, float, np.ndarray]:
    """Nodes, cost and squared errors from `least_squares` on scaled residuals, the first node fixed."""
    d, k = (7 if sim3 else 6), len(graph.nodes)
    start = graph.nodes.copy()
    measured = graph.measured.copy()
    if not sim3:
        start[:, 7] = measured[:, 7] = 1.0
    roots = np.linalg.cholesky(graph.information[:, :d, :d])

    def nodes_at(x: np.ndarray) -> np.ndarray:
        steps = np.zeros((k, 7))
        steps[1:, :d] = x.reshape(k - 1, d)
        R = rotation_of(start) * Rotation.from_rotvec(steps[:, 3:6])
        return np.concatenate([wxyz_of(R), start[:, 4:7] + steps[:, :3], start[:, 7:] * np.exp(steps[:, 6:])], axis=1)

    def whitened(x: np.ndarray) -> np.ndarray:
        nodes = nodes_at(x)
        e = relative(measured, relative(nodes[graph.source], nodes[graph.target]))
        sign = np.where(e[:, :1] < 0, -1.0, 1.0)
        error = np.concatenate([e[:, 4:7], 2.0 * sign * e[:, 1:4], np.log(e[:, 7:])], axis=1)[:, :d]
        return np.einsum("mji,mj->mi", roots, error)

    def residuals(x: np.ndarray) -> np.ndarray:
        r = whitened(x)
        s = np.square(r).sum(axis=1)
        rho = s if loss == "squared" else scale**2 * np.log1p(s / scale**2)
        return (r * np.sqrt(weights * rho / s)[:, None]).ravel()

    found = least_squares(
        residuals, np.zeros((k - 1) * d), method="trf", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12
    )
    return nodes_at(found.x), float(found.cost), np.square(whitened(found.x)).sum(axis=1)


def _planar(xyt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    half = 0.5 * xyt[2]
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), np.array([xyt[0], xyt[1], 0.0])


def _symmetric(upper: np.ndarray, d: int) -> np.ndarray:
    matrix = np.zeros((d, d))
    matrix[np.triu_indices(d)] = upper
    return matrix + np.triu(matrix, 1).T


def _array(poses) -> np.ndarray:
    return np.array([np.concatenate([q / np.linalg.norm(q), t, [1.0]]) for q, t in poses])
