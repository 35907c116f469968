"""A hand before the lens: an actor that is fixed to the camera, and comes and goes."""

from collections.abc import Callable

import numpy as np

from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.primitives import Solid, capsule, pill, scaled_solid
from jaxslam.datasets.synthetic.texture import Material
from jaxslam.geometry.so3 import axis_rotation, matrices
from jaxslam.worlds.description import Hand

_SKIN = Material((0.72, 0.50, 0.38), (0.85, 0.64, 0.52), noise_per_m=30.0, noise=0.4)
_COMES_IN_S = 0.3
_FINGERS_M = ((-0.033, 0.070), (-0.011, 0.082), (0.011, 0.078), (0.033, 0.062))
"""Place across the palm and length of each finger."""
_FINGER_M, _PALM_M, _ARM_M = 0.0095, 0.095, 0.25
"""Radius of a finger, and lengths of palm and forearm."""
_OUT_OF_SIGHT_M = 1e4


class HandActor:
    """A palm with four fingers and a forearm, upright in the picture."""

    label = "person"

    def __init__(
        self,
        hand: Hand,
        pose_at: Callable[[np.ndarray], np.ndarray],
        picture_tan: float,
        rng: np.random.Generator,
        factor: float = 1.0,
    ) -> None:
        """Build a hand.

        Args:
            hand: Its description.
            pose_at: `(t, 7)` poses `T_world_cam`, wxyz_xyz, at `(t,)` seconds.
            picture_tan: Height of the picture at a distance of 1.
            rng: Chooses the pattern of the skin.
            factor: Factor of all lengths.
        """
        self._hand, self._pose_at, self._factor = hand, pose_at, factor
        fingers: list[Solid] = [capsule(_FINGER_M, length, _SKIN, rng) for _, length in _FINGERS_M]
        palm, arm = pill((0.047, 0.018, 0.055), 0.02, _SKIN, rng), pill((0.032, 0.03, 0.03), _ARM_M, _SKIN, rng)
        self.solids = [scaled_solid(each, factor) for each in (*fingers, palm, arm)]
        upright = matrices(axis_rotation(0, np.pi / 2.0))  # z of a solid is up in the picture, -y of the camera
        tops = [np.array([x, -_PALM_M - 0.5 * length, 0.0]) for x, length in _FINGERS_M]
        places = [*tops, np.array([0.0, -0.045, 0.0]), np.array([0.0, 0.5 * _ARM_M, 0.0])]
        self._places = np.stack([transform(upright, place) for place in places])
        height_m = picture_tan * hand.before_m
        tip_m = _PALM_M + max(length for _, length in _FINGERS_M) + _FINGER_M
        self._there_m = 0.5 * height_m - hand.covers * height_m + tip_m
        self._away_m = 0.5 * height_m + tip_m + 0.02

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the camera at `(t,)` seconds: `(t, 7)`, wxyz_xyz."""
        return self._pose_at(time_s)

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        """Placements of its solids in the axes of the camera: `(t, 6, 4, 4)`."""
        to_end_s = np.minimum(time_s - self._hand.from_s, self._hand.until_s - time_s)
        share = np.clip(to_end_s / _COMES_IN_S, 0.0, 1.0)
        down_m = self._away_m + share**2 * (3.0 - 2.0 * share) * (self._there_m - self._away_m)
        parts = np.tile(self._places, (len(time_s), 1, 1, 1))
        parts[..., 1, 3] += down_m[:, None]
        parts[..., 2, 3] += np.where(to_end_s > 0.0, self._hand.before_m, -_OUT_OF_SIGHT_M)[:, None]
        parts[..., :3, 3] *= self._factor
        return parts
