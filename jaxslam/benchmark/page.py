"""What a suite has shown, as one HTML page that needs nothing else: tables that sort, plots, the runs' own pictures."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxslam.benchmark.report import COLUMNS, cells, how, published_table
from jaxslam.benchmark.rows import rows_of
from jaxslam.benchmark.suite import Suite

_PICTURE_PX = 720
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 60rem; padding: 0 1rem 3rem; color: #222; }
h1, h2 { line-height: 1.2; } h2 { border-top: 1px solid #ddd; padding-top: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; white-space: nowrap; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; } th { cursor: pointer; background: #f4f4f4; }
img { max-width: 100%; height: auto; } .failed { color: #b00; } figure { margin: 1rem 0; } figcaption { color: #555; }
@media (prefers-color-scheme: dark) { body { background: #181818; color: #ddd; } th { background: #2a2a2a; }
  th, td, h2 { border-color: #444; } .failed { color: #f77; } figcaption { color: #aaa; } }
"""
_SCRIPT = """
document.querySelectorAll("th").forEach(head => head.addEventListener("click", () => {
  const table = head.closest("table"), column = head.cellIndex, body = table.tBodies[0];
  const down = head.dataset.down = head.dataset.down === "1" ? "" : "1";
  const key = row => { const text = row.cells[column].textContent, number = parseFloat(text);
    return isNaN(number) ? text : number; };
  [...body.rows].sort((a, b) => { const x = key(a), y = key(b);
    const order = typeof x === typeof y ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1;
    return down ? order : -order; }).forEach(row => body.append(row));
}));
"""


def html_report(suite: Suite, results: Sequence[Mapping[str, Any]], missing: Sequence[str], out: Path) -> str:
    """The report of a suite.

    Args:
        suite: What was run.
        results: Of every run, as `run_jobs` gives them.
        missing: Names of recordings that are not there.
        out: The folder of the results, whose pictures are shown.
    """
    rows = rows_of(results)
    parts = [f"<h1>{_text(suite.name)}</h1>", f"<p>{_text(suite.about)}</p>"]
    for sequence in dict.fromkeys(row["sequence"] for row in rows):
        of_it = [row for row in rows if row["sequence"] == sequence]
        runs = [result for result in results if result["sequence"] == sequence]
        parts.append(f"<h2>{_text(sequence)}</h2>")
        parts.append(_table(COLUMNS, [cells(row) for row in of_it]))
        published = published_table(suite, sequence, of_it)
        if published:
            parts.append(_table(published[0], published[1:]))
        parts += [
            f'<p class="failed">{_text(run["label"])}, seed {run["seed"]}: {_text(run["problem"])}</p>'
            for run in runs
            if run["status"] != "done"
        ]
        done = [run for run in runs if run["status"] == "done"]
        if done:
            parts.append(_figure(_png(_overview(done)), f"{sequence}: errors of the runs, and time of the frames"))
        parts += [_median_run(label, done, out) for label in dict.fromkeys(run["label"] for run in done)]
    if missing:
        parts.append("<h2>Not run: recordings that are not on this machine</h2><ul>")
        parts += [f"<li>{_text(name)}: <code>jaxslam data get {_text(name)}</code></li>" for name in missing]
        parts.append("</ul>")
    parts.append(f"<p>{_text(how(results))}</p>")
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(suite.name)}</title><style>{_STYLE}</style></head><body>"
    )
    return head + "\n".join(parts) + f"<script>{_SCRIPT}</script></body></html>\n"


def _text(value: object) -> str:
    return html.escape(str(value))


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{_text(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(picture: bytes, caption: str) -> str:
    data = base64.b64encode(picture).decode()
    return (
        f'<figure><img alt="{_text(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{_text(caption)}</figcaption></figure>"
    )


def _overview(done: Sequence[Mapping[str, Any]]) -> Figure:
    """ATE of the runs as boxes, and median and 95th percentile of the frames' times."""
    labels = list(dict.fromkeys(run["label"] for run in done))
    figure = Figure(figsize=(9, 0.6 * len(labels) + 1.8), layout="constrained")
    errors, times = figure.subplots(1, 2)
    of = lambda label, name: [run[name] for run in done if run["label"] == label and run.get(name) is not None]
    positions = np.arange(len(labels), 0, -1)
    found = [of(label, "ate_rmse_m") for label in labels]
    known = [index for index, values in enumerate(found) if values]
    if known:
        errors.boxplot(
            [found[index] for index in known], positions=positions[known], orientation="horizontal", widths=0.6
        )
    for index in known:
        errors.plot(found[index], np.full(len(found[index]), positions[index]), ".", color="tab:blue", alpha=0.6)
    errors.set(xlabel="ATE [m]", yticks=positions, ylim=(0.4, len(labels) + 0.6))
    errors.set_yticklabels(labels)
    for name, marker in (("flow_ratio_median", "o"), ("flow_ratio_p95", "|")):
        middle = [np.median(of(label, name)) if of(label, name) else np.nan for label in labels]
        times.plot(middle, positions, marker, markersize=9, label=name.removeprefix("flow_ratio_"))
    times.axvline(1, color="0.6", linewidth=0.8)
    times.set(xlabel="time of a frame / OpenCV's flow of 1000 points", yticks=positions, ylim=(0.4, len(labels) + 0.6))
    times.set_yticklabels([])
    times.legend(fontsize=8)
    for axes in (errors, times):
        axes.set_xlim(left=0)
        axes.grid(alpha=0.3)
    return figure


def _png(figure: Figure) -> bytes:
    file = io.BytesIO()
    FigureCanvasAgg(figure).print_png(file)
    return file.getvalue()


def _median_run(label: str, done: Sequence[Mapping[str, Any]], out: Path) -> str:
    """The picture that the run of median error has left, path and error over time."""
    runs = [run for run in done if run["label"] == label]
    ates = [np.inf if run["ate_rmse_m"] is None else run["ate_rmse_m"] for run in runs]
    run = runs[int(np.argsort(ates, kind="stable")[(len(runs) - 1) // 2])]
    path = out / run["sequence"] / label / str(run["seed"]) / "plot.png"
    if not path.is_file():
        return f'<p class="failed">{_text(label)}: no pose in its median run</p>'
    with Image.open(path) as picture:
        picture.thumbnail((_PICTURE_PX, 10 * _PICTURE_PX))
        file = io.BytesIO()
        picture.convert("RGB").quantize(128).save(file, "PNG")
    return _figure(file.getvalue(), f"{label}, its run of median error (seed {run['seed']})")
