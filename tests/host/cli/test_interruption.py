"""Runs that Ctrl-C, SIGTERM or an error ends: what was computed is on disk, and a `Slam` still has it."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scene import CONFIG, SETTINGS, Clip, clip

from jaxslam import datasets
from jaxslam.cli.entry_point import main
from jaxslam.cli.interruption import Interruption
from jaxslam.cli.tracking_run import track
from jaxslam.geometry.se3 import between
from jaxslam.io.atomic_files import write_atomically
from jaxslam.map.npz_file import load_map
from jaxslam.results.run_results import RESULT_FILES
from jaxslam.slam import tracker as tracker_module
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus
from jaxslam.trajectory.trajectory import read_tum

FRAMES, STOP = 20, 8
ALWAYS = {"trajectory.txt", "trajectory_online.txt", "frames.csv", "summary.json", "config.yaml"}


class Stopping(Clip):
    """A recording at one of whose frames something happens; it is read ahead, so that this is some frames early."""

    def __init__(self, happens: Callable[[], None], at: int = STOP) -> None:
        whole = clip()
        super().__init__(whole.source, whole.frames[:FRAMES])
        self.happens, self.at = happens, at

    def __getitem__(self, index: int) -> Any:
        if index == self.at:
            self.happens()
        return super().__getitem__(index)


def send(number: int) -> Callable[[], None]:
    return lambda: os.kill(os.getpid(), number)


def fail() -> None:
    raise KeyError("of the\ndriver")


def check_results(folder: Path, cut_short: str | None, most: int) -> dict[str, Any]:
    """The files of a run are there and agree with each other; gives the summary."""
    names = {path.name for path in folder.iterdir()}
    assert names >= ALWAYS
    assert names <= {*RESULT_FILES, "a.map"}
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["cut_short"] == cut_short
    assert summary["frames"] <= most
    assert len((folder / "frames.csv").read_text().splitlines()) == summary["frames"] + 1
    if summary["tracked"]:
        assert len(read_tum(folder / "trajectory.txt")) == summary["tracked"]
        assert {"plot.png", "map.png"} <= names
    return summary


@pytest.mark.parametrize(
    ("happens", "error", "reason"),
    [
        (send(signal.SIGINT), KeyboardInterrupt, "interrupted"),
        (send(signal.SIGTERM), KeyboardInterrupt, "terminated"),
        (fail, KeyError, "KeyError: 'of the\\ndriver'"),
    ],
    ids=["ctrl_c", "sigterm", "error"],
)
def test_results_are_on_disk(
    tmp_path: Path, happens: Callable[[], None], error: type[BaseException], reason: str
) -> None:
    recording, handlers = Stopping(happens), [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    slam = Slam(recording.camera, CONFIG)
    with pytest.raises(error):
        track(recording, slam, "default", tmp_path, save_map=tmp_path / "a.map")
    summary = check_results(tmp_path, reason, STOP + 1)
    assert summary["tracked"] == len(slam.trajectory) > 0
    assert len(load_map(tmp_path / "a.map").ids) == summary["keyframes"] > 0
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


@pytest.mark.slow
def test_poses_are_those_of_a_whole_run(tmp_path: Path) -> None:
    """To the byte, as they were given out."""
    recording = Stopping(lambda: None)
    track(recording, Slam(recording.camera, CONFIG), "default", tmp_path / "whole")
    check_results(tmp_path / "whole", None, FRAMES)
    stopping = Stopping(send(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        track(stopping, Slam(recording.camera, CONFIG), "default", tmp_path / "part")
    whole, part = ((tmp_path / name / "trajectory_online.txt").read_bytes() for name in ("whole", "part"))
    assert whole.startswith(part)
    assert len(part) < len(whole)


def test_before_the_first_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = Stopping(lambda: None)
    slam = Slam(recording.camera, CONFIG)
    monkeypatch.setattr(slam, "warm_up", send(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        track(recording, slam, "default", tmp_path)
    assert check_results(tmp_path, "interrupted", 0)["frames"] == 0


def test_map_outlives_a_picture_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr("jaxslam.results.run_results._write_pictures", fail)
    recording = Stopping(lambda: None)
    with pytest.raises(MemoryError):
        track(recording, Slam(recording.camera, CONFIG), "default", tmp_path, save_map=tmp_path / "a.map")
    assert {path.name for path in tmp_path.iterdir()} >= ALWAYS
    assert len(load_map(tmp_path / "a.map").ids) > 0


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 130, and the table says it."""
    monkeypatch.setattr(datasets, "open_dataset", lambda *_: Stopping(send(signal.SIGTERM)))
    arguments = ["run", "somewhere", "--out", str(tmp_path), "--set", *SETTINGS]
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 130
    printed, said = capsys.readouterr()
    summary = check_results(tmp_path, "terminated", STOP + 1)
    assert f"after {summary['frames']} frames" in printed
    assert said.strip() == "error: interrupted"


