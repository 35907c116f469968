"""`jaxslam bench`: run a suite of recordings with presets, and write a report."""

import re
from collections.abc import Collection
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from jaxslam.benchmark.job import Job
from jaxslam.benchmark.page import html_report
from jaxslam.benchmark.report import markdown_report
from jaxslam.benchmark.rows import row_name
from jaxslam.benchmark.runner import RESULTS, Executor, local, missing, plan, run_jobs, swept
from jaxslam.benchmark.suite import checked_presets, load_suite, suites
from jaxslam.commands.console import console
from jaxslam.config import load_config
from jaxslam.errors import BenchmarkError
from jaxslam.files import make_folder, write_atomically

_REPORT, _PAGE = "report.md", "report.html"
_LOCAL = "local"
_DASK = re.compile(r"dask://((?:\[[0-9A-Fa-f:.]+\]|[^\s/:@\[\]]+):[0-9]+)")


@dataclass(frozen=True)
class RunsOfSuite:
    """How a suite is run, and where its results go."""

    root: Path | None = None
    """Folder in which recordings are looked for first."""
    presets: tuple[str, ...] = ()
    """Presets, instead of the suite's."""
    runs: int | None = None
    """How often to run each, instead of as often as the suite says."""
    workers: int | None = None
    """Runs at the same time on this machine; times are only worth something with 1, which it is if not given."""
    executor: str = _LOCAL
    """Where to run: local, or dask://HOST:PORT, the scheduler of a Dask cluster. Its workers have recordings and --root
    on their own machines, and run as many at a time as they have threads: `dask worker --nthreads 1` for times."""
    resume: bool = False
    """Go on with results that are there."""
    out: Path | None = None
    """Folder for the results; results/bench/SUITE if not given."""
    set: tuple[str, ...] = ()
    """Settings of all runs, as in `--set track.num_points=400`."""
    sweep: tuple[str, ...] = ()
    """Settings with several values each, all combinations of which are run: `track.num_points=256,512`."""

    def results(self, name: str, rows: Collection[str] | None = None) -> list[dict[str, Any]]:
        """Run what has not been run; the report is written, and the results given back.

        Args:
            name: Of the suite.
            rows: What to run of it, by `row_name`; all if not given.
        """
        for option, value in (("--runs", self.runs), ("--workers", self.workers)):
            if value is not None and value < 1:
                raise BenchmarkError(f"{option}: expected at least 1, got {value}")
        suite = swept(load_suite(name), self.sweep)
        chosen = checked_presets(self.presets) if self.presets else ()
        jobs = plan(replace(suite, settings=(*self.set, *suite.settings)), presets=chosen, runs=self.runs)
        jobs = [job for job in jobs if rows is None or row_name(job.clip.name, job.label) in rows]
        for preset, settings in {(job.preset, job.settings) for job in jobs}:
            load_config(preset, overrides=settings)  # an error now, not after hours
        out = self.out or Path("results") / "bench" / suite.name
        with self._executor(self._root(name)) as executor:
            absent = missing(suite, executor.recordings)
            self._prepare(out)
            for why in dict.fromkeys(absent.values()):
                names = ", ".join(name for name in absent if absent[name] == why)
                console.print(f"Not run: {names}: {why}", highlight=False)
            results = self._run([job for job in jobs if job.clip.recording not in absent], out, executor)
        write_atomically(out / _REPORT, markdown_report(suite, results, absent).encode(), BenchmarkError)
        write_atomically(out / _PAGE, html_report(suite, results, absent, out).encode(), BenchmarkError)
        failed = sum(result["status"] != "done" for result in results)
        console.print(f"{len(results) - failed} runs, {failed} failed, {len(absent)} recordings not run.")
        console.print(
            f"Report: {out / _PAGE}, {out / _REPORT}; figures: {out / RESULTS}; each run in {out}/SEQUENCE/PRESET/SEED"
        )
        return results

    @property
    def runs_here(self) -> bool:
        """Whether runs are on this machine, not on those of a cluster."""
        return self.executor == _LOCAL

    def _root(self, suite: str) -> Path | None:
        """Where recordings are looked for first: the suite itself, if it is a folder of them."""
        root = self.root
        if root is None and suite not in suites() and Path(suite).is_dir():
            root = Path(suite)
        if root is not None and not self.runs_here:
            return root.absolute()  # on other machines, which are asked
        if root is not None and not root.is_dir():
            raise BenchmarkError(f"--root: expected a folder, got '{root}'")
        return root

    def _executor(self, root: Path | None) -> AbstractContextManager[Executor]:
        if self.runs_here:
            return local(self.workers or 1, root)
        match = _DASK.fullmatch(self.executor)
        if match is None:
            raise BenchmarkError(f"--executor: expected local or dask://HOST:PORT, got '{self.executor}'")
        if self.workers is not None:
            raise BenchmarkError(
                "--workers: is for this machine; a Dask cluster runs as many as its workers have threads"
            )
        from jaxslam.benchmark.cluster import cluster  # noqa: PLC0415 - Dask is an extra

        return cluster(match[1], root)

    def _prepare(self, out: Path) -> None:
        if not self.resume and out.is_dir() and any(out.iterdir()):
            raise BenchmarkError(
                f"{out}: expected no results there; --resume goes on with them, --out names another folder"
            )
        make_folder(out, BenchmarkError)

    def _run(self, jobs: list[Job], out: Path, executor: Executor) -> list[dict[str, Any]]:
        columns = (
            TextColumn("Runs"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("runs", total=len(jobs))

            def told(result: dict[str, Any]) -> None:
                progress.console.print(_line(result), highlight=False)
                progress.advance(task)

            return run_jobs(jobs, out, executor=executor, on_result=told)


@dataclass(frozen=True)
class Bench(RunsOfSuite):
    """Run a suite: recordings or rendered rooms, presets, several seeds. Without a suite, list those there are.

    Three more have a --help of their own: `jaxslam bench gate` fails if a suite has become worse than its baseline,
    `jaxslam bench kernels` measures the kernels, `jaxslam bench batch` the tracker on many clips at once.
    """

    suite: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE")] = None
    """A known suite, a YAML file, or a folder of recordings."""

    def main(self) -> None:
        """Run the command."""
        if self.suite is None:
            _list()
            return
        results = self.results(self.suite)
        failed = sum(result["status"] != "done" for result in results)
        if failed or not results:
            raise BenchmarkError(f"{failed} of {len(results)} runs failed" if results else "nothing could be run")


def _line(result: dict[str, Any]) -> str:
    name = f"{row_name(result['sequence'], result['label'])}, seed {result['seed']}"
    if result["status"] != "done":
        return f"{name}: {result['problem']}"
    ate = result["ate_rmse_m"]
    return f"{name}: ATE {'-' if ate is None else f'{ate:.4f} m'}, {result['tracked_percent']:.1f} % tracked"


def _list() -> None:
    table = Table("suite", "sequences", "presets", "runs", "about", title="Suites", title_justify="left")
    for name in suites():
        suite = load_suite(name)
        table.add_row(name, str(len(suite.sequences)), ", ".join(suite.presets), str(suite.runs), suite.about)
    console.print(table)
