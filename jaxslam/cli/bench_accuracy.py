"""`jaxslam bench accuracy`: check whether tracking has become less accurate than the frozen baseline."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxslam.cli.bench import RunsOfSuite
from jaxslam.cli.console import plain_console, print_json
from jaxslam.errors import BenchmarkError

if TYPE_CHECKING:
    from jaxslam.benchmark.suites.accuracy_ruler import AccuracyBaseline

_SUITE = "accuracy"
_OUT = Path("results") / "bench" / _SUITE
_MAX_WORKERS = 2

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class AccuracyRuler(RunsOfSuite):
    """Options of `jaxslam bench accuracy`."""

    baseline: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Baseline file to compare with. By default, the baseline that comes with jaxslam and was measured on this CPU, or
    else the first one."""
    suite: str = _SUITE
    """Suite to run. A suite file of your own can add recordings."""
    results_from: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder with finished results of the suite, such as those of another commit, to read instead of running it."""
    update: str | None = None
    """Write what was measured to --baseline instead of comparing, and store this reason in it."""
    commit: str | None = None
    """Commit that was measured, for --update, if the results do not name it."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.benchmark.suites.accuracy_ruler import (  # noqa: PLC0415
            compare_accuracy,
            load_accuracy_baseline,
            measured,
            save_accuracy_baseline,
        )
        from jaxslam.benchmark.suites.gate import check_reason  # noqa: PLC0415
        from jaxslam.benchmark.suites.plan import fingerprint  # noqa: PLC0415
        from jaxslam.cli.accuracy_report import default_baseline, figures, print_and_write  # noqa: PLC0415

        if self.update is not None:
            check_reason(self.update)
            if self.baseline is None:
                raise BenchmarkError("bench accuracy: --update: expected --baseline FILE to write to")
        file = self.baseline or default_baseline(_SUITE)
        baseline = None if self.update is not None else load_accuracy_baseline(file)
        sequences = fingerprint(self.plan(self.suite).jobs)["sequences"]
        results, out = self._measured()
        now = measured(results, out)
        if baseline is None:
            save_accuracy_baseline(file, self._made(results, sequences, now))
            plain_console.print(f"Baseline: {file}")
            if self.json:
                print_json(json.loads(file.read_text(encoding="utf-8")))
            return
        reading = compare_accuracy(now, sequences, baseline)
        print_and_write(reading, baseline, results, file, out)
        if self.json:
            print_json(figures(reading))
        if reading.worse:
            raise BenchmarkError(f"less accurate than {baseline.commit}: {'; '.join(reading.worse)}")

    def _measured(self) -> tuple[Sequence[Mapping[str, Any]], Path]:
        """Run the suite or read its results, and return them with the folder they are in."""
        from jaxslam.benchmark.suites.collected_results import read_results  # noqa: PLC0415
        from jaxslam.runtime.threads import usable_cores  # noqa: PLC0415

        if self.results_from is not None:
            results = read_results(self.results_from)
            if not results:
                raise BenchmarkError(f"--results-from: expected a folder with results, got '{self.results_from}'")
            return results, self.results_from
        out = self.out or _OUT
        workers = self.workers or min(_MAX_WORKERS, usable_cores())
        return replace(self, out=out, workers=workers if self.runs_here else None).results(self.suite), out

    def _made(
        self, results: Sequence[Mapping[str, Any]], sequences: Mapping[str, Any], now: Mapping[str, Any]
    ) -> "AccuracyBaseline":
        """Make a baseline of what was measured."""
        from jaxslam.benchmark.machine_names import machine_of, versions_of  # noqa: PLC0415
        from jaxslam.benchmark.suites.accuracy_ruler import AccuracyBaseline  # noqa: PLC0415

        commits = {self.commit or result["commit"] for result in results}
        if len(commits) != 1 or None in commits:
            raise BenchmarkError(f"--commit: expected the one commit measured, got {sorted(map(str, commits))}")
        labels = sorted({result["label"] for result in results})
        if len(labels) != 1:
            raise BenchmarkError(f"bench accuracy: expected runs of one preset, got {labels}")
        return AccuracyBaseline(
            commit=str(commits.pop()),
            reason=self.update or "",
            machine=machine_of(results),
            versions=versions_of(results),
            preset=labels[0],
            sequences={name: sequences[name] for name in now},
            recordings=now,
        )
