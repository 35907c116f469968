"""`jaxslam bench`: runs in processes of their own, reports, and going on where it was broken off."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxslam.benchmark.report import published_table
from jaxslam.benchmark.suite import Sequence, Suite
from jaxslam.cli import main
from jaxslam.datasets.synthetic import SyntheticConfig

SUITE = """
about: a small room
presets: [static, default]
runs: 2
set: [semantics.model=null, track.num_points=128, mapping.num_features=200]
sequences:
  - name: room
    room: {frames: 8, people: 1, width: 160, height: 120}
"""
COLUMNS = ("preset", "runs", "tracked, %", "ATE, m", "from - to")


def suite_file(folder: Path, text: str = SUITE) -> str:
    path = folder / "small.yaml"
    path.write_text(text)
    return str(path)


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["bench", *arguments])
    assert ended.value.code == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a small suite."""
    folder = tmp_path_factory.mktemp("bench")
    main(["bench", suite_file(folder), "--out", str(folder / "out")])
    return folder / "out"


class TestResults:
    def test_of_every_run(self, out: Path) -> None:
        results = json.loads((out / "results.json").read_text())
        assert [(run["label"], run["seed"]) for run in results] == [
            ("static", 0), ("static", 1), ("default", 0), ("default", 1)
        ]  # fmt: skip
        for run in results:
            folder = out / "room" / run["label"] / str(run["seed"])
            assert json.loads((folder / "result.json").read_text()) == run
            assert (folder / "trajectory.txt").is_file()
            assert run["status"] == "done"
            assert run["frames"] == 8
            assert 0 < run["ate_rmse_m"] < 0.1
            assert run["flow_ratio_median"] == pytest.approx(run["track_ms"]["median"] / run["flow_ms"], rel=1e-2)
            assert {"cpu", "cores", "threads", "versions", "commit", "peak_rss_mb", "seed"} <= set(run)

    def test_report(self, out: Path) -> None:
        text = (out / "report.md").read_text()
        head, _, *rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
        assert tuple(head[: len(COLUMNS)]) == COLUMNS
        assert [row[:2] for row in rows] == [["static", "2 of 2"], ["default", "2 of 2"]]
        results = json.loads((out / "results.json").read_text())
        for row in rows:
            ates = sorted(run["ate_rmse_m"] for run in results if run["label"] == row[0])
            assert row[3:5] == [f"{sum(ates) / 2:.4f}", f"{ates[0]:.4f} - {ates[1]:.4f}"]
        assert "deterministic, all frames" in text

    def test_page(self, out: Path) -> None:
        """It needs nothing from elsewhere."""
        page = (out / "report.html").read_text()
        assert page.startswith("<!doctype html>")
        assert not re.findall(r'(?:src|href)="(?!data:)', page)
        assert page.count("<img") == 3
        assert "2 of 2" in page


