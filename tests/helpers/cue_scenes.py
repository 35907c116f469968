"""Points before a camera that moves, some of which move too: what dynamic cues are given."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import make_intrinsics, project
from jaxslam_kernels.se3 import retract, to_camera, to_world
from quick_compile import quick_compile_nested

from jaxslam.dynamics.cue import CueInput

N = 60
MOTIONS: dict[str, Any] = {
    "none": (0, 0, 0, 0, 0, 0),
    "ahead": (0, 0, 0.05, 0, 0, 0),
    "sideways": (0.05, 0, 0, 0, 0, 0),
    "turning": (0, 0, 0, 0.02, 0.05, 0.01),
    "all": (0.02, -0.01, 0.03, 0.01, 0.03, -0.02),
}
"""Tangents of the camera from frame to frame."""
_project, _retract, _to_camera, _to_world = map(quick_compile_nested, (project, retract, to_camera, to_world))
INTRINSICS = (500.0, 505.0, 320.0, 240.0, (0.05, -0.1, 0.001, -0.001, 0.0))


def scene(motion: Any, moved_m: Any = (0, 0, 0), seed: int = 0, noise_px: float = 0.0) -> CueInput:
    """Points before a camera that moves by a tangent in its own axes; every third point moves too, in the world."""
    rng = np.random.default_rng(seed)
    X_cam = np.stack([rng.uniform(-1, 1, N), rng.uniform(-0.8, 0.8, N), rng.uniform(1, 4, N)])
    before = _retract(SE3.identity(), jnp.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.3]))
    now = _retract(before, jnp.asarray(motion, float))
    X_world = np.asarray(_to_world(before, jnp.asarray(X_cam)))
    X_now = X_world + np.where(moves()[None, :], np.asarray(moved_m, float)[:, None], 0)
    intrinsics = make_intrinsics(*INTRINSICS, dtype=jnp.float64)
    seen = _to_camera(now, jnp.asarray(X_now))
    noise = noise_px * rng.standard_normal((2, 2, N))
    return CueInput(
        uv_before=_project(intrinsics, jnp.asarray(X_cam)) + noise[0],
        uv=_project(intrinsics, seen) + noise[1],
        followed=jnp.ones(N, bool),
        masked=jnp.zeros(N, bool),
        agrees=jnp.asarray(~moves() | (not any(moved_m))),
        weight=jnp.ones(N),
        depth_before=jnp.asarray(X_cam[2]),
        depth=seen[2],
        X_world=jnp.asarray(X_world),
        X_anchor=jnp.asarray(X_world),
        T_world_before=before,
        T_world_cam=now,
        intrinsics=intrinsics,
        size=jnp.array([640.0, 480.0]),
        key=jax.random.key(seed),
    )


def moves() -> np.ndarray:
    """Which points do."""
    return np.arange(N) % 3 == 0


def check_finite(function: Callable[..., Any], *arguments: Any) -> None:
    """That everything it gives is finite."""
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(function(*arguments)))
