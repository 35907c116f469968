"""The way of the camera of a world: poses at any time."""

import numpy as np

from jaxslam.datasets.synthetic.camera_path import hand_tremor, looking_at, poses_of
from jaxslam.worlds.description import Way
from jaxslam.worlds.motion import SmoothWay

_SWING_PERIOD_S = 8.0


class CameraWay:
    """Poses of the camera on its way."""

    def __init__(self, way: Way, seed: int) -> None:
        """Prepare a way.

        Args:
            way: Its description.
            seed: Chooses the phases of the tremor.
        """
        self._way = way
        self._smooth = SmoothWay(way.points_m, way.speed_m_per_s, way.ends, way.pause_s, 0.5 * way.turn_s)
        self._phases = np.random.default_rng([seed, 600]).uniform(0.0, 2.0 * np.pi, (2, 3))
        self.seconds = self._smooth.seconds

    def poses(self, time_s: np.ndarray) -> np.ndarray:
        """Poses `T_world_cam` at `(t,)` seconds since the start: `(t, 7)` float64, wxyz_xyz."""
        position = self._smooth.position(time_s)
        if self._way.look == "ahead":
            swing = np.deg2rad(self._way.swing_deg) * np.sin(2.0 * np.pi * time_s / _SWING_PERIOD_S)
            down = np.full(len(time_s), np.deg2rad(self._way.down_deg))
            angles = np.stack([self._smooth.heading(time_s) + swing, down, np.zeros(len(time_s))], axis=1)
        else:
            angles = looking_at(position, np.array(self._way.look))
        moved, turned = hand_tremor(time_s, self._phases)
        return poses_of(position + self._way.tremor * moved, angles + self._way.tremor * turned)
