"""Recordings at the rate they were taken at: which frames are late, and what a run says of them."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from small_scene import CONFIG, Clip, clip

from jaxslam.config.loading import load_config
from jaxslam.datasets.realtime import in_real_time
from jaxslam.results.run_results import RunInfo, write_results
from jaxslam.sensors.frame import Frame
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

STEP_NS = 33_000_000


class FakeTime:
    """A clock that only what sleeps or works moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


def at(frame: Frame, timestamp_ns: int) -> Frame:
    return replace(frame, timestamp_ns=timestamp_ns, depth_timestamp_ns=None)


def given_out(num: int, work_s: Callable[[int], float]) -> tuple[list[int], list[float]]:
    """Which frames arrive at who works so long on each, and when."""
    fake, stamps = FakeTime(), np.arange(num) * STEP_NS
    taken, at = [], []
    for index, frame in enumerate(in_real_time(range(num), stamps, fake.clock, fake.sleep)):
        if frame is None:
            continue
        assert frame == index
        taken.append(index)
        at.append(fake.now - 100)
        fake.now += work_s(index)
    return taken, at


class TestInRealTime:
    def test_in_time(self) -> None:
        taken, at = given_out(20, lambda _: 0.03)
        assert taken == list(range(20))
        np.testing.assert_allclose(at, np.arange(20) * 0.033)

    def test_half_as_fast(self) -> None:
        taken, _ = given_out(20, lambda _: 0.07)
        assert taken == [*range(0, 17, 2), 19]  # a little slower than that: two are missed in the end

    def test_one_long_pause(self) -> None:
        """What came during the pause is dropped but the newest, and the next ones come in time."""
        taken, at = given_out(20, lambda index: 0.18 if index == 5 else 0.01)
        assert taken == [0, 1, 2, 3, 4, 5, *range(10, 20)]
        np.testing.assert_allclose(at[7:], np.arange(11, 20) * 0.033)

    def test_the_last_is_never_late(self) -> None:
        taken, _ = given_out(4, lambda _: 10.0)
        assert taken == [0, 3]

    def test_one_frame(self) -> None:
        assert list(in_real_time(["only"], np.array([5]))) == ["only"]

    def test_lengths_differ(self) -> None:
        with pytest.raises(ValueError, match="zip"):
            list(in_real_time(range(3), np.arange(2) * STEP_NS))


class TestRun:
    def test_all_in_time(self) -> None:
        """Ten times slower than it was taken."""
        recording = clip()
        slow = Clip(recording.source, [at(f, 10**9 * i // 3) for i, f in enumerate(recording.frames[:6])])
        with Slam(slow.camera, replace(CONFIG, run=replace(CONFIG.run, realtime=True))) as slam:
            began = time.monotonic()
            records = slam.run(slow)
            assert time.monotonic() - began >= 0.95 * (slow.timestamps_ns[-1] - slow.timestamps_ns[0]) * 1e-9
        assert [record.status for record in records] == [TrackStatus.STARTED] + 5 * [TrackStatus.OK]

    def test_what_is_late_is_dropped(self, tmp_path) -> None:
        """A thousand frames a second: nobody can."""
        recording = clip()
        fast = Clip(recording.source, [at(f, 10**6 * i) for i, f in enumerate(recording.frames)])
        with Slam(fast.camera, replace(CONFIG, run=replace(CONFIG.run, realtime=True))) as slam:
            records = slam.run(fast)
            summary, _ = write_results(tmp_path, slam, records, RunInfo(fast, "default", 1.0))
        dropped = [record for record in records if record.status == TrackStatus.DROPPED]
        assert 0 < len(dropped) < len(records) == len(fast)
        assert summary["dropped"] == len(dropped)
        assert summary["tracked"] + summary["status_counts"].get("LOST", 0) == len(records) - len(dropped)
        assert summary["realtime"]
        assert not summary["deterministic"]
        assert records[-1].status != TrackStatus.DROPPED
        assert "before there was time" in dropped[0].reason

    def test_settings(self) -> None:
        config = load_config(overrides=["run.realtime=true"])
        assert not config.run.in_turn
        assert load_config().run.in_turn
        assert not load_config(overrides=["run.deterministic=false"]).run.in_turn
