"""What a suite has shown, as Markdown; and the tables of which the HTML page is made too."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from jaxslam.benchmark.published import Figure, Verdict, load_published, published_for, verdict
from jaxslam.benchmark.rows import ACCURACY, RUNNING, Column, by_sequence, cell, columns_of, rows_of
from jaxslam.benchmark.suite import Suite

_INLINE = (
    " In deterministic runs mapping and the detector are done within the frame, which takes so much longer; with"
    " `--set run.deterministic=false` they have threads of their own."
)
VERDICTS: tuple[Verdict, ...] = ("better", "in range", "worse")


def markdown_report(suite: Suite, results: Sequence[Mapping[str, Any]], missing: Mapping[str, str]) -> str:
    """The report of a suite.

    Args:
        suite: What was run.
        results: Of every run, as `run_jobs` gives them.
        missing: Names of what was not run, with the reason.
    """
    rows = rows_of(results)
    parts = [f"# {suite.name}\n", f"{suite.about}\n" if suite.about else ""]
    parts.append(_markdown(overview_table(suite, rows)))
    parts += [f"- {line}\n" for line in (*summary_lines(suite, rows), *without_network(results))]
    for sequence, of_it in by_sequence(rows).items():
        parts.append(f"## {sequence}\n")
        tables = (figure_table(of_it, ACCURACY), figure_table(of_it, RUNNING), published_table(suite, sequence, of_it))
        parts += [_markdown(found) for found in tables]
        parts += [f"- {line}\n" for line in failures(of_it)]
    if missing:
        parts.append("## Not run\n")
        parts += [f"- {name}: {why}\n" for name, why in missing.items()]
    known = protocols(suite, rows)
    if known:
        parts += ["## How published figures came about\n", *(f"- {line}\n" for line in known)]
    parts.append(how(results))
    return "\n".join(part for part in parts if part)


def overview_table(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Median ATE of every label on every sequence beside the best published one; headings first."""
    labels = list(dict.fromkeys(row["label"] for row in rows))
    lines = [["ATE, m", *labels, "best published", "of"]]
    for sequence, of_it in by_sequence(rows).items():
        medians = {row["label"]: row["ate_rmse_m"] for row in of_it}
        ours = ["-" if (spread := medians.get(label)) is None else f"{spread['median']:.4f}" for label in labels]
        best = published_of(suite, sequence)[:1]
        lines.append([sequence, *ours, *((f"{best[0].value:g}", best[0].system) if best else ("-", "-"))])
    return lines if rows else []


