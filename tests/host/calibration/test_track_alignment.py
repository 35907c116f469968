"""Points are found again by their patches, on a textured plane that a camera moves along and turns before."""

from typing import TypeAlias

import cv2
import numpy as np
import pytest

from jaxslam.calibration.batch_solve import BlockState
from jaxslam.calibration.depth_patches import DepthPlanes
from jaxslam.calibration.parameters import vector_of
from jaxslam.calibration.track_alignment import aligned
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.datasets.synthetic.camera_path import camera_path
from jaxslam.geometry.se3 import between, rotate
from jaxslam.geometry.so3 import matrices
from jaxslam.sensors.camera import Camera

CAMERA = Camera("plane", 320, 240, 260.0, 260.0, 159.5, 119.5, depth_scale_per_m=5000.0)
K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
NORMAL, DISTANCE = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0]), 1.6
FRAMES, DRIFT_PX = 12, 0.1
SeenPlane: TypeAlias = tuple[TrackBlock, BlockState, np.ndarray]


def homography(pose: np.ndarray) -> np.ndarray:
    """Pixels of a frame for those of the first one, of points on the plane; `pose` is relative to the first frame."""
    R = matrices(pose[:4])
    return K @ (R.T + np.outer(-R.T @ pose[4:], NORMAL) / DISTANCE) @ np.linalg.inv(K)


@pytest.fixture(scope="module")
def seen_plane() -> SeenPlane:
    """A block whose tracks drift, its true poses and points, and the images."""
    rng = np.random.default_rng(0)
    times_s = np.arange(FRAMES) / 30
    path = camera_path("rpy", 3 * times_s, 1)
    poses = np.stack([between(path[0], pose) for pose in path])
    large = cv2.GaussianBlur(rng.uniform(0, 255, (960, 1280)).astype(np.float32), (0, 0), 5.0)
    large = np.clip(128 + 6 * (large - large.mean()), 0, 255)
    # The first frame sees the middle of the texture at half of its size.
    from_texture = np.diag([0.5, 0.5, 1.0])
    from_texture[:2, 2] = -160, -120
    images = np.stack(
        [
            cv2.warpPerspective(large, homography(pose) @ from_texture, (320, 240), flags=cv2.INTER_AREA)
            for pose in poses
        ]
    )
    gains = rng.uniform(0.9, 1.1, (FRAMES, 1, 1))
    noisy = np.clip(gains * images + rng.normal(0, 1.0, images.shape), 0, 255).round().astype(np.uint8)
    first = np.stack([rng.uniform(40, 280, 60), rng.uniform(40, 200, 60), np.ones(60)])
    rays = np.linalg.inv(K) @ first
    X_world = rays * DISTANCE / (NORMAL @ rays)
    uv, planes = np.zeros((FRAMES, 2, 60)), np.zeros((FRAMES, 3, 60))
    for index, pose in enumerate(poses):
        X_cam = matrices(pose[:4]).T @ (X_world - pose[4:, None])
        uv[index] = (K @ (X_cam / X_cam[2]))[:2]
        normal = rotate(np.array([*(pose[:4] * [1, -1, -1, -1]), 0, 0, 0]), NORMAL)
        planes[index] = [1 / X_cam[2], *(normal[:2, None] / [[CAMERA.fx], [CAMERA.fy]] / (normal @ X_cam))]
    seen = np.asarray(((uv > 12) & (uv < np.array([[307], [227]]))).all(axis=1))
    drifted = uv + DRIFT_PX * rng.normal(size=uv.shape).cumsum(axis=0)
    block = TrackBlock(
        times_s=times_s,
        poses=poses,
        X_world=X_world,
        uv=drifted,
        seen=seen,
        depth=DepthPlanes(planes, uv, np.full(seen.shape, 0.01), seen),
        patches=None,
        delay_s=np.zeros(FRAMES),
        time_sign=np.ones(FRAMES),
        origin=poses[0],
        timestamps_ns=np.round(1e9 * times_s).astype(np.int64),
    )
    return block, BlockState(poses, np.pad(X_world, ((0, 1), (0, 0)))), noisy


def spread_px(block: TrackBlock) -> float:
    """Deviation of the places on the plane that the frames say a point is at, in pixels of the first frame."""
    places = []
    for pose, uv, seen in zip(block.poses, block.uv, block.seen, strict=True):
        u, v, w = np.linalg.inv(homography(pose)) @ np.concatenate([uv, np.ones((1, uv.shape[1]))])
        places.append(np.where(seen, np.stack([u / w, v / w]), np.nan))
    return float(np.nanmean(np.nanstd(places, axis=0)))


@pytest.mark.slow
def test_drift_is_undone(seen_plane: SeenPlane) -> None:
    block, state, images = seen_plane
    found = aligned(block, state, vector_of(CAMERA), images)
    assert spread_px(block) > 0.1
    assert spread_px(found) < 0.02
    assert found.seen.sum() > 0.9 * block.seen.sum()
    assert not (found.seen & ~block.seen).any()


def test_what_looks_different_is_not_seen(seen_plane: SeenPlane) -> None:
    block, state, images = seen_plane
    covered = images.copy()
    covered[-1] = np.random.default_rng(1).integers(0, 255, covered[-1].shape)
    found = aligned(block, state, vector_of(CAMERA), covered)
    assert found.seen[-1].sum() <= 0.05 * block.seen[-1].sum()
    assert found.seen[:-1].sum() > 0.9 * block.seen[:-1].sum()
