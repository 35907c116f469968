"""Plots of a suite's runs: errors, paths against the truth, errors and times of frames, stages, frame rates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxslam.benchmark.suites.aggregate import median_run
from jaxslam.benchmark.suites.run_names import run_folder
from jaxslam.results.frame_table import Errors, read_errors, read_track_ms
from jaxslam.visualization.plots import with_breaks

_WIDTH_IN, _DPI = 4.8, 160
"""So that the letters can be read on a telephone, across its whole width."""
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
"""Told apart by the color-blind too (Okabe and Ito)."""
_STAGES = ("take over", "flow", "wait for mask", "pose", "match with map", "hand over")
_ROOM = 0.15
_FRAMES = "frames.csv"
_LONGEST = 29
"""Letters of a label."""


def plot_spread(done: Sequence[Mapping[str, Any]]) -> Figure:
    """ATE of the runs of one sequence as boxes, and times of their frames, a line a label."""
    labels = _labels(done)
    figure = Figure(dpi=_DPI, figsize=(_WIDTH_IN, 0.8 * len(labels) + 1.8), layout="constrained")
    errors, times = figure.subplots(2, 1)
    positions = np.arange(len(labels), 0, -1)
    found = [_figures(done, label, "ate_rmse_m") for label in labels]
    known = [index for index, values in enumerate(found) if values]
    if known:
        errors.boxplot(
            [found[index] for index in known], positions=positions[known], orientation="horizontal", widths=0.6
        )
    for index in known:
        errors.plot(found[index], np.full(len(found[index]), positions[index]), ".", color=_color(index), alpha=0.7)
    errors.set(xlabel="ATE [m]", yticks=positions, yticklabels=_shortened(labels))
    for name, marker in (("flow_ratio_median", "o"), ("flow_ratio_p95", "|"), ("flow_ratio_max", "x")):
        values = [_figures(done, label, name) for label in labels]
        middle = [np.median(value) if value else np.nan for value in values]
        times.plot(middle, positions, marker, color="0.2", markersize=7, label=name.removeprefix("flow_ratio_"))
    times.axvline(1, color="0.6", linewidth=0.8)
    times.set(xlabel="time of a frame / LK", yticks=positions, yticklabels=_shortened(labels), xscale="log")
    times.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for axes in (errors, times):
        axes.set_ylim(0.4, len(labels) + 0.6)
        axes.grid(alpha=0.3)
    errors.set_xlim(left=0)
    return figure


def plot_paths(done: Sequence[Mapping[str, Any]], out: Path) -> Figure | None:
    """The run of median error of every label against the truth, at the truth's scale; `None` if none was evaluated."""
    runs = {label: errors for label in _labels(done) if (errors := _errors(done, label, out)) is not None}
    if not runs:
        return None
    columns = min(len(runs), 2)
    lines = (len(runs) + columns - 1) // columns
    truth = next(iter(runs.values())).reference_m
    plane = sorted(np.argsort(-np.ptp(truth, axis=0), kind="stable")[:2].tolist())
    low, high = truth[:, plane].min(axis=0), truth[:, plane].max(axis=0)
    room = _ROOM * max(*(high - low).tolist(), 1e-3)
    figure = Figure(dpi=_DPI, figsize=(_WIDTH_IN, 2.4 * lines + 0.3), layout="constrained")
    every = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in every[len(runs) :]:
        axes.set_axis_off()
    for axes, (label, errors) in zip(every, runs.items(), strict=False):
        axes.plot(*errors.reference_m[:, plane].T, color="0.6", linewidth=2.5, label="truth")
        axes.plot(
            *with_breaks(errors.timestamps_ns, errors.positions_m[:, plane]).T,
            color=_color(list(runs).index(label)),
            linewidth=1,
        )
        axes.set_title(f"{_short(label)}, {_rmse(errors):.4f} m", fontsize=9)
        axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room), aspect="equal")
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8)
    figure.supxlabel(f"{'xyz'[plane[0]]} [m], truth in gray", fontsize=9)
    figure.supylabel(f"{'xyz'[plane[1]]} [m]", fontsize=9)
    return figure


def plot_errors(done: Sequence[Mapping[str, Any]], out: Path) -> Figure | None:
    """Error over time of the run of median error of every label; `None` if none was evaluated."""
    figure = Figure(dpi=_DPI, figsize=(_WIDTH_IN, 2.8), layout="constrained")
    axes = figure.subplots()
    start = None
    for index, label in enumerate(_labels(done)):
        errors = _errors(done, label, out)
        if errors is None:
            continue
        start = errors.timestamps_ns[0] if start is None else start
        seconds = (errors.timestamps_ns - start) * 1e-9
        lines = with_breaks(errors.timestamps_ns, np.column_stack([seconds, errors.errors_m]))
        axes.plot(*lines.T, color=_color(index), linewidth=1, label=_short(label))
    if start is None:
        return None
    axes.set(xlabel="time [s]", ylabel="error [m]", yscale="log")
    axes.margins(x=0)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    return figure


