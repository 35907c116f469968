"""The gyro: rotation from frame to frame, the bias that the images tell, and samples that are missing."""

import functools

import numpy as np
import pytest

from jaxslam.geometry.se3 import IDENTITY, angle, between, compose, inverse, retract
from jaxslam.sensors import Frame, ImuSamples, ImuSheet
from jaxslam.sensors.gyro import Gyro

PLACE = retract(IDENTITY, np.array([0.1, 0.2, 0.3, 0.5, -1.0, 0.7]))
SHEET = ImuSheet(200.0, 1.7e-4, 2e-5, 2e-3, 3e-3, tuple(PLACE.tolist()))
BIAS = np.array([0.02, -0.05, 0.08])
FRAME_NS, SAMPLE_NS = 50_000_000, 5_000_000
IMAGE, DEPTH_M = np.zeros((12, 16), np.uint8), np.zeros((12, 16), np.float32)


def rate(time_s: np.ndarray) -> np.ndarray:
    """True angular rates `(n, 3)` in IMU axes, rad/s."""
    return np.stack([np.sin(3 * time_s), 0.8 * np.cos(2 * time_s), 0.5 * np.sin(time_s + 1)], axis=-1)


def frames(count: int, bias: np.ndarray = BIAS, noise: float = 0.0, kept: slice = slice(None)) -> list[Frame]:
    """Frames with the samples since the one before."""
    times_ns = np.arange(0, count * FRAME_NS, SAMPLE_NS) - 2_000_000
    rates = rate(1e-9 * times_ns) + bias + noise * np.random.default_rng(0).normal(size=(len(times_ns), 3))
    samples = ImuSamples(times_ns, rates, np.tile([0, 0, 9.81], (len(times_ns), 1)))
    frames_ns = FRAME_NS * np.arange(count)
    parts = [samples.since_last_frame(frames_ns, index, fps=20.0) for index in range(count)]
    cut = [
        ImuSamples(*(getattr(p, f)[kept] for f in ("timestamps_ns", "gyro_rad_per_s", "accel_m_per_s2"))) for p in parts
    ]
    return [Frame(int(stamp), IMAGE, DEPTH_M, imu=part) for stamp, part in zip(frames_ns, cut, strict=True)]


@functools.cache
def true_motion(index: int) -> np.ndarray:
    """Pose `(7,)` of the camera of a frame in the axes of the camera of the frame before."""
    steps = 50
    begins_s = 1e-9 * FRAME_NS * (index - 1)
    middles_s = begins_s + 1e-9 * FRAME_NS * (np.arange(steps) + 0.5) / steps
    turned = IDENTITY
    for each in rate(middles_s) * 1e-9 * FRAME_NS / steps:
        turned = retract(turned, np.concatenate([np.zeros(3), each]))
    place = np.concatenate([PLACE[:4], np.zeros(3)])
    return compose(inverse(place), compose(turned, place))


def test_the_rotation_of_the_camera() -> None:
    gyro = Gyro(SHEET)
    for index, frame in enumerate(frames(20, bias=np.zeros(3))):
        motion = gyro.motion(frame)
        if index == 0:
            assert motion is None  # since when?
            continue
        assert motion is not None
        assert not motion.has_translation
        assert angle(between(true_motion(index), motion.T_last_cam)) < 2e-4


def test_the_images_tell_the_bias() -> None:
    gyro, noise = Gyro(SHEET), 1.7e-4 * np.sqrt(200)
    before = after = None
    for index, frame in enumerate(frames(100, noise=noise)):
        motion = gyro.motion(frame)
        if motion is None:
            continue
        after = angle(between(true_motion(index), motion.T_last_cam))
        before = after if before is None else before
        gyro.correct(motion, true_motion(index), 1e-8 * np.eye(3), 0.05)
    np.testing.assert_allclose(gyro.bias_rad_per_s, BIAS, atol=2e-3)
    assert before is not None
    assert after is not None
    assert before > 4e-3
    assert after < 5e-4


@pytest.mark.slow
def test_it_is_believed_by_how_well_it_has_done() -> None:
    """Images that are apart from it by a millirad each time, as those of another clock, make it uncertain by that."""
    gyro, random = Gyro(SHEET), np.random.default_rng(0)
    motion = None
    for index, frame in enumerate(frames(200, bias=np.zeros(3))):
        motion = gyro.motion(frame)
        if motion is not None:
            seen = retract(true_motion(index), np.concatenate([np.zeros(3), 1e-3 * random.normal(size=3)]))
            gyro.correct(motion, seen, 1e-8 * np.eye(3), 0.05)
    assert motion is not None
    assert 0.7e-3 < np.sqrt(motion.covariance[0, 0]) < 1.5e-3


def test_a_wrong_pose_says_nothing_of_the_bias() -> None:
    gyro = Gyro(SHEET)
    for index, frame in enumerate(frames(40, bias=np.zeros(3))):
        motion = gyro.motion(frame)
        if motion is not None:
            off = retract(true_motion(index), np.array([0, 0, 0, 0.2, 0, 0])) if index == 30 else true_motion(index)
            gyro.correct(motion, off, 1e-8 * np.eye(3), 0.05)
    assert np.abs(gyro.bias_rad_per_s).max() < 3e-3


@pytest.mark.parametrize("kept", [slice(3, None), slice(None, -3), slice(0, 0)], ids=["late", "early", "none"])
def test_nothing_is_known_where_samples_are_missing(kept: slice) -> None:
    gyro = Gyro(SHEET)
    assert [gyro.motion(frame) for frame in frames(5, kept=kept)] == [None] * 5


def test_after_a_gap_it_goes_on() -> None:
    gyro, given = Gyro(SHEET), frames(8, bias=np.zeros(3))
    known = [gyro.motion(frame) is not None for frame in (*given[:3], *given[5:])]
    assert known == [False, True, True, False, True, True]
    without = Frame(9 * FRAME_NS, IMAGE, DEPTH_M)
    assert gyro.motion(without) is None
