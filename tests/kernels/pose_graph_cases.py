"""Pose graphs for tests: made ones, g2o files, and optima found without JAX."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


class Graph(NamedTuple):
    """Arrays of a graph; a node or measurement is `wxyz_xyz` and a scale."""

    nodes: np.ndarray
    source: np.ndarray
    target: np.ndarray
    measured: np.ndarray
    information: np.ndarray
    truth: np.ndarray


def loop_graph(seed: int, k: int, *, noise: float = 0.02, sim3: bool = False) -> Graph:
    """One round with odometry, three loop closings, initial poses off the truth; scales if asked for."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, k, endpoint=False)
    turns = Rotation.from_rotvec(np.stack([0.2 * np.sin(3 * angles), 0.1 * np.cos(angles), angles], 1))
    places = np.stack([4 * np.cos(angles), 4 * np.sin(angles), 0.3 * np.sin(2 * angles)], 1)
    truth = np.concatenate([_wxyz(turns), places, np.exp(0.1 * sim3 * rng.normal(size=(k, 1)))], axis=1)
    truth[0, 7] = 1.0
    source = np.concatenate([np.arange(k - 1), [k - 1, k - 2, k // 2]])
    target = np.concatenate([np.arange(1, k), [0, 1, 0]])
    m = len(source)
    measured = np.empty((m, 8))
    for i in range(m):
        a, b = truth[source[i]], truth[target[i]]
        measured[i] = _disturbed(rng, _relative(a[None], b[None]), noise)[0]
    root = rng.normal(size=(m, 7, 7)) + 3.0 * np.eye(7)
    information = 100.0 * root @ root.swapaxes(1, 2)
    return Graph(_disturbed(rng, truth, 0.08, first=1), source, target, measured, information, truth)


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


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`wxyz_xyz` of poses b in the frames of poses a, real part not negative."""
    Ra, Rb = _rotation(a), _rotation(b)
    q = _wxyz(Ra.inv() * Rb)
    return np.concatenate([np.where(q[:, :1] < 0, -q, q), Ra.inv().apply(b[:, 4:7] - a[:, 4:7])], axis=1)


def move(motion: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """A rigid motion of the world applied to all nodes."""
    R = _rotation(motion[None])[0]
    return np.concatenate([_wxyz(R * _rotation(nodes)), R.apply(nodes[:, 4:7]) + motion[4:7], nodes[:, 7:]], axis=1)


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
        R = _rotation(start) * Rotation.from_rotvec(steps[:, 3:6])
        return np.concatenate([_wxyz(R), start[:, 4:7] + steps[:, :3], start[:, 7:] * np.exp(steps[:, 6:])], axis=1)

    def whitened(x: np.ndarray) -> np.ndarray:
        nodes = nodes_at(x)
        e = _relative(measured, _relative(nodes[graph.source], nodes[graph.target]))
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


def _relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Similarities b in the frames of similarities a."""
    e = between(a, b)
    e[:, 4:] /= a[:, 7:]
    return np.concatenate([e, b[:, 7:] / a[:, 7:]], axis=1)


def _disturbed(rng: np.random.Generator, nodes: np.ndarray, noise: float, first: int = 0) -> np.ndarray:
    steps = noise * rng.normal(size=(len(nodes), 7))
    steps[:first] = 0.0
    R = _rotation(nodes) * Rotation.from_rotvec(steps[:, 3:6])
    return np.concatenate([_wxyz(R), nodes[:, 4:7] + steps[:, :3], nodes[:, 7:] * np.exp(steps[:, 6:])], axis=1)


def _rotation(nodes: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(nodes[:, :4], -1, axis=1))


def _wxyz(R: Rotation) -> np.ndarray:
    return np.roll(R.as_quat(), 1, axis=1)


def _planar(xyt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    half = 0.5 * xyt[2]
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), np.array([xyt[0], xyt[1], 0.0])


def _symmetric(upper: np.ndarray, d: int) -> np.ndarray:
    matrix = np.zeros((d, d))
    matrix[np.triu_indices(d)] = upper
    return matrix + np.triu(matrix, 1).T


def _array(poses) -> np.ndarray:
    return np.array([np.concatenate([q / np.linalg.norm(q), t, [1.0]]) for q, t in poses])
