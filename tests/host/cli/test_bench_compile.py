"""`jaxslam bench compile`: a part in its own process, where a frame's operations are, the budget, bad input."""

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import failing, printed_json
from tiny_recording import CAMERA, write_recording

from jaxslam.benchmark.compiling import part_process
from jaxslam.benchmark.compiling.part_process import PartJob
from jaxslam.cli.entry_point import main
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.write_tum import write_tum

fails = failing("bench", "compile")


class TestPart:
    @pytest.mark.slow
    def test_report_of_loop_closing(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        main(["bench", "compile", "--only", "loop-closing", "--out", str(tmp_path), "--json"])
        content, _ = printed_json(capsys)
        assert json.loads((tmp_path / "compile.json").read_text()) == content
        assert {"cpu", "vectors", "versions", "commit", "scene"} <= set(content)
        rows = {row["program"]: row for row in content["rows"]}
        assert {row["part"] for row in rows.values()} == {"loop-closing"}
        for name in ("optimize", "agreed", "refined"):
            row = rows[name]
            assert row["instructions"] > row["kernels"] > 100
            assert min(row["trace_s"], row["lower_s"], row["compile_s"]) > 0
            assert 100 < row["peak_mb"] < 2000
            assert sum(of["instructions"] for of in row["functions"]) == row["instructions"]
            assert all(of["executed"] is None for of in row["functions"])
        assert any(of["function"].startswith("pose.p3p.") for of in rows["agreed"]["functions"])
        report = (tmp_path / "compile.md").read_text()
        assert report.startswith("# What compiling costs\n")
        assert f"## optimize: {rows['optimize']['instructions']:,} instructions" in report
        assert content["cpu"] in report

    @pytest.mark.slow
    def test_flow_of_a_recording_by_function(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        write_tum(SyntheticDataset(SyntheticConfig(frames=12, width=320, height=240)), tmp_path / "room")
        options = [
            "--recording",
            str(tmp_path / "room"),
            "--by-function",
            "--functions",
            "3",
            "--out",
            str(tmp_path / "out"),
        ]
        main(["bench", "compile", "--only", "flow", *options])
        out = capsys.readouterr().out
        assert "executed per frame in" in out
        (row,) = json.loads((tmp_path / "out" / "compile.json").read_text())["rows"]
        assert row["program"] == "follow_points"
        assert sum(of["executed"] for of in row["functions"]) > 100
        assert 0 < sum(of["self_ms"] for of in row["functions"]) < 1000
        dearest = [of["self_ms"] for of in row["functions"]]
        assert dearest == sorted(dearest, reverse=True)


class TestBudget:
    """With made counts: those of the two programs are compiled in `test_compile_budget`."""

    @pytest.fixture
    def counts(self, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
        """Instructions by function of the program that each part has; changed by a test."""
        sizes = {"pose.p3p": 700, "se3.retract": 300}

        def measured(job: PartJob, *, plain: bool) -> list[dict[str, Any]]:
            assert plain
            program = {"flow": "follow_points", "step": "track_followed"}[job.part]
            functions = [{"function": name, "instructions": size} for name, size in sizes.items()]
            return [{"program": program, "instructions": sum(sizes.values()), "kernels": 50, "functions": functions}]

        monkeypatch.setattr(part_process, "measure_part", measured)
        return sizes

    def test_written_and_kept_to(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, counts: dict[str, int]
    ) -> None:
        budget = str(tmp_path / "budget.json")
        main(["bench", "compile", "--update-budget", "--budget", budget])
        main(["bench", "compile", "--check-budget", "--budget", budget])
        assert capsys.readouterr().out.rstrip().endswith(f"Within {budget}.")
        counts["pose.p3p"] += 30
        with pytest.raises(SystemExit) as stop:
            main(["bench", "compile", "--check-budget", "--budget", budget])
        assert stop.value.code == 1
        out, err = capsys.readouterr()
        for program in ("follow_points", "track_followed"):
            assert f"{program}: 1,030 instructions, 3.0 % above the budget of 1,000; grown most: pose.p3p +30" in out
        assert f"2 counts are off {budget}. If it must be" in err
        main(["bench", "compile", "--update-budget", "--budget", budget, "--json"])
        written, _ = printed_json(capsys)
        assert written["track_followed"]["instructions"] == 1030
        main(["bench", "compile", "--check-budget", "--budget", budget])


class TestErrors:
    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            (("--only", "stepp"), "--only: expected one of flow, step, gradient, mapping, loop-closing, dense, got"),
            (("--only", "stepp"), "(did you mean 'step'?)"),
            (("--gradient-size", "160"), "--gradient-size: expected WIDTHxHEIGHT of 64 to 8192 pixels, got '160'"),
            (("--functions", "0"), "--functions: expected at least 1, got 0"),
            (("--check-budget", "--only", "step"), "expected no other option"),
            (("--check-budget", "--update-budget"), "expected --check-budget or --update-budget, got both"),
            (("--check-budget", "--budget", "nowhere.json"), "nowhere.json: expected a baseline, cannot be read"),
            (("--update-budget", "--budget", "no/where.json"), "no/where.json"),
        ],
    )
    def test_of_options(self, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], expected: str) -> None:
        assert expected in fails(capsys, *options)

    def test_no_recording(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        """Found by the part's process, and said as any other command does."""
        missing = tmp_path / "nowhere"
        said = fails(capsys, "--only", "flow", "--recording", str(missing), "--out", str(tmp_path))
        assert said == f"flow: {missing}: expected the folder of a recording, got nothing there"

    def test_recording_too_short_to_be_traced(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        """Said before anything is compiled."""
        recording = write_recording(tmp_path / "walk")
        CAMERA.save(recording / "camera.yaml")
        options = ["--by-function", "--recording", str(recording), "--out", str(tmp_path)]
        assert fails(capsys, "--only", "step", *options).endswith("--by-function: expected more than 10 frames, got 6")
