"""Print and write what `jaxslam bench accuracy` measured, beside its baseline."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jaxslam.benchmark.machine_names import cpu_name, machine_of, versions_of
from jaxslam.benchmark.reports.document import Bullets, Table, to_markdown
from jaxslam.benchmark.suites.accuracy_ruler import (
    MAX_MEAN,
    MAX_RECORDING,
    Accuracy,
    AccuracyBaseline,
    Compared,
    load_accuracy_baseline,
)
from jaxslam.cli.console import make_table, plain_console
from jaxslam.config.loading import configs_dir
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import write_atomically
from jaxslam.runtime.machine import machine

_REPORT = "accuracy.md"
_COLUMNS = ("recording", "tracked, %", "ATE, mm", "worst", "was, mm", "ratio", "by chance", "equal")


def default_baseline(suite: str) -> Path:
    """Return the baseline that was measured on this CPU, or else the first one that comes with jaxslam.

    Args:
        suite: Name of the suite, with which the names of its baselines begin.

    Raises:
        BenchmarkError: If no baseline of the suite comes with jaxslam, or one cannot be read.
    """
    files = sorted((configs_dir() / "benchmarks" / "baselines").glob(f"{suite}-*.json"))
    if not files:
        raise BenchmarkError("bench accuracy: expected a baseline that comes with jaxslam, got none; give --baseline")
    here = cpu_name(machine())
    return next((file for file in files if load_accuracy_baseline(file).machine.startswith(here)), files[0])


def print_and_write(
    reading: Accuracy, baseline: AccuracyBaseline, results: Sequence[Mapping[str, Any]], file: Path, out: Path
) -> None:
    """Print the comparison with the baseline, and write it beside the results.

    Args:
        reading: Comparison of the results with the baseline.
        baseline: Baseline that was compared with.
        results: Results of all runs.
        file: File of the baseline.
        out: Folder of the results.

    Raises:
        BenchmarkError: If the report cannot be written.
    """
    cells = [_cells(row) for row in reading.recordings]
    lines = _sentences(reading, baseline, results, file)
    title = f"Accuracy of {baseline.preset} against {baseline.commit}"
    plain_console.print(make_table(title, *_COLUMNS, rows=cells))
    for line in lines:
        plain_console.print(line)
    text = to_markdown([Table([_COLUMNS, *cells]), Bullets(lines)])
    write_atomically(out / _REPORT, text.encode(), BenchmarkError)
    plain_console.print(f"Report: {out / _REPORT}")


def figures(reading: Accuracy) -> dict[str, Any]:
    """Return the comparison for `--json`, with the medians and ratios of its table."""
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


def _sentences(
    reading: Accuracy, baseline: AccuracyBaseline, results: Sequence[Mapping[str, Any]], file: Path
) -> list[str]:
    """Say in sentences what the comparison found."""
    low, high = reading.mean_by_chance
    mean = "-" if reading.mean_ratio is None else f"{reading.mean_ratio:.3f}"
    number = sum(row.ratio is not None for row in reading.recordings)
    lines = [
        f"Geometric mean of the ratios over {number} recordings: {mean} (by chance {low:.3f} - {high:.3f});"
        f" not worse up to {MAX_MEAN:g}, a recording up to {MAX_RECORDING:g}.",
        f"Baseline: {file.name}, {baseline.commit}, {baseline.machine}; {baseline.versions}. {baseline.reason}",
    ]
    here = machine_of(results), versions_of(results)
    if here != (baseline.machine, baseline.versions):
        lines.append(
            f"Here: {here[0]}; {here[1]}. Other hardware or libraries round differently, which changes errors as other"
            " seeds do: this alone explains ratios within the range given as by chance."
        )
    if reading.left_out:
        lines.append(f"Not run, and not counted: {', '.join(reading.left_out)}.")
    return [*lines, f"Verdict: {'; '.join(reading.worse) or 'nothing is worse'}."]
