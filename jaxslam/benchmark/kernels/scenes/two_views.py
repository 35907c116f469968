"""Matches of two views whose motion is known: ordinary ones, and ones that leave the motion open."""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.spatial.transform import Rotation

MATRIX = np.array([[517.0, 0.0, 318.6], [0.0, 516.0, 255.3], [0.0, 0.0, 1.0]])
SIZE = np.array([640.0, 480.0])
Kind: TypeAlias = Literal["ordinary", "rotation", "plane", "still"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class TwoViewScene:
    """All float64. `F` is of unit norm, zero where there is no translation; `outlier` marks wrong matches."""

    uv_before: np.ndarray
    uv_after: np.ndarray
    exact_before: np.ndarray
    exact_after: np.ndarray
    F: np.ndarray
    outlier: np.ndarray


def make_two_views(
    seed: int, n: int = 500, *, noise_px: float = 0.5, outliers: float = 0.5, kind: Kind = "ordinary"
) -> TwoViewScene:
    """Points 1 to 5 m away, or on a slanted plane, seen from two places 10 to 30 cm apart or from one."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0.0, 1.0, (2, n)) * SIZE[:, None]
    rays = np.linalg.solve(MATRIX, np.concatenate([uv, np.ones((1, n))]))
    normal = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
    depth = 2.5 / (normal @ rays) if kind == "plane" else rng.uniform(1.0, 5.0, n)
    R = np.eye(3) if kind == "still" else Rotation.from_rotvec(rng.normal(size=3) * 0.04).as_matrix()
    direction = rng.normal(size=3)
    moved = kind in {"ordinary", "plane"}
    t = direction / np.linalg.norm(direction) * rng.uniform(0.1, 0.3) * moved
    image = MATRIX @ (R @ (rays * depth) + t[:, None])
    after = image[:2] / image[2]
    outlier = np.arange(n) < round(outliers * n)
    noise = rng.normal(size=(2, 2, n)) * noise_px
    uv_after = np.where(outlier, rng.uniform(0.0, 1.0, (2, n)) * SIZE[:, None], after + noise[1])
    inverse = np.linalg.inv(MATRIX)
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    F = inverse.T @ cross @ R @ inverse
    return TwoViewScene(uv + noise[0], uv_after, uv, after, F / max(np.linalg.norm(F), 1e-30), outlier)
