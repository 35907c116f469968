"""Protocols: how a paper makes its table of the runs of a sequence. They are YAML files in `configs/benchmarks`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from jaxslam.benchmark.suites.aggregate import FEWEST_TO_TRIM, Column, Statistic, column_of
from jaxslam.benchmark.suites.published import load_published
from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import BenchmarkError, JaxSlamError, nearest
from jaxslam.io.yaml_files import read_mapping

NOT_PUBLISHED = "-"
"""Stands for a figure that a paper does not have."""


@dataclass(frozen=True)
class PaperTable(ValidatedConfig):
    """A table of a paper that is not about single sequences: figures of the paper above ours.

    Attributes:
        title: Number of the table in the paper, and what it shows.
        paper: Name of the system whose paper it is from.
        columns: Names of our figures, in the order of the columns.
        published: Rows of the paper by the name of a system: for each column the name of a figure in the paper's
            `overall` figures, or `-`.

    Raises:
        BenchmarkError: If a field has the wrong type, or a paper or a figure is unknown.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    title: str
    paper: str
    columns: tuple[str, ...]
    published: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        papers = {paper.name: dict(paper.overall) for paper in load_published()}
        if self.paper not in papers:
            raise BenchmarkError(f"paper: unknown paper '{self.paper}'{nearest(self.paper, papers)}")
        overall = papers[self.paper]
        for system, names in self.published.items():
            if len(names) != len(self.columns):
                raise BenchmarkError(f"published: {system}: expected {len(self.columns)} figures, got {len(names)}")
            for name in names:
                if name != NOT_PUBLISHED and name not in overall:
                    raise BenchmarkError(f"published: {system}: unknown figure '{name}'{nearest(name, overall)}")

    def published_rows(self) -> dict[str, list[str]]:
        """Return the figures of the paper by the name of a system."""
        overall = dict(next(paper.overall for paper in load_published() if paper.name == self.paper))
        return {
            system: [name if name == NOT_PUBLISHED else f"{overall[name]:.10g}" for name in names]
            for system, names in self.published.items()
        }


@dataclass(frozen=True)
class Protocol(ValidatedConfig):
    """Number of runs of a sequence, statistic over them, and figures of a table.

    Attributes:
        about: Description in one line, with the table of the paper.
        columns: Names of the figures, in the order of the columns.
        statistic: What is taken of the runs of a sequence: `median`, `mean`, or `trimmed_mean`, the mean without the
            smallest and the largest, for which three runs are needed.
        runs: Number of runs of each sequence; `None` if the paper does not state it: the number that the suite gives.
        variants: Settings by name, as in `Suite`: the ways in which the paper has every sequence processed.
        tables: Tables of the paper of times or sizes.

    Raises:
        BenchmarkError: If a field has the wrong type, or a figure is unknown.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    about: str
    columns: tuple[str, ...]
    statistic: Literal["median", "mean", "trimmed_mean"] = "median"
    runs: Annotated[int, Range(at_least=1)] | None = None
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    tables: tuple[PaperTable, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.columns:
            raise BenchmarkError("columns: expected at least one figure")
        if self.statistic == "trimmed_mean" and self.runs is not None and self.runs < FEWEST_TO_TRIM:
            raise BenchmarkError(f"runs: expected {FEWEST_TO_TRIM} or more for a trimmed_mean, got {self.runs}")
        for figures in (self.columns, *(table.columns for table in self.tables)):
            self.shown(figures)

    def shown(self, figures: Sequence[str] | None = None) -> list[Column]:
        """Return the columns of its table, or of those figures."""
        statistic: Statistic = self.statistic
        return [column_of(figure, statistic) for figure in (self.columns if figures is None else figures)]


def protocols() -> dict[str, Path]:
    """Find the protocols that come with jaxslam: files by name."""
    return {path.stem: path for path in sorted((configs_dir() / "benchmarks" / "protocols").glob("*.yaml"))}


def load_protocol(given: object, place: str) -> Protocol:
    """Load a protocol.

    Args:
        given: Name in `protocols()`, or a mapping with the fields of one.
        place: File and key that hold it, for errors.

    Raises:
        BenchmarkError: If there is no such protocol, or it is malformed.
    """
    if not isinstance(given, str):
        return from_mapping(Protocol, given, place)
    known = protocols()
    if given not in known:
        raise BenchmarkError(f"{place}: unknown protocol '{given}'{nearest(given, known)}")
    return from_mapping(Protocol, read_mapping(known[given], BenchmarkError), str(known[given]))
