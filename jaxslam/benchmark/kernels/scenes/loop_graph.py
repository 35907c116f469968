"""Pose graphs of one round trip, made."""

from typing import NamedTuple

import numpy as np
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
    truth = np.concatenate([wxyz_of(turns), places, np.exp(0.1 * sim3 * rng.normal(size=(k, 1)))], axis=1)
    truth[0, 7] = 1.0
    source = np.concatenate([np.arange(k - 1), [k - 1, k - 2, k // 2]])
    target = np.concatenate([np.arange(1, k), [0, 1, 0]])
    m = len(source)
    measured = np.empty((m, 8))
    for i in range(m):
        a, b = truth[source[i]], truth[target[i]]
        measured[i] = _disturbed(rng, relative(a[None], b[None]), noise)[0]
    root = rng.normal(size=(m, 7, 7)) + 3.0 * np.eye(7)
    information = 100.0 * root @ root.swapaxes(1, 2)
    return Graph(_disturbed(rng, truth, 0.08, first=1), source, target, measured, information, truth)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`wxyz_xyz` of poses b in the frames of poses a, real part not negative."""
    Ra, Rb = rotation_of(a), rotation_of(b)
    q = wxyz_of(Ra.inv() * Rb)
    return np.concatenate([np.where(q[:, :1] < 0, -q, q), Ra.inv().apply(b[:, 4:7] - a[:, 4:7])], axis=1)


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Similarities b in the frames of similarities a."""
    e = between(a, b)
    e[:, 4:] /= a[:, 7:]
    return np.concatenate([e, b[:, 7:] / a[:, 7:]], axis=1)


def rotation_of(nodes: np.ndarray) -> Rotation:
    """The rotations of nodes."""
    return Rotation.from_quat(np.roll(nodes[:, :4], -1, axis=1))


def wxyz_of(R: Rotation) -> np.ndarray:
    """Quaternions `(k, 4)` of rotations, real part first."""
    return np.roll(R.as_quat(), 1, axis=1)


def _disturbed(rng: np.random.Generator, nodes: np.ndarray, noise: float, first: int = 0) -> np.ndarray:
    steps = noise * rng.normal(size=(len(nodes), 7))
    steps[:first] = 0.0
    R = rotation_of(nodes) * Rotation.from_rotvec(steps[:, 3:6])
    return np.concatenate([wxyz_of(R), nodes[:, 4:7] + steps[:, :3], nodes[:, 7:] * np.exp(steps[:, 6:])], axis=1)
