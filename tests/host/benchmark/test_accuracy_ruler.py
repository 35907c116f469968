"""The accuracy ruler on results made by hand: what is worse, what cannot be compared, what is chance."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import failing
from made_results import done

from jaxslam.benchmark.suites.accuracy_ruler import (
    Accuracy,
    AccuracyBaseline,
    Measured,
    compare_accuracy,
    load_accuracy_baseline,
    measured,
    save_accuracy_baseline,
)
from jaxslam.benchmark.suites.plan import fingerprint, plan
from jaxslam.benchmark.suites.suite import load_suite
from jaxslam.cli.entry_point import main
from jaxslam.config.loading import configs_dir
from jaxslam.errors import BenchmarkError

fails = failing("bench", "accuracy")
VERSIONS = ("jaxlib", "opencv-python-headless", "numpy")

SEEDS = 10
ATES = tuple(0.010 + 0.0002 * seed for seed in range(SEEDS))


def runs(scale: float = 1.0, *, tracked: int = 900, name: str = "") -> Measured:
    trajectories = tuple(f"{name}{scale}{seed}" for seed in range(SEEDS))
    return Measured(90, tracked, tuple(scale * ate for ate in ATES), trajectories, "data", "network")


SEQUENCES = {name: {"recording": name} for name in ("a", "b", "new")}
BASELINE = AccuracyBaseline("8561ab9", "first", "a CPU", "numpy 2", "default", SEQUENCES, {"a": runs(), "b": runs(2.0)})


def compare(now: Mapping[str, Measured]) -> Accuracy:
    return compare_accuracy(now, SEQUENCES, BASELINE)


class TestComparison:
    def test_of_the_same_bytes(self) -> None:
        reading = compare(BASELINE.recordings)
        assert reading.mean_ratio == pytest.approx(1)
        assert reading.worse == ()
        assert [row.equal_runs for row in reading.recordings] == [SEEDS, SEEDS]

    def test_geometric_mean(self) -> None:
        """A gain on one recording pays for a loss on another, up to the limit of a single one."""
        reading = compare({"a": runs(1.1), "b": runs(2.0 / 1.1)})
        assert [row.ratio for row in reading.recordings] == pytest.approx([1.1, 1 / 1.1])
        assert reading.mean_ratio == pytest.approx(1)
        assert reading.worse == ()
        assert [row.equal_runs for row in reading.recordings] == [0, 0]

    @pytest.mark.parametrize(
        ("scales", "sentences"),
        [
            ((1.03, 1.045), ()),
            ((1.05, 1.05), ("geometric mean of the ratios 1.050, expected at most 1.04",)),
            ((1.16, 0.8), ("a: ratio 1.160, expected at most 1.15",)),
        ],
    )
    def test_limits(self, scales: Sequence[float], sentences: Sequence[str]) -> None:
        reading = compare({"a": runs(scales[0]), "b": runs(2 * scales[1])})
        assert reading.worse == tuple(sentences)

    def test_one_frame_fewer_is_worse(self) -> None:
        reading = compare({"a": runs(tracked=899), "b": runs(2.0)})
        assert reading.worse == ("a: 899 frames tracked over all seeds, expected 900",)

    def test_new_and_missing_recordings(self) -> None:
        """One that the baseline lacks has no say; one that was not run is named."""
        reading = compare({"a": runs(), "new": runs(9.0)})
        assert (reading.mean_ratio, reading.left_out, reading.worse) == (pytest.approx(1), ("b",), ())
        assert [row.ratio for row in reading.recordings] == [pytest.approx(1), None]

    def test_by_chance(self) -> None:
        """Two medians of the same seeds differ by some percent, their mean over recordings by less."""
        reading = compare(BASELINE.recordings)
        (low, high), (mean_low, mean_high) = reading.recordings[0].by_chance, reading.mean_by_chance
        assert 0.9 < low < mean_low < 1 < mean_high < high < 1.1

    def test_refuses_another_part_of_a_recording(self) -> None:
        sequences = SEQUENCES | {"a": {"recording": "a", "stop": 20}}
        with pytest.raises(BenchmarkError, match=r"recordings of the baseline; a.stop: not there, now 20"):
            compare_accuracy({"a": runs()}, sequences, BASELINE)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"frames": 30}, "a: frames: expected 90 as in the baseline, got 30"),
            ({"data_sha256": "x"}, "a: data_sha256: expected data as in the baseline, got x"),
            ({"network_sha256": "none"}, "a: network_sha256: expected network as in the baseline, got none"),
            ({"ates_m": ATES[:3]}, "a: expected 10 seeds as in the baseline, got 3"),
        ],
    )
    def test_refuses_something_else(self, change: dict[str, Any], message: str) -> None:
        with pytest.raises(BenchmarkError, match=message):
            compare({"a": replace(runs(), **change)})


class TestFile:
    def test_round_trip(self, tmp_path: Path) -> None:
        save_accuracy_baseline(tmp_path / "file.json", BASELINE)
        assert load_accuracy_baseline(tmp_path / "file.json") == BASELINE

    @pytest.mark.parametrize(
        ("recordings", "message"),
        [
            ({}, r"recordings: expected at least one, each in `sequences`, got \[\]"),
            ({"a": {"ates_m": [0.1]}}, "recordings: a: missing 'frames', 'tracked'"),
            ({"a": {**vars(runs()), "ates_m": [float("nan")]}}, r"a: ates_m\[0\]: expected a finite number > 0"),
            ({"a": {**vars(runs()), "ates_m": []}}, "a: ates_m: expected the error of at least one seed"),
        ],
    )
    def test_that_is_none(self, tmp_path: Path, recordings: dict[str, Any], message: str) -> None:
        (tmp_path / "file.json").write_text(json.dumps({**vars(BASELINE), "recordings": recordings}, default=vars))
        with pytest.raises(BenchmarkError, match=message):
            load_accuracy_baseline(tmp_path / "file.json")

    def test_that_is_missing(self, tmp_path: Path) -> None:
        with pytest.raises(BenchmarkError, match=r"nowhere\.json: expected a baseline, cannot be read"):
            load_accuracy_baseline(tmp_path / "nowhere.json")


class TestMeasured:
    def result(self, folder: Path, number: int, **changes: Any) -> dict[str, Any]:
        seed = changes.get("seed", number)
        place = folder / "a" / "default" / str(seed)
        place.mkdir(parents=True)
        (place / "trajectory.txt").write_text(f"{seed}")
        return {
            **{"sequence": "a", "label": "default", "seed": seed, "status": "done", "problem": None, "frames": 90},
            **{"tracked": 90, "ate_rmse_m": ATES[seed], "data_sha256": None, "networks_sha256": {"model": "n"}},
            **changes,
        }

    def test_of_results(self, tmp_path: Path) -> None:
        """By seed, in whatever order they ended."""
        found = measured([self.result(tmp_path, seed) for seed in (1, 0)], tmp_path)["a"]
        assert (found.frames, found.tracked, found.ates_m) == (90, 180, ATES[:2])
        assert (found.data_sha256, found.network_sha256) == ("", "n")
        assert found.tracked_percent == 100
        assert len(set(found.trajectories_sha256)) == 2

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"status": "failed", "problem": "killed"}, "a, seed 1: expected a run with an ATE, got none: killed"),
            ({"ate_rmse_m": None, "evaluation_problem": "no truth"}, "a, seed 1: .* got none: no truth"),
            ({"frames": 4}, "a: frames: expected the same in all runs, got 90 and 4"),
            ({"networks_sha256": {}}, "a: networks_sha256: expected the same in all runs"),
            ({"seed": 2}, r"a: expected the seeds 0 to 1 of one preset, got \[0, 2\]"),
        ],
    )
    def test_of_runs_that_do_not_fit(self, tmp_path: Path, changes: dict[str, Any], message: str) -> None:
        results = [self.result(tmp_path, 0), self.result(tmp_path, 1, **changes)]
        with pytest.raises(BenchmarkError, match=message):
            measured(results, tmp_path)


class TestCommand:
    """Results of a room that were made by hand; nothing is run."""

    def folder(self, place: Path, scale: float = 1.0) -> Path:
        """Two runs of the suite, and the suite itself beside them."""
        place.mkdir()
        (place / "two.yaml").write_text("runs: 2\nsequences: [{name: a, room: {frames: 90}}]\n")
        results = []
        for seed in range(2):
            run = done("a", "default", seed, frames=90, tracked=90, ate_rmse_m=scale * ATES[seed], data_sha256=None)
            results.append(run | {"vectors": "avx2", "versions": dict.fromkeys(VERSIONS, "1")})
            trajectory = place / "a" / "default" / str(seed) / "trajectory.txt"
            trajectory.parent.mkdir(parents=True)
            trajectory.write_text(f"{scale} {seed}")
        (place / "results.json").write_text(json.dumps(results))
        return place

    def command(self, folder: Path, *more: str) -> list[str]:
        suite = ["--suite", str(folder / "two.yaml"), "--baseline", str(folder.parent / "baseline.json")]
        return ["bench", "accuracy", "--results-from", str(folder), *suite, *more]

    def test_compares(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """The same bytes, then errors a tenth larger, which end with code 1 and say by how much."""
        before = self.folder(tmp_path / "before")
        main(self.command(before, "--update", "first"))
        assert load_accuracy_baseline(tmp_path / "baseline.json").commit == "abc"
        main(self.command(before))
        printed = capsys.readouterr().out
        assert "Geometric mean of the ratios over 1 recordings: 1.000" in printed
        assert "Verdict: nothing is worse." in printed
        assert "| a | 100.00 | 10.10 | 1.01 | 10.10 | 1.000 |" in (before / "accuracy.md").read_text()
        after = self.folder(tmp_path / "after", 1.1)
        with pytest.raises(SystemExit):
            main(self.command(after, "--json"))
        reading = json.loads(capsys.readouterr().out)
        assert reading["recordings"][0]["ratio"] == pytest.approx(1.1)
        assert reading["worse"]
        assert "less accurate than abc: geometric mean of the ratios 1.100" in fails(capsys, *self.command(after)[2:])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("--update", "why"), "--update: expected --baseline FILE to write to"),
            (("--update", " ", "--baseline", "x.json"), "--update: expected a reason"),
            (("--baseline", "nowhere.json"), "nowhere.json: expected a baseline, cannot be read"),
            (("--results-from", "nowhere"), "--results-from: expected a folder with results, got 'nowhere'"),
        ],
    )
    def test_wrong_options(self, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str) -> None:
        assert message in fails(capsys, *arguments)

    def test_baselines_that_come_with_jaxslam(self) -> None:
        """Each is of the suite's sequences as they are now, with as many seeds."""
        planned = fingerprint(plan(load_suite("accuracy")))
        files = sorted((configs_dir() / "benchmarks" / "baselines").glob("accuracy-*.json"))
        assert files
        for file in files:
            baseline = load_accuracy_baseline(file)
            assert baseline.sequences == planned["sequences"]
            for name, runs in baseline.recordings.items():
                assert len(runs.ates_m) == planned["sequences"][name].get("runs", planned["runs"])
