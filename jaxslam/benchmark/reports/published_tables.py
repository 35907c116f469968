"""Tables of suites with published figures and ours in one order: ratio to the best, rank, and who is better."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxslam.benchmark.suites.aggregate import Statistic, by_sequence
from jaxslam.benchmark.suites.published import Figure, load_published
from jaxslam.benchmark.suites.published_comparison import (
    ATE,
    METRICS,
    PublishedMetric,
    best_of_systems,
    clip_of,
    kitti_means,
    published_of,
    rank_among,
    reservations,
    verdict_on,
)
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.suite import Suite

_NONE = "-"
_COMPARED = (
    *("DROID-W", "DynaSLAM", "Occlusion SLAM", "RTS-SLAM", "NGD-SLAM", "TRS-SLAM", "USD-SLAM"),
    *("ORB-SLAM2", "ORB-SLAM3"),
)
"""Systems of the short comparison: those that jaxslam builds, their base, and two that many compare with."""
_ALL_TRACKED_PERCENT = 99.95


class _Ours(NamedTuple):
    """A row of ours that stands beside published figures.

    Attributes:
        row: Row, from `rows_of`.
        value: Figure of its runs.
        reasons: Why it may not be compared, from `reservations`.
    """

    row: Mapping[str, Any]
    value: float
    reasons: list[str]


def published_tables(suite: Suite, sequence: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[list[str]]]:
    """Tables of published figures of a sequence by the name of the figure, of each of `METRICS` that papers have.

    Args:
        suite: Suite that was run.
        sequence: Its name in the suite; of a part of a recording nothing has been published.
        rows: Those of `rows_of` that are of the sequence.
    """
    found = {metric.figure: published_table(suite, sequence, rows, metric) for metric in METRICS}
    return {figure: lines for figure, lines in found.items() if lines}


def published_table(
    suite: Suite, sequence: str, rows: Sequence[Mapping[str, Any]], metric: PublishedMetric = ATE
) -> list[list[str]]:
    """List the published figures of a sequence and ours, best first, and how each of our rows compares; headings first.

    A ratio is that to the best published figure. A rank is that among whole published systems, each with its best
    figure, as if no other row of ours were there.

    Args:
        suite: Suite that was run.
        sequence: Its name in the suite.
        rows: Those of `rows_of` that are of the sequence.
        metric: Name of the figure.

    Returns:
        Lines of as many texts; none if nothing has been published.
    """
    figures, statistic = published_of(suite, sequence, metric.figure), _statistic(suite)
    ours = _ours(suite, rows, metric, statistic)
    if not figures or (not ours and any(row["lacks_network"] for row in rows)):
        return []
    beside = [f"{row['label']} is" for row, _, _ in ours]
    head = [f"published {metric.name}", metric.unit, *beside, "ratio", "rank", "aligned", "source", "note"]
    lines = [(figure.value, _published_line(figure, figures, ours, metric)) for figure in figures]
    lines += [(one.value, _line_of_ours(one, figures, len(ours), statistic)) for one in ours]
    return [head, *(line for _, line in sorted(lines, key=lambda line: line[0]))]


def comparison_table(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Compare labels, other systems that were run too, and published figures in a short table; headings first.

    It is the table of the README. A cell has the ATE, the share of frames tracked if not all are, and the number of
    runs if not all are done.

    Args:
        suite: Suite that was run.
        rows: From `rows_of`.
    """
    labels = list(dict.fromkeys(row["label"] for row in rows))
    lines = [["recording", *labels, "published"]]
    for sequence, of_it in by_sequence(rows).items():
        cells = {row["label"]: _short_cell(row, _statistic(suite)) for row in of_it}
        others = [
            f"{figure.system}{'' if figure.sensor == 'rgbd' else f' ({figure.sensor})'} {figure.value:g} m"
            for figure in best_of_systems(published_of(suite, sequence))
            if figure.system in _COMPARED
        ]
        clip = clip_of(suite, sequence)
        name = f"`{sequence}`" if clip is None else described(clip)
        lines.append([name, *(cells.get(label, _NONE) for label in labels), ", ".join(others) or _NONE])
    return lines if rows else []


def described(clip: Clip) -> str:
    """Say in words what a sequence of a suite is."""
    part = f", frames {clip.start} to {'the end' if clip.stop is None else clip.stop - 1}" if clip.start else ""
    if not clip.start and clip.stop is not None:
        part = f", first {clip.stop} frames"
    every = f", one frame in {clip.every}" if clip.every > 1 else ""
    if clip.room is None:
        return f"`{clip.source}`{part}{every}"
    room = clip.room
    moving = [f"{number} {what}" for number, what in ((room.people, "people"), (room.boxes, "boxes")) if number]
    sensor = ["stereo"] if room.baseline_m is not None else []
    return ", ".join([f"rendered room, path {room.path}", *(moving or ["nothing moves"]), *sensor]) + part + every


