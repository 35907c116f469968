"""Motion that something else measured: it leads optical flow, adds up while lost, and is one term of the pose."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from small_scene import CONFIG, HEIGHT, WIDTH

from jaxslam.datasets import Subset
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.errors import DatasetError
from jaxslam.geometry.se3 import IDENTITY, angle, between, compose, displacement, inverse, retract
from jaxslam.sensors import Frame, ImuSamples, ImuSheet, MotionPrior
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.outside_motion import OutsideMotion
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

SOURCE = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=120, people=0, path="rpy"))
PLACE = retract(IDENTITY, np.array([0, 0, 0, 0.5, -1.0, 0.7]))
SHEET = ImuSheet(200.0, 1.7e-4, 2e-5, 2e-3, 3e-3, tuple(PLACE.tolist()))
BIAS = np.array([0.02, -0.05, 0.03])
PREDICTING = replace(CONFIG, run=replace(CONFIG.run, on_loss="predict"))
SURE = np.diag(np.repeat([1e-4, 1e-6], 3))
STEP = np.array([0.1, 0, 0, 0, 0.2, 0])


@pytest.fixture(scope="module")
def slam() -> Iterator[Slam]:
    with Slam(SOURCE.camera, CONFIG) as slam:
        yield slam


@pytest.fixture(scope="module")
def with_gyro() -> Iterator[Slam]:
    with Slam(SOURCE.camera, PREDICTING, imu=SHEET) as slam:
        yield slam


def moved(first: int, second: int) -> np.ndarray:
    """True pose `(7,)` of the second frame in the axes of the first."""
    return between(*SOURCE.T_world_cam[[first, second]])


def wrong(given: FrameResult, first: int, second: int, start: FrameResult) -> np.ndarray:
    """Error `(6,)` of the motion between two frames."""
    return displacement(moved(first, second), between(start.T_world_cam, given.T_world_cam))


def turning(first: int, second: int) -> ImuSamples:
    """Samples of a gyro with a bias that turns evenly between two frames."""
    start_ns, end_ns = SOURCE[first].timestamp_ns, SOURCE[second].timestamp_ns
    times_ns = np.arange(start_ns + 5_000_000, end_ns + 1, 5_000_000)
    turn = displacement(IDENTITY, compose(PLACE, compose(moved(first, second), inverse(PLACE))))[3:]
    rates = np.tile(turn / (1e-9 * (end_ns - start_ns)) + BIAS, (len(times_ns), 1))
    return ImuSamples(times_ns, rates, np.zeros((len(times_ns), 3)))


class TestSlam:
    def test_a_prior_leads_flow_where_nothing_else_does(self, slam: Slam) -> None:
        """Half a picture is turned out of view: too much for optical flow, and for features of so small a picture."""
        first, second = 60, 84
        statuses = []
        for prior in (None, MotionPrior(moved(first, second), SURE), MotionPrior(moved(first, second), SURE[3:, 3:])):
            slam.reset()
            start = slam.track(SOURCE[first])
            result = slam.track(SOURCE[second], prior)
            statuses.append(result.status)
            if prior is not None:
                error = wrong(result, first, second, start)
                assert np.linalg.norm(error[:3]) < 0.03
                assert np.linalg.norm(error[3:]) < 0.01
        assert statuses[0] == TrackStatus.LOST
        assert TrackStatus.LOST not in statuses[1:]

    def test_a_prior_is_a_term_of_the_pose(self, slam: Slam) -> None:
        """One that is as sure as a robot's arm stands against the images; one that is unsure does not."""
        off = retract(moved(60, 62), np.array([0.02, 0, 0, 0, 0, 0]))
        errors = []
        for sigma in (1e-5, 10.0):
            slam.reset()
            start = slam.track(SOURCE[60])
            result = slam.track(SOURCE[62], MotionPrior(off, np.diag(np.repeat([sigma**2, 1.0], 3))))
            errors.append(wrong(result, 60, 62, start)[0])
            assert np.sqrt(result.covariance[0, 0]) < 1.01 * max(sigma, 0.01)
        assert errors[0] > 0.018
        assert abs(errors[1]) < 0.005

    def test_a_gyro_tells_how_the_camera_turned(self, with_gyro: Slam) -> None:
        """By more than half of the picture, with a bias that is unknown at first; without samples it is just lost."""
        errors = []
        for has_samples in (True, False):
            with_gyro.reset()
            results = [with_gyro.track(SOURCE[60])]
            for first, second in ((60, 62), (62, 64), (64, 100)):
                imu = turning(first, second) if has_samples else None
                results.append(with_gyro.track(replace(SOURCE[second], imu=imu)))
            assert TrackStatus.LOST not in [result.status for result in results[:3]]
            errors.append(np.linalg.norm(wrong(results[3], 60, 100, results[0])[3:]))
        assert errors[0] < 0.1
        assert errors[1] > 0.4
        assert results[3].status == TrackStatus.LOST

    def test_a_lost_camera_is_where_it_was_measured_to_be(self) -> None:
        """Black frames, with priors: the pose that a controller is given follows them, and the old map is found."""
        with Slam(SOURCE.camera, PREDICTING) as predicting:
            start = predicting.track(SOURCE[60])
            black = SOURCE[60].image * 0
            for index in range(61, 70):
                frame = replace(SOURCE[index], image=black)
                result = predicting.track(frame, MotionPrior(moved(index - 1, index), 1e-2 * SURE))
                assert result.status == TrackStatus.LOST
                assert np.linalg.norm(wrong(result, 60, index, start)) < 1e-3
            again = predicting.track(SOURCE[70], MotionPrior(moved(69, 70), 1e-2 * SURE))
        assert again.status in (TrackStatus.OK, TrackStatus.WEAK)
        assert np.linalg.norm(wrong(again, 60, 70, start)[:3]) < 0.02

    def test_what_is_no_prior_is_refused_and_loses_nothing(self, slam: Slam) -> None:
        slam.reset()
        slam.track(SOURCE[60])
        with pytest.raises(TypeError, match=r"prior: expected a jaxslam\.MotionPrior, got ndarray"):
            slam.track(SOURCE[61], moved(60, 61))  # pyright: ignore[reportArgumentType]
        assert slam.track(SOURCE[61]).status == TrackStatus.OK
        with pytest.raises(TypeError, match=r"imu: expected a jaxslam\.ImuSheet, got str; read_imu_sheet"):
            Slam(SOURCE.camera, CONFIG, imu="sensor.yaml")  # pyright: ignore[reportArgumentType]


