"""Seconds between frames from time stamps: regular, of arrival, in other units, of clocks that were set."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxslam.datasets import open_dataset
from jaxslam.errors import FrameError
from jaxslam.slam.frame_clock import FrameClock
from jaxslam.slam.input_warnings import InputWarnings
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory

MS = 1_000_000
PERIOD_NS = 33_333_333


def elapsed(times_ns: np.ndarray, fps: float = 30.0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Seconds before each frame, and the warnings."""
    warnings = InputWarnings()
    clock, steps = FrameClock(fps, warnings), []
    for time_ns in times_ns.tolist():
        clock.check(time_ns)
        steps.append(clock.elapsed_s(time_ns))
        clock.advance(time_ns)
    return np.array(steps), warnings.all


def regular(number: int, period_ns: int = PERIOD_NS) -> np.ndarray:
    return 10**18 + np.arange(number) * period_ns


class TestRegular:
    @pytest.mark.parametrize(
        "place", ["tum/rgbd_dataset_freiburg1_rpy_excerpt", "bonn/rgbd_bonn_crowd", "kitti/sequences/06"]
    )
    def test_recordings_are_taken_as_they_are(self, place: str, data_dir: Path) -> None:
        dataset = open_dataset(data_dir / place)
        steps, warnings = elapsed(dataset.timestamps_ns, dataset.camera.fps)
        assert (steps[1:] == np.diff(dataset.timestamps_ns) * 1e-9).all()
        assert not warnings

    @pytest.mark.parametrize("rate", [2.0, 10.0, 15.0, 25.0, 60.0, 200.0])
    def test_another_rate_than_the_nominal_one(self, rate: float) -> None:
        """From the fifth frame on, when there is a median, as it is."""
        times_ns = regular(40, round(1e9 / rate))
        steps, warnings = elapsed(times_ns)
        np.testing.assert_array_equal(steps[5:], np.diff(times_ns)[4:] * 1e-9)
        assert not warnings

    def test_dropped_frames_and_pauses(self) -> None:
        """One frame in five is missing, and once all for a minute."""
        times_ns = regular(100)[np.arange(100) % 5 != 3]
        times_ns[40:] += 60 * 10**9
        steps, warnings = elapsed(times_ns)
        np.testing.assert_array_equal(steps[1:], np.diff(times_ns) * 1e-9)
        assert not warnings

    def test_one_early_frame(self) -> None:
        """Two frames 1 ms apart are a period apart, whatever is said; that is no reason to distrust the others."""
        times_ns = regular(40)
        times_ns[20] = times_ns[19] + MS
        steps, warnings = elapsed(times_ns)
        assert steps[20] == pytest.approx(1 / 30)
        np.testing.assert_array_equal(np.delete(steps, [0, 20]), np.delete(np.diff(times_ns), 19) * 1e-9)
        assert not warnings


