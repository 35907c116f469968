"""`jaxslam bench`: run a suite of recordings with presets, and write a report."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from jaxslam.benchmark.gate import complaints, load_baseline, make_baseline, save_baseline
from jaxslam.benchmark.job import Job
from jaxslam.benchmark.page import html_report
from jaxslam.benchmark.report import markdown_report
from jaxslam.benchmark.runner import RESULTS, local, missing, plan, run_jobs, swept
from jaxslam.benchmark.suite import checked_presets, load_suite, suites
from jaxslam.config import load_config
from jaxslam.errors import BenchmarkError
from jaxslam.files import write_atomically

_console = Console(soft_wrap=True)
_REPORT, _PAGE = "report.md", "report.html"
_GATE = "gate"


@dataclass(frozen=True)
class Bench:
    """Run a suite: recordings or rendered rooms, presets, several seeds. Without a suite, list those there are.

    `jaxslam bench gate --baseline FILE` runs the suite of a baseline, and fails if it has become worse.
    """

    suite: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE")] = None
    """A known suite, a YAML file, a folder of recordings, or `gate`."""
    root: Path | None = None
    """Folder in which recordings are looked for first."""
    presets: tuple[str, ...] = ()
    """Presets, instead of the suite's."""
    runs: int | None = None
    """How often to run each, instead of as often as the suite says."""
    workers: int = 1
    """Runs at the same time; times are only worth something with 1."""
    resume: bool = False
    """Go on with results that are there."""
    out: Path | None = None
    """Folder for the results; results/bench/SUITE if not given."""
    set: tuple[str, ...] = ()
    """Settings of all runs, as in `--set track.num_points=400`."""
    sweep: tuple[str, ...] = ()
    """Settings with several values each, all combinations of which are run: `track.num_points=256,512`."""

    baseline: Path | None = None
    """Of the gate: the file of what to keep to."""
    update: str | None = None
    """Of the gate: make the figures of now those to keep to, for this reason."""
    of: str | None = None
    """Of the gate: the suite, where there is no baseline yet."""

    def main(self) -> None:
        """Run the command."""
        if self.suite is None:
            _list()
        elif self.suite == _GATE:
            self._gate()
        elif self.baseline is not None or self.update is not None or self.of is not None:
            raise BenchmarkError(f"--baseline, --update and --of: expected with `bench {_GATE}`, got '{self.suite}'")
        else:
            self._bench()

    def _gate(self) -> None:
        """Run the suite of a baseline, and compare."""
        if self.baseline is None:
            raise BenchmarkError(f"bench {_GATE}: expected --baseline FILE")
        before = load_baseline(self.baseline) if self.baseline.exists() or self.update is None else None
        suite = self.of or (None if before is None else before.suite)
        if suite is None:
            raise BenchmarkError(f"{self.baseline}: not there yet; --of SUITE says of what to make it")
        if before is not None:
            plain = replace(self, suite=suite, presets=self.presets or before.presets, runs=self.runs or before.runs)
        else:
            plain = replace(self, suite=suite)
        out = self.out or Path("results") / "bench" / _GATE
        plain = replace(plain, out=out)
        results = plain._results()
        if self.update is not None:
            presets = tuple(dict.fromkeys(result["preset"] for result in results))
            runs = 1 + max((result["seed"] for result in results), default=0)
            save_baseline(self.baseline, make_baseline(suite, presets, runs, self.update, results))
            _console.print(f"Baseline: {self.baseline}")
            return
        assert before is not None
        worse = complaints(before, results)
        for complaint in worse:
            _console.print(f"worse: {complaint}", highlight=False)
        if worse:
            raise BenchmarkError(f"{len(worse)} figures are worse than in {self.baseline} ({before.reason})")
        _console.print(f"Nothing is worse than in {self.baseline}.")

    def _bench(self) -> None:
        """Run the suite, and write its report."""
        results = self._results()
        failed = sum(result["status"] != "done" for result in results)
        if failed or not results:
            raise BenchmarkError(f"{failed} of {len(results)} runs failed" if results else "nothing could be run")

    def _results(self) -> list[dict[str, Any]]:
        """Run what has not been run; the report is written, and the results given back."""
        assert self.suite is not None
        for name, value in (("--runs", self.runs), ("--workers", self.workers)):
            if value is not None and value < 1:
                raise BenchmarkError(f"{name}: expected at least 1, got {value}")
        suite = swept(load_suite(self.suite), self.sweep)
        root = self._root()
        chosen = checked_presets(self.presets) if self.presets else ()
        jobs = plan(replace(suite, settings=(*self.set, *suite.settings)), presets=chosen, runs=self.runs)
        for preset, settings in {(job.preset, job.settings) for job in jobs}:
            load_config(preset, overrides=settings)  # an error now, not after hours
        absent = missing(suite, root)
        there = [job for job in jobs if job.clip.recording not in absent]
        out = self.out or Path("results") / "bench" / suite.name
        self._prepare(out)
        for name in absent:
            _console.print(f"Not on this machine: {name}; to get it: jaxslam data get {name}", highlight=False)
        results = self._run(there, out, root)
        write_atomically(out / _REPORT, markdown_report(suite, results, absent).encode(), BenchmarkError)
        write_atomically(out / _PAGE, html_report(suite, results, absent, out).encode(), BenchmarkError)
        failed = sum(result["status"] != "done" for result in results)
        _console.print(f"{len(results) - failed} runs, {failed} failed, {len(absent)} recordings missing.")
        _console.print(
            f"Report: {out / _PAGE}, {out / _REPORT}; figures: {out / RESULTS}; each run in {out}/SEQUENCE/PRESET/SEED"
        )
        return results

    def _root(self) -> Path | None:
        """Where recordings are looked for first: the suite itself, if it is a folder of them."""
        root = self.root
        if root is None and self.suite not in suites() and Path(self.suite or "").is_dir():
            root = Path(self.suite or "")
        if root is not None and not root.is_dir():
            raise BenchmarkError(f"--root: expected a folder, got '{root}'")
        return root

    def _prepare(self, out: Path) -> None:
        if not self.resume and out.is_dir() and any(out.iterdir()):
            raise BenchmarkError(
                f"{out}: expected no results there; --resume goes on with them, --out names another folder"
            )
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            raise BenchmarkError(f"{out}: cannot be made: {problem.strerror}") from None

    def _run(self, jobs: list[Job], out: Path, root: Path | None) -> list[dict[str, Any]]:
        columns = (
            TextColumn("Runs"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=_console) as progress, local(self.workers) as executor:
            task = progress.add_task("runs", total=len(jobs))

            def told(result: dict[str, Any]) -> None:
                progress.console.print(_line(result), highlight=False)
                progress.advance(task)

            return run_jobs(jobs, out, root, executor=executor, on_result=told)


def _line(result: dict[str, Any]) -> str:
    name = f"{result['sequence']}, {result['label']}, seed {result['seed']}"
    if result["status"] != "done":
        return f"{name}: {result['problem']}"
    ate = result["ate_rmse_m"]
    return f"{name}: ATE {'-' if ate is None else f'{ate:.4f} m'}, {result['tracked_percent']:.1f} % tracked"


def _list() -> None:
    table = Table("suite", "sequences", "presets", "runs", "about", title="Suites", title_justify="left")
    for name in suites():
        suite = load_suite(name)
        table.add_row(name, str(len(suite.sequences)), ", ".join(suite.presets), str(suite.runs), suite.about)
    _console.print(table)
