"""Baselines of suites in files: figures to compare with, and the plan of the runs that gave them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from jaxslam.benchmark.suites.aggregate import row_name
from jaxslam.benchmark.suites.plan import plan_differences
from jaxslam.config.validation import Range, ValidatedConfig, from_mapping
from jaxslam.errors import BenchmarkError, JaxSlamError
from jaxslam.io.atomic_files import write_atomically

ATE = "ate_rmse_m"
"""Name of the figure that every row must have."""
_AGAIN = "--of SUITE --update REASON makes a new one"


@dataclass(frozen=True)
class Baseline(ValidatedConfig):
    """Figures of a suite that later runs are compared with.

    Attributes:
        suite: Name of the suite, or its file.
        presets: Presets that the suite was run with.
        runs: Number of runs of each sequence and preset.
        reason: Reason why these are the figures to compare with.
        machine: Machine that the figures were measured on.
        versions: Versions of the libraries that computed the figures.
        noise: Standard deviation of the errors of a row over seeds, as a share of their mean, by row.
        rows: Figures by name within each row; a row is a sequence and a label.
        plan: Sequences, presets and runs, from `jaxslam.benchmark.suites.plan.fingerprint`.

    Raises:
        BenchmarkError: If a field has the wrong type, there are no rows, a figure is not finite, a row has no ATE, or
            the rows are not those of the plan.
    """

    _error: ClassVar[type[JaxSlamError]] = BenchmarkError

    suite: str
    presets: tuple[str, ...]
    runs: int
    reason: str
    machine: str
    versions: str
    noise: Mapping[str, Annotated[float, Range(at_least=0)]]
    rows: Mapping[str, Mapping[str, float]]
    plan: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rows:
            raise BenchmarkError("rows: expected figures of at least one sequence, got none")
        for row, figures in self.rows.items():
            if ATE not in figures:
                raise BenchmarkError(f"rows: {row}: expected {ATE}, got none: without ground truth nothing is compared")
        if not {"sequences", "presets", "runs"} <= self.plan.keys():
            raise BenchmarkError(f"plan: expected what was run, got {sorted(self.plan) or 'none'}; {_AGAIN}")
        self._check_plan()

    def _check_plan(self) -> None:
        planned = {row_name(sequence, label) for sequence in self.plan["sequences"] for label in self.plan["presets"]}
        for row in sorted(planned ^ set(self.rows)):
            where = "planned, and not in rows" if row in planned else "in rows, and not planned"
            raise BenchmarkError(f"rows: expected those of the plan; {row} is {where}")
        if set(self.noise) != set(self.rows):
            raise BenchmarkError(f"noise: expected a share for each row, got {sorted(self.noise)}; {_AGAIN}")


def load_baseline(path: Path) -> Baseline:
    """Read a baseline.

    Raises:
        BenchmarkError: If the file is missing, is no baseline, or is one that nothing can be compared with.
    """
    return read_baseline(Baseline, path, "bench gate --update")


_Record = TypeVar("_Record", bound=ValidatedConfig)


def read_baseline(cls: type[_Record], path: Path, written_by: str) -> _Record:
    """Read a baseline of either kind.

    Args:
        cls: Class of the baseline.
        path: JSON file of the baseline.
        written_by: Command that writes such files.

    Raises:
        BenchmarkError: If the file is missing, is no baseline, or is one that nothing can be compared with.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as problem:
        raise BenchmarkError(f"{path}: expected a baseline, cannot be read: {problem.strerror}") from None
    except ValueError as problem:
        raise BenchmarkError(f"{path}: expected a baseline as `{written_by}` writes it, got {problem!r}") from None
    return from_mapping(cls, content, str(path))


def save_baseline(path: Path, baseline: Baseline) -> None:
    """Write a baseline.

    Raises:
        BenchmarkError: If the file cannot be written.
    """
    plain = {key: dict(value) if isinstance(value, Mapping) else value for key, value in vars(baseline).items()}
    write_atomically(path, (json.dumps(plain, indent=1) + "\n").encode(), BenchmarkError)


def check_same_plan(baseline: Baseline, plan: Mapping[str, Any]) -> None:
    """Refuse a plan that differs from the plan of a baseline.

    Args:
        baseline: Baseline to compare with.
        plan: Sequences, presets and runs, from `jaxslam.benchmark.suites.plan.fingerprint`.

    Raises:
        BenchmarkError: If the plans differ; the message names the differences.
    """
    different = plan_differences(baseline.plan, plan)
    if different:
        raise BenchmarkError(f"expected the runs of the baseline; {'; '.join(different)}; {_AGAIN}")
