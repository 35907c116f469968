"""Where and how commands print: tables of 80 columns, brackets as they are, JSON alone on standard output."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from command_line import printed_json
from made_results import done
from rich.console import Console
from rich.progress import Progress
from tiny_recording import CAMERA, write_recording

from jaxslam.benchmark.kernels.registry import chosen
from jaxslam.cli import bench_kernels, compare_run, tracking_run
from jaxslam.cli.bench import Bench
from jaxslam.cli.bench_batch import Batch, clips_table
from jaxslam.cli.bench_kernels import case_table
from jaxslam.cli.compare_run import figures, print_tables
from jaxslam.cli.console import console, make_table, messages_for, plain_console, print_json, text_column
from jaxslam.cli.entry_point import main
from jaxslam.cli.shared_options import WithJson

WIDTH, CUT = 80, "…"
NAN = float("nan")
CLIPS_ROW: dict[str, Any] = {
    "clips": 64,
    "way": "32 threads of 16",
    "threads": 1,
    "frames_per_s": 1206.3,
    "cores": 31.98,
    "compile_s": 123.4,
    "frames_per_s_per_core": 104.1,
    "loop_frames_per_s": 72.3,
    "ratio_to_loop": 22.9,
    "peak_rss_mb": 12345.0,
    "peak_device_mb": None,
    "ate_rmse_m": 0.01234,
    "ate_rmse_m_of_clips": [0.2],
    "off_alone_m": 1e-5,
    "same_statuses": True,
}
KERNEL_ROW: dict[str, Any] = {
    "kernel": "bundle_adjust",
    "size": 12,
    "label": "12 keyframes, 1500 points",
    "backend": "cpu",
    "device": "cpu",
    "compile_s": 3.0,
    "ours_ms": 12345.0,
    "ours_p95_ms": 12345.0,
    "theirs_ms": 12345.0,
    "theirs_p95_ms": 12345.0,
    "ratio": 0.00123,
    "difference": 0.000123,
    "agrees": False,
    "problem": "",
}


@pytest.fixture(autouse=True)
def _narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal of 80 columns, whatever the one of the tests is."""
    for shared in (console, plain_console):
        monkeypatch.setattr(shared, "_width", WIDTH)


@dataclass(frozen=True)
class Told(WithJson):
    """A command that says something, and prints a document if that is asked for."""

    def main(self) -> None:
        """Run the command."""
        console.print("working")
        plain_console.print("still working")
        if self.json:
            print_json({"figure": 1})


def rows_of(text: str) -> list[str]:
    """The lines of tables, which are indented or rules."""
    return [line for line in text.splitlines() if line.startswith((" ", "─"))]


