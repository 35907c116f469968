"""Blocks of tracks as a camera with known parameters would give, in the parameters' own model of time and lens."""

from dataclasses import dataclass

import numpy as np

from jaxslam.calibration.depth_patches import DepthPlanes
from jaxslam.calibration.parameters import CameraVector, vector_of
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.datasets.synthetic.camera_path import camera_path
from jaxslam.geometry.se3 import between, compose, rotate
from jaxslam.geometry.so3 import matrices
from jaxslam.sensors.camera import Camera

CAMERA = Camera("simulated", 320, 240, 262.0, 260.0, 161.0, 117.0, depth_scale_per_m=5000.0)
EXTRINSICS = (0.004, -0.006, 0.003, 0.015, -0.008)
FPS = 30.0


@dataclass(frozen=True)
class Simulation:
    """What is simulated.

    Attributes:
        truth: True parameters.
        path: Kind of the camera's path.
        seed: Chooses path, points and noise.
        pixel: Noise of a pixel.
        depth: Noise of the inverse depth, 1/m.
        num_points: Points of a block.
    """

    truth: CameraVector
    path: str = "rpy"
    seed: int = 0
    pixel: float = 0.2
    depth: float = 0.002
    num_points: int = 80


def true_vector() -> CameraVector:
    """True parameters of a camera with all faults."""
    camera = Camera(
        "true", 320, 240, 262.0, 260.0, 161.0, 117.0,
        distortion=(0.08, -0.12, 0.001, -0.002, 0.03),
        depth_offset_m=0.02, depth_delay_s=0.008, readout_s=0.015,
    )  # fmt: skip
    vector = vector_of(camera)
    vector[12:] = EXTRINSICS
    return vector


def simulate_blocks(simulation: Simulation, num_blocks: int = 10, num_frames: int = 15) -> list[TrackBlock]:
    """Blocks in a row."""
    rng = np.random.default_rng(simulation.seed)
    return [_block(simulation, index * num_frames / FPS, num_frames, rng) for index in range(num_blocks)]


def _block(simulation: Simulation, start_s: float, num_frames: int, rng: np.random.Generator) -> TrackBlock:
    times_s = np.arange(num_frames) / FPS
    path = lambda seconds: camera_path(simulation.path, start_s + np.atleast_1d(seconds), simulation.seed)
    poses, truth, count = path(times_s), simulation.truth, simulation.num_points
    # Points that the middle frame sees, each on a plane of its own.
    middle = poses[num_frames // 2]
    rays = _rays(truth, np.stack([rng.uniform(5, 314, count), rng.uniform(5, 234, count)]))
    X_world = (rotate(middle, (rays * rng.uniform(1.0, 3.5, count)).T) + middle[4:]).T
    normals = rng.normal(size=(3, count)) * 0.5 + rotate(middle, np.array([0.0, 0.0, 1.0]))[:, None]
    uv = np.stack([_seen(truth, path, time_s, X_world) for time_s in times_s])
    inside = (uv[:, 0] > 1) & (uv[:, 0] < 318) & (uv[:, 1] > 1) & (uv[:, 1] < 238)
    uv_seen = uv + simulation.pixel * rng.normal(size=uv.shape)
    plane = np.stack(
        [_plane(truth, path(t + truth[10])[0], X_world, normals, at) for t, at in zip(times_s, uv_seen, strict=True)]
    )
    noise = simulation.depth * rng.normal(size=(num_frames, count))
    plane[:, 0] += noise
    return TrackBlock(
        times_s=times_s,
        poses=np.stack([between(poses[0], pose) for pose in poses]),
        X_world=matrices(poses[0, :4]).T @ (X_world - poses[0, 4:, None]),
        uv=uv_seen,
        seen=inside,
        depth=DepthPlanes(
            plane,
            uv_seen,
            np.full((num_frames, count), 2 * simulation.depth),
            inside & (rng.uniform(size=inside.shape) < 0.9),
        ),
        patches=None,
        delay_s=np.zeros(num_frames),
        time_sign=np.ones(num_frames),
        origin=poses[0],
        timestamps_ns=np.round(1e9 * (start_s + times_s)).astype(np.int64),
    )


def _rays(truth: CameraVector, uv: np.ndarray) -> np.ndarray:
    """Directions with a depth of one, by Newton-free fixed-point iteration on the lens."""
    target = (uv - truth[2:4, None]) / truth[:2, None]
    xy = target.copy()
    for _ in range(60):
        xy += target - _bent(truth, xy)
    return np.concatenate([xy, np.ones((1, xy.shape[1]))])


def _bent(truth: CameraVector, xy: np.ndarray) -> np.ndarray:
    k1, k2, p1, p2, k3 = truth[4:9]
    x, y = xy
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )


def _pixels(truth: CameraVector, X_cam: np.ndarray) -> np.ndarray:
    return truth[:2, None] * _bent(truth, X_cam[:2] / X_cam[2]) + truth[2:4, None]


def _seen(truth: CameraVector, path, time_s: float, X_world: np.ndarray) -> np.ndarray:
    """Pixels of points in an image whose rows are taken one after the other."""
    row, uv = np.full(X_world.shape[1], 119.5), np.zeros((2, X_world.shape[1]))
    for _ in range(8):
        poses = path(time_s + truth[11] * (row / 239 - 0.5))
        X_cam = np.einsum("nji,nj->ni", matrices(poses[:, :4]), X_world.T - poses[:, 4:]).T
        uv = _pixels(truth, X_cam)
        row = uv[1]
    return uv


def _plane(
    truth: CameraVector, pose: np.ndarray, X_world: np.ndarray, normals: np.ndarray, uv: np.ndarray
) -> np.ndarray:
    """Inverse depth that the depth camera measures around pixels on planes through the points, and its slope."""
    turn, shift = truth[12:15], np.array([truth[15], truth[16], 0.0])
    angle = np.linalg.norm(turn)
    axis = turn / angle if angle else turn
    T_depth_color = compose(
        np.array([np.cos(angle / 2), *np.sin(angle / 2) * axis, 0, 0, 0]), np.array([1.0, 0, 0, 0, *shift])
    )
    T_cam_world = between(pose, np.array([1.0, 0, 0, 0, 0, 0, 0]))
    T = compose(T_depth_color, T_cam_world)
    X, normal = (rotate(T, X_world.T) + T[4:]).T, rotate(T, normals.T).T
    distance = (X * normal).sum(axis=0)

    def inverse(at: np.ndarray) -> np.ndarray:
        return 1 / (distance / (normal * _rays(truth, at)).sum(axis=0) + truth[9])

    step = np.array([[0.5], [0.0]])
    return np.stack([inverse(uv), *(inverse(uv + each) - inverse(uv - each) for each in (step, step[::-1]))])
