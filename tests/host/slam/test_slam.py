"""`Slam`: accuracy on the small scene, determinism, compiling once, flat memory, and what `run` reports."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from small_scene import CONFIG, Clip, clip, resident_mb, track_round_trip

from jaxslam.slam.frame_records import FrameRecords
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import write_tum

HELPERS = str(Path(__file__).resolve().parents[2] / "helpers")

MAX_PROGRAMS = 30
"""Measured: 28. The tracker is one, the changes to its state three, the map's kernels six, masks four; the first state,
and what makes numbers of the settings, are the others."""


@pytest.fixture(scope="module")
def slam() -> Slam:
    """One tracker for all tests, reset before each use."""
    slam = Slam(clip().camera, CONFIG)
    slam.warm_up()
    return slam


def run(slam: Slam, recording: Clip) -> FrameRecords:
    slam.reset()
    return slam.run(recording)


class TestAccuracy:
    def test_ate(self, slam: Slam) -> None:
        recording = clip()
        records = run(slam, recording)
        assert records[0].status is TrackStatus.STARTED
        assert all(record.status is TrackStatus.OK for record in records[1:])
        assert evaluate(slam.trajectory, recording.source.ground_truth).ate_rmse_m < 0.025


class TestReports:
    def test_every_frame_once_in_order(self, slam: Slam) -> None:
        recording = clip()
        seen: list[int] = []
        slam.reset()
        records = slam.run(recording, lambda frame, result: seen.append(result.timestamp_ns))
        assert seen == [record.timestamp_ns for record in records] == recording.timestamps_ns.tolist()
        assert records[0].is_keyframe
        assert all(record.track_ms is not None and record.track_ms > 0 for record in records)

    def test_trajectory_is_what_was_given_out(self, slam: Slam) -> None:
        slam.reset()
        results = [slam.track(frame) for frame in clip().frames[:10]]
        trajectory = slam.online_trajectory
        np.testing.assert_allclose(
            trajectory.T_world_cam, np.array([result.T_world_cam for result in results]), atol=1e-6
        )
        np.testing.assert_array_equal(trajectory.timestamps_ns, [result.timestamp_ns for result in results])

    def test_empty_trajectory(self, slam: Slam) -> None:
        slam.reset()
        assert len(slam.trajectory) == 0


class TestDeterminism:
    def test_two_runs(self, slam: Slam, tmp_path: Path) -> None:
        for name, tracker in (("a", slam), ("b", Slam(clip().camera, CONFIG))):
            run(tracker, clip(2))
            write_tum(tmp_path / name, tracker.trajectory)
        assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()

    @pytest.mark.slow
    def test_two_processes(self, slam: Slam, tmp_path: Path) -> None:
        """Another process, that compiles or loads from the cache for itself, writes the same bytes."""
        script = (
            "import sys; sys.path.insert(0, sys.argv[1])\n"
            "import jax; jax.config.update('jax_numpy_dtype_promotion', 'strict')\n"
            "jax.config.update('jax_numpy_rank_promotion', 'raise')\n"
            "from small_scene import CONFIG, clip\n"
            "from jaxslam.slam.slam import Slam\n"
            "from jaxslam.trajectory.trajectory import write_tum\n"
            "slam = Slam(clip(2).camera, CONFIG); slam.run(clip(2)); write_tum(sys.argv[2], slam.trajectory)\n"
        )
        run(slam, clip(2))
        write_tum(tmp_path / "here", slam.trajectory)
        subprocess.run([sys.executable, "-c", script, HELPERS, str(tmp_path / "there")], check=True, timeout=600)
        assert (tmp_path / "here").read_bytes() == (tmp_path / "there").read_bytes()


class TestCompiling:
    @pytest.mark.slow
    def test_everything_before_the_first_frame(self, slam: Slam, compiled: list[str]) -> None:
        """Making and warming up compile a known number of programs, as in a new process; tracking then none.

        Not for a frame without a mask or with one, in color or gray, late in time, dark or without depth, nor in a
        tracker reset or made anew.
        """
        frames = clip(2).frames
        jax.clear_caches()
        compiled.clear()
        fresh = Slam(clip().camera, CONFIG)
        fresh.warm_up()
        assert [sum(part in name for name in compiled) for part in ("follow_points", "track_followed")] == [1, 1]
        assert len(compiled) <= MAX_PROGRAMS

        compiled.clear()
        shape = frames[0].image.shape[:2]
        masked = {"dynamic_mask": np.ones(shape, bool), "depth_timestamp_ns": frames[20].timestamp_ns + 5_000_000}
        gray, black = frames[21].image[..., 1].copy(), np.zeros_like(frames[22].image)
        frames[20] = dataclasses.replace(frames[20], **masked)
        frames[21] = dataclasses.replace(frames[21], image=gray)
        frames[22] = dataclasses.replace(frames[22], image=black, depth_m=np.zeros(shape, np.float32))
        statuses = [fresh.track(frame).status for frame in [*frames[:30], *frames[40:]]]
        assert statuses[22] is TrackStatus.LOST
        fresh.reset()
        again = Slam(clip().camera, CONFIG)
        for tracker in (fresh, again):
            for frame in frames[:5]:
                tracker.track(frame)
            assert len(tracker.trajectory) == 5
        assert compiled == []

    def test_compiling_would_be_seen(self, compiled: list[str]) -> None:
        jax.jit(lambda x: x + len(compiled))(1.5)
        assert len(compiled) == 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
class TestMemory:
    def test_is_flat(self, slam: Slam) -> None:
        frames = clip().frames
        track_round_trip(slam, frames, 300)
        before = resident_mb()
        track_round_trip(slam, frames, 600)
        assert resident_mb() < 1.02 * before
