"""Protocols: how a paper makes its table of the runs of a sequence. They are YAML files in `configs/benchmarks`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from jaxslam.benchmark.suites.aggregate import FEWEST_TO_TRIM, Column, Statistic, column_of
from jaxslam.config.loading import configs_dir
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import BenchmarkError, JaxSlamError, nearest
from jaxslam.io.yaml_files import read_mapping


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

    Raises:
        BenchmarkError: If a field has the wrong type, or a figure is unknown.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    about: str
    columns: tuple[str, ...]
    statistic: Literal["median", "mean", "trimmed_mean"] = "median"
    runs: Annotated[int, Range(at_least=1)] | None = None
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.columns:
            raise BenchmarkError("columns: expected at least one figure")
        if self.statistic == "trimmed_mean" and self.runs is not None and self.runs < FEWEST_TO_TRIM:
            raise BenchmarkError(f"runs: expected {FEWEST_TO_TRIM} or more for a trimmed_mean, got {self.runs}")
        self.shown()

    def shown(self) -> list[Column]:
        """Return the columns of its table."""
        statistic: Statistic = self.statistic
        return [column_of(figure, statistic) for figure in self.columns]


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
