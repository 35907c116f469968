"""Rotation and time between a camera and a gyro, from how both turn: neither poses nor points change for it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from jaxslam.calibration.report import Estimate, Verdict
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.trajectory.trajectory import Trajectory

_NAMES = ("gyro_turn_x", "gyro_turn_y", "gyro_turn_z", "gyro_delay_s")
_UNITS = ("rad", "rad", "rad", "s")
_TRIED_S = np.linspace(-0.1, 0.1, 41)
"""Delays from which the fit begins: the best of them."""
_FEWEST_STEPS, _PARTS = 40, 10
"""Steps from frame to frame that are needed, and parts of the recording that are compared."""
_SURE = 2.0
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class _Turns:
    """Rotations of a camera from frame to frame, and the orientation of a gyro over time.

    Attributes:
        start_s: `(n,)` times at which the rotations begin, seconds.
        end_s: `(n,)` times at which they end, seconds.
        turned: Rotations of the camera, `n` of them, in its own axes.
        orientation: Orientation of the gyro at a time, up to the bias.
        span_s: First and last time of the gyro, seconds.
    """

    start_s: Float[np.ndarray, " n"]
    end_s: Float[np.ndarray, " n"]
    turned: Rotation
    orientation: Slerp
    span_s: tuple[float, float]

    def of_gyro(self, delay_s: float) -> Rotation:
        """Rotations of the gyro over the same times, later by a delay."""
        start, end = (np.clip(times + delay_s, *self.span_s) for times in (self.start_s, self.end_s))
        return self.orientation(start).inv() * self.orientation(end)


def calibrate_gyro(trajectory: Trajectory, samples: ImuSamples, sheet: ImuSheet) -> tuple[Estimate, ...]:
    """Estimate how the axes of a gyro lie to those of the camera, and how late its clock is.

    The bias of the gyro is estimated along. A value changes only if it makes the parts of the recording that it was not
    fitted to agree better.

    Args:
        trajectory: Poses of the camera, tracked without the gyro.
        samples: Samples of the IMU.
        sheet: Data sheet of the IMU, with the place of the camera on it.

    Returns:
        `gyro_turn_x`, `_y`, `_z`: rotation vector, in camera axes, by which `T_imu_cam` of the sheet is to be turned;
        and `gyro_delay_s`: the time to be added to that of a frame to get the time of the samples. No estimates if the
        recording and the samples hardly overlap.
    """
    turns = _turns(trajectory, samples)
    if turns is None:
        return ()
    stated = Rotation.from_quat(np.roll(sheet.T_imu_cam[:4], -1))
    first = _first_guess(turns, stated)
    scale = _scale(_residuals(first, turns, stated))
    part = np.arange(len(turns.start_s)) * _PARTS // len(turns.start_s)
    found = _fit(first, turns, stated, scale, part >= 0)
    sigmas = _standard_deviations(found, turns, stated, scale, part)
    before = np.zeros(7)
    before[4:] = found[4:]
    gains = []
    for half in (0, 1):
        held = part % 2 != half
        fitted = _fit(found, turns, stated, scale, ~held)
        costs = [_costs(_residuals(each, turns, stated)[held], scale) for each in (before, fitted)]
        gains.append(costs[0] - costs[1])
    gain = np.concatenate(gains)
    better = gain.mean() > _SURE * gain.std(ddof=1) / np.sqrt(len(gain))
    verdict = Verdict.NOT_IN_FILE if better else Verdict.NO_GAIN
    return tuple(
        Estimate(name, unit, 0.0, float(found[k]) if better else 0.0, float(found[k]), float(sigmas[k]), verdict)
        for k, (name, unit) in enumerate(zip(_NAMES, _UNITS, strict=True))
    )


def _turns(trajectory: Trajectory, samples: ImuSamples) -> _Turns | None:
    """Prepare both; `None` if they have too little time in common."""
    if len(samples) < 2 or len(trajectory) < 2:
        return None
    origin = int(samples.timestamps_ns[0])
    times = 1e-9 * (samples.timestamps_ns - origin)
    steps = 0.5 * (samples.gyro_rad_per_s[1:] + samples.gyro_rad_per_s[:-1]) * np.diff(times)[:, None]
    orientation = [Rotation.identity()]
    for step in Rotation.from_rotvec(steps):
        orientation.append(orientation[-1] * step)
    frames = 1e-9 * (trajectory.timestamps_ns - origin)
    camera = Rotation.from_quat(np.roll(trajectory.T_world_cam[:, :4], -1, axis=1))
    lengths = np.diff(frames)
    margin = float(np.abs(_TRIED_S).max())
    usable = (frames[:-1] > margin) & (frames[1:] < times[-1] - margin) & (lengths < 2.5 * np.median(lengths))
    if usable.sum() < _FEWEST_STEPS:
        return None
    turned = camera[:-1].inv() * camera[1:]
    slerp = Slerp(times, Rotation.concatenate(orientation))
    return _Turns(frames[:-1][usable], frames[1:][usable], turned[usable], slerp, (times[0], times[-1]))


def _first_guess(turns: _Turns, stated: Rotation) -> Float[np.ndarray, "7"]:
    """Return turn, delay and bias: of all delays that are tried, the one with which the rotations are the same."""
    camera = stated.apply(turns.turned.as_rotvec())
    best, least = np.zeros(7), np.inf
    for delay_s in _TRIED_S:
        gyro = turns.of_gyro(delay_s).as_rotvec()
        turn = Rotation.align_vectors(gyro, camera)[0]
        cost = float(np.median(np.linalg.norm(gyro - turn.apply(camera), axis=1)))
        if cost < least:
            # From IMU axes to those of the camera, in which the turn is to be.
            own = stated.inv().apply(turn.as_rotvec())
            best, least = np.array([*own, delay_s, 0.0, 0.0, 0.0]), cost
    return best


def _residuals(values: np.ndarray, turns: _Turns, stated: Rotation) -> Float[np.ndarray, "n 3"]:
    """Return by how much camera and gyro turn differently, `(n, 3)` rad."""
    imu_from_camera = stated * Rotation.from_rotvec(values[:3])
    lengths = turns.end_s - turns.start_s
    gyro = turns.of_gyro(values[3]) * Rotation.from_rotvec(-values[4:] * lengths[:, None])
    camera = imu_from_camera * turns.turned * imu_from_camera.inv()
    return (camera.inv() * gyro).as_rotvec()


def _fit(first: np.ndarray, turns: _Turns, stated: Rotation, scale: float, used: np.ndarray) -> Float[np.ndarray, "7"]:
    units = np.array([1e-2, 1e-2, 1e-2, 1e-3, 1e-2, 1e-2, 1e-2])
    residuals = lambda values: (_residuals(values * units, turns, stated)[used] / scale).ravel()
    return least_squares(residuals, first / units, loss="cauchy", f_scale=2.0, diff_step=1e-4).x * units


def _scale(residuals: Float[np.ndarray, "n 3"]) -> float:
    return max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals))), 1e-7)


def _costs(residuals: Float[np.ndarray, "n 3"], scale: float) -> Float[np.ndarray, " n"]:
    return np.log1p((residuals / scale) ** 2).sum(axis=1)


def _standard_deviations(
    found: np.ndarray, turns: _Turns, stated: Rotation, scale: float, part: np.ndarray
) -> Float[np.ndarray, "7"]:
    """Return the standard deviations by which the parts of the recording contradict each other (the jackknife)."""
    without = np.array([_fit(found, turns, stated, scale, part != each) for each in range(_PARTS)])
    return np.sqrt((_PARTS - 1) / _PARTS * np.square(without - without.mean(axis=0)).sum(axis=0))
