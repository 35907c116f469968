"""`jaxslam bench gate`: check whether a suite has become worse than its baseline."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxslam.cli.bench import RunsOfSuite
from jaxslam.cli.console import plain_console, print_json
from jaxslam.errors import BenchmarkError

if TYPE_CHECKING:
    from jaxslam.benchmark.suites.baseline import Baseline
    from jaxslam.benchmark.suites.gate import Complaint

_MAX_REPEATS = 2
_OUT = Path("results") / "bench" / "gate"

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Gate(RunsOfSuite):
    """Options of `jaxslam bench gate`."""

    baseline: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Baseline file to compare with."""
    update: str | None = None
    """Replace the baseline by the figures measured now, and store this reason in it."""
    of: str | None = None
    """Suite to run if the baseline does not exist yet."""
    errors_only: bool = False
    """Leave times out of the new baseline, so that later runs are not compared by them."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.benchmark.suites.gate import runs_at_once  # noqa: PLC0415
        from jaxslam.benchmark.suites.plan import fingerprint  # noqa: PLC0415

        if self.baseline is None:
            raise BenchmarkError("bench gate: expected --baseline FILE")
        if self.errors_only and self.update is None:
            raise BenchmarkError("bench gate: --errors-only expected --update REASON, got none")
        before = self.before(self.baseline)
        suite = self.of or (None if before is None else before.suite)
        if suite is None:
            raise BenchmarkError(f"{self.baseline}: does not exist yet; --of SUITE names the suite to make it from")
        presets, runs = (self.presets, self.runs) if before is None else (before.presets, before.runs)
        out = self.out or _OUT
        options = replace(self, presets=self.presets or presets, runs=runs if self.runs is None else self.runs, out=out)
        if before is not None and self.update is None and self.runs_here and self.workers is None:
            options = replace(options, workers=runs_at_once(before))
        planned = fingerprint(options.plan(suite).jobs)
        if self.update is not None:
            _write_baseline(self.baseline, self.update, options, suite, planned)
            return
        assert before is not None
        _check_plan(self.baseline, before, planned)
        _compare(self.baseline, before, options, suite, out)

    def before(self, path: Path) -> "Baseline | None":
        """Read the baseline to compare with.

        Returns:
            The baseline; `None` if there is none, or a damaged one, and a new one replaces it.

        Raises:
            BenchmarkError: If it is missing or damaged and is not going to be replaced.
        """
        from jaxslam.benchmark.suites.baseline import load_baseline  # noqa: PLC0415

        if self.update is not None and not path.exists():
            return None
        try:
            return load_baseline(path)
        except BenchmarkError:
            if self.update is None or self.of is None:
                raise
            return None


def _compare(path: Path, before: "Baseline", options: Gate, suite: str, out: Path) -> None:
    """Run the suite, print what is worse than the baseline, and fail if anything is."""
    from jaxslam.benchmark.suites.collected_results import as_table  # noqa: PLC0415
    from jaxslam.benchmark.suites.gate import differences  # noqa: PLC0415

    results = options.results(suite)
    other = differences(before, results)
    if other:
        plain_console.print(
            f"Here: {other}. Errors may differ as they do between seeds; times of another machine are not compared."
        )
    worse = _complaints_after_repeats(before, options, suite, out, results)
    for complaint in worse:
        plain_console.print(f"worse: {complaint}")
    if options.json:
        complained = [asdict(complaint) | {"text": str(complaint)} for complaint in worse]
        print_json({"results": as_table(results), "here": other, "worse": complained})
    if worse:
        raise BenchmarkError(f"{len(worse)} figures are worse than in {path} ({before.reason})")
    plain_console.print(f"Nothing is worse than in {path}.")


def _complaints_after_repeats(
    before: "Baseline", options: Gate, suite: str, out: Path, results: list[dict[str, Any]]
) -> "list[Complaint]":
    """List the complaints that remain after rows that were slow have been measured again.

    Args:
        before: Baseline to compare with.
        options: Options of the runs.
        suite: Name of the suite.
        out: Folder of the results; repeated runs go below it.
        results: Results of all runs; the repeated runs are appended.
    """
    from jaxslam.benchmark.suites.gate import complaints  # noqa: PLC0415

    worse = complaints(before, results)
    for repeat in range(1, 1 + _MAX_REPEATS):
        slow = sorted({complaint.row for complaint in worse if complaint.of_time})
        if not slow:
            break
        plain_console.print(f"Slower, and measured again: {'; '.join(slow)}")
        results += replace(options, out=out / f"again-{repeat}").results(suite, slow)
        worse = complaints(before, results)
    return worse


def _write_baseline(path: Path, reason: str, options: Gate, suite: str, planned: Mapping[str, Any]) -> None:
    """Run the suite, with enough seeds to tell the spread of its errors, and write its figures as the new baseline."""
    from jaxslam.benchmark.suites.baseline import save_baseline  # noqa: PLC0415
    from jaxslam.benchmark.suites.gate import SEEDS_OF_NOISE, check_reason, make_baseline  # noqa: PLC0415

    check_reason(reason)
    results = replace(options, runs=max(planned["runs"], SEEDS_OF_NOISE)).results(suite)
    presets = tuple(dict.fromkeys(label["preset"] for label in planned["presets"].values()))
    runs, errors_only = planned["runs"], options.errors_only
    baseline = make_baseline(suite, presets, runs, reason, results, planned, errors_only=errors_only)
    save_baseline(path, baseline)
    plain_console.print(f"Baseline: {path}")
    if options.json:
        print_json(json.loads(path.read_text(encoding="utf-8")))


def _check_plan(path: Path, before: "Baseline", planned: Mapping[str, Any]) -> None:
    """Raise an error that names the baseline file if other runs are planned than it has."""
    from jaxslam.benchmark.suites.baseline import check_same_plan  # noqa: PLC0415

    try:
        check_same_plan(before, planned)
    except BenchmarkError as problem:
        raise BenchmarkError(f"{path}: {problem}") from None