class TestRun:
    def test_samples_of_a_frame_that_cannot_be_read_are_not_lost(self, with_gyro: Slam) -> None:
        class Damaged(Subset):
            """Frames 60, 62, 64 and 66, of which the third is damaged, with all samples of a gyro at rest."""

            @property
            def imu_samples(self) -> ImuSamples:
                times_ns = np.arange(SOURCE[59].timestamp_ns, SOURCE[66].timestamp_ns, 5_000_000)
                return ImuSamples(times_ns, np.zeros((len(times_ns), 3)), np.zeros((len(times_ns), 3)))

            def __getitem__(self, index: int) -> Frame:
                if index == 2:
                    raise DatasetError("frame 2: damaged")
                return super().__getitem__(index)

        given: list[Frame | None] = []
        with_gyro.reset()
        with_gyro.run(Damaged(SOURCE, 60, 67, 2), lambda frame, _: given.append(frame))
        assert given[2] is None
        assert given[1] is not None
        assert given[3] is not None
        assert given[3].imu is not None
        since = given[3].imu.timestamps_ns
        assert since[0] - given[1].timestamp_ns <= 5_000_000
        assert given[3].timestamp_ns - since[-1] <= 5_000_000


class TestWarnings:
    def test_of_samples_without_a_data_sheet(self, slam: Slam) -> None:
        slam.reset()
        slam.track(replace(SOURCE[62], imu=turning(60, 62)))
        assert [text for text in slam.warnings if text.startswith("imu: expected the data sheet")]

    def test_of_a_data_sheet_without_samples(self, with_gyro: Slam) -> None:
        with_gyro.reset()
        with_gyro.track(SOURCE[60])
        assert [text for text in with_gyro.warnings if text.startswith("imu: expected samples")]


class TestOutsideMotion:
    FRAME = Frame(0, np.zeros((12, 16), np.uint8), np.zeros((12, 16), np.float32))

    def test_motions_add_up_while_lost(self) -> None:
        motion, prior = OutsideMotion(None), MotionPrior(retract(IDENTITY, STEP), SURE)
        assert motion.of_frame(self.FRAME, prior, 0.1) is None  # nothing was tracked yet
        motion.frame_tracked(np.zeros(6), SURE, is_ok=True)
        first, second = (motion.of_frame(self.FRAME, prior, 0.1) for _ in range(2))
        assert first is not None
        assert second is not None
        np.testing.assert_allclose(second.prior.T_last_cam, compose(prior.T_last_cam, prior.T_last_cam), atol=1e-12)
        assert np.trace(second.information) < np.trace(first.information)
        motion.frame_tracked(STEP, SURE, is_ok=True)
        again = motion.of_frame(self.FRAME, prior, 0.1)
        assert again is not None
        assert angle(between(again.prior.T_last_cam, prior.T_last_cam)) < 1e-9

    def test_the_bias_of_a_gyro_is_the_same_in_all_frames(self) -> None:
        """Twice as long, twice as uncertain: errors of one bias do not cancel."""
        motion, samples = OutsideMotion(SHEET), np.arange(0, 1_000_000_001, 5_000_000)
        deviations = []
        for index in range(5):
            now_ns = 100_000_000 * index
            part = samples[(samples > now_ns - 100_000_000) & (samples <= now_ns)]
            imu = ImuSamples(part, np.zeros((len(part), 3)), np.zeros((len(part), 3)))
            known = motion.of_frame(replace(self.FRAME, timestamp_ns=now_ns, imu=imu), None, 0.1)
            if index == 0:
                motion.frame_tracked(np.zeros(6), SURE, is_ok=True)
            else:
                assert known is not None
                deviations.append(np.sqrt(known.prior.covariance[0, 0]))
        np.testing.assert_allclose(deviations, 0.1 * 0.1 * np.arange(1, 5), rtol=0.01)

    def test_a_frame_without_one_breaks_the_chain_until_a_frame_is_tracked(self) -> None:
        motion, prior = OutsideMotion(None), MotionPrior(retract(IDENTITY, STEP), SURE)
        motion.frame_tracked(np.zeros(6), SURE, is_ok=True)
        known = [motion.of_frame(self.FRAME, given, 0.1) is not None for given in (prior, None, prior)]
        assert known == [True, False, False]
        motion.frame_tracked(np.zeros(6), SURE, is_ok=True)
        assert motion.of_frame(self.FRAME, prior, 0.1) is not None
