"""Tracking begins before everything is compiled: what waits, what is said, and that results are the same in turn."""

import dataclasses
import functools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from small_scene import CONFIG, HEIGHT, WIDTH, Clip, clip

from jaxslam.config.schema import DenseConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.sensors.frame import Frame
from jaxslam.slam import back_end
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackReason, TrackStatus
from jaxslam.trajectory.trajectory import write_tum

HELPERS = str(Path(__file__).resolve().parents[2] / "helpers")
LIVE = dataclasses.replace(CONFIG, run=dataclasses.replace(CONFIG.run, deterministic=False))
DENSE = DenseConfig(enabled=True)


@functools.cache
def loop() -> Clip:
    """A path whose end shows other things than its beginning."""
    source = SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=72, people=0, path="loop", fps=15))
    return Clip(source, [source[index] for index in range(72)])


class WrongError(Exception):
    """What goes wrong in these tests."""


class Gate:
    """Holds the thread at the programs of recognition, which are neither the first nor the last."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.reached, self.open, self.error = threading.Event(), threading.Event(), False
        compile_view_matching = back_end.compile_view_matching

        def held(*arguments: object) -> None:
            self.reached.set()
            assert self.open.wait(120)
            if self.error:
                raise WrongError
            compile_view_matching(*arguments)  # pyright: ignore[reportArgumentType]

        patch.setattr(back_end, "compile_view_matching", held)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    gate = Gate(monkeypatch)
    yield gate
    gate.open.set()


def track(slam: Slam, frames: list[Frame | None], start: int = 0) -> list[FrameResult]:
    """Track frames, each a thirtieth of a second after the one before; `None` is a black one."""
    black = Frame(0, np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32))
    times = [(start + index) * 33_333_333 for index in range(len(frames))]
    return [
        slam.track(dataclasses.replace(frame or black, timestamp_ns=time_ns))
        for frame, time_ns in zip(frames, times, strict=True)
    ]


class TestLive:
    def test_frames_are_tracked_and_keyframes_wait(self, gate: Gate) -> None:
        with Slam(clip().camera, LIVE) as slam:
            results = track(slam, [*clip().frames[:20]])
            assert [result.status for result in results] == [TrackStatus.STARTED, *[TrackStatus.OK] * 19]
            assert gate.reached.wait(60)
            assert len(slam.map.ids) == 0
            assert slam.compile_s > 0
            gate.open.set()
            slam.finish()
            assert len(slam.map.ids) >= 1
            assert slam.compile_s == slam.warm_up() == slam.warm_up()

    def test_a_lost_frame_says_why_and_is_relocalized_later(self, gate: Gate) -> None:
        frames = loop().frames
        with Slam(loop().camera, LIVE) as slam:
            track(slam, [*frames])
            lost = track(slam, [None, None, frames[30], frames[31]], 72)
            assert [result.status for result in lost] == [TrackStatus.LOST] * 4
            assert lost[0].reason == TrackReason.NO_POINTS.text
            assert {result.reason for result in lost[1:]} == {TrackReason.GETTING_READY.text}
            gate.open.set()
            slam.finish()
            assert track(slam, [frames[31]], 76)[0].status is TrackStatus.RELOCALIZED

    def test_a_loaded_map(self, gate: Gate, tmp_path: Path) -> None:
        frames = clip().frames
        gate.open.set()
        with Slam(clip().camera, CONFIG) as slam:
            track(slam, [*frames])
            slam.save(tmp_path / "map.npz")
        gate.open.clear()
        with Slam.load(tmp_path / "map.npz", config=LIVE) as slam:
            first = track(slam, [*frames[:3]])
            assert {result.reason for result in first} == {TrackReason.GETTING_READY.text}
            gate.open.set()
            slam.warm_up()
            assert track(slam, [*frames[3:5]], 3)[0].status is TrackStatus.RELOCALIZED

    def test_a_weak_frame_stays_weak(self, gate: Gate) -> None:
        settings = dataclasses.replace(LIVE, track=dataclasses.replace(LIVE.track, match_map="always"))
        with Slam(clip().camera, settings) as slam:
            assert {result.num_matched for result in track(slam, [*clip().frames[:10]])} == {0}
            gate.open.set()
            slam.finish()
            assert track(slam, [*clip().frames[10:12]], 10)[1].num_matched > 0


class TestErrors:
    def test_of_the_thread_are_raised_and_tried_again(self, gate: Gate) -> None:
        gate.error = True
        with Slam(clip().camera, LIVE) as slam:
            track(slam, [*clip().frames[:3]])
            gate.open.set()
            with pytest.raises(WrongError):
                slam.finish()
            with pytest.raises(WrongError):
                slam.warm_up()
            track(slam, [*clip().frames[3:4]], 3)
            worker = slam._programs._worker
            assert worker is not None
            worker._jobs.join()
            with pytest.raises(WrongError):
                track(slam, [*clip().frames[4:5]], 4)
            gate.error = False
            track(slam, [*clip().frames[4:6]], 4)
            slam.finish()
            assert len(slam.map.ids) >= 1


class TestClose:
    @pytest.mark.slow
    def test_in_two_seconds_and_what_is_compiled_is_used_again(self, gate: Gate, compiled: list[str]) -> None:
        jax.clear_caches()
        slam = Slam(clip().camera, LIVE)
        compiled.clear()
        track(slam, [*clip().frames[:3]])
        assert gate.reached.wait(60)
        began = time.monotonic()
        slam.close()
        assert time.monotonic() - began < 2
        with pytest.raises(RuntimeError, match="closed"):
            track(slam, [*clip().frames[3:4]], 3)
        slam.finish()  # does not wait
        slam.reset()
        track(slam, [*clip().frames[:3]])
        gate.open.set()
        slam.finish()
        assert len(slam.map.ids) >= 1
        slam.close()
        large = [
            name for name in compiled if any(part in name for part in ("track_followed", "follow_points", "_agreed"))
        ]
        assert sorted(large) == sorted(set(large))
        assert len(large) == 3

    @pytest.mark.slow
    def test_the_process_ends(self, tmp_path: Path) -> None:
        """In the middle of compiling, with nothing kept on the disk: it is not aborted."""
        script = (
            "import sys; sys.path.insert(0, sys.argv[1])\n"
            "from small_scene import CONFIG, clip\n"
            "import dataclasses\n"
            "from jaxslam.slam.slam import Slam\n"
            "run = dataclasses.replace(CONFIG.run, deterministic=False)\n"
            "slam = Slam(clip().camera, dataclasses.replace(CONFIG, run=run))\n"
            "print(slam.track(clip().frames[0]).status.name, slam._programs._worker is not None)\n"
            "sys.exit(3)\n"
        )
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-c", script, HELPERS],
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert (done.returncode, done.stdout.strip()) == (3, "STARTED True"), done.stderr


class TestInTurn:
    @pytest.mark.slow
    @pytest.mark.parametrize("dense", [False, pytest.param(True, marks=pytest.mark.slow)])
    def test_cold_as_warm(self, tmp_path: Path, *, dense: bool) -> None:
        """A loss among the first frames too: to the byte."""
        frames = loop().frames
        order = [*frames[:2], None, *frames[2:], None, None, *frames[30:45]]
        settings = dataclasses.replace(CONFIG, dense=DENSE) if dense else CONFIG
        for name in ("warm", "cold"):
            jax.clear_caches()
            with Slam(loop().camera, settings) as slam:
                if name == "warm":
                    slam.warm_up()
                statuses = [result.status for result in track(slam, order)]
                assert TrackStatus.RELOCALIZED in statuses
                slam.finish()
                write_tum(tmp_path / name, slam.trajectory)
                slam.save(tmp_path / f"{name}.map")
        for end in ("", ".map"):
            assert (tmp_path / f"warm{end}").read_bytes() == (tmp_path / f"cold{end}").read_bytes()

    def test_a_frame_waits_for_what_it_needs(self, gate: Gate) -> None:
        """The first frames do not; the one with the first result of mapping does."""
        with Slam(clip().camera, CONFIG) as slam:
            track(slam, [*clip().frames[: CONFIG.mapping.latency_frames]])
            assert not gate.open.is_set()
            opened: list[bool] = []
            threading.Thread(target=lambda: (gate.reached.wait(60), opened.append(True), gate.open.set())).start()
            track(slam, [*clip().frames[3:5]], CONFIG.mapping.latency_frames)
            assert opened
            assert len(slam.map.ids) == 1
