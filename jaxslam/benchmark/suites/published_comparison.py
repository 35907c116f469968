"""Whether our figures of a recording may be compared with published ones, and how they compare."""

import functools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxslam.benchmark.suites.published import Figure, Metric, Verdict, load_published, published_for, verdict
from jaxslam.benchmark.suites.suite import Sequence as Clip
from jaxslam.benchmark.suites.suite import Suite
from jaxslam.datasets.catalog import known_recordings

NO_VERDICT = "no verdict"
VERDICTS: tuple[Verdict, ...] = ("better", "in range", "worse")

_MIN_TRACKED_PERCENT = 95.0
"""Of all frames, dropped ones too: an error of the easy part of a recording says nothing about the rest."""
_ALL_IMAGES, _MIN_WITH_DEPTH = 0.99, 0.9
"""Shares of the published length. Of the color images of TUM up to 7 % have no depth image at the same time."""
_MIN_MATCHED_PERCENT = 90.0
"""Of the frames, with ground truth at their time."""
_MIN_COVERED_PERCENT = 80.0
"""Of the time of the ground truth, where the published length is not known. That of TUM fr1 begins before the images
and ends after them: those of fr1 xyz cover 88 %."""


class PublishedMetric(NamedTuple):
    """A figure that papers report of a sequence.

    Attributes:
        figure: Its name, of theirs, and of ours too if those have no other.
        name: Name in tables.
        unit: Unit of its numbers.
        other_name: Its name in our rows, if it is another one.
        depends_on_machine: Whether there is no verdict, because it was measured on another machine.
    """

    figure: Metric
    name: str
    unit: str
    other_name: str | None = None
    depends_on_machine: bool = False

    @property
    def of_ours(self) -> str:
        """Its name in our rows."""
        return self.other_name or self.figure


METRICS = (
    PublishedMetric("ate_rmse_m", "ATE", "m"),
    PublishedMetric("rpe_trans_m_per_s", "RPE", "m/s"),
    PublishedMetric("rpe_rot_deg_per_s", "RPE", "deg/s"),
    PublishedMetric("kitti_trans_percent", "t_rel", "%"),
    PublishedMetric("kitti_rot_deg_per_100m", "r_rel", "deg/100 m"),
    PublishedMetric("frame_ms", "time of a frame", "ms", "track_ms_mean", depends_on_machine=True),
)
ATE = METRICS[0]
_KITTI = tuple(f"kitti_{number:02d}" for number in range(11))
_KITTI_MEANS = {
    "kitti_mean_ate_m": METRICS[0],
    "kitti_mean_t_rel_percent": METRICS[3],
    "kitti_mean_r_rel_deg_per_100m": METRICS[4],
}
"""Names of the means over KITTI odometry in `PublishedSystem.overall`."""


def clip_of(suite: Suite, sequence: str) -> Clip | None:
    """The sequence of a suite by its name; `None` if the suite has it no more."""
    return next((clip for clip in suite.sequences if clip.name == sequence), None)


def published_of(suite: Suite, sequence: str, metric: Metric = "ate_rmse_m") -> list[Figure]:
    """Published figures of a sequence of a suite, best first; of a part of a recording there are none."""
    clip = clip_of(suite, sequence)
    if clip is None or not clip.recording or not clip.whole:
        return []
    return published_for(clip.recording, metric, variants=suite.ablation)


def best_of_systems(figures: Iterable[Figure]) -> list[Figure]:
    """One figure of each whole system, best first: of several that papers report of it, the best."""
    best: dict[str, Figure] = {}
    for figure in figures:
        if figure.variant is None and (figure.system not in best or figure.value < best[figure.system].value):
            best[figure.system] = figure
    return sorted(best.values(), key=lambda figure: figure.value)


def reservations(suite: Suite, row: Mapping[str, Any]) -> list[str]:
    """Why the figures of a row may not be compared with published ones, in words; none if they may.

    Args:
        suite: Suite that was run.
        row: From `rows_of`.
    """
    found = [f"{row['done']} of {row['runs']} planned runs are done"] if row["done"] < row["runs"] else []
    found += ["run without the network that the preset needs"] if row["lacks_network"] else []
    tracked = _of(row, "tracked_of_all_percent", "least")
    if tracked is not None and tracked < _MIN_TRACKED_PERCENT:
        late = _of(row, "dropped_percent", "most")
        found.append(f"{tracked:.1f} % of the frames tracked" + (f", {late:.1f} % dropped" if late else ""))
    without = sum(row["unevaluated"].values())
    if without and row["ate_rmse_m"] is not None:
        found.append(f"{without} of {row['done']} runs have no ATE")
    clip, frames = clip_of(suite, row["sequence"]), _of(row, "frames", "least")
    if clip is not None and clip.recording and clip.whole and frames is not None:
        found += _of_a_part(clip.recording, frames, _of(row, "images", "least") or frames)
        found += _without_truth(clip.recording, row)
    return found


