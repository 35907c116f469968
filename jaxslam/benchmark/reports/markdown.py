"""Reports of suites: tables of errors and times beside published figures, and warnings about them."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from jaxslam.benchmark.reports.document import Block, Bullets, Heading, Image, Paragraph, Table, to_markdown
from jaxslam.benchmark.reports.published_tables import comparison_table, protocols, published_tables, rank_table
from jaxslam.benchmark.suites.aggregate import (
    ACCURACY,
    RUNNING,
    Column,
    by_sequence,
    cell,
    columns_of,
    rows_of,
    with_shown_labels,
)
from jaxslam.benchmark.suites.protocol import PaperTable, Protocol
from jaxslam.benchmark.suites.published_comparison import (
    VERDICTS,
    best_of_systems,
    clip_of,
    counted,
    kitti_means,
    length_is_known,
    published_of,
    reservations,
)
from jaxslam.benchmark.suites.suite import Suite

_INLINE = (
    " In deterministic runs mapping and the detector are done within the frame, which takes so much longer; with"
    " `--set run.deterministic=false` they have threads of their own."
)
_MARK = "*"
"""Behind an error that may not be compared with published ones."""


def markdown_report(suite: Suite, results: Sequence[Mapping[str, Any]], missing: Mapping[str, str]) -> str:
    """Render the report of a suite as Markdown.

    Args:
        suite: Suite that was run.
        results: Results of all planned runs, from `Collected.every`.
        missing: Reasons why sequences were not run, by name.
    """
    return to_markdown(suite_report(suite, with_shown_labels(results), missing))


def suite_report(
    suite: Suite,
    results: Sequence[Mapping[str, Any]],
    missing: Mapping[str, str],
    images: Mapping[str, Sequence[Image]] | None = None,
) -> Iterator[Block]:
    """Make the report of a suite, block by block.

    Args:
        suite: Suite that was run.
        results: Results of all planned runs, from `with_shown_labels`.
        missing: Reasons why sequences were not run, by name.
        images: Images of each sequence by its name, and images of the whole suite under an empty name.
    """
    rows, images = rows_of(results), images or {}
    yield Heading(suite.name, 1)
    yield Paragraph(suite.about)
    yield Table(overview_table(suite, rows), "overview")
    yield Table(comparison_table(suite, rows), "comparison")
    if suite.protocol is not None:
        yield Heading("Table of the paper")
        yield Paragraph(suite.protocol.about)
        yield Table(protocol_table(suite.protocol, rows), "protocol")
        for number, table in enumerate(suite.protocol.tables, 1):
            yield Table(paper_table(suite.protocol, table, rows), f"paper-{number}")
    yield Bullets(summary_lines(suite, rows))
    yield Table(rank_table(suite, rows), "ranks")
    yield Bullets(warnings(suite, results), is_warning=True)
    yield Table(kitti_means(suite, rows), "kitti_means")
    yield from images.get("", ())
    for sequence, of_it in by_sequence(rows).items():
        yield Heading(sequence)
        yield Table(figure_table(of_it, ACCURACY), f"{sequence}-accuracy")
        yield Table(figure_table(of_it, RUNNING), f"{sequence}-running")
        for figure, lines in published_tables(suite, sequence, of_it).items():
            yield Table(lines, f"{sequence}-published-{figure}")
        yield Bullets(list(failures(of_it)), is_warning=True)
        yield from images.get(sequence, ())
    if missing:
        yield Heading("Not run")
        yield Bullets([f"{name}: {why}" for name, why in missing.items()])
    if known := protocols(suite, rows):
        yield Heading("How published figures came about")
        yield Bullets(known)
    yield Paragraph(how(results))


def overview_table(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Median ATE of every label on every sequence beside the best published one; headings first.

    Frames, and the least shares tracked and poses matched, are those of all runs of the sequence.
    """
    labels = list(dict.fromkeys(row["label"] for row in rows))
    lines = [["ATE, m", *labels, "best published", "of", "frames", "tracked, %", "matched poses", "runs done"]]
    for sequence, of_it in by_sequence(rows).items():
        by_label = {row["label"]: row for row in of_it}
        ours = [_ate(suite, by_label[label]) if label in by_label else "-" for label in labels]
        best = best_of_systems(published_of(suite, sequence))[:1]
        theirs = (f"{best[0].value:g}", best[0].system) if best else ("-", "-")
        runs = f"{sum(row['done'] for row in of_it)} of {sum(row['runs'] for row in of_it)}"
        least = (_least(of_it, "frames", 0), _least(of_it, "tracked_percent", 1), _least(of_it, "num_matched", 0))
        lines.append([sequence, *ours, *theirs, *least, runs])
    return lines if rows else []


