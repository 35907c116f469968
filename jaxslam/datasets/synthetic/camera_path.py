"""Paths of the hand-held camera: smooth closed forms, in the manner of the TUM RGB-D recordings.

World axes: x forward from the camera's usual place, y to the left, z up, origin on the floor in the middle of the
room. Poses are `T_world_cam`, wxyz_xyz, with OpenCV camera axes.
"""

from collections.abc import Callable
from typing import TypeAlias, get_args

import numpy as np

from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.errors import ConfigError, nearest
from jaxslam.geometry.so3 import axis_rotation, multiply

CAMERA_PATHS: tuple[str, ...] = get_args(CameraPathKind)
LOOP_SECONDS = 32.0
HOME = np.array([-1.9, 0.0, 1.35])
DESK = np.array([0.4, 0.0, 0.85])

_BODY_FROM_CAMERA = np.array([0.5, -0.5, 0.5, -0.5])
_HOME_PITCH = np.deg2rad(12.0)

_Motion: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Positions `(n, 3)` and yaw, pitch (positive looks down), roll `(n, 3)` in radians."""


def camera_path(kind: str, time_s: np.ndarray, seed: int) -> np.ndarray:
    """Camera poses at given times.

    Args:
        kind: One of `CAMERA_PATHS`.
        time_s: `(n,)` seconds since the start.
        seed: Chooses the phases of the motion and of the hand's tremor.

    Returns:
        `(n, 7)` float64 poses `T_world_cam`, wxyz_xyz.

    Raises:
        ConfigError: `kind` is not the name of a path.
    """
    if kind not in _PATHS:
        raise ConfigError(f"path: no camera path '{kind}'{nearest(kind, CAMERA_PATHS)}")
    time_s = np.asarray(time_s, np.float64)
    phases = np.random.default_rng([seed, CAMERA_PATHS.index(kind)]).uniform(0.0, 2.0 * np.pi, (4, 3))
    position, angles = _PATHS[kind](time_s, phases)
    moved, turned = hand_tremor(time_s, phases[2:])
    return poses_of(position + moved, angles + turned)


def hand_tremor(time_s: np.ndarray, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tremor of the hand that holds the camera.

    Args:
        time_s: `(n,)` seconds since the start.
        phases: `(2, 3)` phases in radians.

    Returns:
        Offsets of the position, `(n, 3)` meters, and of yaw, pitch and roll, `(n, 3)` radians.
    """
    shake = _waves(time_s, (0.9, 0.63, 0.77), phases[0]) + 0.5 * _waves(time_s, (0.37, 0.31, 0.41), phases[1])
    return 0.002 * shake, np.deg2rad(0.15) * np.roll(shake, 1, axis=1)


def _waves(time_s: np.ndarray, periods: tuple[float, float, float], phases: np.ndarray) -> np.ndarray:
    """Three unit sinusoids, `(n, 3)`."""
    return np.sin(2.0 * np.pi * time_s[:, None] / np.array(periods) + phases)


def _xyz(time_s: np.ndarray, phases: np.ndarray) -> _Motion:
    position = HOME + np.array([0.15, 0.25, 0.12]) * _waves(time_s, (5.3, 7.1, 4.7), phases[0])
    angles = np.deg2rad([2.5, 2.0, 1.5]) * _waves(time_s, (6.1, 4.3, 5.9), phases[1])
    return position, angles + np.array([0.0, _HOME_PITCH, 0.0])


def _rpy(time_s: np.ndarray, phases: np.ndarray) -> _Motion:
    position = HOME + 0.03 * _waves(time_s, (3.1, 3.7, 2.9), phases[0])
    angles = np.deg2rad([25.0, 14.0, 20.0]) * _waves(time_s, (5.1, 3.9, 4.5), phases[1])
    return position, angles + np.array([0.0, _HOME_PITCH, 0.0])


def _halfsphere(time_s: np.ndarray, phases: np.ndarray) -> _Motion:
    sweep = _waves(time_s, (10.0, 6.7, 5.0), phases[0])
    azimuth, elevation = np.deg2rad(50.0) * sweep[:, 0], np.deg2rad(22.0) * (1.0 + sweep[:, 1])
    outward = np.stack(
        [-np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    position = HOME + np.array([0.35, 0.0, -0.1]) + 0.5 * outward
    return position, looking_at(position, DESK) + np.deg2rad(3.0) * sweep[:, [2, 2, 2]]


def _static(time_s: np.ndarray, phases: np.ndarray) -> _Motion:
    position = HOME + 0.004 * _waves(time_s, (3.3, 4.1, 2.7), phases[0])
    angles = np.deg2rad(0.4) * _waves(time_s, (3.9, 2.3, 3.1), phases[1])
    return position, angles + np.array([0.0, _HOME_PITCH, 0.0])


def _loop(time_s: np.ndarray, phases: np.ndarray) -> _Motion:
    turn = 2.0 * np.pi * time_s / LOOP_SECONDS
    # Harmonics of the round close with it: the camera comes back to where it left, but for the tremor of the hand.
    bob = np.sin(turn[:, None] * np.array([3.0, 2.0, 4.0]) + phases[0])
    ring = np.stack([-np.cos(turn), -np.sin(turn), np.zeros_like(turn)], axis=1)
    position = np.array([0.2, 0.0, 1.35]) + np.array([1.75, 1.9, 0.0]) * ring + 0.06 * bob
    target = DESK + 0.25 * np.sin(turn[:, None] * np.array([2.0, 3.0, 2.0]) + phases[1])
    return position, looking_at(position, target)


_PATHS: dict[str, Callable[[np.ndarray, np.ndarray], _Motion]] = {
    "xyz": _xyz,
    "rpy": _rpy,
    "halfsphere": _halfsphere,
    "static": _static,
    "loop": _loop,
}


def looking_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Yaw, pitch and zero roll `(n, 3)` that point the optical axis from `position` to `target`."""
    x, y, z = np.moveaxis(target - position, -1, 0)
    return np.stack([np.arctan2(y, x), np.arctan2(-z, np.hypot(x, y)), np.zeros_like(x)], axis=1)


def poses_of(position: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Camera poses `(n, 7)` at positions `(n, 3)`, with yaw, pitch (positive looks down) and roll `(n, 3)`."""
    yaw, pitch, roll = angles.T
    body = multiply(axis_rotation(2, yaw), axis_rotation(1, pitch))
    rotation = multiply(multiply(body, axis_rotation(0, roll)), _BODY_FROM_CAMERA)
    return np.concatenate([rotation, position], axis=1)
