"""The way of the camera of a world: poses at any time."""

from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from jaxslam.datasets.synthetic.camera_path import hand_tremor, looking_at, poses_of
from jaxslam.errors import ConfigError
from jaxslam.geometry.se3 import compose
from jaxslam.geometry.so3 import axis_rotation, matrices, multiply
from jaxslam.sensors.imu_preintegration import GRAVITY_M_PER_S2
from jaxslam.trajectory import trajectory
from jaxslam.worlds.data_paths import data_path
from jaxslam.worlds.description import Way, World
from jaxslam.worlds.motion import SmoothWay

_SWING_PERIOD_S = 8.0
_MIN_POSES = 4
"""A spline through poses needs as many."""


class CameraWay(Protocol):
    """Poses of the camera on its way."""

    def poses(self, time_s: np.ndarray) -> np.ndarray:
        """Poses `T_world_cam` at `(t,)` seconds since the start: `(t, 7)` float64, wxyz_xyz."""
        ...


def camera_way(world: World) -> CameraWay:
    """Return the way of the camera of a world.

    Raises:
        ConfigError: The trajectory in a file is shorter than the recording, or a variable in its path is not set.
        TrajectoryError: The file cannot be read.
    """
    if world.way.file is None:
        return PointWay(world.way, world.seed, world.scale)
    return FileWay(world.way, str(data_path(world.way.file, Path())), world.seconds, world.scale, world.seed)


class PointWay:
    """The way through points."""

    def __init__(self, way: Way, seed: int, scale: float) -> None:
        """Prepare a way.

        Args:
            way: Its description.
            seed: Chooses the phases of the tremor.
            scale: Factor of all lengths.
        """
        self._way, self._scale, self._phases = way, scale, _phases(seed)
        self._smooth = SmoothWay(way.points_m, way.speed_m_per_s, way.ends, way.pause_s, 0.5 * way.turn_s)

    def poses(self, time_s: np.ndarray) -> np.ndarray:
        """Poses `T_world_cam` at `(t,)` seconds since the start: `(t, 7)` float64, wxyz_xyz."""
        within_s = time_s + self._way.from_s
        position = self._smooth.position(within_s)
        if self._way.look == "ahead":
            swing = np.deg2rad(self._way.swing_deg) * np.sin(2.0 * np.pi * within_s / _SWING_PERIOD_S)
            swing += np.pi if self._way.backward else 0.0
            down = np.full(len(time_s), np.deg2rad(self._way.down_deg))
            angles = np.stack([self._smooth.heading(within_s) + swing, down, np.zeros(len(time_s))], axis=1)
        else:
            angles = looking_at(position, np.array(self._way.look))
        moved, turned = hand_tremor(time_s, self._phases)
        position = self._scale * (position + self._way.tremor * moved)
        poses = poses_of(position, angles + self._way.tremor * turned)
        if self._way.flies:
            poses[:, :4] = multiply(_lean(self._smooth.acceleration(within_s)), poses[:, :4])
        return poses


class FileWay:
    """The way of a trajectory in a file: splines through its poses, smooth up to the acceleration.

    Attributes:
        start_ns: Time of the start on the clock of the file, nanoseconds.
    """

    def __init__(self, way: Way, file: str, seconds: float, scale: float, seed: int) -> None:
        """Read the trajectory.

        Args:
            way: Its description.
            file: Its file.
            seconds: Length of the recording.
            scale: Factor of all lengths.
            seed: Chooses the phases of the tremor.

        Raises:
            ConfigError: It is shorter than the recording, or has fewer than four poses.
            TrajectoryError: The file cannot be read.
        """
        self._way, self._scale, self._phases = way, scale, _phases(seed)
        given = trajectory.read(file)
        stamps, first = np.unique(given.timestamps_ns, return_index=True)
        if len(stamps) < _MIN_POSES:
            raise ConfigError(f"{file}: expected at least {_MIN_POSES} poses, got {len(stamps)}")
        times_s = 1e-9 * (stamps - stamps[0])
        poses = compose(_smoothed(given.T_world_cam[first], times_s, way.smooth_s), np.array([way.T_body_cam]))
        if times_s[-1] < way.from_s + seconds:
            needed = f"from_s + seconds, {way.from_s + seconds:g} s"
            raise ConfigError(f"{file}: expected a trajectory of {needed}, got {times_s[-1]:.3f} s")
        self.start_ns = int(stamps[0]) + round(1e9 * way.from_s)
        turn = axis_rotation(2, np.deg2rad(way.turn_deg))
        places = poses[:, 4:] @ matrices(turn).T + np.array(way.at_m)
        self._position = CubicSpline(times_s, places)
        self._rotation = RotationSpline(times_s, Rotation.from_quat(multiply(turn, poses[:, :4])[:, [1, 2, 3, 0]]))

    def poses(self, time_s: np.ndarray) -> np.ndarray:
        """Poses `T_world_cam` at `(t,)` seconds since the start: `(t, 7)` float64, wxyz_xyz."""
        within_s = np.asarray(time_s, np.float64) + self._way.from_s
        moved, turned = (self._way.tremor * each for each in hand_tremor(time_s, self._phases))
        rotation = self._rotation(within_s) * Rotation.from_euler("ZYX", turned)
        position = self._scale * (self._position(within_s) + moved)
        return np.concatenate([rotation.as_quat()[:, [3, 0, 1, 2]], position], axis=1)


def _lean(accel_m_per_s2: np.ndarray) -> np.ndarray:
    """Return the smallest rotations, `(t, 4)` wxyz, from up to the direction in which rotors pull a multirotor."""
    pull = accel_m_per_s2 - GRAVITY_M_PER_S2
    x, y, z = (pull / np.linalg.norm(pull, axis=1, keepdims=True)).T
    # From a unit vector a to b, the quaternion is (1 + a . b, a x b), normalized.
    quaternion = np.stack([1.0 + z, -y, x, np.zeros_like(x)], axis=1)
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)


def _smoothed(poses: np.ndarray, times_s: np.ndarray, over_s: float) -> np.ndarray:
    """Average `(n, 7)` poses at `(n,)` times over a time; those at the ends, with the first and last pose repeated."""
    width = round(over_s / float(np.median(np.diff(times_s))))
    if width < 2:
        return poses
    same_side = np.cumprod(np.where(np.sum(poses[1:, :4] * poses[:-1, :4], axis=1) < 0, -1.0, 1.0))
    signs = np.concatenate([[1.0], same_side])[:, None]
    smooth = uniform_filter1d(
        np.concatenate([signs * poses[:, :4], poses[:, 4:]], axis=1), width, axis=0, mode="nearest"
    )
    smooth[:, :4] /= np.linalg.norm(smooth[:, :4], axis=1, keepdims=True)
    return smooth


def _phases(seed: int) -> np.ndarray:
    return np.random.default_rng([seed, 600]).uniform(0.0, 2.0 * np.pi, (2, 3))