def protocol_table(protocol: Protocol, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Figures of all rows as a protocol takes them, and their means over the sequences; headings first.

    A mean is there for what every sequence of a label has.
    """
    columns = protocol.shown()
    lines = [["sequence", "preset", "runs", *(column.heading for column in columns)]]
    for row in rows:
        runs = f"{row['done']} of {row['runs']}"
        lines.append([row["sequence"], row["label"], runs, *(cell(row, column) for column in columns)])
    of_label: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        of_label.setdefault(row["label"], []).append(row)
    for label, group in of_label.items():
        if len(group) > 1:
            lines.append(["mean of the sequences", label, "", *(_mean_cell(group, column) for column in columns)])
    return lines if rows else []


def paper_table(protocol: Protocol, table: PaperTable, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Figures of a paper above those of all rows, as a protocol takes them; headings first.

    Times of the paper are of its machine.
    """
    columns = protocol.shown(table.columns)
    lines = [[table.title, "of", *(column.heading for column in columns)]]
    lines += [[system, f"paper of {table.paper}", *figures] for system, figures in table.published_rows().items()]
    ours = [[row["label"], row["sequence"], *(cell(row, column) for column in columns)] for row in rows]
    return lines + ours if ours else []


def _mean_cell(rows: Sequence[Mapping[str, Any]], column: Column) -> str:
    values = [(row[column.figure] or {}).get(column.which) for row in rows]
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.{column.digits}f}" if len(known) == len(values) else "-"


