"""What a suite once showed, in a file: figures to keep to, and the plan of the runs that gave them."""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxslam.benchmark.suites.aggregate import row_name
from jaxslam.benchmark.suites.plan import plan_differences
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import write_atomically

ATE = "ate_rmse_m"
"""The figure that every row must have."""
_AGAIN = "--of SUITE --update REASON makes a new one"


@dataclass(frozen=True)
class Baseline:
    """What a suite once showed.

    Attributes:
        suite: Name of the suite, or its file.
        presets: With what it was run.
        runs: How often each.
        reason: Why these figures are the ones to keep to.
        machine: On which they were measured.
        versions: Of the libraries that computed them.
        noise: By label, the standard deviation of errors over seeds, as a share of them; none where there was one run.
        rows: Figures by sequence and label.
        plan: What was run, from `jaxslam.benchmark.suites.plan.fingerprint`.

    Raises:
        BenchmarkError: If there are no rows, or one has a figure that is not finite, or no ATE.
    """

    suite: str
    presets: tuple[str, ...]
    runs: int
    reason: str
    machine: str
    versions: str
    noise: Mapping[str, float]
    rows: Mapping[str, Mapping[str, float]]
    plan: Mapping[str, Any]

    def __post_init__(self) -> None:
        if not self.rows:
            raise BenchmarkError("rows: expected figures of at least one sequence, got none")
        for row, figures in self.rows.items():
            if ATE not in figures:
                raise BenchmarkError(f"rows: {row}: expected {ATE}, got none: without ground truth nothing is compared")
            for figure, value in figures.items():
                if not math.isfinite(value):
                    raise BenchmarkError(f"rows: {row}: {figure}: expected a finite number, got {value}")
        for label, share in self.noise.items():
            if not math.isfinite(share) or share < 0:
                raise BenchmarkError(f"noise: {label}: expected a finite number >= 0, got {share}")
        self._check_plan()

    def _check_plan(self) -> None:
        planned = {row_name(sequence, label) for sequence in self.plan["sequences"] for label in self.plan["presets"]}
        for row in sorted(planned ^ set(self.rows)):
            where = "planned, and not in rows" if row in planned else "in rows, and not planned"
            raise BenchmarkError(f"rows: expected those of the plan; {row} is {where}")


def load_baseline(path: Path) -> Baseline:
    """The baseline in a file.

    Raises:
        BenchmarkError: If it is missing, no baseline, or one that nothing can be held to.
    """
    with reading_baseline(path, "bench gate --update"):
        content = json.loads(path.read_text())
        presets = tuple(str(preset) for preset in content["presets"])
        rows = {str(row): {str(k): float(v) for k, v in figures.items()} for row, figures in content["rows"].items()}
        suite, reason, machine, versions = (str(content[key]) for key in ("suite", "reason", "machine", "versions"))
        noise = {str(label): float(share) for label, share in content["noise"].items()}
        return Baseline(suite, presets, int(content["runs"]), reason, machine, versions, noise, rows, _plan_of(content))


@contextmanager
def reading_baseline(path: Path, written_by: str) -> Iterator[None]:
    """Turn what goes wrong while a baseline is read into errors that name the file.

    Args:
        path: The file.
        written_by: Command that writes such files.

    Raises:
        BenchmarkError: If the file is missing, is no baseline, or one that nothing can be compared with.
    """
    try:
        yield
    except OSError as problem:
        raise BenchmarkError(f"{path}: expected a baseline, cannot be read: {problem.strerror}") from None
    except BenchmarkError as problem:
        raise BenchmarkError(f"{path}: {problem}") from None
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        raise BenchmarkError(f"{path}: expected a baseline as `{written_by}` writes it, got {problem!r}") from None


def _plan_of(content: Mapping[str, Any]) -> dict[str, Any]:
    if "plan" not in content:
        raise BenchmarkError(f"plan: expected what was run, got a baseline that does not say it; {_AGAIN}")
    return {key: content["plan"][key] for key in ("sequences", "presets", "runs")}


def save_baseline(path: Path, baseline: Baseline) -> None:
    """Write a baseline.

    Raises:
        BenchmarkError: If it cannot be written.
    """
    plain = {key: dict(value) if isinstance(value, Mapping) else value for key, value in vars(baseline).items()}
    write_atomically(path, (json.dumps(plain, indent=1) + "\n").encode(), BenchmarkError)


def check_same_plan(baseline: Baseline, plan: Mapping[str, Any]) -> None:
    """See whether what is going to be run is what a baseline is of.

    Args:
        baseline: The figures to keep to.
        plan: From `jaxslam.benchmark.suites.plan.fingerprint`.

    Raises:
        BenchmarkError: If not; it names the differences.
    """
    different = plan_differences(baseline.plan, plan)
    if different:
        raise BenchmarkError(f"expected the runs of the baseline; {'; '.join(different)}; {_AGAIN}")
