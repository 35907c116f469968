"""Work of `jaxslam compare`: run the presets, collect their figures, and print and write the tables."""

import json
import statistics
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxslam.benchmark.reports.document import Bullets, Table, to_markdown
from jaxslam.benchmark.suites.aggregate import shown_label
from jaxslam.cli.console import console, make_table, plain_console
from jaxslam.cli.tracking_run import number, track
from jaxslam.datasets import imu_sheet
from jaxslam.io.atomic_files import write_atomically
from jaxslam.semantics.from_config import network_files, preset_needs_network
from jaxslam.slam.slam import Slam

if TYPE_CHECKING:
    from jaxslam.cli.compare import Compare
    from jaxslam.datasets import Dataset

_COLUMNS = (
    *("preset", "tracked", "dropped", "matched poses", "ATE, m", "from - to", "ATE Sim(3), m"),
    *("RPE, m/s", "RPE, deg/s", "mean ms", "median ms", "p95 ms"),
)
_ERRORS = ("preset", "ATE, m", "from - to", "ATE Sim(3), m", "RPE, m/s", "RPE, deg/s")
_COVERAGE_AND_TIMES = tuple(column for column in _COLUMNS if column not in _ERRORS[1:])


def check_networks(options: "Compare", chosen: tuple[str, ...]) -> None:
    """Check that this machine has the networks of all presets: an error now, not after other presets.

    Args:
        options: Options of the command.
        chosen: Names of the presets to compare.

    Raises:
        ModelError: If a network is missing and a run without it is not allowed.
    """
    for preset in chosen:
        network_files(options.settings(preset).semantics)


def compare_presets(options: "Compare", chosen: tuple[str, ...], dataset: "Dataset", out: Path) -> list[dict[str, Any]]:
    """Track a recording with several presets, and return one row of figures for each.

    Args:
        options: Options of the command: the number of runs of each preset, and the settings of all runs.
        chosen: Names of the presets.
        dataset: Recording to track.
        out: Folder for the results; those of a run are written to `PRESET/SEED` below it.
    """
    rows: list[dict[str, Any]] = []
    for preset in chosen:
        summaries = []
        for seed in range(options.runs):
            console.print(f"{preset}, run {seed + 1} of {options.runs}")
            slam = Slam(dataset.camera, options.settings(preset, f"run.seed={seed}"), imu=imu_sheet(dataset))
            folder = out / preset / str(seed)
            summaries.append(track(dataset, slam, preset, folder, quiet=True))
        rows.append(figures(preset, summaries))
    return rows


def write_tables(rows: list[dict[str, Any]], out: Path) -> None:
    """Write `comparison.json` and `comparison.md`, and print where they are.

    Args:
        rows: Figures of each preset, from `figures`.
        out: Existing folder for the files; files of the same names are replaced.
    """
    lines = [line for row in rows for line in remarks(row)]
    write_atomically(out / "comparison.json", (json.dumps(rows, indent=2) + "\n").encode())
    text = to_markdown([Table([_COLUMNS, *map(_cells, rows)]), Bullets(lines)])
    write_atomically(out / "comparison.md", text.encode())
    console.print(f"Table in {out}: comparison.md, comparison.json; results of each run in {out}/PRESET/SEED")


def figures(preset: str, summaries: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of a preset over its runs; those of accuracy over the runs that could be evaluated."""
    ates = [summary["ate_rmse_m"] for summary in summaries if summary["ate_rmse_m"] is not None]
    problems = [summary["evaluation_problem"] for summary in summaries if summary["ate_rmse_m"] is None]
    evaluations = [summary["evaluation"] for summary in summaries if summary["evaluation"] is not None]
    without = next(
        (summary["without_network"] for summary in summaries if summary["without_network"] is not None), None
    )
    known = lambda name: [evaluation[name] for evaluation in evaluations if evaluation[name] is not None]
    similar = [summary["ate_sim3_rmse_m"] for summary in summaries if summary["ate_sim3_rmse_m"] is not None]
    times = [summary["track_ms"] for summary in summaries if summary["track_ms"] is not None]
    middle = lambda values: statistics.median(values) if values else None
    return {
        "preset": preset,
        "without_network": without,
        "lacks_network": without is not None and preset_needs_network(preset),
        "runs": len(summaries),
        "tracked_percent": min(summary["tracked_percent"] for summary in summaries),
        "dropped_percent": max(summary["dropped_percent"] for summary in summaries),
        "ate_rmse_m": middle(ates),
        "ate_rmse_m_of_runs": ates,
        "ate_sim3_rmse_m": middle(similar),
        **{name: middle(known(name)) for name in ("rpe_trans_m_per_s", "rpe_rot_deg_per_s")},
        "num_matched": min((evaluation["num_matched"] for evaluation in evaluations), default=None),
        "evaluation_problems": problems,
        "notes": list(dict.fromkeys(note for evaluation in evaluations for note in evaluation["notes"])),
        **{f"track_ms_{name}": middle([time[name] for time in times]) for name in ("mean", "median", "p95")},
    }


def _cells(row: dict[str, Any]) -> list[str]:
    ates = row["ate_rmse_m_of_runs"]
    return [
        shown_label(row["preset"], lacks_network=row["lacks_network"]),
        f"{row['tracked_percent']:.1f} %",
        f"{row['dropped_percent']:.1f} %",
        number(row["num_matched"], 0),
        number(row["ate_rmse_m"], 4),
        f"{min(ates):.4f} - {max(ates):.4f}" if ates else "-",
        number(row["ate_sim3_rmse_m"], 4),
        number(row["rpe_trans_m_per_s"], 4),
        number(row["rpe_rot_deg_per_s"], 3),
        *(number(row[f"track_ms_{name}"], 1) for name in ("mean", "median", "p95")),
    ]


def remarks(row: dict[str, Any]) -> list[str]:
    """Why a preset ran without a network, why runs have no ATE, and what the evaluations say about their figures."""
    missing = Counter(row["evaluation_problems"])
    why = row["without_network"]
    lines = [] if why is None else [f"{row['preset']}: without a network ({why})"]
    lines += [f"{row['preset']}: no ATE of {count} runs: {problem}" for problem, count in missing.items()]
    return lines + [f"{row['preset']}: note: {note}" for note in row["notes"]]


def print_tables(title: str, rows: list[dict[str, Any]]) -> None:
    """Print two tables, since one with all columns would not fit 80 columns, and what there is to say about them."""
    for name, columns in ((title, _ERRORS), ("", _COVERAGE_AND_TIMES)):
        table = make_table(name, *columns, wrap_first=True)
        for row in rows:
            cells = dict(zip(_COLUMNS, _cells(row), strict=True))
            table.add_row(*(cells[column] for column in columns))
        console.print(table)
    for row in rows:
        for line in remarks(row):
            plain_console.print(line)
