"""A window of keyframes that see the same points: made ones, for bundle adjustment."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.bundle.cost import Observations, observe
from jaxslam_kernels.camera import make_intrinsics
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.scenes.single_view import to_wxyz_xyz

FOCAL_PX, CENTER_PX = 500.0, (320.0, 240.0)
"""Of the camera, which has no distortion."""


class Window(NamedTuple):
    """Initial values of a bundle adjustment, and the truth.

    Attributes:
        truth: `(k, 7)` `wxyz_xyz` of T_world_cam.
        poses: `(k, 7)` where to start; the first is true.
        X_world: `(3, n)` where the points start.
        observations: m of them, with depths.
    """

    truth: np.ndarray
    poses: jax.Array
    X_world: jax.Array
    observations: Observations


def make_window(k: int, n: int, m: int) -> Window:
    """A camera that moves a meter sideways sees n points m times in k pictures, which points by chance."""
    rng = np.random.default_rng(0)
    X_world = rng.uniform([[-2.0], [-1.5], [2.0]], [[2.0], [1.5], [5.0]], (3, n))
    rotations = [Rotation.from_rotvec(0.05 * rng.normal(size=3)) for _ in range(k)]
    positions = np.linspace([-0.5, 0.0, 0.0], [0.5, 0.0, 0.2], k)
    X_cam = np.stack([r.inv().apply(X_world.T - t).T for r, t in zip(rotations, positions, strict=True)])
    camera, point = np.divmod(np.sort(rng.choice(k * n, m, replace=False)), n)
    X, Y, Z = X_cam[camera, :, point].T
    uv = FOCAL_PX * np.stack([X / Z, Y / Z]) + np.array(CENTER_PX)[:, None] + rng.normal(size=(2, m))
    sigma_depth = 0.005 * Z**2
    depth = Z + sigma_depth * rng.normal(size=m)
    truth = np.stack([to_wxyz_xyz(r, t) for r, t in zip(rotations, positions, strict=True)])
    start = truth.copy()
    start[1:, 4:] += 0.02 * rng.normal(size=(k - 1, 3))
    single = lambda x: jnp.asarray(x, jnp.float32)
    observations = observe(
        jnp.asarray(camera, jnp.int32),
        jnp.asarray(point, jnp.int32),
        single(uv),
        make_intrinsics(FOCAL_PX, FOCAL_PX, *CENTER_PX),
        depth=single(depth),
        sigma_depth=single(sigma_depth),
    )
    return Window(truth, single(start), single(X_world + 0.05 * rng.normal(size=X_world.shape)), observations)


def without_depth(window: Window) -> Window:
    """The window as other libraries take it: no depths, and only points that are seen twice or more."""
    point = np.asarray(window.observations.point)
    often = np.bincount(point)[point] > 1
    pixels = window.observations._replace(depth=jnp.zeros(point.size, jnp.float32), valid=jnp.asarray(often))
    return window._replace(observations=pixels)
