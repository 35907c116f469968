"""The gate: what it lets pass and what it does not."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxslam.benchmark.suites.baseline import Baseline, check_same_plan, load_baseline, save_baseline
from jaxslam.benchmark.suites.gate import complaints, differences, make_baseline, runs_at_once
from jaxslam.benchmark.suites.plan import fingerprint, plan
from jaxslam.benchmark.suites.suite import load_suite
from jaxslam.cli.bench_gate import Gate
from jaxslam.errors import BenchmarkError
from jaxslam.runtime.machine import machine
from jaxslam.runtime.threads import usable_cores

ROOT = Path(__file__).resolve().parents[3]
LABELS = ("static", "default")
PLAN: dict[str, Any] = {
    "sequences": {"room": {"room": {"frames": 12}}},
    "presets": {label: {"preset": label, "settings": []} for label in LABELS},
    "runs": 2,
}


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
    return make_baseline("smoke", LABELS, 2, "first", results(), PLAN)


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
        assert make_baseline("smoke", LABELS, 2, "first", disturbed, PLAN).rows == baseline().rows
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
        noise = pytest.approx(np.sqrt(2) * 0.001 / 0.011, abs=1e-4)
        assert baseline().noise == {f"room, {label}": noise for label in LABELS}
        assert not complaints(baseline(), results(ate=1.5, **other))
        assert {complaint.figure for complaint in complaints(baseline(), results(ate=1.6, **other))} == {"ate_rmse_m"}
        assert {complaint.figure for complaint in complaints(baseline(), results(tracked=99.0, **other))} == {
            "tracked_percent"
        }

    def test_spread_of_a_row_is_its_own(self) -> None:
        """A row that is a matter of luck makes no other one pass, and seeds beyond those compared tell its spread."""
        lucky = [
            {**run, "seed": seed, "ate_rmse_m": run["ate_rmse_m"] * (1 + 3 * (seed > 1))}
            for run in results()
            if run["label"] == "static"
            for seed in (run["seed"], run["seed"] + 2)
        ]
        before = make_baseline("smoke", LABELS, 2, "first", [*lucky, *results()[2:]], PLAN)
        assert before.rows == baseline().rows
        found = complaints(before, results(ate=2.5, cpu="another"))
        assert [complaint.row for complaint in found] == ["room, default"]

    def test_times_are_those_of_a_machine(self) -> None:
        assert not complaints(baseline(), results(time=2.0, cpu="another"))
        assert complaints(baseline(), results(time=2.0, jaxlib="2"))

    def test_runs_at_once_where_times_do_not_count(self) -> None:
        here = make_baseline("smoke", LABELS, 2, "first", [{**run, **machine()} for run in results()], PLAN)
        assert runs_at_once(here) == 1
        assert runs_at_once(baseline()) == usable_cores()

    def test_a_baseline_of_errors_only_compares_no_times(self) -> None:
        here = [{**run, **machine()} for run in results()]
        before = make_baseline("smoke", LABELS, 2, "first", here, PLAN, errors_only=True)
        assert runs_at_once(before) == usable_cores()
        slow = [{**run, **machine()} for run in results(time=10.0)]
        assert complaints(before, slow) == []
        assert complaints(make_baseline("smoke", LABELS, 2, "first", here, PLAN), slow)
        with pytest.raises(BenchmarkError, match="--errors-only expected --update REASON"):
            Gate(baseline=Path("baseline.json"), errors_only=True).main()

    def test_differences_are_told(self) -> None:
        assert differences(baseline(), results()) == ""
        assert differences(baseline(), results(cpu="b")) == "b (avx2), 2 cores, not any (avx2), 2 cores"

    def test_failed_and_missing_runs(self) -> None:
        failed = [{**run, "status": "failed", "problem": "killed by signal 9"} for run in results()]
        assert "killed by signal 9" in " ".join(map(str, complaints(baseline(), failed)))
        assert [str(complaint) for complaint in complaints(baseline(), results()[:2])] == ["room, default: is missing"]
        wrong = [{**run, "ate_rmse_m": float("nan")} for run in results()]
        assert {complaint.figure for complaint in complaints(baseline(), wrong)} == {"ate_rmse_m"}
        lost = [{**run, "ate_rmse_m": None} for run in results()]
        assert {complaint.figure for complaint in complaints(baseline(), lost)} == {"ate_rmse_m is missing"}


class TestFile:
    def test_there_and_back(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "baseline.json", baseline())
        assert load_baseline(tmp_path / "baseline.json") == baseline()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "expected a baseline as `bench gate --update` writes it"),
            ("[]", r"expected `key: value` lines, got \[\]"),
            ("{}", "missing 'suite', 'presets', 'runs'"),
            ('{"suite": "smoke", "presets": 3}', "missing 'runs', 'reason'"),
            ('{"rows": {"a": {"b": "c"}}}', "missing 'suite'"),
        ],
    )
    def test_damaged(self, tmp_path: Path, text: str, message: str) -> None:
        path = tmp_path / "baseline.json"
        path.write_text(text)
        with pytest.raises(BenchmarkError, match=rf"baseline\.json: {message}"):
            load_baseline(path)
        with pytest.raises(BenchmarkError, match="cannot be read"):
            load_baseline(tmp_path / "nowhere.json")

    def test_reason_and_whole_results(self) -> None:
        with pytest.raises(BenchmarkError, match="expected a reason"):
            make_baseline("smoke", LABELS, 2, " ", results(), PLAN)
        with pytest.raises(BenchmarkError, match="ended well"):
            make_baseline("smoke", LABELS, 2, "so", [{**results()[0], "status": "failed"}], PLAN)
        with pytest.raises(BenchmarkError, match="ended well"):
            make_baseline("smoke", LABELS, 2, "so", [], PLAN)

    def test_is_plain(self, tmp_path: Path) -> None:
        save_baseline(tmp_path / "baseline.json", baseline())
        content = json.loads((tmp_path / "baseline.json").read_text())
        assert content["rows"]["room, static"] == {
            "ate_rmse_m": 0.011,
            "tracked_percent": 100.0,
            "time_of_flows": 3.075,
        }

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("rows", {}, "rows: expected figures of at least one sequence, got none"),
            ("rows", {"room, static": {"ate_rmse_m": float("nan")}}, "ate_rmse_m: expected a finite number, got nan"),
            ("rows", {"room, static": {"tracked_percent": 100.0}}, "room, static: expected ate_rmse_m, got none"),
            ("rows", {"room, static": {"ate_rmse_m": 0.1}}, "room, default is planned, and not in rows"),
            ("noise", {"static": float("inf")}, "noise: static: expected a finite number >= 0, got inf"),
            ("noise", {"static": 0.1}, "noise: expected a share for each row, got ['static']"),
        ],
    )
    def test_nothing_can_be_held_to_it(self, tmp_path: Path, key: str, value: object, message: str) -> None:
        path = tmp_path / "baseline.json"
        save_baseline(path, baseline())
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
        with pytest.raises(BenchmarkError, match=re.escape(message)) as raised:
            load_baseline(path)
        assert str(raised.value).startswith(str(path))

    def test_that_does_not_say_what_was_run(self, tmp_path: Path) -> None:
        path = tmp_path / "baseline.json"
        save_baseline(path, baseline())
        path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "plan"}))
        with pytest.raises(BenchmarkError, match=r"plan: expected what was run.*--of SUITE --update REASON"):
            load_baseline(path)

    def test_new_one_in_the_place_of_a_bad_one(self, tmp_path: Path) -> None:
        """Of a suite that is named; without a name, nobody knows of what."""
        path = tmp_path / "baseline.json"
        path.write_text("{}")
        assert Gate(baseline=path, update="so", of="smoke").before(path) is None
        for gate in (Gate(baseline=path, update="so"), Gate(baseline=path, of="smoke")):
            with pytest.raises(BenchmarkError, match=r"baseline\.json: missing 'suite', 'presets'"):
                gate.before(path)

    def test_without_ground_truth(self) -> None:
        with pytest.raises(BenchmarkError, match="expected ate_rmse_m, got none"):
            make_baseline("smoke", LABELS, 2, "so", [{**run, "ate_rmse_m": None} for run in results()], PLAN)


class TestSamePlan:
    def test_differences_are_named(self) -> None:
        check_same_plan(baseline(), PLAN)
        other = {**PLAN, "sequences": {"room": {"room": {"frames": 4}}}, "runs": 1}
        with pytest.raises(BenchmarkError, match=r"sequences\.room\.room\.frames: 12, now 4; runs: 2, now 1"):
            check_same_plan(baseline(), other)

    @pytest.mark.parametrize("name", ["rooms", "worlds"])
    def test_those_of_the_project_are_what_their_suites_run_now(self, name: str) -> None:
        ours = load_baseline(ROOT / ".ci" / f"{name}.json")
        check_same_plan(ours, fingerprint(plan(load_suite(ours.suite), presets=ours.presets, runs=ours.runs)))
