"""Coverage: the share of a recording's frames that have a pose, and what is said where frames are not known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxslam.errors import TrajectoryError
from jaxslam.trajectory.coverage import coverage_of

STEP_NS = 33_000_000
FRAMES = 10**15 + STEP_NS * np.arange(100)


class TestFramesKnown:
    def test_is_of_the_frames(self) -> None:
        """Poses as even as can be, but of every fourth frame only."""
        coverage = coverage_of(FRAMES[::4], FRAMES, FRAMES, 0.02)
        assert (coverage.num_frames, coverage.coverage_percent) == (100, 25)
        assert len(coverage.lost_spans_ns) == 25
        assert coverage.lost_spans_ns[0].tolist() == FRAMES[[0, 4]].tolist()
        assert coverage.lost_spans_ns[-1].tolist() == FRAMES[[96, 99]].tolist()

    def test_all(self) -> None:
        coverage = coverage_of(FRAMES, FRAMES, FRAMES, 0.02)
        assert coverage.coverage_percent == 100
        assert coverage.lost_spans_ns.shape == (0, 2)

    def test_stamps_a_little_off(self) -> None:
        """A pose belongs to the nearest frame, one to one, if it is near enough."""
        near, far = (coverage_of(FRAMES[:50] + shift, FRAMES, FRAMES, 0.01) for shift in (9_000_000, 11_000_000))
        assert (near.coverage_percent, far.coverage_percent) == (50, 0)

    def test_never_more_frames_than_poses(self) -> None:
        """Of frames 1 ms apart twenty are near each pose."""
        frames = 10**15 + 1_000_000 * np.arange(1000)
        assert coverage_of(frames[::100], frames, frames, 0.02).coverage_percent == 1

    def test_frames_beyond_the_reference_count(self) -> None:
        """Ground truth of half a recording says nothing of how much of it was tracked."""
        assert coverage_of(FRAMES[:75], FRAMES[:50], FRAMES, 0.02).coverage_percent == 75

    @pytest.mark.parametrize("clock", [0, 1])
    def test_on_either_clock(self, clock: int) -> None:
        """With an offset of half an interval added to the stamps of the estimate, frames may have it too or not."""
        estimate = FRAMES[:60] + STEP_NS // 2
        frames = FRAMES + clock * (STEP_NS // 2)
        coverage = coverage_of(estimate, FRAMES, frames, 0.002, frames_offset_s=STEP_NS // 2 * 1e-9)
        assert coverage.coverage_percent == 60
        assert coverage.lost_spans_ns.tolist() == [frames[[59, 99]].tolist()]

    def test_of_another_recording(self) -> None:
        """No frame has a pose; what is missing of the path is told from its own gaps."""
        kept = np.r_[0:30, 60:100]
        coverage = coverage_of(FRAMES[kept], FRAMES, FRAMES + 10**12, 0.02)
        assert (coverage.num_frames, coverage.coverage_percent) == (100, 0)
        assert coverage.lost_spans_ns.tolist() == [FRAMES[[29, 60]].tolist()]

    @given(st.sets(st.integers(0, 11), min_size=1))
    @settings(max_examples=100, deadline=None)
    def test_spans_are_the_frames_without_poses(self, kept: set[int]) -> None:
        frames = FRAMES[:12]
        spans = coverage_of(frames[sorted(kept)], frames, frames, 0.001).lost_spans_ns
        for index, frame in enumerate(frames):
            inside = any(begin <= frame <= end for begin, end in spans) and index not in kept
            assert inside == (index not in kept)
        strictly = [int(((frames > begin) & (frames < end)).sum()) for begin, end in spans]
        ends = (0 not in kept) + (11 not in kept)
        assert sum(strictly) + ends == 12 - len(kept)

    @pytest.mark.parametrize("frames", [np.zeros(0, np.int64), np.zeros(3), np.zeros((2, 2), np.int64)])
    def test_refuses(self, frames: np.ndarray) -> None:
        with pytest.raises(TrajectoryError, match=r"frames_ns: expected \(n,\) integers in nanoseconds, at least one"):
            coverage_of(FRAMES, FRAMES, frames, 0.02)


class TestFramesUnknown:
    def test_coverage_is_unknown(self) -> None:
        coverage = coverage_of(FRAMES[10:70:4], FRAMES, None, 0.02)
        assert coverage.num_frames is coverage.coverage_percent is None
        assert coverage.pose_interval_s == coverage.longest_gap_s == pytest.approx(4 * 0.033)
        assert coverage.span_percent == pytest.approx(100 * 56 / 99)

    def test_gaps_are_those_of_the_path(self) -> None:
        coverage = coverage_of(FRAMES[np.r_[0:30, 32:50, 60:100]], FRAMES, None, 0.02)
        assert coverage.lost_spans_ns.tolist() == [FRAMES[[49, 60]].tolist()]
        assert coverage.longest_gap_s == pytest.approx(11 * 0.033)

    def test_single_pose(self) -> None:
        coverage = coverage_of(FRAMES[:1], FRAMES[:1], None, 0.02)
        assert (coverage.pose_interval_s, coverage.longest_gap_s, coverage.span_percent) == (None, None, 100)