def _short_cell(row: Mapping[str, Any], statistic: Statistic) -> str:
    ate, tracked = row["ate_rmse_m"], row["tracked_percent"]
    texts = [_NONE if ate is None or statistic not in ate else f"{ate[statistic]:.4f} m"]
    if tracked is not None and tracked["least"] < _ALL_TRACKED_PERCENT:
        texts.append(f"{tracked['least']:.4g} % tracked")
    if row["done"] < row["runs"]:
        texts.append(f"{row['done']} of {row['runs']} runs")
    return ", ".join(texts)


def rank_table(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Rank each label by ATE beside published ones, over all sequences that may be compared; headings first."""
    lines = [["against published ATE", "sequences", "ratio to the best", "mean rank", "of systems"]]
    for label in dict.fromkeys(row["label"] for row in rows):
        found = [
            (one.value / systems[0].value, rank_among(one.value, systems), len(systems) + 1)
            for row in rows
            if row["label"] == label and (systems := best_of_systems(published_of(suite, row["sequence"])))
            for one in _ours(suite, [row], ATE, _statistic(suite))
            if not one.reasons
        ]
        if found:
            ratios, ranks, systems = np.array(found).T
            ratio, rank = float(np.exp(np.log(ratios).mean())), float(ranks.mean())
            lines.append([label, str(len(found)), f"{ratio:.2f}", f"{rank:.1f}", f"{float(systems.mean()):.1f}"])
    return lines if len(lines) > 1 else []


def protocols(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Note for every paper with figures next to ours: its frames, and which statistic of how many runs."""
    sequences = by_sequence(rows)
    figures = [f for name in sequences for metric in METRICS for f in published_of(suite, name, metric.figure)]
    names = {name for figure in figures for name in (figure.reported_by or figure.system).split(", ")}
    names |= {line[1] for line in kitti_means(suite, rows)[1:]}
    return [
        f"{paper.name} ({paper.authors}; {paper.venue}{'' if paper.year is None else f', {paper.year}'}):"
        f" {paper.protocol} {paper.link or ''}".rstrip()
        for paper in load_published()
        if paper.name in names
    ]


def _statistic(suite: Suite) -> Statistic:
    return "median" if suite.protocol is None else suite.protocol.statistic


def _ours(
    suite: Suite, rows: Sequence[Mapping[str, Any]], metric: PublishedMetric, statistic: Statistic
) -> list[_Ours]:
    """Rows that have the figure, and enough runs for the statistic, with a network if their preset needs one."""
    fit = [row for row in rows if statistic in (row[metric.of_ours] or {}) and not row["lacks_network"]]
    return [_Ours(row, row[metric.of_ours][statistic], reservations(suite, row)) for row in fit]


def _published_line(
    figure: Figure, figures: Sequence[Figure], ours: Sequence[_Ours], metric: PublishedMetric
) -> list[str]:
    name = figure.system if figure.variant is None else f"{figure.system}, {figure.variant}"
    stated = figure.alignment if figure.alignment_stated else f"{figure.alignment}, not stated"
    whose = figure.source if figure.reported_by is None else f"{figure.source} of {figure.reported_by}"
    verdicts = (verdict_on(row, metric, figure.value, reasons) for row, _, reasons in ours)
    others = [other for other in best_of_systems(figures) if other.system != figure.system]
    rank = str(rank_among(figure.value, others)) if figure.variant is None else _NONE
    return [name, f"{figure.value:g}", *verdicts, _ratio(figure.value, figures), rank, stated, whose, figure.note]


def _line_of_ours(one: _Ours, figures: Sequence[Figure], columns: int, statistic: Statistic) -> list[str]:
    row, value, reasons = one
    comparable = not reasons
    place = (_ratio(value, figures), str(rank_among(value, best_of_systems(figures)))) if comparable else (_NONE, _NONE)
    source = f"here, {statistic.replace('_', ' ')} of {row['done']} runs"
    return [row["label"], f"{value:.4g}", *[_NONE] * columns, *place, "se3", source, "; ".join(reasons)]


def _ratio(value: float, figures: Sequence[Figure]) -> str:
    """Return the ratio to the best figure of a whole system."""
    systems = best_of_systems(figures)
    return f"{value / systems[0].value:.2f}" if systems else _NONE
