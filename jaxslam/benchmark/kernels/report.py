"""Report on comparisons of kernels: a table in Markdown, a log-log plot, and slopes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.benchmark.kernels.case import Case
from jaxslam.benchmark.reports.document import Bullets, Heading, Paragraph, Table, to_markdown
from jaxslam.visualization.plots import png

COLUMNS = ("kernel", "size", "on", "ours, ms", "p95", "theirs, ms", "p95", "ratio", "difference", "compile, s")
_COLUMNS_OF_PLOTS, _WIDTH_IN, _HEIGHT_IN, _DPI = 3, 13.0, 3.4, 110
_ROOM_FOR_LEGEND = 0.35
_OURS = {"cpu": ("#0072b2", "o"), "other": ("#009e73", "^")}
_THEIRS = ("#d55e00", "s")
_HOW = (
    "Median and 95th percentile of calls in turn, ratio of the medians, ours over theirs; the time of compiling is that"
    " of the processor, or of loading where JAX keeps programs on disk. On the processor everything is held on one"
    " core, where the system allows it."
)

Rows = Sequence[Mapping[str, Any]]


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row of `measure` as texts below `COLUMNS`."""
    return [
        row["kernel"],
        row["label"],
        row["backend"],
        _figure(row["ours_ms"]),
        _figure(row["ours_p95_ms"]),
        _figure(row["theirs_ms"]),
        _figure(row["theirs_p95_ms"]),
        _figure(row["ratio"]),
        "-" if row["problem"] else _agreement(row),
        f"{row['compile_s']:.1f}",
    ]


def slopes(rows: Rows) -> dict[str, float]:
    """Powers of the size with which the times of a kernel grow, `ours` by backend, and `theirs`.

    A straight line through all sizes, both axes logarithmic; of one size there is none.
    """
    return {
        name: float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
        for name, (sizes, times) in _lines(rows).items()
        if len(sizes) > 1
    }


def about(case: Case, rows: Rows) -> str:
    """Say in one line what is compared, and add what the table does not say."""
    problem = next((f" ({row['problem']})" for row in rows if row["problem"]), "")
    return f"beside {case.reference}{problem}: {case.compared}; size: {case.axis}; difference: {case.difference}"


def markdown_report(cases: Sequence[Case], rows: Rows, machine: Mapping[str, Any]) -> str:
    """All rows in one table, what is compared, how the times grow, and on what they were taken."""
    of = {case.name: [row for row in rows if row["kernel"] == case.name] for case in cases}
    grown = [f"`{name}`: {_growth(slopes(rows))}" for name, rows in of.items() if slopes(rows)]
    return to_markdown(
        [
            Heading("Kernels beside other libraries", 1),
            Table([COLUMNS, *map(cells, rows)]),
            Bullets([f"`{case.name}` {about(case, of[case.name])}" for case in cases]),
            Paragraph("Growth with the size N:" if grown else ""),
            Bullets(grown),
            Paragraph(f"{_HOW} {_on_what(rows, machine)}"),
        ]
    )


def picture(cases: Sequence[Case], rows: Rows) -> bytes:
    """A PNG, one small plot a kernel: time over size, both axes logarithmic, the slope beside each name."""
    columns = min(_COLUMNS_OF_PLOTS, len(cases))
    lines = math.ceil(len(cases) / columns)
    figure = Figure(figsize=(_WIDTH_IN * columns / _COLUMNS_OF_PLOTS, _HEIGHT_IN * lines), layout="constrained")
    plots = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, case in zip(plots, cases, strict=False):
        _plot(axes, case, [row for row in rows if row["kernel"] == case.name])
    for axes in plots[len(cases) :]:
        axes.set_axis_off()
    figure.set_dpi(_DPI)
    return png(figure)


def _plot(axes: Axes, case: Case, rows: Rows) -> None:
    grown = slopes(rows)
    for name, (sizes, times) in _lines(rows).items():
        color, marker = _THEIRS if name == "theirs" else _OURS.get(name.removeprefix("ours "), _OURS["other"])
        whose = case.reference if name == "theirs" else name
        slope = f",  N^{grown[name]:.2f}" if name in grown else ""
        axes.loglog(sizes, times, marker=marker, color=color, label=whose + slope)
    axes.set(title=case.name, xlabel=case.axis, ylabel="ms")
    labels = {row["size"]: row["label"] for row in rows}
    axes.set_xticks(list(labels), list(labels.values()))
    axes.minorticks_off()
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** _ROOM_FOR_LEGEND)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper left")


def _lines(rows: Rows) -> dict[str, tuple[list[int], list[float]]]:
    """Sizes and medians of `ours BACKEND`, and of `theirs` as they were beside ours on the processor."""
    lines: dict[str, tuple[list[int], list[float]]] = {}
    for row in rows:
        sides = [(f"ours {row['backend']}", row["ours_ms"])]
        if row["backend"] == "cpu" and row["theirs_ms"] is not None:
            sides.append(("theirs", row["theirs_ms"]))
        for name, time_ms in sides:
            sizes, times = lines.setdefault(name, ([], []))
            sizes.append(row["size"])
            times.append(time_ms)
    return lines


def _growth(powers: Mapping[str, float]) -> str:
    return ", ".join(f"{name} N^{power:.2f}" for name, power in powers.items())


def _agreement(row: Mapping[str, Any]) -> str:
    if row["difference"] is None:
        return "one found nothing"
    return _figure(row["difference"]) + ("" if row["agrees"] else ", too much")


def _figure(value: float | None) -> str:
    """Three digits."""
    if value is None:
        return "-"
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _on_what(rows: Rows, machine: Mapping[str, Any]) -> str:
    accelerators = sorted({row["device"] for row in rows if row["backend"] != "cpu"})
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    return (
        f"Processor: {machine['cpu']}, {machine['cores']} cores, XLA with {machine['threads']} threads."
        + (f" Accelerator: {', '.join(accelerators)}." if accelerators else "")
        + f" Versions: {versions}. jaxslam: {machine['commit'] or machine['versions']['jaxslam']}."
    )
