"""`jaxslam bench`: runs in processes of their own, reports, and going on where it was broken off."""

import csv
import html
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import failing, printed_json
from small_scene import SETTINGS

from jaxslam.benchmark.reports.html import html_report
from jaxslam.benchmark.reports.plots import plot_rates
from jaxslam.benchmark.suites.collected_results import ALWAYS
from jaxslam.benchmark.suites.suite import Sequence, Suite
from jaxslam.cli.entry_point import main
from jaxslam.datasets.synthetic import SyntheticConfig

fails = failing("bench")

SUITE = f"""
about: a small room
presets: [static, default]
runs: 2
set: [semantics.model=null, {", ".join(SETTINGS)}]
sequences:
  - name: room
    room: {{frames: 8, people: 1, width: 160, height: 120}}
"""
COLUMNS = ("preset", "runs", "frames", "tracked, %", "matched poses", "ATE, m", "from - to")


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
LOOK = """
const table = document.querySelectorAll("table")[1];
const head = [...table.rows[0].cells].find(cell => cell.textContent == "ATE, m");
const order = () => { head.click(); return [...table.tBodies[0].rows].map(row => row.cells[0].textContent); };
const pictures = [...document.images];
document.querySelectorAll("details").forEach(part => part.open = true);
parent.postMessage(JSON.stringify({
  pictures: pictures.length, drawn: pictures.filter(picture => picture.naturalWidth > 100).length,
  wide: document.documentElement.scrollWidth, window: innerWidth, sorted: [order(), order()]}), "*");
"""
"""Looks at a page, and tells the one around it."""
AROUND = """<script>onmessage = message => document.title = message.data;</script>
<iframe src="page.html" width="{width}" height="900" style="border: 0"></iframe>
"""
"""A window as narrow as wanted, which a browser's own is not; its title is what is told."""


def tables(markdown: str) -> list[list[list[str]]]:
    """Cells of every table, headings first."""
    groups = re.findall(r"(?:^\|.*\n)+", markdown, flags=re.MULTILINE)
    split = [[line.strip("| ").split(" | ") for line in group.splitlines()] for group in groups]
    return [[lines[0], *lines[2:]] for lines in split]


def column(table: list[list[str]], index: int) -> list[str]:
    """Of the rows below the headings."""
    return [row[index] for row in table[1:]]


