"""The gate: what it lets pass and what it does not."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxslam.benchmark.gate import (
    Baseline,
    complaints,
    differences,
    load_baseline,
    make_baseline,
    runs_at_once,
    save_baseline,
)
from jaxslam.errors import BenchmarkError
from jaxslam.results import machine
from jaxslam.xla import usable_cores

LABELS = ("static", "default")


def results(
    *,
    ate: float = 1.0,
    time: float = 1.0,
    flow: float = 1.0,
    tracked: float = 100.0,
    jitter: float = 0.0,
    cpu: str = "any",
    jaxlib: str = "1",
) -> list[dict[str, Any]]:
    """Two runs of each of two presets, their figures multiplied by so much."""
    random = np.random.default_rng(0 if not jitter else None)
    return [
        {
            "sequence": "room",
            "label": label,
            "seed": seed,
            "status": "done",
            "problem": None,
            "cpu": cpu,
            "vectors": "avx2",
            "cores": 2,
            "versions": {"jaxlib": jaxlib, "opencv-python-headless": "2", "numpy": "3"},
            "evaluation": None,
            "track_ms": {"median": 30 * time * (1 + 0.05 * seed + jitter * random.uniform())},
            "flow_ms": flow * 10 * (1 + 0.05 * seed + jitter * random.uniform()),
            "mask_age_frames": None,
            "ate_rmse_m": ate * (0.01 + 0.002 * seed),
            "tracked_percent": tracked,
        }
        for label in LABELS
        for seed in range(2)
    ]


def baseline() -> Baseline:
    return make_baseline("smoke", LABELS, 2, "first", results())


class TestComplaints:
    @pytest.mark.parametrize(
        "changes",
        [{}, {"ate": 0.5}, {"ate": 1.015}, {"time": 0.3}, {"time": 1.15}],
        ids=["nothing", "better", "a little worse", "faster", "a little slower"],
    )
    def test_none(self, changes: Mapping[str, Any]) -> None:
        assert not complaints(baseline(), results(**changes))

    @pytest.mark.parametrize("run", range(20))
    def test_times_that_jitter(self, run: int) -> None:
        assert not complaints(baseline(), results(jitter=0.19)), f"run {run}"

    def test_flow_slowed_down(self) -> None:
        """In one run, it neither hides what has become slower nor makes everything slower afterwards."""
        disturbed = [
            {**run, "flow_ms": run["flow_ms"] * (1.5 if index == 1 else 1)} for index, run in enumerate(results())
        ]
        assert make_baseline("smoke", LABELS, 2, "first", disturbed).rows == baseline().rows
        assert {complaint.of_time for complaint in complaints(baseline(), results(time=1.5, flow=1.0))} == {True}
        assert not complaints(baseline(), results(time=1.5, flow=1.5))

    @pytest.mark.parametrize(
        ("changes", "figure"),
        [({"ate": 1.05}, "ate_rmse_m"), ({"time": 1.5}, "time_of_flows"), ({"tracked": 99.9}, "tracked_percent")],
    )
    def test_what_is_worse(self, changes: Mapping[str, Any], figure: str) -> None:
        found = complaints(baseline(), results(**changes))
        assert [(complaint.row, complaint.figure) for complaint in found] == [
            (f"room, {label}", figure) for label in LABELS
        ]
        assert all(f"{figure} " in str(complaint) and "was" in str(complaint) for complaint in found)

    @pytest.mark.parametrize("other", [{"cpu": "another"}, {"jaxlib": "2"}])
    def test_where_rounding_differs(self, other: dict[str, Any]) -> None:
        """Seeds differ by 12.9 % here, so that 50 % may be chance and 60 % are not."""
        assert baseline().noise == {label: pytest.approx(np.sqrt(2) * 0.001 / 0.011, abs=1e-4) for label in LABELS}
        assert not complaints(baseline(), results(ate=1.5, **other))
        assert {complaint.figure for complaint in complaints(baseline(), results(ate=1.6, **other))} == {"ate_rmse_m"}
        assert {complaint.figure for complaint in complaints(baseline(), results(tracked=99.0, **other))} == {
            "tracked_percent"
        }

    def test_times_are_those_of_a_machine(self) -> None:
        assert not complaints(baseline(), results(time=2.0, cpu="another"))
        assert complaints(baseline(), results(time=2.0, jaxlib="2"))

    def test_runs_at_once_where_times_do_not_count(self) -> None:
        here = make_baseline("smoke", LABELS, 2, "first", [{**run, **machine()} for run in results()])
        assert runs_at_once(here) == 1
        assert runs_at_once(baseline()) == usable_cores()

    def test_differences_are_told(self) -> None:
        assert differences(baseline(), results()) == ""
        assert differences(baseline(), results(cpu="b")) == "b (avx2), 2 cores, not any (avx2), 2 cores"

    def test_failed_and_missing_runs(self) -> None:
        failed = [{**run, "status": "failed", "problem": "killed by signal 9"} for run in results()]
        assert "killed by signal 9" in " ".join(map(str, complaints(baseline(), failed)))
        assert [str(complaint) for complaint in complaints(baseline(), results()[:2])] == ["room, default: is missing"]
        lost = [{**run, "ate_rmse_m": None} for run in results()]
        assert {complaint.figure for complaint in complaints(baseline(), lost)} == {"ate_rmse_m is missing"}


class TestFile:
    def test_there_and_back(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "baseline.json", baseline())
        assert load_baseline(tmp_path / "baseline.json") == baseline()

    @pytest.mark.parametrize(
        "text", ["", "[]", "{}", '{"suite": "smoke", "presets": 3}', '{"rows": {"a": {"b": "c"}}}']
    )
    def test_damaged(self, tmp_path: Path, text: str) -> None:
        path = tmp_path / "baseline.json"
        path.write_text(text)
        with pytest.raises(BenchmarkError, match="expected a baseline"):
            load_baseline(path)
        with pytest.raises(BenchmarkError, match="cannot be read"):
            load_baseline(tmp_path / "nowhere.json")

    def test_reason_and_whole_results(self) -> None:
        with pytest.raises(BenchmarkError, match="expected a reason"):
            make_baseline("smoke", LABELS, 2, " ", results())
        with pytest.raises(BenchmarkError, match="ended well"):
            make_baseline("smoke", LABELS, 2, "so", [{**results()[0], "status": "failed"}])
        with pytest.raises(BenchmarkError, match="ended well"):
            make_baseline("smoke", LABELS, 2, "so", [])

    def test_is_plain(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "baseline.json", baseline())
        content = json.loads((tmp_path / "baseline.json").read_text())
        assert content["rows"]["room, static"] == {
            "ate_rmse_m": 0.011,
            "tracked_percent": 100.0,
            "time_of_flows": 3.075,
        }
