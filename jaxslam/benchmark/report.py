"""What a suite has shown, as Markdown: a table a sequence, published figures beside ours."""

from collections.abc import Mapping, Sequence
from typing import Any

from jaxslam.benchmark.published import published_for, verdict
from jaxslam.benchmark.rows import rows_of
from jaxslam.benchmark.suite import Suite

COLUMNS = (
    "preset",
    "runs",
    "tracked, %",
    "ATE, m",
    "from - to",
    "ATE Sim(3), m",
    "RPE, m/s",
    "RPE, deg/s",
    "time / LK",
    "p95 / LK",
)


def published_table(suite: Suite, sequence: str, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """What has been published about a sequence, best first, and how each of our rows compares; headings first.

    Args:
        suite: What was run.
        sequence: Its name in the suite; of a part of a recording nothing has been published.
        rows: Those of `rows_of` that are of the sequence.

    Returns:
        Lines of as many texts; none if nothing has been published.
    """
    clip = next(clip for clip in suite.sequences if clip.name == sequence)
    figures = published_for(clip.recording) if clip.recording and clip.whole else []
    ours = [row for row in rows if row["ate_rmse_m"] is not None]
    lines = [["published ATE", "m", "aligned", *(f"{row['label']} is" for row in ours), "source", "note"]]
    for figure in figures:
        verdicts = [verdict(row["ate_rmse_m"]["least"], row["ate_rmse_m"]["most"], figure.value) for row in ours]
        stated = figure.alignment if figure.alignment_stated else f"{figure.alignment}, not stated"
        whose = figure.source if figure.reported_by is None else f"{figure.source} of {figure.reported_by}"
        lines.append([figure.system, f"{figure.value:g}", stated, *verdicts, whose, figure.note])
    return lines if figures else []


def markdown_report(suite: Suite, results: Sequence[Mapping[str, Any]], missing: Sequence[str]) -> str:
    """The report of a suite.

    Args:
        suite: What was run.
        results: Of every run, as `run_jobs` gives them.
        missing: Names of recordings that are not there.
    """
    rows = rows_of(results)
    parts = [f"# {suite.name}\n", f"{suite.about}\n" if suite.about else ""]
    for sequence in dict.fromkeys(row["sequence"] for row in rows):
        of_it = [row for row in rows if row["sequence"] == sequence]
        parts += [f"## {sequence}\n", table(COLUMNS, [cells(row) for row in of_it])]
        published = published_table(suite, sequence, of_it)
        if published:
            parts.append(table(published[0], published[1:]))
        parts += [
            f"- {row['label']}: {row['runs'] - row['done']} runs failed: {'; '.join(row['problems'])}\n"
            for row in of_it
            if row["done"] < row["runs"]
        ]
    if missing:
        parts.append("## Not run: recordings that are not on this machine\n")
        parts += [f"- {name}: `jaxslam data get {name}`\n" for name in missing]
    parts.append(how(results))
    return "\n".join(part for part in parts if part)


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "".join(f"| {' | '.join(line)} |\n" for line in (columns, ["---"] * len(columns), *rows))


def figure(spread: Mapping[str, float] | None, digits: int) -> str:
    """The median of a figure, `-` if no run has it."""
    return "-" if spread is None else f"{spread['median']:.{digits}f}"


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row of `rows_of` as texts below `COLUMNS`."""
    ate = row["ate_rmse_m"]
    return [
        row["label"],
        f"{row['done']} of {row['runs']}",
        figure(row["tracked_percent"], 1),
        figure(ate, 4),
        "-" if ate is None else f"{ate['least']:.4f} - {ate['most']:.4f}",
        figure(row["ate_sim3_rmse_m"], 4),
        figure(row["rpe_trans_m_per_s"], 4),
        figure(row["rpe_rot_deg_per_s"], 3),
        figure(row["flow_ratio_median"], 2),
        figure(row["flow_ratio_p95"], 2),
    ]


def how(results: Sequence[Mapping[str, Any]]) -> str:
    """On what the runs were made, and what the figures mean."""
    done = [result for result in results if result["status"] == "done"]
    if not done:
        return "No run was finished.\n"
    machines = sorted({f"{result['cpu']}, {result['cores']} cores" for result in done})
    commits = sorted({result["commit"] or result["versions"]["jaxslam"] for result in done})
    modes = sorted({_mode(result) for result in done})
    return (
        f"ATE: RMSE after SE(3) alignment of all frames, median and range of the runs; `better` than a published figure"
        f" if all of them are, `equal` if it lies within their range. RPE: over 1 s. LK: OpenCV's"
        f" optical flow of 1000 points in one thread, on the same machine. Runs: {'; '.join(modes)}."
        f" Machine: {'; '.join(machines)}. jaxslam: {', '.join(commits)}.\n"
    )


def _mode(result: Mapping[str, Any]) -> str:
    if result["realtime"]:
        return "at the rate of the recording, late frames dropped"
    return "deterministic, all frames" if result["deterministic"] else "all frames, each module in its thread"
