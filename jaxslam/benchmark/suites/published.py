"""Published figures, with what is known of how they came about: the data files of `configs/benchmarks/published`.

A file holds one paper's tables: figures of its own system, of variants of it, and those it reports of other systems.
`best.yaml` collects the best figure of each sequence, from papers without a file of their own too.
"""

import dataclasses
import functools
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_args

from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Range, ValidatedConfig, checked_value, field_hints, from_mapping
from jaxslam.errors import ConfigError, nearest
from jaxslam.io.yaml_files import check_keys, checked_mapping, read_mapping

Metric: TypeAlias = Literal[
    "ate_rmse_m",
    "ate_mean_m",
    "ate_median_m",
    "ate_std_m",
    "rpe_trans_m_per_s",
    "rpe_rot_deg_per_s",
    "kitti_trans_percent",
    "kitti_rot_deg_per_100m",
    "frame_ms",
]
"""Of one sequence; smaller is better. The names are those of `Evaluation`, and the mean time of a frame."""
Sensor: TypeAlias = Literal["rgbd", "stereo", "mono"]
Alignment: TypeAlias = Literal["se3", "sim3"]
Verdict: TypeAlias = Literal["better", "in range", "worse"]

_COLLECTION = "Collection of best figures"
_POSITIVE = Annotated[float, Range(above=0)]
_SEQUENCE = re.compile(r"rgbd_dataset_freiburg[123]_[a-z0-9_]+|rgbd_bonn_[a-z0-9_]+|kitti_\d\d")


@dataclass(frozen=True)
class Figure(ValidatedConfig):
    """One published number.

    Attributes:
        system: Name of the system.
        sequence: Name of the recording's folder, `kitti_NN` for KITTI odometry.
        metric: Name of the figure; it contains the unit.
        value: The number.
        sensor: Sensor that the system was run with.
        alignment: Transform fitted before measuring: a rigid motion or, laxer, a similarity.
        alignment_stated: Whether the paper says so; otherwise it is what is usual for the sensor.
        source: The table.
        reported_by: The papers of other systems it is from, with commas between; `None` if from the system's own.
        variant: Part of the system that ran, in an ablation; `None` for the whole system.
        note: A reservation about it; empty if there is none.
    """

    system: str
    sequence: str
    metric: Metric
    value: _POSITIVE
    sensor: Sensor
    alignment: Alignment
    alignment_stated: bool
    source: str
    reported_by: str | None = None
    variant: str | None = None
    note: str = ""


@dataclass(frozen=True)
class _Paper(ValidatedConfig):
    """A paper, without its figures.

    Attributes:
        name: Name of the system.
        title: Title of the paper.
        authors: Family names of the authors.
        venue: Conference or journal.
        year: Year of publication; `None` if the paper does not say.
        link: DOI or web page; `None` if the paper has none.
        sensor: Sensor of the system, unless a table names another.
        alignment: Alignment of trajectories before errors are measured, unless a table names another.
        alignment_stated: Whether the paper states the alignment.
        protocol: Frames and number of runs, as far as the paper states them.
        source: Place of the figures in the paper.
    """

    name: str
    title: str
    authors: str
    venue: str
    year: int | None
    link: str | None
    sensor: Sensor
    alignment: Alignment
    alignment_stated: bool
    protocol: str
    source: str


@dataclass(frozen=True)
class PublishedTable(ValidatedConfig):
    """One table of a data file.

    Attributes:
        source: Table or section of the paper.
        figures: Figures by sequence: `{metric: value}`, or a number where the table has a `metric`.
        system: System that the figures belong to, if it is not the paper's own.
        variant: Part of the system that ran, in an ablation; `None` for the whole system.
        sensor: Sensor; `None` for that of the paper.
        alignment: Alignment; `None` for that of the paper.
        note: Reservation about the figures; empty if there is none.
        metric: Metric of all figures; `None` if each sequence names its metrics.
    """

    source: str
    figures: Mapping[str, Any]
    system: str | None = None
    variant: str | None = None
    sensor: Sensor | None = None
    alignment: Alignment | None = None
    note: str = ""
    metric: Metric | None = None


@dataclass(frozen=True)
class _PaperFile(_Paper):
    """A data file as it is written; `overall` holds figures by name."""

    tables: tuple[PublishedTable, ...]
    overall: Mapping[str, _POSITIVE] = field(default_factory=dict)


@dataclass(frozen=True)
class PublishedSystem(_Paper):
    """A paper and the figures in it.

    Attributes:
        figures: All figures: those of the system, of its variants, and of other systems.
        overall: Name and value of each figure that belongs to no sequence; the name ends with the unit.
    """

    figures: tuple[Figure, ...] = ()
    overall: tuple[tuple[str, _POSITIVE], ...] = ()

    @property
    def own(self) -> tuple[Figure, ...]:
        """Figures of the whole system."""
        return tuple(f for f in self.figures if f.reported_by is None and f.variant is None)

    @property
    def variants(self) -> tuple[Figure, ...]:
        """Figures of its variants: the ablation."""
        return tuple(f for f in self.figures if f.variant is not None)

    @property
    def reported(self) -> tuple[Figure, ...]:
        """Figures of other systems."""
        return tuple(f for f in self.figures if f.reported_by is not None)


@functools.cache
def load_published() -> tuple[PublishedSystem, ...]:
    """Every data file that comes with jaxslam, in the order of file names, the collection of the best ones last.

    Raises:
        ConfigError: If a file is malformed; the message names the file, the key, what was expected and what came.
    """
    papers = map(read_published, sorted((configs_dir() / "benchmarks" / "published").glob("*.yaml")))
    return tuple(sorted(papers, key=lambda paper: paper.name == _COLLECTION))


