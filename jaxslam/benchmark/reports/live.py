"""Report on live runs of several programs in turn: figures, ratios, and a plot of each run."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from matplotlib.figure import Figure

from jaxslam.benchmark.reports.document import Heading, Paragraph, Table, to_markdown
from jaxslam.visualization.plots import png

COLUMNS = ("program", "median, ms", "p95, ms", "max, ms", "CPU, ms", "late", "tracked", "MB", "ATE, mm")
RATIO_COLUMNS = ("jaxslam against", "median", "p95", "CPU", "memory")
_RATIOS = ("median_ms", "p95_ms", "cpu_ms", "peak_mb")
_PANELS = (("median_ms", "median, ms"), ("p95_ms", "p95, ms"), ("cpu_ms", "processor time, ms"))
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
_SIZE_IN, _DPI = (8.0, 3.2), 120

Runs = Sequence[Mapping[str, Any]]


def by_program(runs: Runs) -> dict[str, list[Mapping[str, Any]]]:
    """Return the runs of each program, in the order of the rounds; jaxslam is the first program."""
    programs: dict[str, list[Mapping[str, Any]]] = {}
    for run in runs:
        programs.setdefault(run["program"], []).append(run)
    return programs


def rows(runs: Runs) -> list[list[str]]:
    """Return a row of texts below `COLUMNS` for each program: medians over its runs, with the range of some."""
    return [_row(program, own) for program, own in by_program(runs).items()]


def ratio_rows(runs: Runs) -> list[list[str]]:
    """Return a row below `RATIO_COLUMNS` for each other program: medians over rounds of the ratio within a round."""
    programs = by_program(runs)
    (_, own), *others = programs.items()
    return [[name, *(f"{ratio(own, theirs, field):.2f}" for field in _RATIOS)] for name, theirs in others]


def ratio(own: Runs, theirs: Runs, field: str) -> float:
    """Return the median of the ratios of a figure of two programs within each round that both have ended."""
    by_round = {run["round"]: run for run in theirs}
    return statistics.median(ours[field] / by_round[ours["round"]][field] for ours in own if ours["round"] in by_round)


def _row(program: str, runs: Runs) -> list[str]:
    values = {field: [run[field] for run in runs if run[field] is not None] for field in runs[0]}
    frames = runs[0]["frames"]
    median = lambda field, digits=1, scale=1.0: (
        f"{scale * statistics.median(values[field]):.{digits}f}" if values[field] else "-"
    )
    spread = lambda field: f"{median(field)} ({min(values[field]):.1f}-{max(values[field]):.1f})"
    return [
        program,
        spread("median_ms"),
        spread("p95_ms"),
        median("max_ms", 0),
        spread("cpu_ms"),
        median("late", 0),
        f"{min(values['tracked'])} of {frames}",
        median("peak_mb", 0),
        median("ate_m", 1, 1e3),
    ]


MEANING = (
    "All programs run in turn, each in a process of its own, with nothing else running. Images are loaded before the"
    " clock starts; each frame is given when it is due, or as soon as the one before is done. Median, 95th percentile"
    " and maximum of the wall time of a frame; processor time of the whole process for a frame, mapping beside"
    " included; frames that were due before the one before was done; fewest frames tracked in a round; peak memory with"
    " the loaded images. The table has medians over rounds, with the range; a ratio is the median of the ratios of the"
    " rounds."
)
"""What the figures of the tables are."""


def markdown_report(content: Mapping[str, Any]) -> str:
    """Return the content of `live.json` as tables, and how it was measured."""
    return f"{section(content, level=1)}\n{to_markdown([Paragraph(MEANING)])}"


def section(content: Mapping[str, Any], level: Literal[1, 2] = 2) -> str:
    """Return the tables of `live.json` under a heading, and where they were measured, without what they mean."""
    title = f"Live: {content['recording']}, {content['rate_hz']:g} Hz, {content['cpu']}"
    ratios = ratio_rows(content["runs"])
    tables = [Table([COLUMNS, *rows(content["runs"])]), *([Table([RATIO_COLUMNS, *ratios])] if ratios else [])]
    return to_markdown([Heading(title, level), *tables, Paragraph(conditions(content))])


def conditions(content: Mapping[str, Any]) -> str:
    """Say with which settings and on which machine the figures were measured."""
    settings = "".join(f", {setting}" for setting in content["settings"])
    return (
        f"Preset {content['preset']}{settings}; {content['rounds']} rounds."
        f" Processor: {content['cpu']} ({content['vectors']}), {content['cores']} cores."
        f" jaxslam: {content['commit'] or content['versions']['jaxslam']}."
    )


def picture(content: Mapping[str, Any]) -> bytes:
    """Draw median, p95 and processor time of each run, side by side for each program, as a PNG."""
    programs = by_program(content["runs"])
    figure = Figure(dpi=_DPI, figsize=_SIZE_IN, layout="constrained")
    for at, (field, label) in zip(figure.subplots(1, len(_PANELS)), _PANELS, strict=True):
        for number, (program, runs) in enumerate(programs.items()):
            color, values = _COLORS[number % len(_COLORS)], [run[field] for run in runs]
            at.bar(number, statistics.median(values), color=color, alpha=0.4, label=program)
            at.plot([number] * len(values), values, "o", color=color, markersize=4)
        at.set(title=label, xticks=[])
        at.set_ylim(bottom=0)
        at.grid(axis="y", alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(programs))
    figure.suptitle(f"{content['recording']}, {content['rate_hz']:g} Hz", fontsize=10)
    return png(figure)