def suite_file(folder: Path, text: str = SUITE) -> str:
    path = folder / "small.yaml"
    path.write_text(text)
    return str(path)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a small suite."""
    folder = tmp_path_factory.mktemp("bench")
    main(["bench", suite_file(folder), "--out", str(folder / "out")])
    return folder / "out"


@pytest.fixture
def mine(out: Path, tmp_path: Path) -> Path:
    """A copy of them; what is the same in another suite is taken from here with `--resume`."""
    return Path(shutil.copytree(out, tmp_path / "out"))


def times_of(files: list[Path]) -> dict[Path, int]:
    """When they were written."""
    return {path: path.stat().st_mtime_ns for path in files}


@pytest.mark.slow
class TestResults:
    def test_of_every_run(self, out: Path) -> None:
        assert {path.name for path in out.iterdir()} == {"results.json", "report.md", "report.html", "room", "tables"}
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
            assert run["networks_sha256"] == {}
            assert run["images"] == 8
            assert set(ALWAYS) <= set(run)

    def test_report(self, out: Path) -> None:
        text = (out / "report.md").read_text()
        overview, accuracy, running = tables(text)
        assert tuple(accuracy[0][: len(COLUMNS)]) == COLUMNS
        assert [row[:2] for row in accuracy[1:]] == [["static", "2 of 2"], ["default", "2 of 2"]]
        results = json.loads((out / "results.json").read_text())
        for row in accuracy[1:]:
            ates = sorted(run["ate_rmse_m"] for run in results if run["label"] == row[0])
            assert row[5:7] == [f"{sum(ates) / 2:.4f}", f"{ates[0]:.4f} - {ates[1]:.4f}"]
        assert overview == [
            [
                *("ATE, m", "static", "default", "best published", "of"),
                *("frames", "tracked, %", "matched poses", "runs done"),
            ],
            ["room", *column(accuracy, 5), "-", "-", "8", "100.0", "8", "4 of 4"],
        ]
        times = sorted(run["track_ms"]["p95"] for run in results if run["label"] == "static")
        assert float(running[1][running[0].index("p95, ms")]) == pytest.approx(sum(times) / 2, abs=0.06)
        assert "deterministic, all frames" in text

    def test_tables(self, out: Path) -> None:
        """Those of the report, each as CSV and LaTeX."""
        names = {path.name for path in (out / "tables").iterdir()}
        assert names == {
            f"{name}.{kind}" for name in ("overview", "room-accuracy", "room-running") for kind in ("csv", "tex")
        }
        _, accuracy, _ = tables((out / "report.md").read_text())
        with (out / "tables" / "room-accuracy.csv").open(newline="") as file:
            assert list(csv.reader(file)) == accuracy

    def test_page(self, out: Path) -> None:
        """It needs nothing from elsewhere."""
        page = (out / "report.html").read_text()
        assert page.startswith("<!doctype html>")
        assert not re.findall(r'(?:src|href)="(?!data:)', page)
        pictures = re.findall(r'<img alt="([^"]*)" src="data:image/(?:png|jpeg);base64,[A-Za-z0-9+/=]{1000,}"', page)
        shown = ("errors of the runs", "against the truth", "error over time", "times of the frames", "largest error")
        assert all(any(what in picture for picture in pictures) for what in shown)
        assert "2 of 2" in page

    @pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
    @pytest.mark.parametrize("width", [390, 1200])
    def test_page_in_a_browser(self, out: Path, tmp_path: Path, width: int) -> None:
        """It is no wider than the window, its pictures are there, and a click on a heading sorts."""
        page, around = tmp_path / "page.html", tmp_path / "around.html"
        page.write_text((out / "report.html").read_text().replace("</body>", f"<script>{LOOK}</script></body>"))
        around.write_text(AROUND.format(width=width))
        browser = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'user'}"]
        shown = subprocess.run(
            [*browser, "--virtual-time-budget=5000", "--dump-dom", around.as_uri()],
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        found = re.search(r"<title>(.*?)</title>", shown.stdout)
        assert found is not None
        seen = json.loads(html.unescape(found[1]))
        assert seen["pictures"] == seen["drawn"] >= 5
        assert seen["wide"] <= seen["window"] == width
        results = json.loads((out / "results.json").read_text())
        ate = {
            label: [run["ate_rmse_m"] for run in results if run["label"] == label] for label in ("static", "default")
        }
        up = sorted(ate, key=lambda label: float(f"{sum(ate[label]) / 2:.4f}"))
        assert seen["sorted"] == [up, up[::-1]]


@pytest.mark.slow
class TestRates:
    def test_errors_over_the_rate(self, out: Path, mine: Path) -> None:
        """Of a room that is there at two rates, one line a preset, through the medians of its runs."""
        shutil.copytree(out / "room", mine / "room_15_hz")
        results = json.loads((out / "results.json").read_text())
        slow = [{**run, "sequence": "room_15_hz", "rate_hz": 15.0, "ate_rmse_m": 0.05} for run in results]
        figure = plot_rates({"room": [*results, *slow]})
        lines = {str(line.get_label()): np.asarray(line.get_xydata()) for line in figure.axes[0].lines}
        assert set(lines) == {"static", "default"}
        for label, points in lines.items():
            ates = [run["ate_rmse_m"] for run in results if run["label"] == label]
            np.testing.assert_allclose(points, [[15.0, 0.05], [30.0, np.median(ates)]], rtol=1e-3)
        room = SyntheticConfig(frames=8, people=1, width=160, height=120)
        suite = Suite("rates", "", (Sequence("room", room=room), Sequence("room_15_hz", room=room, every=2)))
        page = html_report(suite, [*results, *slow], {}, mine)
        assert "Error over the rate of frames" in page
        assert "Error over the rate of frames" not in (out / "report.html").read_text()


@pytest.mark.slow
class TestGoingOn:
    def test_nothing_twice(self, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
        before = times_of(sorted(out.rglob("result.json")))
        kept = (out / "results.json").read_text()
        main(["bench", suite_file(out.parent), "--out", str(out), "--resume", "--json"])
        assert times_of(sorted(out.rglob("result.json"))) == before
        assert (out / "results.json").read_text() == kept
        results, messages = printed_json(capsys)
        assert results == json.loads(kept)
        assert "4 runs, 0 failed" in messages
        assert "| recording | static | default | published |" in messages

    def test_not_by_mistake(self, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "--resume keeps them" in fails(capsys, suite_file(out.parent), "--out", str(out))

    def test_what_differs_is_run_again(self, mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """That alone, and it is said why; other presets and seeds stay in the report."""
        config = mine / "room/default/0/config.yaml"
        assert "probation_frames: 8" in config.read_text()
        config.write_text(config.read_text().replace("probation_frames: 8", "probation_frames: 9"))
        result = mine / "room/default/1/result.json"
        edited = json.loads(result.read_text()) | {"commit": "deadbeef", "data_sha256": "x", "ate_rmse_m": 1e-9}
        result.write_text(json.dumps(edited))
        before = times_of(sorted(mine.rglob("result.json")))
        main(["bench", suite_file(tmp_path), "--out", str(mine), "--resume", "--presets", "default"])
        assert "probation_frames: 8" in config.read_text()
        now = times_of(sorted(mine.rglob("result.json")))
        assert [path for path in now if now[path] != before[path]] == [config.parent / "result.json", result]
        out = capsys.readouterr().out
        assert "room, default, seed 0: run again: track.probation_frames was 9.0, is 8.0" in out
        assert "room, default, seed 1: run again: result.json is not as the run wrote it" in out
        assert "Also in the report: 2 runs of earlier calls." in out
        results = json.loads((mine / "results.json").read_text())
        assert [(run["label"], run["seed"]) for run in results] == [
            ("static", 0), ("static", 1), ("default", 0), ("default", 1)
        ]  # fmt: skip
        assert "| static | 2 of 2 |" in (mine / "report.md").read_text()
        assert "<td>static</td><td>2 of 2</td>" in (mine / "report.html").read_text()

    def test_killed_in_the_middle(self, tmp_path: Path) -> None:
        """No run that was finished is repeated, and none is lost: one at work then, one not begun."""
        suite, folder = suite_file(tmp_path, SUITE.replace("runs: 2", "runs: 3")), tmp_path / "out"
        program = "from jaxslam.cli.entry_point import main; main()"
        chosen = ["--out", str(folder), "--presets", "static"]
        command = [sys.executable, "-c", program, "bench", suite, *chosen]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until = time.monotonic() + 120
        while not (done := sorted(folder.rglob("result.json"))) and time.monotonic() < until:
            time.sleep(0.05)
        process.kill()  # its child notices by itself
        process.wait()
        assert done
        done = sorted(folder.rglob("result.json"))
        assert len(done) < 3
        before = times_of(done)
        main(["bench", suite, *chosen, "--resume"])
        assert times_of(done) == before
        assert len(json.loads((folder / "results.json").read_text())) == 3
        assert not (folder / ".rooms").exists()


class TestTrouble:
    @pytest.mark.slow
    def test_run_that_crashes(self, mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """It is a row that says so; the others are there."""
        text = SUITE.replace("runs: 2", "runs: 1") + "  - recording: broken\n    camera: tum_fr1\n"
        (tmp_path / "data" / "broken").mkdir(parents=True)
        (tmp_path / "data" / "broken" / "rgb.txt").write_text("nonsense\n")
        options = ["--out", str(mine), "--root", str(tmp_path / "data"), "--resume"]
        assert "2 of 4 runs failed" in fails(capsys, suite_file(tmp_path, text), *options)
        results = json.loads((mine / "results.json").read_text())
        assert [run["status"] for run in results] == ["done"] * 4 + ["failed"] * 2
        assert len({tuple(run) for run in results}) == 1  # the same keys, as a table has
        assert results[-1]["frames"] is None
        assert results[-1]["problem"].startswith("ended with 1: error: ")
        report = (mine / "report.md").read_text()
        assert "1 runs failed: ended with 1" in report
        assert "| static | 0 of 1 |" in report
        assert "- 4 of 6 planned runs are done, 2 failed\n" in report

    @pytest.mark.slow
    def test_recording_that_is_not_there(self, mine: Path, tmp_path: Path) -> None:
        suite = suite_file(tmp_path, SUITE + "  - recording: rgbd_bonn_nowhere\n")
        main(["bench", suite, "--out", str(mine), "--resume"])
        assert "rgbd_bonn_nowhere: not there, nor in `jaxslam data list`" in (mine / "report.md").read_text()
        assert "rgbd_bonn_nowhere" in (mine / "report.html").read_text()

    @pytest.mark.slow
    def test_kitti(self, tmp_path: Path, data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """What is there of it is run, with the development kit's figures; the other ten are named."""
        text = "sequences: [{recording: kitti_06, sensor: stereo, stop: 12}, {recording: kitti_10, sensor: stereo}]"
        suite = suite_file(tmp_path, text + "\nset: [semantics.model=null]\n")
        main(["bench", suite, "--root", str(data_dir), "--out", str(tmp_path / "out")])
        out = capsys.readouterr().out
        assert "Not run: kitti_10: not there" in out
        assert "1 runs, 0 failed, 1 recordings not run." in out
        (result,) = json.loads((tmp_path / "out" / "results.json").read_text())
        assert (result["status"], result["tracked"], result["camera"]) == ("done", 12, "kitti_06")
        assert result["ate_rmse_m"] < 0.1
        assert {"kitti_trans_percent", "kitti_rot_deg_per_100m"} <= result["evaluation"].keys()

    def test_wrong_options(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        suite, file = suite_file(tmp_path), tmp_path / "file"
        file.write_text("")
        new = ["--out", str(tmp_path / "new")]
        assert "did you mean 'smoke'" in fails(capsys, "smok", *new)
        assert "--runs: expected at least 1" in fails(capsys, suite, "--runs", "0", *new)
        assert "--workers: expected at least 1" in fails(capsys, suite, "--workers", "0", *new)
        assert "unknown preset" in fails(capsys, suite, "--presets", "nnn", *new)
        assert "--root: expected a folder" in fails(capsys, suite, "--root", str(file), *new)
        assert "cannot be written to" in fails(capsys, suite, "--out", str(file / "out"))
        assert "num_point" in fails(capsys, suite, "--set", "track.num_point=3", *new)
        assert "num_points" in fails(capsys, suite, "--sweep", "track.num_points=a,b", *new)
        assert not (tmp_path / "new").exists()

    def test_list(self, capsys: pytest.CaptureFixture[str]) -> None:
        main(["bench"])
        text = capsys.readouterr().out
        assert "smoke" in text
        assert "bonn_dynamic" in text


@pytest.fixture(scope="module")
def command(out: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Of a gate whose baseline is what one preset, run once, shows now: the run of the small suite."""
    folder = tmp_path_factory.mktemp("gate")
    shutil.copytree(out / "room/default/0", folder / "out/room/default/0")
    command = ["bench", "gate", "--baseline", str(folder / "baseline.json"), "--out", str(folder / "out"), "--resume"]
    chosen = ["--presets", "default", "--runs", "1", "--of", suite_file(folder)]
    main([*command, *chosen, "--update", "as it is now"])
    return command


@pytest.mark.slow
class TestGate:
    def test_nothing_is_worse(self, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
        main([*command, "--json"])
        told, err = printed_json(capsys)
        assert "Nothing is worse" in err
        assert (told["worse"], told["results"][0]["status"]) == ([], "done")

    @pytest.mark.parametrize(("figure", "factor"), [("ate_rmse_m", 0.95), ("time_of_flows", 1 / 1.5)])
    def test_planted_loss(
        self, command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path, figure: str, factor: float
    ) -> None:
        """As if it had been 5 % better, or 1.5 times as fast, before. Times, measured again, are what they were."""
        better = json.loads(Path(command[3]).read_text())
        better["rows"]["room, default"][figure] *= factor
        (tmp_path / "better.json").write_text(json.dumps(better))
        out = Path(command[5])
        for again in ("again-1", "again-2"):
            shutil.copytree(out / "room", out / again / "room", dirs_exist_ok=True)
        error = fails(capsys, "gate", "--baseline", str(tmp_path / "better.json"), *command[4:])
        assert "1 figures are worse" in error
        assert figure != "time_of_flows" or (out / "again-2" / "results.json").exists()
        assert "as it is now" in error

    def test_wrong_options(self, command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        nowhere = ["--baseline", str(tmp_path / "nowhere.json")]
        assert "expected --baseline FILE" in fails(capsys, "gate")
        assert "cannot be read" in fails(capsys, "gate", *nowhere)
        assert "--of SUITE" in fails(capsys, "gate", *nowhere, "--update", "why")
        other = json.loads(Path(command[3]).read_text())
        other["plan"]["sequences"]["room"]["room"]["frames"] = 12
        (tmp_path / "other.json").write_text(json.dumps(other))
        told = fails(capsys, "gate", "--baseline", str(tmp_path / "other.json"), *command[4:])
        assert "other.json: expected the runs of the baseline; sequences.room.room.frames: 12, now 8" in told
        assert "presets.default.settings" in fails(capsys, *command[1:], "--set", "track.num_points=100")
        assert "expected a reason" in fails(capsys, *command[1:], "--update", " ")
        assert "--workers: expected at least 1, got 0" in fails(capsys, *command[1:], "--workers", "0")
