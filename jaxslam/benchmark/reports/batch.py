"""Report on tracking many clips at once: a table in Markdown, and throughput over the number of clips."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxslam.benchmark.reports.document import Heading, Paragraph, Table, to_markdown
from jaxslam.visualization.plots import png

COLUMNS = (
    "clips",
    "how",
    "frames/s",
    "cores",
    "a core",
    "loop",
    "/ loop",
    "compile",
    "MB",
    "ATE, m",
    "worst, m",
    "off, m",
)
_SIZE_IN, _DPI = (6.4, 4.8), 160
_LOOP_COLOR, _IDEAL_COLOR = "#d55e00", "0.6"
_COLORS = ("#0072b2", "#009e73")

Rows = Sequence[Mapping[str, Any]]


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row of `batch.measure` as texts below `COLUMNS`."""
    memory = row["peak_rss_mb"] if row["peak_device_mb"] is None else row["peak_device_mb"]
    return [
        str(row["clips"]),
        row["way"],
        f"{row['frames_per_s']:.0f}",
        f"{row['cores']:.2f}",
        f"{row['frames_per_s_per_core']:.0f}",
        f"{row['loop_frames_per_s']:.0f}",
        f"{row['ratio_to_loop']:.2f}",
        f"{row['compile_s']:.1f}",
        f"{memory:.0f}",
        f"{row['ate_rmse_m']:.5f}",
        f"{max(row['ate_rmse_m_of_clips']):.5f}",
        f"{row['off_alone_m']:.1e}" + ("" if row["same_statuses"] else ", other statuses"),
    ]


def markdown_report(content: Mapping[str, Any]) -> str:
    """Return the content of `batch.json` as a table, and how it was measured."""
    width, height = content["size"]
    title = f"Many clips at once: {content['frames']} frames of {width} x {height} each"
    table = Table([COLUMNS, *map(cells, content["rows"])])
    return to_markdown([Heading(title, 1), table, Paragraph(how(content))])


def how(content: Mapping[str, Any]) -> str:
    """Say what the figures mean, and on which machine they were measured."""
    repeated = max(row["clips"] for row in content["rows"]) > content["different"]
    on_device = any(row["peak_device_mb"] is not None for row in content["rows"])
    memory = "of the accelerator" if on_device else "of the process"
    return (
        f"{content['different']} rendered rooms, different in motion, textures and people"
        + ("; of more clips some are the same. " if repeated else ". ")
        + "Frames/s of all clips together, median of rounds in turn with the loop: the compiled step clip by clip,"
        " frame by frame. Cores: processor time over wall time. Compile: seconds of the first call, of one frame; a"
        f" program made before is only called. MB: the most memory {memory} so far, compiling included. ATE: RMSE after"
        " SE(3) alignment, median of the rooms, and the worst. Off: farthest position from that of the clip tracked"
        f" alone. Rounds: {content['rounds']}. Device: {content['device']}."
        f" Processor: {content['cpu']}, {content['cores']} cores, XLA with {content['threads']} threads."
        f" jaxslam: {content['commit'] or content['versions']['jaxslam']}."
    )


def picture(content: Mapping[str, Any]) -> bytes:
    """A PNG: frames a second over clips, both axes logarithmic, with the loop and what would be ideal."""
    rows = content["rows"]
    figure = Figure(dpi=_DPI, figsize=_SIZE_IN, layout="constrained")
    axes = figure.subplots()
    for threads, color in zip(sorted({row["threads"] for row in rows}), _COLORS, strict=False):
        of_it = [row for row in rows if row["threads"] == threads]
        label = "one program" if threads == 1 else f"a few clips in each of {threads} threads"
        axes.loglog(*_line(of_it, "frames_per_s"), marker="o", color=color, label=label)
    one = [row for row in rows if row["threads"] == 1]
    axes.loglog(*_line(one, "loop_frames_per_s"), marker="s", color=_LOOP_COLOR, label="loop, clip by clip")
    counts = np.array([row["clips"] for row in one])
    ideal = one[0]["frames_per_s"] * counts / counts[0]
    axes.loglog(counts, ideal, "--", color=_IDEAL_COLOR, label="ideal: each further clip for nothing")
    axes.set(xlabel="clips at once", ylabel="frames a second", title=content["device"])
    axes.set_xticks(counts.tolist(), [str(count) for count in counts])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper left")
    return png(figure)


def _line(rows: Rows, name: str) -> tuple[list[int], list[float]]:
    return [row["clips"] for row in rows], [row[name] for row in rows]