class TestSecondCtrlC:
    def test_while_results_are_written(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """It ends at once, and leaves no half-written file."""
        seen: list[int] = []

        def interrupted(path: Path, data: bytes) -> None:
            send(signal.SIGINT)()
            seen.append(1)
            write_atomically(path, data)

        monkeypatch.setattr("jaxslam.results.run_results.write_atomically", interrupted)
        recording = Stopping(send(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            track(recording, Slam(recording.camera, CONFIG), "default", tmp_path)
        assert not seen
        assert not (tmp_path / "summary.json").exists()
        assert not list(tmp_path.glob(".*"))

    def test_third_ends_the_process(self) -> None:
        with Interruption() as interruption:
            interruption.check()
            send(signal.SIGTERM)()
            with pytest.raises(KeyboardInterrupt):
                interruption.check()
            with pytest.raises(KeyboardInterrupt):
                send(signal.SIGINT)()
            assert signal.getsignal(signal.SIGINT) == signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
        assert signal.getsignal(signal.SIGINT) == signal.default_int_handler

    def test_ignored_signal_stays_ignored(self) -> None:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            with Interruption() as interruption:
                send(signal.SIGINT)()
                interruption.check()
        finally:
            signal.signal(signal.SIGINT, before)


class TestOutputs:
    """What cannot be written is said before anything is tracked."""

    @pytest.mark.parametrize(
        ("command", "words"),
        [
            ("run x --save-map no/a.map", "--save-map: 'no/a.map' cannot be written: No such file or directory"),
            ("run x --save-map folder", "--save-map: folder: cannot be written: expected a file, got a folder"),
            ("run x --save-map /dev/full", "/dev/full: cannot be written: expected a file, got a device"),
            ("run x --save-map /proc/a.map", "--save-map: '/proc/a.map' cannot be written: "),
            ("run x --out file", "--out: 'file' cannot be written to: expected a folder, got a file"),
            ("demo --out file", "--out: 'file' cannot be written to: expected a folder, got a file"),
            ("demo --out file/out", "--out: 'file/out' cannot be written to: Not a directory"),
            ("demo --out /proc/out", "--out: '/proc/out' cannot be written to: No such file or directory"),
        ],
    )
    def test_checked_first(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        command: str,
        words: str,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        Path("file").write_text("")
        Path("folder").mkdir()
        monkeypatch.setattr(datasets, "open_dataset", lambda *_: Stopping(pytest.fail, at=0))
        monkeypatch.setattr(Slam, "warm_up", pytest.fail)
        with pytest.raises(SystemExit) as stop:
            main([*command.split(), "--set", *SETTINGS])
        assert stop.value.code == 1
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert words in line
        assert len(line) < 300


_SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_COMMANDS = {"demo": ["demo", "--frames", "60"], "run": ["run", "RECORDING", "--max-frames", "60"]}


@pytest.fixture(scope="module", params=_COMMANDS)
def command(request: pytest.FixtureRequest, data_dir: Path) -> list[str]:
    recording = str(data_dir / "tum/rgbd_dataset_freiburg1_rpy_excerpt")
    words = [recording if word == "RECORDING" else word for word in _COMMANDS[request.param]]
    return [sys.executable, "-m", "jaxslam", *words, "--set", "semantics.model=null"]


@pytest.fixture(scope="module")
def duration_s(command: list[str], tmp_path_factory: pytest.TempPathFactory) -> float:
    """Of the whole; the second time, when all is compiled."""
    durations = []
    for _ in range(2):
        out = tmp_path_factory.mktemp("whole") / "out"
        with started(command, out) as process:
            began = time.monotonic()
            assert process.wait(300) == 0
            durations.append(time.monotonic() - began)
        assert check_results(out, None, 60)["frames"] == 60
    return durations[1]


@pytest.mark.benchmark
class TestAnyMoment:
    """Of the command as a process of its own: from where it begins to compile until it ends by itself."""

    @pytest.mark.parametrize("moment", range(20))
    def test_results_are_on_disk(self, tmp_path: Path, command: list[str], duration_s: float, moment: int) -> None:
        number = list(_SIGNALS)[moment % 2]
        with started(command, tmp_path / "out") as process:
            time.sleep(duration_s * moment / 20)
            process.send_signal(number)
            code = process.wait(60)
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        check_results(tmp_path / "out", summary["cut_short"], 60)
        print(f"moment {moment}: {summary['cut_short']} after {summary['frames']} frames, exit code {code}")
        if summary["cut_short"] is None:  # it came while results were written, or when Python was ending, or too late
            assert summary["frames"] == 60
            assert code in (130, -number, 0)
        else:
            assert summary["cut_short"] == _SIGNALS[number]
            assert summary["frames"] <= 60
            assert code == 130


@contextmanager
def started(command: list[str], out: Path) -> Iterator[subprocess.Popen[str]]:
    """The process from the time its folder is there."""
    process = subprocess.Popen(
        [*command, "--out", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        while not out.is_dir():
            assert process.poll() is None, process.stderr and process.stderr.read()
            time.sleep(0.01)
        yield process
    finally:
        process.kill()
        process.communicate()


class TestSlam:
    """Of a robot's own loop."""

    @pytest.mark.parametrize("error", [None, KeyboardInterrupt, KeyError])
    @pytest.mark.parametrize("deterministic", [True, False])
    def test_keeps_map_and_trajectory(
        self, tmp_path: Path, error: type[BaseException] | None, deterministic: bool
    ) -> None:
        recording = clip()
        settings = replace(CONFIG, run=replace(CONFIG.run, deterministic=deterministic))
        tracked, slam = [], Slam(recording.camera, settings)
        try:
            with slam:
                for frame in recording.frames[:FRAMES]:
                    tracked.append(slam.track(frame))
                slam.finish()
                if error is not None:
                    raise error
        except (KeyboardInterrupt, KeyError):
            assert error is not None
        assert len(slam.trajectory) == len(slam.online_trajectory) == len(tracked)
        np.testing.assert_allclose(slam.online_trajectory.T_world_cam[-1, 4:], tracked[-1].T_world_cam[4:], atol=1e-6)
        assert len(slam.map.ids) > 0
        slam.save(tmp_path / "a.map")
        assert len(load_map(tmp_path / "a.map").ids) == len(slam.map.ids)

    def test_interrupted_within_a_step(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The step has taken its state with it; the next frame is found from the last one, or in the map."""
        recording = clip()
        slam, step = Slam(recording.camera, CONFIG), tracker_module._track_followed
        for frame in recording.frames[:FRAMES]:
            slam.track(frame)

        def interrupted(*arguments: Any) -> None:
            step(*arguments)
            raise KeyboardInterrupt

        monkeypatch.setattr(tracker_module, "_track_followed", interrupted)
        with pytest.raises(KeyboardInterrupt):
            slam.track(recording.frames[FRAMES])
        monkeypatch.undo()
        slam.save(tmp_path / "a.map")
        assert len(slam.trajectory) == FRAMES
        assert len(load_map(tmp_path / "a.map").ids) == len(slam.map.ids) > 0
        results = [slam.track(frame) for frame in recording.frames[FRAMES + 1 : FRAMES + 8]]
        found = [result for result in results if result.status != TrackStatus.LOST]
        assert found
        assert TrackStatus.STARTED not in [result.status for result in found]
        truth = recording.source.T_world_cam
        for result in found:
            index = int(np.searchsorted(recording.timestamps_ns, result.timestamp_ns))
            wrong = between(between(truth[0], truth[index]), result.T_world_cam)
            assert np.linalg.norm(wrong[4:]) < 0.03