def read_published(path: Path) -> PublishedSystem:
    """One data file.

    A table of it has a `source` and `figures`, and may have a `system` (another one, whose figures it reports), a
    `variant`, a `sensor`, an `alignment` and a `note`. Figures are `sequence: {metric: value}`, or `sequence: value`
    where the table has a `metric`.

    Raises:
        ConfigError: If it is unreadable, a key is unknown, missing or holds the wrong type, or a figure is not
            positive or stands twice.
    """
    file = from_mapping(_PaperFile, read_mapping(path, ConfigError), str(path))
    figures = tuple(
        figure
        for number, table in enumerate(file.tables)
        for figure in _figures(table, file, f"{path}: tables[{number}]: figures")
    )
    _check_unique(figures, path)
    head = {name: getattr(file, name) for name in field_hints(_Paper)}
    return PublishedSystem(**head, figures=figures, overall=tuple(file.overall.items()))


def published_for(sequence: str, metric: str = "ate_rmse_m", *, variants: bool = False) -> list[Figure]:
    """List the published figures of a recording, from best to worst.

    A system's own paper goes before what others report of it. Without one, the same number from several papers is
    one figure that names them all; different numbers are all there.

    Args:
        sequence: Name of the recording's folder; of one that nobody has figures for, there are none.
        metric: One of `Metric`.
        variants: Include those of ablations.

    Raises:
        ConfigError: If there is no such metric, or a data file is malformed.
    """
    if metric not in get_args(Metric):
        raise ConfigError(f"metric: expected a known one, got '{metric}'{nearest(metric, get_args(Metric))}")
    found = [
        figure
        for paper in load_published()
        for figure in paper.figures
        if (figure.sequence, figure.metric) == (sequence, metric) and (variants or figure.variant is None)
    ]
    own = [figure for figure in found if figure.reported_by is None]
    with_paper = {(figure.system, figure.variant) for figure in own}
    reported = [f for f in found if f.reported_by is not None and (f.system, f.variant) not in with_paper]
    return sorted([*own, *_merged(reported)], key=lambda figure: figure.value)


def verdict(ours_best: float, ours_worst: float, published: float) -> Verdict:
    """Compare our runs with a published figure of which smaller is better.

    Args:
        ours_best: The smallest figure of our runs.
        ours_worst: The largest.
        published: The other's.

    Returns:
        `in range` if the published figure lies within our runs, `better` if all of ours are smaller, `worse` if all are
        larger.

    Raises:
        ConfigError: If a figure is not finite, or the best is larger than the worst.
    """
    if not all(map(math.isfinite, (ours_best, ours_worst, published))) or ours_best > ours_worst:
        raise ConfigError(
            f"verdict: expected finite figures, the best no larger than the worst, got {ours_best} to {ours_worst}"
            f" against {published}"
        )
    if ours_best <= published <= ours_worst:
        return "in range"
    return "better" if ours_worst < published else "worse"


def _figures(table: PublishedTable, file: _Paper, place: str) -> Iterator[Figure]:
    """Make a figure of every number in a table."""
    system = table.system or file.name
    for sequence, row in table.figures.items():
        for metric, value in _checked_row(sequence, row, table.metric, f"{place}: {sequence}").items():
            yield Figure(
                system=system,
                sequence=sequence,
                metric=metric,
                value=value,
                sensor=table.sensor or file.sensor,
                alignment=table.alignment or file.alignment,
                alignment_stated=file.alignment_stated,
                source=table.source,
                reported_by=None if system == file.name else file.name,
                variant=table.variant,
                note=table.note,
            )


def _checked_row(sequence: str, row: object, metric: str | None, place: str) -> dict[Any, float]:
    """Metrics and figures of one sequence; `row` is a lone figure where the table gives the metric."""
    if not _SEQUENCE.fullmatch(sequence):
        raise ConfigError(f"{place}: expected the folder of a recording of TUM or Bonn, or kitti_NN, got '{sequence}'")
    numbers = {metric: row} if metric else checked_mapping(row, place, ConfigError)
    check_keys(numbers, get_args(Metric), (), place, ConfigError)
    return {name: checked_value(_POSITIVE, value, f"{place}: {name}") for name, value in numbers.items()}


def _merged(figures: Iterable[Figure]) -> list[Figure]:
    """One figure for each system and value, by all who report it; the collection speaks where no paper does."""
    groups: dict[tuple[str, str | None, float], list[Figure]] = {}
    for figure in figures:
        groups.setdefault((figure.system, figure.variant, figure.value), []).append(figure)
    return [_joined([f for f in group if f.reported_by != _COLLECTION] or group) for group in groups.values()]


def _joined(group: list[Figure]) -> Figure:
    if len(group) == 1:
        return group[0]
    return dataclasses.replace(
        group[0],
        source="; ".join(f"{figure.source} of {figure.reported_by}" for figure in group),
        reported_by=", ".join(dict.fromkeys(str(figure.reported_by) for figure in group)),
        note=" ".join(filter(None, dict.fromkeys(figure.note for figure in group))),
    )


def _check_unique(figures: Iterable[Figure], path: Path) -> None:
    seen: dict[tuple[str, str | None, str, str], Figure] = {}
    for figure in figures:
        key = (figure.system, figure.variant, figure.sequence, figure.metric)
        if key in seen:
            whose = figure.system + (f" ({figure.variant})" if figure.variant else "")
            raise ConfigError(
                f"{path}: {figure.sequence}: {figure.metric}: expected one figure of {whose}, got {seen[key].value:g}"
                f" of {seen[key].source} and {figure.value:g} of {figure.source}"
            )
        seen[key] = figure
