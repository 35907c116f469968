"""`jaxslam bench`: run a suite of recordings with presets, and write a report."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from jaxslam.benchmark.reports.html import html_report
from jaxslam.benchmark.reports.markdown import markdown_report
from jaxslam.benchmark.suites.aggregate import row_name
from jaxslam.benchmark.suites.collected_results import RESULTS, Collected, as_table, read_results
from jaxslam.benchmark.suites.job import DONE, FAILED, NOT_RUN, Job, about
from jaxslam.benchmark.suites.plan import missing, plan, replaced_settings, swept
from jaxslam.benchmark.suites.runner import Executor, local, run_jobs
from jaxslam.benchmark.suites.suite import Suite, check_masks, checked_presets, load_suite, suites
from jaxslam.cli.command_table import COMMANDS
from jaxslam.cli.console import console, make_table, plain_console, print_json, text_column
from jaxslam.cli.shared_options import ALLOW_MISSING_MODEL, Settings, WithJson, flat
from jaxslam.config.loading import load_config
from jaxslam.errors import BenchmarkError, nearest
from jaxslam.io.atomic_files import make_folder, write_atomically
from jaxslam.semantics.from_config import network_files

_REPORT, _PAGE = "report.md", "report.html"
_LOCAL = "local"
_DASK = re.compile(r"dask://((?:\[[0-9A-Fa-f:.]+\]|[^\s/:@\[\]]+):[0-9]+)")


class SuitePlan(NamedTuple):
    """What is going to be run.

    Attributes:
        suite: With sweeps as variants.
        jobs: Every run.
        replaced: What the command line changes about the suite's own settings, in words.
    """

    suite: Suite
    jobs: list[Job]
    replaced: list[str]


@dataclass(frozen=True)
class RunsOfSuite(WithJson):
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
    allow_missing_model: bool = False
    """Go on without the network of a preset that needs one, where it is not on this machine; all results say so."""
    set: Settings = ()
    """Settings of all runs, as in `--set track.num_points=400`; they beat those of the suite. May be given again."""
    sweep: Settings = ()
    """Settings with several values each, all combinations of which are run: `track.num_points=256,512`."""

    def plan(self, name: str) -> SuitePlan:
        """The runs that the suite and these options come to.

        Args:
            name: Of the suite.

        Raises:
            BenchmarkError: If there is no such suite, or an option does not fit.
            ConfigError: If a setting is unknown or cannot be.
            ModelError: If a network that a preset needs is not on this machine, where runs are.
        """
        for option, value in (("--runs", self.runs), ("--workers", self.workers)):
            if value is not None and value < 1:
                raise BenchmarkError(f"{option}: expected at least 1, got {value}")
        allowed = (ALLOW_MISSING_MODEL,) if self.allow_missing_model else ()
        known, settings, sweeps = load_suite(name), (*allowed, *flat(self.set)), flat(self.sweep)
        replaced = replaced_settings(known, settings, sweeps)
        suite = swept(known, sweeps)
        chosen = checked_presets(self.presets) if self.presets else ()
        jobs = plan(suite, presets=chosen, runs=self.runs, settings=settings)
        for preset, of_it in dict.fromkeys((job.preset, job.settings) for job in jobs):  # an error now, not after hours
            config = load_config(preset, overrides=of_it)
            check_masks([job.clip for job in jobs], config)
            if self.runs_here:
                network_files(config.semantics)  # on a cluster, each run sees for itself
        return SuitePlan(suite, jobs, replaced)

    def results(self, name: str, rows: Collection[str] | None = None) -> list[dict[str, Any]]:
        """Run what has not been run; the report is written, and the results given back.

        Args:
            name: Of the suite.
            rows: What to run of it, by `row_name`; all if not given.
        """
        planned = self.plan(name)
        suite, jobs = planned.suite, planned.jobs
        jobs = [job for job in jobs if rows is None or row_name(job.clip.name, job.label) in rows]
        for line in planned.replaced if rows is None else ():
            plain_console.print(line)
        out = self.out or Path("results") / "bench" / suite.name
        with self._executor(self._root(name)) as executor:
            absent = missing(suite, executor.recordings)
            earlier = self._prepare(out)
            for why in dict.fromkeys(absent.values()):
                names = ", ".join(name for name in absent if absent[name] == why)
                plain_console.print(f"Not run: {names}: {why}")
            there = [job for job in jobs if job.clip.recording not in absent]
            collected = Collected(there, earlier)
            report = _Report(suite, collected, absent, out)
            try:
                self._run(there, executor, report)
            finally:  # also if it was interrupted: what is done can be seen
                report.write()
                report.print_outcome()
        return collected.planned

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
        from jaxslam.benchmark.suites.dask_executor import cluster  # noqa: PLC0415 - Dask is an extra

        return cluster(match[1], root)

    def _prepare(self, out: Path) -> list[dict[str, Any]]:
        """Make the folder of the results; gives those of an earlier call that are gone on with."""
        if not self.resume and out.is_dir() and any(out.iterdir()):
            raise BenchmarkError(
                f"{out}: expected no results there; --resume goes on with them, --out names another folder"
            )
        make_folder(out, BenchmarkError)
        return read_results(out) if self.resume else []

    def _run(self, jobs: Sequence[Job], executor: Executor, report: "_Report") -> None:
        columns = (
            text_column("Runs"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("runs", total=len(jobs))
            report.write_text()

            def told(result: dict[str, Any]) -> None:
                report.collected.add(result)
                report.write_text()
                progress.console.print(_line(result), highlight=False)
                progress.advance(task)

            def stale(job: Job, why: str) -> None:
                progress.console.print(f"{_name(about(job))}: run anew: {why}", highlight=False)

            run_jobs(jobs, report.out, executor=executor, on_result=told, on_stale=stale)


@dataclass(frozen=True)
class Bench(RunsOfSuite):
    """Options of `jaxslam bench`."""

    suite: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE")] = None
    """A known suite, a YAML file, or a folder of recordings."""

    def main(self) -> None:
        """Run the command."""
        if self.suite is None:
            _list(as_json=self.json)
            return
        _check_suite(self.suite)
        results = self.results(self.suite)
        if self.json:
            print_json(as_table(results))
        failed = sum(result["status"] != DONE for result in results)
        if failed or not results:
            raise BenchmarkError(f"{failed} of {len(results)} runs failed" if results else "nothing could be run")


@dataclass(frozen=True)
class _Report:
    """What is written about the runs of a suite.

    Attributes:
        suite: With sweeps as variants.
        collected: Results, of earlier calls too.
        absent: Recordings that are not there, by name, and how to get them.
        out: Folder of the results.
    """

    suite: Suite
    collected: Collected
    absent: Mapping[str, str]
    out: Path

    def write_text(self) -> None:
        """Write the results, and the report that is made in no time."""
        self.collected.write(self.out)
        text = markdown_report(self.suite, self.collected.every, self.absent)
        write_atomically(self.out / _REPORT, text.encode(), BenchmarkError)

    def write(self) -> None:
        """Write all of it."""
        self.write_text()
        page = html_report(self.suite, self.collected.every, self.absent, self.out)
        write_atomically(self.out / _PAGE, page.encode(), BenchmarkError)

    def print_outcome(self) -> None:
        """Say how many runs were made, and where everything is."""
        planned, out = self.collected.planned, self.out
        statuses = Counter(result["status"] for result in planned)
        made, left = len(planned) - statuses[NOT_RUN], f", {statuses[NOT_RUN]} not made" if statuses[NOT_RUN] else ""
        plain_console.print(f"{made} runs, {statuses[FAILED]} failed{left}, {len(self.absent)} recordings not run.")
        if (kept := len(self.collected.every) - len(planned)) > 0:
            plain_console.print(f"In the report too: {kept} runs of earlier calls.")
        plain_console.print(
            f"Report: {out / _PAGE}, {out / _REPORT}; figures: {out / RESULTS}; each run in {out}/SEQUENCE/PRESET/SEED"
        )


def _name(result: Mapping[str, Any]) -> str:
    return f"{row_name(result['sequence'], result['label'])}, seed {result['seed']}"


def _line(result: Mapping[str, Any]) -> str:
    if result["status"] != DONE:
        return f"{_name(result)}: {result['problem']}"
    ate = result["ate_rmse_m"]
    known = f"ATE {ate:.4f} m" if ate is not None else f"no ATE ({result['evaluation_problem']})"
    return f"{_name(result)}: {known}, {result['tracked_percent']:.1f} % tracked"


def _check_suite(name: str) -> None:
    """Refuse what is no suite, and may be a misspelt command below `bench` as well."""
    if name in suites() or Path(name).exists():
        return
    commands = [command.words[1] for command in COMMANDS if command.words[0] == "bench" and len(command.words) > 1]
    raise BenchmarkError(
        f"suite: expected a known one, a YAML file or a folder, got '{name}'{nearest(name, [*suites(), *commands])}"
    )


def _list(*, as_json: bool) -> None:
    """Print the suites that come with jaxslam."""
    known = [
        {
            "suite": name,
            "sequences": len(suite.sequences),
            "presets": list(suite.presets),
            "runs": suite.runs,
            "about": suite.about,
        }
        for name, suite in ((name, load_suite(name)) for name in suites())
    ]
    if as_json:
        print_json(known)
        return
    table = make_table("Suites", "suite", "sequences,\nruns", "presets", "about", left=4)
    for suite in known:
        counts = f"{suite['sequences']}, {suite['runs']}"
        table.add_row(suite["suite"], counts, ", ".join(suite["presets"]), suite["about"])
    console.print(table)
