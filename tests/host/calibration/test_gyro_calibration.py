"""Rotation and time between a camera and a gyro."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.calibration.gyro_calibration import calibrate_gyro
from jaxslam.calibration.report import Verdict
from jaxslam.datasets.synthetic.camera_path import camera_path
from jaxslam.sensors.imu import ImuSamples, ImuSheet
from jaxslam.trajectory.trajectory import Trajectory

STATED = ImuSheet(200.0, 1e-4, 1e-5, 1e-3, 1e-4, (0.5, -0.5, 0.5, -0.5, 0.1, 0.0, 0.0))
TURN, DELAY_S, BIAS = np.array([0.02, -0.03, 0.01]), 0.012, np.array([0.03, -0.02, 0.01])


def rotations(time_s: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(camera_path("rpy", time_s, 0)[:, :4], -1, axis=1))


def samples(turn: np.ndarray, delay_s: float, rng: np.random.Generator) -> ImuSamples:
    """Angular rates of a gyro that is turned and late."""
    time_s = np.arange(0.0, 7.0, 1 / 200)
    half = 5e-4
    rates = (rotations(time_s - half).inv() * rotations(time_s + half)).as_rotvec() / (2 * half)
    stated = Rotation.from_quat(np.roll(STATED.T_imu_cam[:4], -1))
    own = (stated * Rotation.from_rotvec(turn)).apply(rates) + BIAS + 2e-3 * rng.normal(size=rates.shape)
    return ImuSamples(np.round(1e9 * (time_s + delay_s)).astype(np.int64), own, np.zeros_like(own))


def trajectory(rng: np.random.Generator) -> Trajectory:
    time_s = np.arange(0.3, 6.5, 1 / 30)
    noisy = rotations(time_s) * Rotation.from_rotvec(3e-4 * rng.normal(size=(len(time_s), 3)))
    poses = np.concatenate([np.roll(noisy.as_quat(), 1, axis=1), np.zeros((len(time_s), 3))], axis=1)
    return Trajectory(np.round(1e9 * time_s).astype(np.int64), poses)


def test_turn_and_delay_are_found() -> None:
    rng = np.random.default_rng(0)
    found = calibrate_gyro(trajectory(rng), samples(TURN, DELAY_S, rng), STATED)
    assert [each.name for each in found] == ["gyro_turn_x", "gyro_turn_y", "gyro_turn_z", "gyro_delay_s"]
    assert all(each.verdict is Verdict.NOT_IN_FILE for each in found)
    values, sigmas = np.array([each.after for each in found]), np.array([each.sigma for each in found])
    truth = np.array([*TURN, DELAY_S])
    assert np.abs(values[:3] - truth[:3]).max() < 2e-3
    assert abs(values[3] - DELAY_S) < 5e-4
    assert (np.abs(values - truth) < 4 * sigmas).all()


def test_large_turn_is_found_too() -> None:
    rng = np.random.default_rng(1)
    turn = np.array([0.0, 0.0, 1.5])
    found = calibrate_gyro(trajectory(rng), samples(turn, 0.0, rng), STATED)
    np.testing.assert_allclose([each.after for each in found[:3]], turn, atol=3e-3)


def test_what_is_right_stays() -> None:
    rng = np.random.default_rng(2)
    found = calibrate_gyro(trajectory(rng), samples(np.zeros(3), 0.0, rng), STATED)
    assert all(each.verdict is Verdict.NO_GAIN and each.after == 0 for each in found)
    assert found[3].found == pytest.approx(0, abs=5e-4)


def test_too_little_in_common() -> None:
    rng = np.random.default_rng(3)
    given = samples(TURN, 0.0, rng)
    later = replace(given, timestamps_ns=given.timestamps_ns + 10**12)
    assert calibrate_gyro(trajectory(rng), later, STATED) == ()
    assert calibrate_gyro(trajectory(rng), given.between(0, 10**6), STATED) == ()
