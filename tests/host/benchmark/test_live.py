"""Live timing beside other programs: what they print, how they are started, the report, and a whole run."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from jaxslam.benchmark.external_program import Program
from jaxslam.benchmark.live.figures import LiveFigures, parse_figures
from jaxslam.benchmark.live.program import ours, parse_program, run_program
from jaxslam.benchmark.reports.live import COLUMNS, markdown_report, picture, ratio_rows, rows
from jaxslam.cli.entry_point import main
from jaxslam.errors import BenchmarkError
from jaxslam.runtime.machine import machine

WORDS = "Shutdown\n160 frames, 158 OK; median 20.5 ms, mean 21, p95 25.9, max 31; processor time 36.2 ms a frame\nbye\n"
FIGURES = LiveFigures(frames=160, tracked=158, median_ms=20.5, p95_ms=25.9, max_ms=31.0, cpu_ms=36.2)
PRINTS_WORDS = "print('12 frames, 11 OK; median 9.0 ms, p95 12; processor time 20 ms')"
HOLDS_MEMORY = f"import time; held = b'x' * 200_000_000; time.sleep(0.6); {PRINTS_WORDS}"


def python(code: str) -> Program:
    return Program("other", (sys.executable, "-c", code))


class TestFigures:
    def test_words(self) -> None:
        assert parse_figures("other", WORDS) == FIGURES

    def test_json_outranks_words(self) -> None:
        line = LiveFigures(5, 4, 1.0, 2.0, 3.0, late=1, ate_m=0.01).as_json()
        assert parse_figures("jaxslam", f"{WORDS}{line}\nend") == LiveFigures(5, 4, 1.0, 2.0, 3.0, late=1, ate_m=0.01)

    @pytest.mark.parametrize(
        ("printed", "message"),
        [
            ("", "got no frames, tracked, median_ms, p95_ms, cpu_ms"),
            ("10 frames, 9 OK; median 3 ms", "other: expected .* got no p95_ms, cpu_ms"),
            ('{"frames": 3, "tracked": "all"}', "got no tracked, median_ms"),
            ("{broken", "expected a line of JSON, got '{broken'"),
        ],
    )
    def test_missing_figures(self, printed: str, message: str) -> None:
        with pytest.raises(BenchmarkError, match=message):
            parse_figures("other", printed)


class TestProgram:
    def test_braces_are_filled_in(self) -> None:
        program = parse_program("orb = run --fps={rate} 'a b' {recording}", {"rate": "30", "recording": "/x y"})
        assert program == Program("orb", ("run", "--fps=30", "a b", "/x y"))

    @pytest.mark.parametrize("text", ["run", "=run", "orb=", "orb=run {fps}", "orb=run {}", "orb=run 'open"])
    def test_bad_text(self, text: str) -> None:
        with pytest.raises(BenchmarkError, match="--with: expected"):
            parse_program(text, {"rate": "30"})

    def test_figures_and_memory(self) -> None:
        found = run_program(python(HOLDS_MEMORY))
        assert (found.frames, found.tracked, found.median_ms, found.cpu_ms) == (12, 11, 9.0, 20.0)
        assert found.peak_mb > 200
        assert found.max_ms is found.late is None

    def test_a_program_that_fails(self) -> None:
        with pytest.raises(BenchmarkError, match="other: exit code 1: ValueError: no vocabulary"):
            run_program(python("raise ValueError('no vocabulary')"))

    def test_a_program_that_hangs(self) -> None:
        with pytest.raises(BenchmarkError, match=r"other: timed out after 0\.5 s and was killed"):
            run_program(python("import time; time.sleep(600)"), limit_s=0.5)

    def test_no_such_program(self) -> None:
        with pytest.raises(BenchmarkError, match="other: '/nowhere/slam' cannot be run"):
            run_program(Program("other", ("/nowhere/slam",)))

    def test_own_process_says_what_is_wrong(self, tmp_path: Path) -> None:
        values = {"recording": str(tmp_path), "rate": "30", "start": "0", "stop": "9", "every": "1"}
        with pytest.raises(BenchmarkError, match=f"jaxslam: exit code 1: .*{tmp_path.name}"):
            run_program(ours({**values, "preset": "default"}, ()))


class TestReport:
    def content(self) -> dict:
        own = {"program": "jaxslam", **vars(FIGURES), "late": 2, "ate_m": 0.0095, "peak_mb": 900.0}
        other = {"program": "orb", **vars(FIGURES), "max_ms": None, "peak_mb": 450.0}
        runs = []
        for number in range(3):
            slow = 1.0 + number  # whatever slows a round slows both
            runs += [own | {"round": number, "median_ms": 10 * slow}, other | {"round": number, "median_ms": 20 * slow}]
        conditions = {"recording": "fr1", "rate_hz": 30.0, "preset": "default", "settings": [], "rounds": 3}
        return {**machine(), **conditions, "runs": runs}

    def test_medians_and_ratios_within_a_round(self) -> None:
        runs = self.content()["runs"]
        shown = [dict(zip(COLUMNS, row, strict=True)) for row in rows(runs)]
        assert shown[0]["median, ms"] == "20.0 (10.0-30.0)"
        assert shown[0]["tracked"] == "158 of 160"
        assert (shown[0]["ATE, mm"], shown[1]["ATE, mm"], shown[1]["max, ms"]) == ("9.5", "-", "-")
        assert ratio_rows(runs) == [["orb", "0.50", "1.00", "1.00", "2.00"]]
        assert ratio_rows(runs[::2]) == []

    def test_pages(self, tmp_path: Path) -> None:
        content = self.content()
        report = markdown_report(content)
        assert report.startswith(f"# Live: fr1, 30 Hz, {content['cpu']}\n")
        assert content["cpu"] in report
        (tmp_path / "live.png").write_bytes(picture(content))
        assert np.ptp(imread(tmp_path / "live.png")) > 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--rounds", "0"], "--rounds: expected at least 1, got 0"),
        (["--rate", "0"], "--rate: expected frames a second, more than 0, got 0"),
        (["--with", "orb"], "--with: expected NAME=COMMAND, got 'orb'"),
        (["--set", "track.points=3"], "track.points"),
        (["--start", "500"], "expected a part of"),
        (["--limit", "0"], "--limit: expected seconds, more than 0, got 0"),
    ],
)
def test_bad_options(words: list[str], message: str, data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["bench", "live", str(data_dir / "tum/rgbd_dataset_freiburg1_rpy_excerpt"), *words])
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_whole_measurement(data_dir: Path, tmp_path: Path) -> None:
    """Two rounds beside a program that prints words."""
    words = ["--rounds", "2", "--stop", "20", "--out", str(tmp_path), "--set", "semantics.model=null"]
    recording, other = (
        data_dir / "tum/rgbd_dataset_freiburg1_rpy_excerpt",
        f'other={sys.executable} -c "{PRINTS_WORDS}"',
    )
    main(["bench", "live", str(recording), *words, "--with", other])
    content = json.loads((tmp_path / "live.json").read_text())
    assert [(run["program"], run["round"]) for run in content["runs"]] == [
        (program, number) for number in range(2) for program in ("jaxslam", "other")
    ]
    own = content["runs"][0]
    assert own["frames"] == own["tracked"] == 20
    assert 0 < own["median_ms"] <= own["p95_ms"] <= own["max_ms"]
    assert own["cpu_ms"] > 0.3 * own["median_ms"]
    assert own["peak_mb"] > 200
    assert own["ate_m"] < 0.02
    assert (tmp_path / "live.md").is_file()
    assert (tmp_path / "live.png").is_file()


FAILS_LATER = """
import pathlib, sys
seen = pathlib.Path(sys.argv[1])
assert not seen.exists(), "out of memory"
seen.touch()
print("12 frames, 11 OK; median 9.0 ms, p95 12.0; processor time 20.0 ms")
"""


@pytest.mark.slow
def test_a_program_that_fails_later(data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs that ended are kept, of it and of the others, and the failure is said."""
    words = ["--rounds", "2", "--stop", "20", "--out", str(tmp_path / "out"), "--set", "semantics.model=null"]
    program = tmp_path / "program.py"
    program.write_text(FAILS_LATER)
    other = f"other={sys.executable} {program} {tmp_path / 'seen'}"
    recording = data_dir / "tum/rgbd_dataset_freiburg1_rpy_excerpt"
    with pytest.raises(SystemExit, match="1"):
        main(["bench", "live", str(recording), *words, "--with", other])
    said = " ".join(capsys.readouterr().err.split())
    assert "round 2: other: exit code 1: AssertionError: out of memory; the other runs are in" in said
    content = json.loads((tmp_path / "out" / "live.json").read_text())
    assert [(run["program"], run["round"]) for run in content["runs"]] == [("jaxslam", 0), ("other", 0), ("jaxslam", 1)]
