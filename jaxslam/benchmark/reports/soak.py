"""Report on a soak test: a table of windows in Markdown, and what grew over the frames."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from jaxslam.benchmark.reports.document import Heading, Paragraph, Table, to_markdown
from jaxslam.benchmark.soak.meter import Window
from jaxslam.visualization.plots import png

_COUNTS = ("frames", "keyframes", "points", "MB", "lost", "covered", "dropped")
COLUMNS = (*_COUNTS, "median", "p95", "max, ms", "CPU, ms", "ATE, mm")
_SIZE_IN, _DPI = (7.2, 8.4), 120
_COLOR, _OTHER_COLOR = "#0072b2", "#d55e00"


def cells(window: Mapping[str, Any]) -> list[str]:
    """Return a window as texts below `COLUMNS`."""
    ate_m = window["ate_m"]
    return [
        str(window["frames"]),
        str(window["keyframes"]),
        str(window["map_points"]),
        f"{window['rss_mb']:.0f}",
        str(window["lost"]),
        str(window["made_lost"]),
        str(window["dropped"]),
        *(f"{window[name]:.1f}" for name in ("median_ms", "p95_ms", "max_ms", "cpu_ms")),
        "-" if ate_m is None else f"{1e3 * ate_m:.1f}",
    ]


def summary(windows: Sequence[Window]) -> dict[str, Any]:
    """Return how the last window compares with the first, and what was lost in all of them."""
    first, last = windows[0], windows[-1]
    both = first.ate_m is not None and last.ate_m is not None
    return {
        "keyframes_ratio": round(last.keyframes / max(first.keyframes, 1), 3),
        "rss_growth_mb": round(last.rss_mb - first.rss_mb, 1),
        "p95_ratio": round(last.p95_ms / first.p95_ms, 3),
        "max_ms": max(window.max_ms for window in windows),
        "lost": sum(window.lost for window in windows),
        "dropped": sum(window.dropped for window in windows),
        "ate_ratio": round((last.ate_m or 0.0) / first.ate_m, 3) if both and first.ate_m else None,
    }


def markdown_report(content: Mapping[str, Any]) -> str:
    """Return the content of `soak.json` as a table, and how it was measured."""
    table = Table([COLUMNS, *map(cells, content["windows"])])
    return to_markdown([Heading(f"Soak test: {content['recording']}", 1), table, Paragraph(_how(content))])


def _how(content: Mapping[str, Any]) -> str:
    threads = "each module in its thread" if content["live"] else "all modules in turn"
    threads += ", frames at the rate of the recording" if content["realtime"] else ""
    fails = content["detector_fails"]
    return (
        f"Preset {content['preset']}, {threads}. Each row sums up the frames since the one before: keyframes and points"
        " of the map and resident memory of the process at its end; frames that were lost though the lens was free, and"
        " while it was covered or in the second after; frames that came too late to be tracked; milliseconds of a"
        " frame, and processor time of all that the process did; RMSE of the poses as they were given out. "
        + (f"The lens is covered every {content['covered_every']} frames. " if content["covered_every"] else "")
        + (f"{fails:.1%} of the calls of the detector fail. " if fails else "")
        + f"Last row against the first: {content['keyframes_ratio']:g} times the keyframes,"
        f" {content['rss_growth_mb']:+g} MB, p95 {content['p95_ratio']:g} times"
        + (f", ATE {content['ate_ratio']:g} times" if content["ate_ratio"] is not None else "")
        + f". Processor: {content['cpu']}, {content['cores']} cores."
        f" jaxslam: {content['commit'] or content['versions']['jaxslam']}."
    )


def picture(content: Mapping[str, Any]) -> bytes:
    """Draw keyframes, memory, time and error over the frames, as a PNG."""
    windows = content["windows"]
    frames = [window["frames"] for window in windows]
    figure = Figure(dpi=_DPI, figsize=_SIZE_IN, layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    for at, (names, label) in zip(axes, _PANELS, strict=True):
        for (name, what), color in zip(names, (_COLOR, _OTHER_COLOR), strict=False):
            at.plot(frames, [_number(window[name]) for window in windows], color=color, label=what)
        at.set(ylabel=label)
        at.set_ylim(bottom=0)
        at.grid(alpha=0.3)
        if len(names) > 1:
            at.legend(fontsize=8)
    for at in axes:
        for window in windows:
            if window["lost"]:
                at.axvline(window["frames"], color="0.8", zorder=0)
    axes[0].set_title(content["recording"])
    axes[-1].set(xlabel="frames")
    return png(figure)


_PANELS = (
    ((("keyframes", "keyframes"),), "keyframes"),
    ((("rss_mb", "memory"),), "memory, MB"),
    ((("p95_ms", "p95"), ("median_ms", "median")), "a frame, ms"),
    ((("ate_m", "error"),), "ATE, m"),
)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