class TestTable:
    def test_long_words_go_on_below(self, capsys: pytest.CaptureFixture[str]) -> None:
        table = make_table("A title", "name", "about", "share of all", left=2)
        table.add_row("n" * 20, "x" * 150, "12.5 %")
        console.print(table)
        out = capsys.readouterr().out
        assert all(len(line) <= WIDTH for line in rows_of(out))
        assert CUT not in out
        assert out.count("x") == 150
        assert "n" * 20 in out

    def test_of_presets_with_long_names(self, capsys: pytest.CaptureFixture[str]) -> None:
        times: Any = {"mean": 12.3, "median": 12.1, "p95": 123.4}
        run = done(
            track_ms=times,
            without_network="why",
            ate_rmse_m=12.3456,
            ate_sim3_rmse_m=12.3456,
            evaluation={"notes": ["[odd]"]},
        )
        rows = [figures(preset, [run, run]) for preset in ("static", "rts-semantics-epipolar")]
        print_tables("walking [xyz]", rows)
        out = capsys.readouterr().out
        assert all(len(line) <= WIDTH for line in rows_of(out))
        assert CUT not in out
        for text in ("walking [xyz]", "[odd]", "12.3456 - 12.3456", "100.0 %", "927", "0.0300", "0.700", "123.4"):
            assert text in out
        assert "rts-semantics-epipolar" in out

    def test_of_clips(self, capsys: pytest.CaptureFixture[str]) -> None:
        console.print(clips_table([CLIPS_ROW | {"same_statuses": same} for same in (True, False)]))
        out = capsys.readouterr().out
        assert all(len(line) <= WIDTH for line in rows_of(out))
        assert CUT not in out
        for text in ("1206", "31.98", "22.90", "123.4", "12345", "0.01234", "1.0e-05", "statuses"):
            assert text in out

    def test_of_kernels(self, capsys: pytest.CaptureFixture[str]) -> None:
        (case,) = chosen(("bundle_adjust",))
        console.print(case_table(case, [KERNEL_ROW]))
        out = capsys.readouterr().out
        assert all(len(line) <= WIDTH for line in rows_of(out))
        assert CUT not in out
        for text in ("12 keyframes, 1500 points", "0.00123", "0.000123, too"):
            assert text in out
        assert out.count("12345") == 4

    @pytest.mark.parametrize("words", [["models", "list"], ["data", "list"], ["bench"]])
    def test_of_what_is_known(self, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
        main(words)
        out = capsys.readouterr().out
        assert len(rows_of(out)) > 10
        assert all(len(line) <= WIDTH for line in rows_of(out))
        assert CUT not in out


def test_brackets_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    label = "static@dynamics.cues=[],[clusters]"
    table = make_table(label, "name", "figure")
    table.add_row(label, "[1]")
    console.print(table)
    console.print(f"{label}, seed 0")
    with Progress(text_column("{task.description}"), console=Console(width=WIDTH)) as progress:
        progress.add_task(label, total=1)
    assert capsys.readouterr().out.count(label) == 4


class TestJson:
    def test_messages_go_elsewhere(self, capsys: pytest.CaptureFixture[str]) -> None:
        for wanted in (True, False):
            command = Told(json=wanted)
            with messages_for(command):
                command.main()
            out, err = capsys.readouterr()
            assert (out, err)[wanted] == "working\nstill working\n"
            assert not wanted or json.loads(out) == {"figure": 1}

    @pytest.mark.parametrize(
        ("words", "keys"),
        [
            (["models", "list"], {"name", "license", "size_bytes", "sha256", "here"}),
            (["data", "list"], {"name", "license", "size_bytes", "url", "here"}),
            (["data", "list", "--missing"], {"name", "page"}),
            (["bench"], {"suite", "sequences", "presets", "runs", "about"}),
        ],
    )
    def test_of_lists(self, capsys: pytest.CaptureFixture[str], words: list[str], keys: set[str]) -> None:
        main([*words, "--json"])
        rows = json.loads(capsys.readouterr().out)
        assert len(rows) > 10
        assert all(keys <= set(row) for row in rows)

    def test_of_doctor(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        """Also of a recording that is not fit, which ends with code 1 as without."""
        recording = write_recording(tmp_path / "walk")
        CAMERA.save(recording / "camera.yaml")
        main(["doctor", str(recording), "--json"])
        found = json.loads(capsys.readouterr().out)
        assert found["errors"] == 0
        assert {"level", "topic", "text"} == set(found["findings"][0])
        (recording / "depth.txt").unlink()
        with pytest.raises(SystemExit) as stop:
            main(["doctor", str(recording), "--dataset", "tum", "--json"])
        out, err = capsys.readouterr()
        assert stop.value.code == 1
        assert json.loads(out)["errors"] == 1
        assert err.startswith("error: ")

    def test_of_run_and_compare(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """The summary of a run, and a row for each preset; here, tracking itself is left out."""
        recording = write_recording(tmp_path / "walk")
        CAMERA.save(recording / "camera.yaml")

        def track(*_: Any, **__: Any) -> dict[str, Any]:
            console.print("tracking")
            return done(ate_rmse_m=NAN, evaluation={"rpe_trans_m_per_s": NAN})

        for module in (tracking_run, compare_run):
            monkeypatch.setattr(module, "track", track)
        main(["run", str(recording), "--json"])
        summary, messages = printed_json(capsys)
        assert messages == "tracking\n"
        assert summary == done(ate_rmse_m=None, evaluation={"rpe_trans_m_per_s": None})
        main(["compare", str(recording), "--presets", "static", "--out", str(tmp_path), "--json"])
        (row,), messages = printed_json(capsys)
        assert messages.startswith("static, run 1 of 1\ntracking\n")
        assert (row["preset"], row["ate_rmse_m"], row["rpe_trans_m_per_s"]) == ("static", None, None)
        assert row["num_matched"] == 927

    def test_of_benchmarks(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """The results of a suite, and the figures of clips and kernels; here, measuring itself is left out."""

        def results(*_: Any, **__: Any) -> list[dict[str, Any]]:
            plain_console.print("running")
            return [done(ate_rmse_m=NAN)]

        monkeypatch.setattr(Bench, "results", results)
        main(["bench", "smoke", "--json"])
        (run,), messages = printed_json(capsys)
        assert messages == "running\n"
        assert {name: run[name] for name in done()} == done(ate_rmse_m=None)
        for command, measuring, row, options in (
            ("batch", Batch, CLIPS_ROW, []),
            ("kernels", bench_kernels, KERNEL_ROW, ["--only", KERNEL_ROW["kernel"]]),
        ):
            monkeypatch.setattr(measuring, "_measured", lambda *_, row=row: [row | {"compile_s": NAN}])
            main(["bench", command, *options, "--out", str(tmp_path), "--json"])
            document, messages = printed_json(capsys)
            assert document["rows"] == [row | {"compile_s": None}]
            assert messages.startswith(f"Table and plot: {tmp_path / command}.md")


def test_figures_that_are_not_finite_are_null(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"rows": [{"ate": float("nan")}, {"ate": float("inf")}, {"ate": 0.5, "name": "nan"}], "count": 3})
    rows = [{"ate": None}, {"ate": None}, {"ate": 0.5, "name": "nan"}]
    assert json.loads(capsys.readouterr().out) == {"rows": rows, "count": 3}
