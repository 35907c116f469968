"""Points seen by one camera whose pose is known: made with OpenCV and SciPy, for pose estimation."""

from dataclasses import dataclass

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics, make_intrinsics
from scipy.spatial.transform import Rotation

TUM_FR1 = (517.306408, 516.469215, 318.643040, 255.313989, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314))
MATRIX = np.array([[TUM_FR1[0], 0.0, TUM_FR1[2]], [0.0, TUM_FR1[1], TUM_FR1[3]], [0.0, 0.0, 1.0]])
DISTORTION = np.array(TUM_FR1[4])


@dataclass(frozen=True)
class PosedPoints:
    """All float64. Poses are `wxyz_xyz` of T_world_cam; `outlier` marks wrong pixels and depths."""

    pose: np.ndarray
    initial: np.ndarray
    X_world: np.ndarray
    uv: np.ndarray
    depth: np.ndarray
    sigma_depth: np.ndarray
    outlier: np.ndarray

    def arrays(self, dtype: DTypeLike | None = None) -> tuple[jax.Array, ...]:
        """`X_world, uv, depth, sigma_depth` for JAX, in its default precision."""
        return tuple(jnp.asarray(a, dtype) for a in (self.X_world, self.uv, self.depth, self.sigma_depth))


def make_scene(
    seed: int, n: int = 60, *, noise_px: float = 1.0, noise_depth: float = 1.0, outliers: float = 0.2
) -> PosedPoints:
    """A view of `n` points 1 to 5 m away, the depth noise growing with the square of the depth."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.0, 5.0, n)
    xy = rng.uniform([[-0.55], [-0.42]], [[0.55], [0.42]], (2, n))
    X_cam = np.concatenate([xy * depth, depth[None]])
    uv = cv2.projectPoints(X_cam.T.copy(), np.zeros(3), np.zeros(3), MATRIX, DISTORTION)[0][:, 0].T
    rotation, position = Rotation.from_quat(rng.normal(size=4)), rng.normal(size=3)
    X_world = rotation.apply(X_cam.T).T + position[:, None]
    sigma_depth = 0.005 * depth**2
    uv = uv + noise_px * rng.normal(size=uv.shape)
    depth = depth + noise_depth * sigma_depth * rng.normal(size=n)
    outlier = np.arange(n) < round(outliers * n)
    uv[:, outlier] = rng.uniform([[0.0], [0.0]], [[639.0], [479.0]], (2, outlier.sum()))
    depth[outlier] = rng.uniform(1.0, 5.0, outlier.sum())
    start = rotation * Rotation.from_rotvec(0.03 * rng.normal(size=3))
    return PosedPoints(
        pose=to_wxyz_xyz(rotation, position),
        initial=to_wxyz_xyz(start, position + 0.03 * rng.normal(size=3)),
        X_world=X_world,
        uv=uv,
        depth=depth,
        sigma_depth=sigma_depth,
        outlier=outlier,
    )


def camera(dtype: DTypeLike | None = None) -> Intrinsics:
    """The color camera of TUM's fr1 recordings, lens distortion included."""
    return make_intrinsics(*TUM_FR1, dtype=jnp.zeros(()).dtype if dtype is None else dtype)


def to_wxyz_xyz(rotation: Rotation, position: np.ndarray) -> np.ndarray:
    """A pose as seven numbers, the quaternion's real part first."""
    return np.concatenate([np.roll(rotation.as_quat(), 1), position])


def pose_of(wxyz_xyz: ArrayLike) -> SE3:
    """The pose, in JAX's default precision."""
    return SE3(jnp.asarray(wxyz_xyz, jnp.zeros(()).dtype))


def pose_error(estimate: ArrayLike, truth: ArrayLike) -> tuple[float, float]:
    """Distance in meters and angle in radians between two `wxyz_xyz`."""
    a, b = (np.asarray(p, np.float64) for p in (estimate, truth))
    turn = Rotation.from_quat(np.roll(a[:4], -1)).inv() * Rotation.from_quat(np.roll(b[:4], -1))
    return float(np.linalg.norm(a[4:] - b[4:])), float(turn.magnitude())