def summary_lines(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Compare each label with published figures: wins and losses."""
    lines = []
    for label in dict.fromkeys(row["label"] for row in rows):
        best, every = counted(suite, [row for row in rows if row["label"] == label])
        if every:
            lines.append(
                f"{label}: against the best published figures {_counts(best)}; against all systems {_counts(every)}"
            )
    return lines


def warnings(suite: Suite, results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Everything to know before the figures are believed, a line each."""
    rows = rows_of(results)
    return [
        *progress_lines(results),
        *reservation_lines(suite, rows),
        *unevaluated_lines(rows),
        *note_lines(rows),
        *without_network(results),
        *mixture_lines(results),
    ]


def progress_lines(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Count the planned runs that are done, unless all are."""
    statuses = Counter(result["status"] for result in results)
    if statuses["done"] == len(results):
        return []
    failed = f", {statuses['failed']} failed" if statuses["failed"] else ""
    left = f", {statuses['not run']} not made yet: --resume goes on with them" if statuses["not run"] else ""
    return [f"{statuses['done']} of {len(results)} planned runs are done{failed}{left}"]


def reservation_lines(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why rows with published figures get no verdict, or what is not known about it."""
    of_rows = [(row, reservations(suite, row)) for row in rows if published_of(suite, row["sequence"])]
    reasons = [(row, ["; ".join(found)]) for row, found in of_rows if found]
    lines = [f"no verdict for {of_it}: {reason}" for reason, of_it in _grouped(reasons)]
    judged = [row for row, found in of_rows if not found and row["ate_rmse_m"] is not None]
    unknown = [row["sequence"] for row in judged if not _length_known(suite, row)]
    if unknown:
        names = ", ".join(dict.fromkeys(unknown))
        lines.append(f"{names}: the published length is not known; whether all of it was run is judged by ground truth")
    return lines


def unevaluated_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why runs that are done have no ATE, a line a reason."""
    of_rows = [(row, row["unevaluated"]) for row in rows]
    return [f"no ATE of {of_it}: {reason}" for reason, of_it in _grouped(of_rows, _part_of_runs)]


def note_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Reservations of the evaluations about their figures, each once, with what it holds for."""
    return [f"note on {of_it}: {note}" for note, of_it in _grouped([(row, row["notes"]) for row in rows])]


def mixture_lines(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """List what differs between runs of several calls: jaxslam, the data of a sequence, or the networks of a label."""
    done = [result for result in results if result["status"] == "done"]
    lines = []
    if len({result.get("sources_sha256") for result in done}) > 1:
        lines.append("runs of several versions of jaxslam stand beside each other: " + "; ".join(_versions(done)))
    for sequence, of_it in by_sequence(done).items():
        if len({result.get("data_sha256") for result in of_it}) > 1:
            lines.append(f"{sequence}: its runs are of different recordings")
    for label in dict.fromkeys(result["label"] for result in done):
        networks = [result["networks_sha256"] for result in done if result["label"] == label]
        if any(of_run != networks[0] for of_run in networks):
            lines.append(f"{label}: its runs are of different networks")
    return lines


def without_network(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Runs in which no network looked at frames, a line a reason."""
    lacking: dict[str, list[str]] = {}
    for result in results:
        if result["status"] == "done" and (why := result.get("without_network")) is not None:
            lacking.setdefault(why, []).append(result["label"])
    return [f"{', '.join(dict.fromkeys(labels))}: without a network ({why})" for why, labels in lacking.items()]


def figure_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> list[list[str]]:
    """Figures of the rows of one sequence, those that there are; headings first."""
    shown = columns_of(rows, columns)
    lines = [["preset", "runs", *(column.heading for column in shown)]]
    return lines + [
        [row["label"], f"{row['done']} of {row['runs']}", *(cell(row, column) for column in shown)] for row in rows
    ]


def failures(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Runs that failed, a line a row."""
    for row in rows:
        if row["failed"]:
            yield f"{row['label']}: {row['failed']} runs failed: {'; '.join(row['problems'])}"


def how(results: Sequence[Mapping[str, Any]]) -> str:
    """On what the runs were made, and what the figures mean."""
    done = [result for result in results if result["status"] == "done"]
    if not done:
        return "No run was finished."
    machines = sorted({f"{result['cpu']}, {result['cores']} cores" for result in done})
    modes = sorted({_mode(result) for result in done})
    return (
        f"Figures are medians of the runs, those of frames, tracked and matched poses the least of them. ATE: RMSE over"
        f" the poses matched with ground truth, after SE(3) alignment; `{_MARK}` behind it: not of all planned runs, or"
        f" not of the whole recording. `better` than a published figure if all runs are, `in range` if it lies between"
        f" them, however far apart they are; no verdict without all planned runs, the whole recording, and 95 % of its"
        f" frames tracked. A system of several figures counts once, with its best. RPE: over 1 s."
        f" First loss: the earliest of the runs; memory: the most. Wall and processor time: of the whole process of a"
        f" run, from its start to its trajectory, with loading and compiling. LK: OpenCV's optical flow of 1000 points"
        f" in one thread, on the same machine."
        f"{_INLINE if any(result['deterministic'] for result in done) else ''}"
        f" Runs: {'; '.join(modes)}. Machine: {'; '.join(machines)}. jaxslam: {', '.join(_versions(done))}."
    )


def _counts(verdicts: Mapping[str, int]) -> str:
    found = [f"{verdicts.get(name, 0)} {name}" for name in VERDICTS]
    without = sum(verdicts.values()) - sum(verdicts.get(name, 0) for name in VERDICTS)
    return ", ".join([*found, f"{without} without a verdict"] if without else found)


def _ate(suite: Suite, row: Mapping[str, Any]) -> str:
    if row["ate_rmse_m"] is None:
        return "-"
    return f"{row['ate_rmse_m']['median']:.4f}" + (_MARK if reservations(suite, row) else "")


def _least(rows: Sequence[Mapping[str, Any]], figure: str, digits: int) -> str:
    found = [row[figure]["least"] for row in rows if row[figure] is not None]
    return f"{min(found):.{digits}f}" if found else "-"


def _length_known(suite: Suite, row: Mapping[str, Any]) -> bool:
    clip = clip_of(suite, row["sequence"])
    return clip is None or length_is_known(clip.recording)


def _grouped(
    of_rows: Sequence[tuple[Mapping[str, Any], Iterable[str]]],
    about: Callable[[Mapping[str, Any], str], str] = lambda row, text: row["label"],
) -> list[tuple[str, str]]:
    """Each text once, with the sequences and labels it is said of: `crowd (static, default); crowd2 (static)`."""
    groups: dict[str, dict[str, list[str]]] = {}
    for row, texts in of_rows:
        for text in texts:
            groups.setdefault(text, {}).setdefault(row["sequence"], []).append(about(row, text))
    return [
        (text, "; ".join(f"{sequence} ({', '.join(labels)})" for sequence, labels in of_it.items()))
        for text, of_it in groups.items()
    ]


def _part_of_runs(row: Mapping[str, Any], reason: str) -> str:
    return f"{row['label']}, {row['unevaluated'][reason]} of {row['done']} runs"


def _versions(done: Sequence[Mapping[str, Any]]) -> list[str]:
    return sorted({result["commit"] or result["versions"]["jaxslam"] for result in done})


def _mode(result: Mapping[str, Any]) -> str:
    if result["deterministic"] is None:
        return "another system, as it is"
    if result["realtime"]:
        return "at the rate of the recording, late frames dropped"
    return "deterministic, all frames" if result["deterministic"] else "all frames, each module in its thread"