def summary_lines(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """How each label stands against what has been published, wins and losses."""
    lines = []
    for label in dict.fromkeys(row["label"] for row in rows):
        of_it = [row for row in rows if row["label"] == label and row["ate_rmse_m"] is not None]
        against = [(row, published_of(suite, row["sequence"])) for row in of_it]
        best = Counter(_verdict(row, figures[0]) for row, figures in against if figures)
        every = Counter(_verdict(row, figure) for row, figures in against for figure in figures)
        if every:
            lines.append(f"{label}: against the best published figures {_counts(best)}; against all {_counts(every)}")
    return lines


def without_network(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Runs that had to do without the network of their settings, a line a network."""
    lacking: dict[str, list[str]] = {}
    for result in results:
        if result["status"] == "done" and ("model", None) in result["networks_sha256"].items():
            lacking.setdefault(result["model"], []).append(result["label"])
    return [
        f"{', '.join(dict.fromkeys(labels))}: without a network, because {model} was not on the machine; depth alone"
        f" decided. To get it: jaxslam models get {model}"
        for model, labels in lacking.items()
    ]


def figure_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> list[list[str]]:
    """Figures of the rows of one sequence, those that there are; headings first."""
    shown = columns_of(rows, columns)
    lines = [["preset", "runs", *(column.heading for column in shown)]]
    return lines + [
        [row["label"], f"{row['done']} of {row['runs']}", *(cell(row, column) for column in shown)] for row in rows
    ]


def published_table(suite: Suite, sequence: str, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """What has been published about a sequence, best first, and how each of our rows compares; headings first.

    Args:
        suite: What was run.
        sequence: Its name in the suite; of a part of a recording nothing has been published.
        rows: Those of `rows_of` that are of the sequence.

    Returns:
        Lines of as many texts; none if nothing has been published.
    """
    figures, ours = published_of(suite, sequence), [row for row in rows if row["ate_rmse_m"] is not None]
    lines = [["published ATE", "m", *(f"{row['label']} is" for row in ours), "aligned", "source", "note"]]
    for figure in figures:
        name = figure.system if figure.variant is None else f"{figure.system}, {figure.variant}"
        stated = figure.alignment if figure.alignment_stated else f"{figure.alignment}, not stated"
        whose = figure.source if figure.reported_by is None else f"{figure.source} of {figure.reported_by}"
        verdicts = (_verdict(row, figure) for row in ours)
        lines.append([name, f"{figure.value:g}", *verdicts, stated, whose, figure.note])
    return lines if figures else []


def published_of(suite: Suite, sequence: str) -> list[Figure]:
    """Published ATE of a sequence of a suite, best first; of a part of a recording there is none."""
    clip = next(clip for clip in suite.sequences if clip.name == sequence)
    return published_for(clip.recording, variants=suite.ablation) if clip.recording and clip.whole else []


def protocols(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of every paper whose figures stand beside ours: which frames, and what was taken of how many runs."""
    figures = [figure for sequence in by_sequence(rows) for figure in published_of(suite, sequence)]
    names = {name for figure in figures for name in (figure.reported_by or figure.system).split(", ")}
    return [
        f"{paper.name} ({paper.authors}; {paper.venue}{'' if paper.year is None else f', {paper.year}'}):"
        f" {paper.protocol} {paper.link or ''}".rstrip()
        for paper in load_published()
        if paper.name in names
    ]


def failures(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Runs that failed, a line a row."""
    for row in rows:
        if row["done"] < row["runs"]:
            yield f"{row['label']}: {row['runs'] - row['done']} runs failed: {'; '.join(row['problems'])}"


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "".join(f"| {' | '.join(line)} |\n" for line in (columns, ["---"] * len(columns), *rows))


def how(results: Sequence[Mapping[str, Any]]) -> str:
    """On what the runs were made, and what the figures mean."""
    done = [result for result in results if result["status"] == "done"]
    if not done:
        return "No run was finished.\n"
    machines = sorted({f"{result['cpu']}, {result['cores']} cores" for result in done})
    commits = sorted({result["commit"] or result["versions"]["jaxslam"] for result in done})
    modes = sorted({_mode(result) for result in done})
    return (
        f"Figures are medians of the runs. ATE: RMSE after SE(3) alignment of all frames; `better` than a published"
        f" figure if all runs are, `in range` if it lies between them, however far apart they are. RPE: over 1 s."
        f" First loss: the earliest of the runs; memory: the most. LK: OpenCV's optical flow of 1000 points in one"
        f" thread, on the same machine."
        f"{_INLINE if any(result['deterministic'] for result in done) else ''}"
        f" Runs: {'; '.join(modes)}. Machine: {'; '.join(machines)}. jaxslam: {', '.join(commits)}.\n"
    )


def _markdown(lines: Sequence[Sequence[str]]) -> str:
    return table(lines[0], lines[1:]) if lines else ""


def _verdict(row: Mapping[str, Any], figure: Figure) -> Verdict:
    return verdict(row["ate_rmse_m"]["least"], row["ate_rmse_m"]["most"], figure.value)


def _counts(verdicts: Mapping[str, int]) -> str:
    return ", ".join(f"{verdicts.get(name, 0)} {name}" for name in VERDICTS)


def _mode(result: Mapping[str, Any]) -> str:
    if result["realtime"]:
        return "at the rate of the recording, late frames dropped"
    return "deterministic, all frames" if result["deterministic"] else "all frames, each module in its thread"