class TestArrival:
    @pytest.mark.parametrize("burst", [2, 3, 4])
    def test_bursts(self, burst: int) -> None:
        """All frames of a burst come when its last one does, 1 ms apart; no step is far from a period for long."""
        times_ns = regular(120)
        last = np.minimum(np.arange(120) // burst * burst + burst - 1, 119)
        steps, warnings = elapsed(times_ns[last] - (last - np.arange(120)) * MS)
        assert steps.min() > 0.5 / 30
        np.testing.assert_allclose(steps[2 * burst + 4 :], 1 / 30, rtol=1e-6)
        assert len(warnings) == 1
        assert "taken on arrival? 33.3 ms a frame are assumed" in warnings[0]

    @pytest.mark.parametrize("seed", range(5))
    def test_jitter(self, seed: int) -> None:
        times_ns = regular(300) + np.random.default_rng(seed).integers(-10 * MS, 10 * MS, 300)
        steps, warnings = elapsed(np.maximum.accumulate(times_ns) + np.arange(300))
        assert np.mean(np.abs(steps[20:] * 30 - 1) < 0.01) > 0.95
        assert steps.sum() == pytest.approx(10, rel=0.05)
        assert len(warnings) == 1

    def test_pause_within(self) -> None:
        """A gap of ten periods between bursts is seen."""
        times_ns = regular(100)
        times_ns[50:] += 10 * PERIOD_NS
        times_ns[0::2] = times_ns[1::2] - MS
        steps, _ = elapsed(times_ns)
        assert 8 / 30 < steps[50] < 13 / 30


class TestWrong:
    @pytest.mark.parametrize(("factor", "unit"), [(1e-3, "microseconds"), (1e-6, "milliseconds"), (1e3, "picoseconds")])
    def test_unit(self, factor: float, unit: str) -> None:
        """Named within ten frames; too short steps are nominal ones."""
        times_ns = np.round(np.arange(10) * PERIOD_NS * factor).astype(np.int64)
        steps, warnings = elapsed(times_ns)
        assert len(warnings) == 1
        assert warnings[0].endswith(f"they look like {unit}")
        if factor < 1:
            np.testing.assert_allclose(steps, 1 / 30)

    def test_depth_of_another_time(self) -> None:
        clock = FrameClock(30, InputWarnings())
        clock.check(10**18, 10**18 + 20 * MS)
        with pytest.raises(
            FrameError, match=r"depth_timestamp_ns: expected within 1 s of timestamp_ns, got \+10\.000 s"
        ):
            clock.check(10**18, 10**18 + 10**10)

    @pytest.mark.parametrize("back_ns", [0, 1, 400 * MS])
    def test_not_later(self, back_ns: int) -> None:
        """As often as it comes."""
        clock = FrameClock(30, InputWarnings())
        clock.advance(10**18)
        for again in range(5):
            with pytest.raises(FrameError, match="timestamp_ns: expected more than the last frame's"):
                clock.check(10**18 - back_ns + min(again, back_ns - 1 if back_ns else 0))


class TestClockThatWasSet:
    def test_ahead_for_one_frame(self) -> None:
        """The stamp of one frame is an hour ahead: of those that follow, two are refused, with the way out."""
        warnings = InputWarnings()
        clock, times_ns = FrameClock(30, warnings), regular(20)
        times_ns[10] += 3600 * 10**9
        refused, steps = [], []
        for time_ns in times_ns.tolist():
            try:
                clock.check(time_ns)
            except FrameError as error:
                refused.append(str(error))
                continue
            steps.append(clock.elapsed_s(time_ns))
            clock.advance(time_ns)
            assert clock.continuous_ns(time_ns) >= 10**18
        assert len(refused) == 2
        assert refused[0].endswith("if the clock was set back, go on: the 3rd such frame in a row is tracked")
        assert len(steps) == 18
        np.testing.assert_allclose(np.delete(steps, 10), 1 / 30, rtol=1e-6)
        assert warnings.all == ("timestamp_ns: the clock was set back by 3599.900 s; tracking goes on from there",)

    def test_time_goes_on_as_it_was(self) -> None:
        """Stamps on the clock that never goes back increase across the step."""
        clock = FrameClock(30, InputWarnings())
        continuous = []
        for time_ns in [*regular(5).tolist(), *(regular(8) - 10**10).tolist()]:
            try:
                clock.check(time_ns)
            except FrameError:
                continue
            clock.advance(time_ns)
            continuous.append(clock.continuous_ns(time_ns))
        assert len(continuous) == 5 + 6
        assert (np.diff(continuous) > 0).all()

    def test_old_frames_between(self) -> None:
        """Single old frames among new ones, and the same old frame again and again, are refused for good."""
        clock = FrameClock(30, InputWarnings())
        for time_ns in regular(20).tolist():
            clock.check(time_ns)
            clock.advance(time_ns)
            with pytest.raises(FrameError):
                clock.check(10**17)
        for _ in range(5):
            with pytest.raises(FrameError):
                clock.check(10**17)


class TestTracking:
    @pytest.mark.slow
    def test_recording_with_stamps_of_arrival(self, data_dir: Path) -> None:
        """In pairs 1 ms apart and with jitter of 10 ms, poses are as with the times of exposure, and none is lost."""
        dataset = open_dataset(data_dir / "tum/rgbd_dataset_freiburg1_rpy_excerpt")
        frames = [dataset[index] for index in range(120)]
        times_ns = np.array([frame.timestamp_ns for frame in frames])
        pairs = times_ns.copy()
        pairs[0:-1:2] = times_ns[1::2] - MS
        jitter = times_ns + np.random.default_rng(1).integers(-10 * MS, 10 * MS, len(frames))
        found: dict[str, tuple[float, int]] = {}
        for name, stamps in {"clean": times_ns, "pairs": pairs, "jitter": np.maximum.accumulate(jitter)}.items():
            with Slam(dataset.camera) as slam:
                results = [
                    slam.track(replace(frame, timestamp_ns=int(stamp) + place, depth_timestamp_ns=None))
                    for place, (frame, stamp) in enumerate(zip(frames, stamps, strict=True))
                ]
                slam.finish()
                assert {result.status for result in results[1:]} == {TrackStatus.OK}
                estimate = Trajectory(times_ns, slam.trajectory.T_world_cam)
                assert dataset.ground_truth is not None
                found[name] = evaluate(estimate, dataset.ground_truth).ate_rmse_m, len(slam.map.ids)
        print({name: f"{1e3 * ate:.1f} mm, {keyframes} keyframes" for name, (ate, keyframes) in found.items()})
        for name in ("pairs", "jitter"):
            assert found[name][0] < 1.3 * found["clean"][0]
            assert found[name][1] <= 1.1 * found["clean"][1] + 0.5