class TestGoingOn:
    def test_nothing_twice(self, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
        files = sorted(out.rglob("result.json"))
        before = [path.stat().st_mtime_ns for path in files]
        kept = (out / "results.json").read_text()
        main(["bench", suite_file(out.parent), "--out", str(out), "--resume"])
        assert [path.stat().st_mtime_ns for path in files] == before
        assert (out / "results.json").read_text() == kept
        assert "4 runs, 0 failed" in capsys.readouterr().out

    def test_not_by_mistake(self, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "--resume goes on" in fails(capsys, suite_file(out.parent), "--out", str(out))

    def test_other_settings_are_other_runs(self, out: Path, tmp_path: Path) -> None:
        command = ["bench", suite_file(tmp_path), "--out", str(tmp_path / "out"), "--runs", "1", "--presets", "default"]
        config = tmp_path / "out/room/default/0/config.yaml"
        main(command)
        assert "probation_frames: 8" in config.read_text()
        config.write_text(config.read_text().replace("probation_frames: 8", "probation_frames: 9"))
        main([*command, "--resume"])
        assert "probation_frames: 8" in config.read_text()

    def test_killed_in_the_middle(self, tmp_path: Path) -> None:
        """No run that was finished is repeated, and none is lost."""
        suite, folder = suite_file(tmp_path), tmp_path / "out"
        program = "from jaxslam.cli import main; main()"
        command = [sys.executable, "-c", program, "bench", suite, "--out", str(folder)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until = time.monotonic() + 120
        while not (done := sorted(folder.rglob("result.json"))) and time.monotonic() < until:
            time.sleep(0.05)
        process.kill()  # its child notices by itself
        process.wait()
        assert done
        done = sorted(folder.rglob("result.json"))
        assert len(done) < 4
        before = {path: path.stat().st_mtime_ns for path in done}
        main(["bench", suite, "--out", str(folder), "--resume"])
        assert {path: path.stat().st_mtime_ns for path in done} == before
        assert len(json.loads((folder / "results.json").read_text())) == 4


class TestTrouble:
    def test_run_that_crashes(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """It is a row that says so; the others are there."""
        text = SUITE.replace("runs: 2", "runs: 1") + "  - recording: broken\n    camera: tum_fr1\n"
        (tmp_path / "data" / "broken").mkdir(parents=True)
        (tmp_path / "data" / "broken" / "rgb.txt").write_text("nonsense\n")
        folder = tmp_path / "out"
        error = fails(capsys, suite_file(tmp_path, text), "--out", str(folder), "--root", str(tmp_path / "data"))
        assert "2 of 4 runs failed" in error
        results = json.loads((folder / "results.json").read_text())
        assert [run["status"] for run in results] == ["done", "done", "failed", "failed"]
        assert results[-1]["problem"].startswith("ended with 1: error: ")
        report = (folder / "report.md").read_text()
        assert "1 runs failed: ended with 1" in report
        assert "| static | 0 of 1 | - |" in report

    def test_recording_that_is_not_there(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        text = SUITE.replace("runs: 2", "runs: 1") + "  - recording: rgbd_bonn_nowhere\n"
        main(["bench", suite_file(tmp_path, text), "--out", str(tmp_path / "out"), "--presets", "default"])
        assert "jaxslam data get rgbd_bonn_nowhere" in (tmp_path / "out" / "report.md").read_text()
        assert "rgbd_bonn_nowhere" in (tmp_path / "out" / "report.html").read_text()

    def test_wrong_options(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        suite, file = suite_file(tmp_path), tmp_path / "file"
        file.write_text("")
        new = ["--out", str(tmp_path / "new")]
        assert "did you mean 'smoke'" in fails(capsys, "smok", *new)
        assert "--runs: expected at least 1" in fails(capsys, suite, "--runs", "0", *new)
        assert "--workers: expected at least 1" in fails(capsys, suite, "--workers", "0", *new)
        assert "unknown preset" in fails(capsys, suite, "--presets", "nnn", *new)
        assert "--root: expected a folder" in fails(capsys, suite, "--root", str(file), *new)
        assert "cannot be made" in fails(capsys, suite, "--out", str(file / "out"))
        assert "num_point" in fails(capsys, suite, "--set", "track.num_point=3", *new)
        assert "num_points" in fails(capsys, suite, "--sweep", "track.num_points=a,b", *new)
        assert not (tmp_path / "new").exists()

    def test_list(self, capsys: pytest.CaptureFixture[str]) -> None:
        main(["bench"])
        text = capsys.readouterr().out
        assert "smoke" in text
        assert "bonn_dynamic" in text


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Of a gate whose baseline is what one preset, run once, shows now."""
    folder = tmp_path_factory.mktemp("gate")
    command = ["bench", "gate", "--baseline", str(folder / "baseline.json"), "--out", str(folder / "out"), "--resume"]
    chosen = ["--presets", "default", "--runs", "1", "--of", suite_file(folder)]
    main([*command, *chosen, "--update", "as it is now"])
    return command


class TestGate:
    def test_nothing_is_worse(self, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
        main(command)
        assert "Nothing is worse" in capsys.readouterr().out

    @pytest.mark.parametrize(("figure", "factor"), [("ate_rmse_m", 0.95), ("flow_ratio_median", 1 / 1.5)])
    def test_planted_loss(
        self, command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path, figure: str, factor: float
    ) -> None:
        """As if it had been 5 % better, or 1.5 times as fast, before."""
        better = json.loads(Path(command[3]).read_text())
        better["rows"]["room, default"][figure] *= factor
        (tmp_path / "better.json").write_text(json.dumps(better))
        error = fails(capsys, "gate", "--baseline", str(tmp_path / "better.json"), *command[4:])
        assert "1 figures are worse" in error
        assert "as it is now" in error

    def test_wrong_options(self, command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        nowhere = ["--baseline", str(tmp_path / "nowhere.json")]
        assert "expected --baseline FILE" in fails(capsys, "gate")
        assert "cannot be read" in fails(capsys, "gate", *nowhere)
        assert "--of SUITE" in fails(capsys, "gate", *nowhere, "--update", "why")
        assert "expected a reason" in fails(capsys, *command[1:], "--update", " ")


class TestPublished:
    """Figures of papers beside ours."""

    @staticmethod
    def lines(clip: Sequence, ates: tuple[float, float]) -> list[list[str]]:
        spread = {"median": sum(ates) / 2, "least": ates[0], "most": ates[1]}
        return published_table(Suite("any", "", (clip,)), clip.name, [{"label": "ours", "ate_rmse_m": spread}])

    def test_beside_ours(self) -> None:
        head, *lines = self.lines(Sequence("crowd", "rgbd_bonn_crowd"), (0.020, 0.025))
        assert head[:4] == ["published ATE", "m", "aligned", "ours is"]
        found = {line[0]: (float(line[1]), line[3]) for line in lines}
        assert found["NGD-SLAM"] == (0.024, "equal")
        assert {verdict for value, verdict in found.values() if value < 0.020} == {"worse"}
        assert {verdict for value, verdict in found.values() if value > 0.025} == {"better"}

    def test_nothing_about_parts_and_rooms(self) -> None:
        assert not self.lines(Sequence("crowd", "rgbd_bonn_crowd", stop=220), (0.02, 0.03))
        assert not self.lines(Sequence("room", room=SyntheticConfig(frames=5)), (0.02, 0.03))
        assert not self.lines(Sequence("mine", "my_own_recording"), (0.02, 0.03))
