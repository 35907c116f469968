"""`jaxslam bench gate`: whether a suite has become worse than its baseline."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.benchmark.suites.baseline import Baseline, check_same_plan, load_baseline, save_baseline
from jaxslam.benchmark.suites.collected_results import as_table
from jaxslam.benchmark.suites.gate import check_reason, complaints, differences, make_baseline, runs_at_once
from jaxslam.benchmark.suites.plan import fingerprint
from jaxslam.cli.bench import RunsOfSuite
from jaxslam.cli.console import plain_console, print_json
from jaxslam.errors import BenchmarkError

_MAX_AGAIN = 2
_OUT = Path("results") / "bench" / "gate"


@dataclass(frozen=True)
class Gate(RunsOfSuite):
    """Options of `jaxslam bench gate`."""

    baseline: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """What to keep to."""
    update: str | None = None
    """Make the figures of now those to keep to, for this reason."""
    of: str | None = None
    """The suite, where there is no baseline yet."""

    def main(self) -> None:
        """Run the command."""
        if self.baseline is None:
            raise BenchmarkError("bench gate: expected --baseline FILE")
        before = self.before(self.baseline)
        suite = self.of or (None if before is None else before.suite)
        if suite is None:
            raise BenchmarkError(f"{self.baseline}: not there yet; --of SUITE says of what to make it")
        presets, runs = (self.presets, self.runs) if before is None else (before.presets, before.runs)
        out = self.out or _OUT
        options = replace(self, presets=self.presets or presets, runs=runs if self.runs is None else self.runs, out=out)
        if before is not None and self.update is None and self.runs_here and self.workers is None:
            options = replace(options, workers=runs_at_once(before))
        planned = fingerprint(options.plan(suite).jobs)
        if self.update is not None:
            self._update(self.baseline, self.update, options, suite, planned)
            return
        assert before is not None
        _check(self.baseline, before, planned)
        results = options.results(suite)
        other = differences(before, results)
        if other:
            plain_console.print(
                f"Here: {other}. Errors may differ as those of seeds do; times of other machines are left out."
            )
        worse = complaints(before, results)
        for again in range(1, 1 + _MAX_AGAIN):
            slow = sorted({complaint.row for complaint in worse if complaint.of_time})
            if not slow:
                break
            plain_console.print(f"Slower, and measured again: {'; '.join(slow)}")
            results += replace(options, out=out / f"again-{again}").results(suite, slow)
            worse = complaints(before, results)
        for complaint in worse:
            plain_console.print(f"worse: {complaint}")
        if self.json:
            complained = [asdict(complaint) | {"text": str(complaint)} for complaint in worse]
            print_json({"results": as_table(results), "here": other, "worse": complained})
        if worse:
            raise BenchmarkError(f"{len(worse)} figures are worse than in {self.baseline} ({before.reason})")
        plain_console.print(f"Nothing is worse than in {self.baseline}.")

    def before(self, path: Path) -> Baseline | None:
        """The baseline that is there; `None` if a new one of a named suite takes the place of none, or of a bad one.

        Raises:
            BenchmarkError: If it is missing or damaged, and is not replaced.
        """
        if self.update is not None and not path.exists():
            return None
        try:
            return load_baseline(path)
        except BenchmarkError:
            if self.update is None or self.of is None:
                raise
            return None

    @staticmethod
    def _update(path: Path, reason: str, options: "Gate", suite: str, planned: Mapping[str, Any]) -> None:
        check_reason(reason)
        results = options.results(suite)
        presets = tuple(dict.fromkeys(of_label["preset"] for of_label in planned["presets"].values()))
        save_baseline(path, make_baseline(suite, presets, planned["runs"], reason, results, planned))
        plain_console.print(f"Baseline: {path}")
        if options.json:
            print_json(json.loads(path.read_text(encoding="utf-8")))


def _check(path: Path, before: Baseline, planned: Mapping[str, Any]) -> None:
    try:
        check_same_plan(before, planned)
    except BenchmarkError as problem:
        raise BenchmarkError(f"{path}: {problem}") from None
