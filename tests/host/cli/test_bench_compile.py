"""`jaxslam bench compile`: a part in its own process, where a frame's operations are, the budget, bad input."""

import json
from pathlib import Path

import pytest
from command_line import failing, printed_json
from tiny_recording import CAMERA, write_recording

from jaxslam.cli.entry_point import main
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.write_tum import write_tum

fails = failing("bench", "compile")


class TestPart:
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
