"""`jaxslam bench gate`: whether a suite has become worse than its baseline."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.benchmark.gate import complaints, differences, load_baseline, make_baseline, runs_at_once, save_baseline
from jaxslam.commands.bench import RunsOfSuite
from jaxslam.commands.console import console
from jaxslam.errors import BenchmarkError

_MOST_AGAIN = 2
_OUT = Path("results") / "bench" / "gate"


@dataclass(frozen=True)
class Gate(RunsOfSuite):
    """Run the suite of a baseline, and fail if errors, coverage or times have become worse."""

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
        before = load_baseline(self.baseline) if self.baseline.exists() or self.update is None else None
        suite = self.of or (None if before is None else before.suite)
        if suite is None:
            raise BenchmarkError(f"{self.baseline}: not there yet; --of SUITE says of what to make it")
        presets, runs = (self.presets, self.runs) if before is None else (before.presets, before.runs)
        out = self.out or _OUT
        options = replace(self, presets=self.presets or presets, runs=self.runs or runs, out=out)
        if before is not None and self.update is None and self.runs_here and self.workers is None:
            options = replace(options, workers=runs_at_once(before))
        results = options.results(suite)
        if self.update is not None:
            ran = tuple(dict.fromkeys(result["preset"] for result in results))
            repeats = 1 + max((result["seed"] for result in results), default=0)
            save_baseline(self.baseline, make_baseline(suite, ran, repeats, self.update, results))
            console.print(f"Baseline: {self.baseline}")
            return
        assert before is not None
        other = differences(before, results)
        if other:
            console.print(
                f"Here: {other}. Errors may differ as those of seeds do; times of other machines are left out."
            )
        worse = complaints(before, results)
        for again in range(1, 1 + _MOST_AGAIN):
            slow = sorted({complaint.row for complaint in worse if complaint.of_time})
            if not slow:
                break
            console.print(f"Slower, and measured again: {'; '.join(slow)}", highlight=False)
            results += replace(options, out=out / f"again-{again}").results(suite, slow)
            worse = complaints(before, results)
        for complaint in worse:
            console.print(f"worse: {complaint}", highlight=False)
        if worse:
            raise BenchmarkError(f"{len(worse)} figures are worse than in {self.baseline} ({before.reason})")
        console.print(f"Nothing is worse than in {self.baseline}.")
