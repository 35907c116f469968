"""Boxes that stand for a while, are pushed about for a while, and stand again: what may move, and mostly does not."""

import numpy as np

from jaxslam.datasets.synthetic.crate import Crate
from jaxslam.geometry.so3 import axis_rotation

MAX_PARKED = 2
PERIOD_S = 5.0
"""It stands so long, moves as long, and so on."""
_SPEED_M_PER_S, _RAMP_S = 0.5, 0.1
"""While it moves, and the time in which it gets as fast and slows down again: a push."""
_CENTERS, _SEMI_AXES = ((-0.5, 0.0), (1.5, 0.9)), (0.14, 0.5)
"""Ellipses on the floor along which they are pushed, one in front of the desk and one behind it."""
_TABLE = 720


class ParkedBox(Crate):
    """A large box on the floor, such as a crate on rollers."""

    def __init__(self, place: int, seed: int) -> None:
        """The box in one of `MAX_PARKED` places; the seed chooses where it begins, which way it goes and its size."""
        rng = np.random.default_rng([seed, 500, place])
        self._center = np.array(_CENTERS[place])
        start, self._turn = rng.uniform(0.0, 2.0 * np.pi, 2)
        self._sense = rng.choice((-1.0, 1.0))
        half_m = rng.uniform((0.14, 0.16, 0.40), (0.20, 0.22, 0.55))
        super().__init__(half_m, ((0.30, 0.34, 0.42), (0.55, 0.58, 0.62)), rng)
        self._angles, self._ways = _by_way()
        self._start_m = float(np.interp(start, self._angles, self._ways))

    def root(self, time_s: np.ndarray) -> np.ndarray:
        """Poses of the center of the box: `(t, 7)`, wxyz_xyz."""
        way = way_m(time_s)
        angle = np.interp((self._start_m + self._sense * way) % self._ways[-1], self._ways, self._angles)
        position = self._center + np.stack([_SEMI_AXES[0] * np.cos(angle), _SEMI_AXES[1] * np.sin(angle)], axis=-1)
        height = np.full((len(way), 1), self.half_m[2])
        return np.concatenate([axis_rotation(2, self._turn + 0.4 * self._sense * way), position, height], axis=1)


def is_moving(time_s: np.ndarray) -> np.ndarray:
    """`(t,)` bool, when parked boxes move."""
    return np.asarray(time_s) % (2 * PERIOD_S) >= PERIOD_S


def way_m(time_s: np.ndarray) -> np.ndarray:
    """`(t,)` how far a parked box has been pushed: at a constant speed, but for the ramps at both ends."""
    rounds, within = np.divmod(np.asarray(time_s, np.float64), 2 * PERIOD_S)
    moving = np.clip(within - PERIOD_S, 0.0, PERIOD_S)
    end = np.clip(moving - (PERIOD_S - _RAMP_S), 0.0, _RAMP_S)
    start = np.clip(moving, 0.0, _RAMP_S)
    flat = np.clip(moving, _RAMP_S, PERIOD_S - _RAMP_S) - _RAMP_S
    seconds = 0.5 * start**2 / _RAMP_S + flat + end - 0.5 * end**2 / _RAMP_S
    return _SPEED_M_PER_S * (rounds * (PERIOD_S - _RAMP_S) + seconds)


def _by_way() -> tuple[np.ndarray, np.ndarray]:
    """Angles once around the ellipse, and how long the way to each is from the one it begins with."""
    angles = np.linspace(0.0, 2.0 * np.pi, _TABLE)
    steps = np.hypot(_SEMI_AXES[0] * np.diff(np.cos(angles)), _SEMI_AXES[1] * np.diff(np.sin(angles)))
    return angles, np.concatenate([[0.0], np.cumsum(steps)])
