"""A map of exact geometry: a camera that moves sideways past a wall."""

import numpy as np
from small_map import points

from jaxslam.features.orb import Features
from jaxslam.geometry.se3 import to_local
from jaxslam.map.edit import with_keyframe, with_observations, with_points
from jaxslam.map.point_records import NONE, Observations
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.sensors.camera import Camera

CAMERA = Camera("exact", 640, 480, 525.0, 525.0, 319.5, 239.5)


NOTHING = Features(
    *(np.zeros((2, 0), np.float32) for _ in range(2)),
    depth=np.zeros(0, np.float32),
    octave=np.zeros(0, np.uint8),
    angle=np.zeros(0, np.float32),
    descriptor=np.zeros((0, 32), np.uint8),
)


def seen_by(slam_map: Map, keyframe_id: int, shown: np.ndarray) -> Observations:
    """Exact observations of points in a keyframe, with depth for two of three."""
    ids = slam_map.points.ids[shown]
    X = to_local(slam_map.pose(keyframe_id), slam_map.points.X_world[:, shown])
    uv = np.stack([CAMERA.fx * X[0] / X[2] + CAMERA.cx, CAMERA.fy * X[1] / X[2] + CAMERA.cy]).astype(np.float32)
    ones = np.ones(len(ids), np.float32)
    return Observations(
        keyframe=np.full(len(ids), keyframe_id, np.int64),
        point=ids,
        feature=np.full(len(ids), NONE, np.int32),
        uv_raw=uv,
        uv=uv,
        depth=np.where(ids % 3 > 0, X[2], 0).astype(np.float32),
        sigma_px=0.3 * ones,
        weight=ones,
    )


def exact_map(num_keyframes: int = 16, num_points: int = 800, *, reach: float = 0.9, seed: int = 0) -> Map:
    """A camera that moves sideways past a wall, each keyframe seeing what is within reach of it."""
    rng = np.random.default_rng(seed)
    slam_map = empty_map(CAMERA)
    for number in range(num_keyframes):
        frame = Keyframe(number, number, NOTHING, b"")
        turn = np.concatenate([[1.0], 0.02 * rng.normal(size=3)])
        place = [0.15 * number, *0.05 * rng.normal(size=2)]
        slam_map = with_keyframe(slam_map, frame, np.concatenate([turn, place]), number - 1 if number else NONE, 0)
    some = points(slam_map, np.zeros(num_points, np.int64), rng)
    span = 0.15 * num_keyframes + reach
    wall = rng.uniform([[-reach], [-0.7], [2.0]], [[span], [0.7], [3.0]], (3, num_points))
    slam_map = with_points(slam_map, some._replace(X_world=wall, weight=np.ones(num_points, np.float32)))
    for number in range(num_keyframes):
        near = np.abs(slam_map.points.X_world[0] - slam_map.T_world_cam[number, 4]) < reach
        slam_map = with_observations(slam_map, seen_by(slam_map, number, np.flatnonzero(near)))
    return slam_map