def plot_times(done: Sequence[Mapping[str, Any]], out: Path) -> Figure | None:
    """Times of the frames of all runs as histograms, and the mean time of each stage, for every label.

    Runs of other systems keep no times of single frames; `None` if there are no others.
    """
    done = [run for run in done if (folder_of(run, out) / _FRAMES).is_file()]
    if not done:
        return None
    labels = _labels(done)
    figure = Figure(dpi=_DPI, figsize=(_WIDTH_IN, 0.3 * len(labels) + 4.2), layout="constrained")
    frames, stages = figure.subplots(2, height_ratios=(2.4, 0.3 * len(labels) + 1))
    taken = {label: np.concatenate([_track_ms(run, out) for run in _of(done, label)]) for label in labels}
    shown = {label: times for label, times in taken.items() if len(times)}
    if shown:
        together = np.concatenate(list(shown.values()))
        bins = np.geomspace(max(together.min(), 1e-2), max(together.max(), 2e-2), 50)
        for index, (label, times) in enumerate(shown.items()):
            weights = np.full(len(times), 100 / len(times))
            frames.hist(
                times, bins=bins.tolist(), weights=weights, histtype="step", color=_color(index), label=_short(label)
            )
        frames.legend(fontsize=8)
    frames.set(xlabel="time of a frame [ms]", ylabel="share of the frames [%]", xscale="log")
    _draw_stages(stages, done, labels)
    for axes in (frames, stages):
        axes.grid(alpha=0.3)
    return figure


def plot_rates(groups: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """ATE over the rate of frames, a picture a recording and a line a label, with the range of its runs.

    Args:
        groups: Results that are done, of a recording each, at several rates.
    """
    columns = min(len(groups), 2)
    lines = (len(groups) + columns - 1) // columns
    figure = Figure(dpi=_DPI, figsize=(_WIDTH_IN, 3.0 * lines), layout="constrained")
    every = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in every[len(groups) :]:
        axes.set_axis_off()
    for axes, (name, done) in zip(every, groups.items(), strict=False):
        for index, label in enumerate(_labels(done)):
            rates = sorted({run["rate_hz"] for run in _of(done, label)})
            found = [[run["ate_rmse_m"] for run in _of(done, label) if run["rate_hz"] == rate] for rate in rates]
            known = [(rate, [a for a in ates if a is not None]) for rate, ates in zip(rates, found, strict=True)]
            _draw_rates(axes, [(rate, ates) for rate, ates in known if ates], _short(label), _color(index))
        axes.set(xscale="log", yscale="log", xlabel="frames a second", ylabel="ATE [m]", title=name)
        ticks = sorted({round(run["rate_hz"]) for run in done})
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    return figure


def _draw_rates(axes: Axes, points: Sequence[tuple[float, Sequence[float]]], label: str, color: str) -> None:
    if not points:
        return
    rates, ates = [rate for rate, _ in points], [of_rate for _, of_rate in points]
    axes.plot(rates, [float(np.median(a)) for a in ates], "o-", color=color, markersize=4, label=label)
    axes.fill_between(rates, [min(a) for a in ates], [max(a) for a in ates], color=color, alpha=0.15, linewidth=0)


def _draw_stages(axes: Axes, done: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> None:
    """Mean time of each stage of the tracking thread, stacked."""
    positions = np.arange(len(labels), 0, -1)
    left = np.zeros(len(labels))
    for stage, color in zip(_STAGES, _COLORS, strict=False):
        means = np.array([_stage_ms(done, label, stage) for label in labels])
        axes.barh(positions, means, left=left, height=0.6, color=color, label=stage)
        left += means
    axes.set(xlabel="mean time of a frame, by stages [ms]", yticks=positions, yticklabels=_shortened(labels))
    axes.legend(fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.4, -0.5))


def _stage_ms(done: Sequence[Mapping[str, Any]], label: str, stage: str) -> float:
    times = [run["stage_ms"][stage]["mean"] for run in _of(done, label) if run["stage_ms"].get(stage)]
    return float(np.median(times)) if times else 0.0


def _shortened(labels: Sequence[str]) -> list[str]:
    return [_short(label) for label in labels]


def _short(label: str) -> str:
    """The beginning and the end of a label that would leave no room for what it labels; never a formula."""
    ends = (_LONGEST - 1) // 2
    shown = label if len(label) <= _LONGEST else f"{label[:ends]}\N{HORIZONTAL ELLIPSIS}{label[-ends:]}"
    return shown.replace("$", r"\$")


def _labels(done: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(run["label"] for run in done))


def _of(done: Sequence[Mapping[str, Any]], label: str) -> list[Mapping[str, Any]]:
    return [run for run in done if run["label"] == label]


def _figures(done: Sequence[Mapping[str, Any]], label: str, name: str) -> list[float]:
    return [run[name] for run in _of(done, label) if run.get(name) is not None]


def _color(index: int) -> str:
    return _COLORS[index % len(_COLORS)]


def folder_of(run: Mapping[str, Any], out: Path) -> Path:
    """Return the folder of the files of a run."""
    return out / (run.get("folder") or run_folder(run["sequence"], run["label"], run["seed"]))


def _errors(done: Sequence[Mapping[str, Any]], label: str, out: Path) -> Errors | None:
    run = median_run(_of(done, label))
    return None if run["ate_rmse_m"] is None else read_errors(folder_of(run, out) / "errors.csv")


def _track_ms(run: Mapping[str, Any], out: Path) -> np.ndarray:
    return read_track_ms(folder_of(run, out) / _FRAMES)


def _rmse(errors: Errors) -> float:
    return float(np.sqrt(np.mean(np.square(errors.errors_m))))
