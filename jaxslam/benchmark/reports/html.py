"""What a suite has shown, as one HTML page that needs nothing else: tables that sort, plots, the runs' own pictures."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from jaxslam.benchmark.reports.markdown import (
    failures,
    figure_table,
    how,
    overview_table,
    protocols,
    published_tables,
    summary_lines,
    warnings,
)
from jaxslam.benchmark.reports.plots import folder_of, plot_errors, plot_paths, plot_rates, plot_spread, plot_times
from jaxslam.benchmark.suites.aggregate import ACCURACY, RUNNING, by_sequence, median_run, rows_of, with_shown_labels
from jaxslam.benchmark.suites.published_comparison import kitti_means
from jaxslam.benchmark.suites.suite import Suite
from jaxslam.visualization.plots import png

_PICTURE_PX = 1000
_COLORED = ("better", "worse")
_PICTURES = {
    "failures.png": "where it was lost, and the largest error",
    "masks.png": "what was left out as moving",
}
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 60rem; padding: 0 1rem 3rem; color: #222;
  overflow-wrap: anywhere; }
h1, h2 { line-height: 1.2; } h2 { border-top: 1px solid #ddd; padding-top: 1rem; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; white-space: nowrap; font-variant-numeric: tabular-nums; font-size: 0.9rem; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
th, th:first-child { cursor: pointer; background: #f4f4f4; }
.better { color: #060; font-weight: 600; } .worse { color: #b00; } .failed { color: #b00; }
img { width: 40rem; max-width: 100%; height: auto; } figure { margin: 1rem 0; } figcaption { color: #555; }
summary { cursor: pointer; padding: .3rem 0; }
@media (max-width: 40rem) { th, td { padding: .3rem .4rem; }
  td:first-child { white-space: normal; overflow-wrap: anywhere; min-width: 6rem; } }
@media (prefers-color-scheme: dark) { body { background: #181818; color: #ddd; }
  th:first-child, td:first-child { background: #181818; } th, th:first-child { background: #2a2a2a; }
  th, td, h2 { border-color: #444; } .better { color: #7d7; } .worse, .failed { color: #f77; }
  figcaption { color: #aaa; } img { background: #fff; } }
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


def html_report(suite: Suite, results: Sequence[Mapping[str, Any]], missing: Mapping[str, str], out: Path) -> str:
    """The report of a suite.

    Args:
        suite: What was run.
        results: Of every planned run, as `Collected.every` gives them.
        missing: Names of what was not run, with the reason.
        out: The folder of the results, whose files are shown.
    """
    results = with_shown_labels(results)
    rows, runs = rows_of(results), by_sequence(results)
    parts = [f"<h1>{_text(suite.name)}</h1>", f"<p>{_text(suite.about)}</p>", _table(overview_table(suite, rows))]
    parts += [f"<p>{_text(line)}</p>" for line in summary_lines(suite, rows)]
    parts += [f'<p class="failed">{_text(line)}</p>' for line in warnings(suite, results)]
    parts.append(_table(kitti_means(suite, rows)))
    rates = _by_rate(suite, results)
    if rates:
        parts.append(_figure(png(plot_rates(rates)), "Error over the rate of frames: median and range of the runs."))
    for sequence, of_it in by_sequence(rows).items():
        parts.append(f"<h2>{_text(sequence)}</h2>")
        parts += [_table(figure_table(of_it, columns)) for columns in (ACCURACY, RUNNING)]
        parts += [f'<p class="failed">{_text(line)}</p>' for line in failures(of_it)]
        parts += [_table(found) for found in published_tables(suite, sequence, of_it)]
        parts += _plots(sequence, [run for run in runs[sequence] if run["status"] == "done"], out)
    if missing:
        parts.append("<h2>Not run</h2><ul>")
        parts += [f"<li>{_text(name)}: {_text(why)}</li>" for name, why in missing.items()]
        parts.append("</ul>")
    known = protocols(suite, rows)
    if known:
        parts.append("<h2>How published figures came about</h2>")
        parts += [f"<p>{_text(line)}</p>" for line in known]
    parts.append(f"<p>{_text(how(results))}</p>")
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(suite.name)}</title><style>{_STYLE}</style></head><body>"
    )
    return head + "\n".join(parts) + f"<script>{_SCRIPT}</script></body></html>\n"


def _text(value: object) -> str:
    return html.escape(str(value))


def _table(lines: Sequence[Sequence[str]]) -> str:
    if not lines:
        return ""
    head = "".join(f"<th>{_text(column)}</th>" for column in lines[0])
    body = "".join("<tr>" + "".join(map(_cell, line)) + "</tr>" for line in lines[1:])
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str) -> str:
    look = f' class="{text}"' if text in _COLORED else ""
    return f"<td{look}>{_text(text)}</td>"


def _figure(picture: bytes, caption: str, kind: str = "png") -> str:
    data = base64.b64encode(picture).decode()
    return (
        f'<figure><img alt="{_text(caption)}" src="data:image/{kind};base64,{data}">'
        f"<figcaption>{_text(caption)}</figcaption></figure>"
    )


def _plots(sequence: str, done: Sequence[Mapping[str, Any]], out: Path) -> list[str]:
    """Everything there is to look at of a sequence, of runs whose files are still there."""
    done = [run for run in done if (folder_of(run, out) / "frames.csv").is_file()]
    if not done:
        return []
    drawn = (
        (plot_spread(done), "errors of the runs, and times of their frames beside OpenCV's optical flow (LK)"),
        (plot_paths(done, out), "runs of median error against the truth"),
        (plot_errors(done, out), "error over time of those runs"),
        (plot_times(done, out), "times of the frames of all runs, and of their stages"),
    )
    parts = [_figure(png(figure), f"{sequence}: {caption}") for figure, caption in drawn if figure is not None]
    for label in dict.fromkeys(run["label"] for run in done):
        run = median_run([run for run in done if run["label"] == label])
        for name, caption in _PICTURES.items():
            parts.append(_picture(folder_of(run, out) / name, f"{label}, seed {run['seed']}: {caption}"))
    return parts


def _picture(path: Path, caption: str) -> str:
    """A picture that a run has left, if it has, folded."""
    if not path.is_file():
        return ""
    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail((_PICTURE_PX, 10 * _PICTURE_PX))
    file = io.BytesIO()
    small.save(file, "JPEG", quality=80)
    shown = _figure(file.getvalue(), caption, "jpeg")
    return f"<details><summary>{_text(caption)}</summary>{shown}</details>"


def _by_rate(suite: Suite, results: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Results that are done of what is there at more than one rate, by the name of the recording, or of the first."""
    sources: dict[object, str] = {}
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for clip in suite.sequences:
        name = sources.setdefault((clip.recording, clip.room, clip.start, clip.stop), clip.recording or clip.name)
        groups.setdefault(name, []).extend(
            result for result in results if result["sequence"] == clip.name and result["status"] == "done"
        )
    return {name: group for name, group in groups.items() if len({round(run["rate_hz"]) for run in group}) > 1}
