"""Reports of suites as one HTML page with sortable tables, plots, and pictures of the runs."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import PIL.Image

from jaxslam.benchmark.reports.document import Image, to_html
from jaxslam.benchmark.reports.markdown import suite_report
from jaxslam.benchmark.reports.plots import folder_of, plot_errors, plot_paths, plot_rates, plot_spread, plot_times
from jaxslam.benchmark.suites.aggregate import by_sequence, median_run, with_shown_labels
from jaxslam.benchmark.suites.suite import Suite
from jaxslam.visualization.plots import png

_PICTURE_PX = 1000
_PICTURES = {
    "failures.png": "where it was lost, and the largest error",
    "masks.png": "what was left out as moving",
}


def html_report(suite: Suite, results: Sequence[Mapping[str, Any]], missing: Mapping[str, str], out: Path) -> str:
    """Render the report of a suite as an HTML page.

    Args:
        suite: Suite that was run.
        results: Results of all planned runs, from `Collected.every`.
        missing: Reasons why sequences were not run, by name.
        out: Folder of the results; its pictures are shown.
    """
    results = with_shown_labels(results)
    images = {
        sequence: _images(sequence, [run for run in runs if run["status"] == "done"], out)
        for sequence, runs in by_sequence(results).items()
    }
    if rates := _by_rate(suite, results):
        images[""] = [Image(png(plot_rates(rates)), "Error over the rate of frames: median and range of the runs.")]
    return to_html(suite.name, suite_report(suite, results, missing, images))


def _images(sequence: str, done: Sequence[Mapping[str, Any]], out: Path) -> list[Image]:
    """Draw all plots of a sequence, and collect the pictures of its median runs, of runs whose files still exist."""
    done = [run for run in done if (folder_of(run, out) / "trajectory.txt").is_file()]
    if not done:
        return []
    drawn = (
        (plot_spread(done), "errors of the runs, and times of their frames beside OpenCV's optical flow (LK)"),
        (plot_paths(done, out), "runs of median error against the truth"),
        (plot_errors(done, out), "error over time of those runs"),
        (plot_times(done, out), "times of the frames of all runs, and of their stages"),
    )
    images = [Image(png(figure), f"{sequence}: {caption}") for figure, caption in drawn if figure is not None]
    for label in dict.fromkeys(run["label"] for run in done):
        run = median_run([run for run in done if run["label"] == label])
        for name, caption in _PICTURES.items():
            if (path := folder_of(run, out) / name).is_file():
                images.append(_picture(path, f"{label}, seed {run['seed']}: {caption}"))
    return images


def _picture(path: Path, caption: str) -> Image:
    """Read a picture that a run has written, and shrink it."""
    with PIL.Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail((_PICTURE_PX, 10 * _PICTURE_PX))
    file = io.BytesIO()
    small.save(file, "JPEG", quality=80)
    return Image(file.getvalue(), caption, "jpeg", is_folded=True)


def _by_rate(suite: Suite, results: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Results that are done of what is there at more than one rate, by the name of the recording, or of the first."""
    sources: dict[object, str] = {}
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for clip in suite.sequences:
        name = sources.setdefault((clip.source, clip.room, clip.start, clip.stop), clip.recording or clip.name)
        groups.setdefault(name, []).extend(
            result for result in results if result["sequence"] == clip.name and result["status"] == "done"
        )
    return {name: group for name, group in groups.items() if len({round(run["rate_hz"]) for run in group}) > 1}
