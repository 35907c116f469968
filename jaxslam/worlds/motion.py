"""Motion along ways: smooth functions of time in float64, exact at any time.

A way is walked at a constant speed, sampled, and smoothed twice over time, so that corners are round and nothing stops
or turns at once; a cubic spline through the samples has continuous acceleration, as an IMU needs it.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from jaxslam.datasets.synthetic.actors import GroundMotion
from jaxslam.worlds.description import Ends, Route

_STEP_S = 0.05
_SMOOTH_S, _SMOOTH_M = 0.6, 6.0
"""Width of each of the two averages of positions over time, and how far something goes in it at most."""
_LEAN_S = 0.3
"""Width of each of the two averages of accelerations over time: how soon a multirotor leans."""
_SLOW_M_PER_S = 0.02
"""Below this speed a direction of motion says nothing."""


class SmoothWay:
    """Positions along a way through points, and the direction in which it goes.

    Attributes:
        seconds: Time from the first point to the last, with `back` and `loop` until it is at the first one again.
    """

    def __init__(
        self,
        points_m: Sequence[Sequence[float]],
        speed_m_per_s: float,
        ends: Ends,
        pause_s: float,
        turn_s: float = _SMOOTH_S,
    ) -> None:
        """Sample and smooth the way.

        Args:
            points_m: Points it passes, `(k, d)`.
            speed_m_per_s: Speed along it.
            ends: See `description.Ends`.
            pause_s: Time of rest at the first and the last point; with `loop`, at the first one.
            turn_s: Width of each of the two averages of directions over time.
        """
        smooth_s = min(_SMOOTH_S, _SMOOTH_M / speed_m_per_s)
        times, places = _timetable(np.asarray(points_m, np.float64), speed_m_per_s, ends, pause_s)
        self.seconds, self._repeats = float(times[-1]), ends != "stop"
        margin_s = 0.0 if self._repeats else 2.0 * max(smooth_s, turn_s)
        num_steps = max(int(np.ceil((self.seconds + 2.0 * margin_s) / _STEP_S)), 8)
        samples = np.linspace(-margin_s, self.seconds + margin_s, num_steps + 1)
        self._step_s, self._bounds = samples[1] - samples[0], "periodic" if self._repeats else "not-a-knot"
        at = np.stack([np.interp(samples, times, column) for column in places.T], axis=1)
        self._positions = self._smooth_spline(samples, at, smooth_s)
        velocity = self._positions(samples, 1)[:, :2]
        if ends == "reverse":
            # It changes direction in the middle of each rest.
            goes_on = np.abs(samples - 0.5 * pause_s - 0.25 * self.seconds) < 0.25 * self.seconds
            velocity = np.where(goes_on[:, None], velocity, -velocity)
        heading = _headings(velocity)
        # A way round turns by a multiple of a full turn: what is left without that repeats too.
        turns = np.round((heading[-1] - heading[0]) / (2.0 * np.pi)) if self._repeats else 0.0
        self._turn_rate = 2.0 * np.pi * turns / self.seconds
        self._headings = self._smooth_spline(samples, (heading - self._turn_rate * samples)[:, None], turn_s)

    def _smooth_spline(self, samples: np.ndarray, values: np.ndarray, smooth_s: float) -> CubicSpline:
        return CubicSpline(samples, _averaged(values, smooth_s / self._step_s, self._repeats), bc_type=self._bounds)

    def position(self, time_s: np.ndarray) -> np.ndarray:
        """Positions at `(t,)` seconds, `(t, d)`."""
        return self._positions(self._folded(time_s))

    def speed(self, time_s: np.ndarray) -> np.ndarray:
        """Speeds on the floor at `(t,)` seconds, `(t,)` m/s."""
        within = self._folded(time_s)
        speed = np.linalg.norm(self._positions(within, 1)[..., :2], axis=-1)
        return speed if self._repeats else np.where(within == time_s, speed, 0.0)

    def acceleration(self, time_s: np.ndarray) -> np.ndarray:
        """Accelerations at `(t,)` seconds, averaged over 0.3 s twice, `(t, d)` m/s^2."""
        return self._accelerations(self._folded(time_s))

    @cached_property
    def _accelerations(self) -> CubicSpline:
        samples = self._positions.x
        return self._smooth_spline(samples, self._positions(samples, 2), _LEAN_S)

    def heading(self, time_s: np.ndarray) -> np.ndarray:
        """Directions of motion at `(t,)` seconds, `(t,)` radians from the x axis, continuous in time."""
        return self._headings(self._folded(time_s))[..., 0] + self._turn_rate * time_s

    def _folded(self, time_s: np.ndarray) -> np.ndarray:
        if self._repeats:
            return np.mod(time_s, self.seconds)
        return np.clip(time_s, self._positions.x[0], self._positions.x[-1])


class RouteWalk:
    """Motion of something on a route: a `Walk` of `datasets.synthetic.actors`."""

    def __init__(self, route: Route) -> None:
        """Prepare the way of a route."""
        self._route = route
        self._way = SmoothWay(route.points_m, route.speed_m_per_s, route.ends, route.pause_s)

    def __call__(self, time_s: np.ndarray) -> GroundMotion:
        """Motion at `(t,)` seconds since the start."""
        since_s = np.asarray(time_s, np.float64) - self._route.delay_s
        heading = self._way.heading(since_s) + (np.pi if self._route.backward else 0.0)
        return GroundMotion(self._way.position(since_s), heading, self._way.speed(since_s))


def _timetable(points: np.ndarray, speed: float, ends: Ends, pause_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times `(k,)` at which something is at places `(k, d)`, at a constant speed between them."""
    if ends == "loop" and not np.array_equal(points[0], points[-1]):
        points = np.concatenate([points, points[:1]])
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arrivals = np.concatenate([[0.0], np.cumsum(steps_m)]) / speed
    # In one direction: rest, go, and rest once more unless the end is the beginning.
    rest_s = 0.0 if ends == "loop" else pause_s
    times = np.concatenate([[0.0], pause_s + arrivals, [pause_s + arrivals[-1] + rest_s]])
    places = np.concatenate([points[:1], points, points[-1:]])
    if ends in {"back", "reverse"}:
        times = np.concatenate([times, times[-1] + arrivals])
        places = np.concatenate([places, points[::-1]])
    return times, places


def _averaged(values: np.ndarray, width: float, repeats: bool) -> np.ndarray:
    """`(n, d)` samples averaged twice over `width` samples; of those that repeat, the last is the first."""
    half = max(round(0.5 * width), 1)
    once = np.full(2 * half + 1, 1.0 / (2 * half + 1))
    weights, reach = np.convolve(once, once), 2 * half
    if repeats:
        padded = values[:-1][np.arange(-reach, len(values) - 1 + reach) % (len(values) - 1)]
    else:
        padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    return np.concatenate([smooth, smooth[:1]]) if repeats else smooth


def _headings(velocity: np.ndarray) -> np.ndarray:
    """Directions of `(n, 2)` velocities, `(n,)` radians, unwrapped; at rest, the direction before or after."""
    angles = np.arctan2(velocity[:, 1], velocity[:, 0])
    moving = np.linalg.norm(velocity, axis=1) > _SLOW_M_PER_S
    if not moving.any():
        return np.zeros(len(velocity))
    last = np.maximum.accumulate(np.where(moving, np.arange(len(angles)), -1))
    return np.unwrap(angles[np.where(last < 0, np.argmax(moving), last)])
