"""`jaxslam compare`: several presets in one table."""

import json
from pathlib import Path

import pytest
from command_line import printed_json
from made_results import done
from small_scene import HEIGHT, SETTINGS, WIDTH

from jaxslam.cli.compare_run import figures, remarks
from jaxslam.cli.entry_point import main
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, write_tum

FRAMES = 8


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "room"
    write_tum(SyntheticDataset(SyntheticConfig(width=WIDTH, height=HEIGHT, frames=FRAMES, people=0)), folder)
    return folder


@pytest.mark.slow
def test_a_table(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two presets, twice each: every run has its folder, every preset its row, which says what it lacks."""
    chosen = ["--presets", "static", "ngd", "--runs", "2", "--allow-missing-model", "--json", "--set", *SETTINGS]
    main(["compare", str(recording), "--out", str(tmp_path), *chosen])
    rows = json.loads((tmp_path / "comparison.json").read_text())
    assert [row["preset"] for row in rows] == ["static", "ngd"]
    for row in rows:
        ates = [
            json.loads((tmp_path / row["preset"] / seed / "summary.json").read_text())["ate_rmse_m"] for seed in "01"
        ]
        assert row["ate_rmse_m_of_runs"] == ates
        assert row["ate_rmse_m"] == pytest.approx(sum(ates) / 2)
        assert row["tracked_percent"] == 100
        assert row["dropped_percent"] == 0
        assert row["track_ms_p95"] >= row["track_ms_median"] > 0
        assert row["num_matched"] == FRAMES
        assert row["rpe_trans_m_per_s"] is None  # the clip is shorter than a second
        assert row["evaluation_problems"] == []
    lines = (tmp_path / "comparison.md").read_text().splitlines()
    assert lines[2].startswith("| static | 100.0 % |")
    assert lines[3].startswith("| ngd (without a network) | 100.0 % |")
    assert len({line.count("|") for line in lines[:4]}) == 1
    assert [line for line in lines[4:] if line] == [
        "- static: without a network (semantics.model is null)",
        "- ngd: without a network (yolox-nano not on this machine)",
    ]
    printed, told = printed_json(capsys)
    assert printed == rows
    assert "ngd, run 2 of 2" in told
    seeds = [(tmp_path / "ngd" / seed / "config.yaml").read_text().count(f"seed: {seed}\n") for seed in "01"]
    assert seeds == [1, 1]


def test_figures_of_a_preset() -> None:
    """RPE over the runs that have it; why the others have no error is said, and what evaluations note."""
    run = done(tracked_percent=90.0, track_ms={"mean": 1.0, "median": 1.0, "p95": 2.0}, evaluation={"notes": ["odd"]})
    other = run | {"evaluation": run["evaluation"] | {"rpe_trans_m_per_s": 0.05, "num_matched": 5}}
    lost = run | {"ate_rmse_m": None, "ate_sim3_rmse_m": None, "evaluation": None, "evaluation_problem": "no truth"}
    row = figures("static", [run, other, lost])
    assert row["rpe_trans_m_per_s"] == pytest.approx(0.04)
    assert row["rpe_rot_deg_per_s"] == pytest.approx(0.7)
    assert row["num_matched"] == 5
    assert remarks(row) == ["static: no ATE of 1 runs: no truth", "static: note: odd"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "0"], "--runs: expected at least 1, got 0"),
        (["--presets", "static", "ngt"], "--presets: unknown preset 'ngt' (did you mean 'ngd'?)"),
        (["--max-frames", "0"], "--max-frames: expected at least 1, got 0"),
    ],
)
def test_wrong_arguments(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit):
        main(["compare", str(recording), "--out", str(tmp_path), *arguments])
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
