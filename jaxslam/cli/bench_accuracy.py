"""`jaxslam bench accuracy`: whether tracking has become less accurate than the frozen baseline."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.benchmark.machine_names import cpu_name, machine_of, versions_of
from jaxslam.benchmark.reports.markdown import table
from jaxslam.benchmark.suites.accuracy_ruler import (
    MAX_MEAN,
    MAX_RECORDING,
    Accuracy,
    AccuracyBaseline,
    Compared,
    compare_accuracy,
    load_accuracy_baseline,
    measured,
    save_accuracy_baseline,
)
from jaxslam.benchmark.suites.collected_results import read_results
from jaxslam.benchmark.suites.gate import check_reason
from jaxslam.benchmark.suites.plan import fingerprint
from jaxslam.cli.bench import RunsOfSuite
from jaxslam.cli.console import make_table, plain_console, print_json
from jaxslam.config.loading import configs_dir
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.runtime.compile_cache import usable_cores
from jaxslam.runtime.machine import machine

_SUITE, _REPORT = "accuracy", "accuracy.md"
_OUT = Path("results") / "bench" / _SUITE
_COLUMNS = ("recording", "tracked, %", "ATE, mm", "worst", "was, mm", "ratio", "by chance", "equal")
_MAX_WORKERS = 2

_Results = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class AccuracyRuler(RunsOfSuite):
    """Options of `jaxslam bench accuracy`."""

    baseline: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Baseline to compare with. If not given: of those that come with jaxslam, the one made on this CPU, or else the
    first."""
    suite: str = _SUITE
    """Suite to run; a file of your own adds recordings."""
    results_from: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder with finished results of the suite to read instead of running it, such as those of another commit."""
    update: str | None = None
    """Write what was measured to --baseline, for this reason, instead of comparing."""
    commit: str | None = None
    """Commit that was measured, for --update, where the results do not tell."""

    def main(self) -> None:
        """Run the command."""
        if self.update is not None:
            check_reason(self.update)
            if self.baseline is None:
                raise BenchmarkError("bench accuracy: --update: expected --baseline FILE to write to")
        file = self.baseline or _baseline_for(machine())
        baseline = None if self.update is not None else load_accuracy_baseline(file)
        sequences = fingerprint(self.plan(self.suite).jobs)["sequences"]
        results, out = self._measured()
        now = measured(results, out)
        if baseline is None:
            save_accuracy_baseline(file, self._made(results, sequences, now))
            plain_console.print(f"Baseline: {file}")
            if self.json:
                print_json(json.loads(file.read_text(encoding="utf-8")))
            return
        reading = compare_accuracy(now, sequences, baseline)
        _report(reading, baseline, _words(reading, baseline, results, file), out)
        if self.json:
            print_json(_figures(reading))
        if reading.worse:
            raise BenchmarkError(f"less accurate than {baseline.commit}: {'; '.join(reading.worse)}")

    def _measured(self) -> tuple[_Results, Path]:
        """Results of all runs, and the folder they are in."""
        if self.results_from is not None:
            results = read_results(self.results_from)
            if not results:
                raise BenchmarkError(f"--results-from: expected a folder with results, got '{self.results_from}'")
            return results, self.results_from
        out = self.out or _OUT
        workers = self.workers or min(_MAX_WORKERS, usable_cores())
        return replace(self, out=out, workers=workers if self.runs_here else None).results(self.suite), out

    def _made(self, results: _Results, sequences: Mapping[str, Any], now: Mapping[str, Any]) -> AccuracyBaseline:
        """What was measured, as a baseline."""
        commits = {self.commit or result["commit"] for result in results}
        if len(commits) != 1 or None in commits:
            raise BenchmarkError(f"--commit: expected the one commit measured, got {sorted(map(str, commits))}")
        labels = sorted({result["label"] for result in results})
        if len(labels) != 1:
            raise BenchmarkError(f"bench accuracy: expected runs of one preset, got {labels}")
        return AccuracyBaseline(
            commit=str(commits.pop()),
            reason=self.update or "",
            machine=machine_of(results),
            versions=versions_of(results),
            preset=labels[0],
            sequences={name: sequences[name] for name in now},
            recordings=now,
        )


def _baseline_for(here: Mapping[str, Any]) -> Path:
    """The baseline of this machine's CPU, or the first that comes with jaxslam."""
    files = sorted((configs_dir() / "benchmarks" / "baselines").glob(f"{_SUITE}-*.json"))
    if not files:
        raise BenchmarkError("bench accuracy: expected a baseline that comes with jaxslam, got none; give --baseline")
    return next((file for file in files if load_accuracy_baseline(file).machine.startswith(cpu_name(here))), files[0])


def _report(reading: Accuracy, baseline: AccuracyBaseline, words: Sequence[str], out: Path) -> None:
    """Print the reading, and write it beside the results."""
    cells = [_cells(row) for row in reading.recordings]
    title = f"Accuracy of {baseline.preset} against {baseline.commit}"
    shown = make_table(title, *_COLUMNS)
    for row in cells:
        shown.add_row(*row)
    plain_console.print(shown)
    for line in words:
        plain_console.print(line)
    text = "\n".join([table(_COLUMNS, cells), *(f"- {line}" for line in words), ""])
    write_atomically(out / _REPORT, text.encode(), BenchmarkError)
    plain_console.print(f"Report: {out / _REPORT}")


def _figures(reading: Accuracy) -> dict[str, Any]:
    """The reading, with the medians and ratios of its table."""
    rows = [
        {
            **asdict(row),
            "tracked_percent": row.now.tracked_percent,
            "median_m": row.now.median_m,
            "median_before_m": None if row.before is None else row.before.median_m,
            "ratio": row.ratio,
        }
        for row in reading.recordings
    ]
    return asdict(reading) | {"recordings": rows}


def _cells(row: Compared) -> list[str]:
    now, ratio = row.now, row.ratio
    return [
        row.name,
        f"{now.tracked_percent:.2f}",
        f"{1e3 * now.median_m:.2f}",
        f"{max(now.ates_m) / now.median_m:.2f}",
        "-" if row.before is None else f"{1e3 * row.before.median_m:.2f}",
        "new" if ratio is None else f"{ratio:.3f}",
        "-" if ratio is None else f"{row.by_chance[0]:.2f}-{row.by_chance[1]:.2f}",
        str(row.equal_runs),
    ]


def _words(reading: Accuracy, baseline: AccuracyBaseline, results: _Results, file: Path) -> list[str]:
    """The reading in sentences."""
    low, high = reading.mean_by_chance
    mean = "-" if reading.mean_ratio is None else f"{reading.mean_ratio:.3f}"
    number = sum(row.ratio is not None for row in reading.recordings)
    words = [
        f"Geometric mean of the ratios over {number} recordings: {mean} (by chance {low:.3f} - {high:.3f});"
        f" not worse up to {MAX_MEAN:g}, a recording up to {MAX_RECORDING:g}.",
        f"Baseline: {file.name}, {baseline.commit}, {baseline.machine}; {baseline.versions}. {baseline.reason}",
    ]
    here = machine_of(results), versions_of(results)
    if here != (baseline.machine, baseline.versions):
        words.append(
            f"Here: {here[0]}; {here[1]}. Other hardware or libraries round otherwise, which acts as other seeds do:"
            " what lies within the figures by chance is explained by that."
        )
    if reading.left_out:
        words.append(f"Not run, and without a say: {', '.join(reading.left_out)}.")
    return [*words, f"Verdict: {'; '.join(reading.worse) or 'nothing is worse'}."]