def length_is_known(recording: str) -> bool:
    """Whether it is known how many frames the whole recording has."""
    return _length(recording) is not None


def rank_among(value: float, others: Iterable[Figure]) -> int:
    """Rank of a figure of which smaller is better: 1 if none of the others is smaller."""
    return 1 + sum(other.value < value for other in others)


def verdict_on(row: Mapping[str, Any], metric: PublishedMetric, published: float, reasons: Sequence[str]) -> str:
    """Compare the runs of a row with a published figure: one of `VERDICTS`, or `NO_VERDICT`.

    Args:
        row: From `rows_of`.
        metric: Figure to compare.
        published: The figure of others.
        reasons: From `reservations`; with one there is no verdict.
    """
    spread, says_nothing = row[metric.of_ours], metric.name == "RPE" and any("RPE" in note for note in row["notes"])
    if spread is None or reasons or metric.depends_on_machine or says_nothing:
        return NO_VERDICT
    return verdict(spread["least"], spread["most"], published)


def counted(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> tuple[Counter[str], Counter[str]]:
    """Verdicts on the ATE of rows: against the best published figure of each sequence, and against every system."""
    best: Counter[str] = Counter()
    every: Counter[str] = Counter()
    for row in rows:
        systems = best_of_systems(published_of(suite, row["sequence"]))
        reasons = reservations(suite, row)
        verdicts = [verdict_on(row, ATE, figure.value, reasons) for figure in systems]
        best.update(verdicts[:1])
        every.update(verdicts)
    return best, every


def kitti_means(suite: Suite, rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Published means over the eleven sequences of KITTI odometry, and ours where all are whole; headings first.

    Returns:
        Lines of as many texts; none for a suite that does not have all of them.
    """
    if not {clip.recording for clip in suite.sequences if clip.whole} >= set(_KITTI):
        return []
    of_kitti = [row for row in rows if (clip := clip_of(suite, row["sequence"])) and clip.recording in _KITTI]
    if not of_kitti:
        return []
    labels = list(dict.fromkeys(row["label"] for row in of_kitti))
    lines = [["mean over KITTI 00 to 10", "of", "published", *labels, *(f"{label} is" for label in labels)]]
    for paper in load_published():
        for name, value in paper.overall:
            if (metric := _KITTI_MEANS.get(name)) is not None:
                ours = [_mean(suite, of_kitti, label, metric.figure) for label in labels]
                texts = ["-" if mean is None else f"{mean['median']:.4g}" for mean in ours]
                found = [NO_VERDICT if mean is None else verdict(mean["least"], mean["most"], value) for mean in ours]
                lines.append([f"{metric.name}, {metric.unit}", paper.name, f"{value:g}", *texts, *found])
    return lines


def _mean(suite: Suite, rows: Sequence[Mapping[str, Any]], label: str, figure: str) -> dict[str, float] | None:
    """Means over all sequences of what the runs of each have; `None` unless each is there, and without reservation."""
    of_it = {
        clip.recording: row[figure]
        for row in rows
        if row["label"] == label and row[figure] is not None and not reservations(suite, row)
        if (clip := clip_of(suite, row["sequence"])) is not None
    }
    if set(of_it) != set(_KITTI):
        return None
    return {name: sum(spread[name] for spread in of_it.values()) / len(of_it) for name in ("median", "least", "most")}


def _of_a_part(recording: str, frames: float, images: float) -> list[str]:
    length = _length(recording)
    if length is None:
        return []
    if images < _ALL_IMAGES * length:
        return [f"a part of the recording: {images:.0f} of {length} images"]
    return [f"{frames:.0f} frames of {length} images"] if frames < _MIN_WITH_DEPTH * length else []


def _without_truth(recording: str, row: Mapping[str, Any]) -> list[str]:
    matched, covered = _of(row, "matched_percent", "least"), _of(row, "span_percent", "least")
    if row["ate_rmse_m"] is None or matched is None:
        return []
    if matched < _MIN_MATCHED_PERCENT:
        return [f"{matched:.1f} % of the frames matched with ground truth"]
    if not length_is_known(recording) and covered is not None and covered < _MIN_COVERED_PERCENT:
        return [f"the published length is not known, and frames cover {covered:.1f} % of the time of the ground truth"]
    return []


def _length(recording: str) -> int | None:
    return _lengths().get(recording)


@functools.cache
def _lengths() -> dict[str, int | None]:
    return {name: recording.frames for name, recording in known_recordings().items()}


def _of(row: Mapping[str, Any], figure: str, which: str) -> float | None:
    spread = row.get(figure)
    return None if spread is None else spread[which]
