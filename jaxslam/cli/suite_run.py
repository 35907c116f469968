"""Run a suite for the commands below `jaxslam bench`: plan it, make its runs with a progress bar, write the report."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.progress import TimeRemainingColumn

from jaxslam.benchmark.reports.document import Table, to_markdown
from jaxslam.benchmark.reports.html import html_report
from jaxslam.benchmark.reports.markdown import markdown_report, suite_report
from jaxslam.benchmark.reports.published_tables import comparison_table
from jaxslam.benchmark.reports.table_files import write_tables
from jaxslam.benchmark.suites.aggregate import row_name, rows_of, with_shown_labels
from jaxslam.benchmark.suites.collected_results import RESULTS, Collected, read_results
from jaxslam.benchmark.suites.job import DONE, FAILED, NOT_RUN, Job, about
from jaxslam.benchmark.suites.plan import missing, not_judged, plan, replaced_settings, swept
from jaxslam.benchmark.suites.runner import Executor, local, run_jobs
from jaxslam.benchmark.suites.suite import Suite, check_masks, checked_presets, load_suite, suites
from jaxslam.cli.bench import LOCAL, RunsOfSuite
from jaxslam.cli.command_table import COMMANDS
from jaxslam.cli.console import console, make_table, plain_console, print_json, progress_bar
from jaxslam.cli.shared_options import ALLOW_MISSING_MODEL, flat
from jaxslam.config.loading import load_config
from jaxslam.errors import BenchmarkError, nearest
from jaxslam.io.atomic_files import make_folder, write_atomically
from jaxslam.semantics.from_config import network_files

_REPORT, _PAGE, _TABLES = "report.md", "report.html", "tables"
_DASK = re.compile(r"dask://((?:\[[0-9A-Fa-f:.]+\]|[^\s/:@\[\]]+):[0-9]+)")


class SuitePlan(NamedTuple):
    """The runs of a suite with the options of a command.

    Attributes:
        suite: Suite with one variant for each combination of swept values.
        jobs: All runs.
        replaced: Lines that say which of the suite's own settings the command line replaces.
    """

    suite: Suite
    jobs: list[Job]
    replaced: list[str]


def plan_suite(options: RunsOfSuite, name: str) -> SuitePlan:
    """List the runs of a suite and check their settings, as `RunsOfSuite.plan` documents."""
    for option, value in (("--runs", options.runs), ("--workers", options.workers)):
        if value is not None and value < 1:
            raise BenchmarkError(f"{option}: expected at least 1, got {value}")
    allowed = (ALLOW_MISSING_MODEL,) if options.allow_missing_model else ()
    known = options.with_systems(load_suite(name))
    settings, sweeps = (*allowed, *flat(options.set)), flat(options.sweep)
    replaced = replaced_settings(known, settings, sweeps)
    suite = swept(known, sweeps)
    chosen = checked_presets(options.presets) if options.presets else ()
    if suite.systems and not options.runs_here:
        raise BenchmarkError(f"--executor: expected {LOCAL} for other systems, got {options.executor}")
    jobs = plan(suite, presets=chosen, runs=options.runs, settings=settings)
    ours = dict.fromkeys((job.preset, job.settings) for job in jobs if job.system is None)
    for preset, overrides in ours:  # an error now, not after hours
        config = load_config(preset, overrides=overrides)
        check_masks([job.clip for job in jobs], config)
        if options.runs_here:
            network_files(config.semantics)  # on a cluster, each run checks on its own machine
    return SuitePlan(suite, jobs, replaced)


def run_suite(options: RunsOfSuite, name: str, rows: Collection[str] | None = None) -> list[dict[str, Any]]:
    """Make the missing runs of a suite and write its report, as `RunsOfSuite.results` documents."""
    suite, jobs, replaced = options.plan(name)
    jobs = [job for job in jobs if rows is None or row_name(job.clip.name, job.label) in rows]
    for line in replaced if rows is None else ():
        plain_console.print(line)
    out = options.out or Path("results") / "bench" / suite.name
    with _executor(options, _root(options, name)) as executor:
        absent = missing(suite, executor.recordings)
        not_run = not_judged(suite, absent) | absent
        earlier = _prepare(out, resume=options.resume)
        for why in dict.fromkeys(not_run.values()):
            names = "; ".join(name for name in not_run if not_run[name] == why)
            plain_console.print(f"Not run: {names}: {why}")
        present = [job for job in jobs if job.clip.source not in absent]
        collected = Collected(present, earlier)
        report = _Report(suite, collected, absent, not_run, out)
        try:
            _make_runs(present, executor, report)
        finally:  # after an interruption too, so that the finished runs can be seen
            report.write()
            report.print_outcome()
    return collected.planned


def _root(options: RunsOfSuite, suite: str) -> Path | None:
    """Return the folder in which to look for recordings first: by default the suite itself, if it is a folder."""
    root = options.root
    if root is None and suite not in suites() and Path(suite).is_dir():
        root = Path(suite)
    if root is not None and not options.runs_here:
        return root.absolute()  # on other machines, which check it themselves
    if root is not None and not root.is_dir():
        raise BenchmarkError(f"--root: expected a folder, got '{root}'")
    return root


def _executor(options: RunsOfSuite, root: Path | None) -> AbstractContextManager[Executor]:
    """Start the executor that `--executor` names."""
    if options.runs_here:
        return local(options.workers or 1, root)
    match = _DASK.fullmatch(options.executor)
    if match is None:
        raise BenchmarkError(f"--executor: expected local or dask://HOST:PORT, got '{options.executor}'")
    if options.workers is not None:
        raise BenchmarkError("--workers: is for this machine; a Dask cluster runs as many as its workers have threads")
    from jaxslam.benchmark.suites.dask_executor import cluster  # noqa: PLC0415 - Dask is an extra

    return cluster(match[1], root)


def _prepare(out: Path, *, resume: bool) -> list[dict[str, Any]]:
    """Make the folder of the results, and read the results of earlier calls if they are to be resumed."""
    if not resume and out.is_dir() and any(out.iterdir()):
        raise BenchmarkError(f"{out}: expected no results there; --resume keeps them, --out names another folder")
    make_folder(out, BenchmarkError)
    return read_results(out) if resume else []


def _make_runs(jobs: Sequence[Job], executor: Executor, report: "_Report") -> None:
    """Make the runs with a progress bar, and update the report after each."""
    with progress_bar("Runs", TimeRemainingColumn()) as progress:
        task = progress.add_task("runs", total=len(jobs))
        report.write_text()

        def show_result(result: dict[str, Any]) -> None:
            report.collected.add(result)
            report.write_text()
            progress.console.print(_line(result), highlight=False)
            progress.advance(task)

        def show_stale(job: Job, why: str) -> None:
            progress.console.print(f"{_name(about(job))}: run again: {why}", highlight=False)

        run_jobs(jobs, report.out, executor=executor, on_result=show_result, on_stale=show_stale)


@dataclass(frozen=True)
class _Report:
    """Files that report on the runs of a suite.

    Attributes:
        suite: Suite with one variant for each combination of swept values.
        collected: Results, including those of earlier calls.
        absent: For each missing recording, its name and how to get it.
        not_run: The same, and for each row of another system without a trajectory its name and why.
        out: Folder of the results.
    """

    suite: Suite
    collected: Collected
    absent: Mapping[str, str]
    not_run: Mapping[str, str]
    out: Path

    def write_text(self) -> None:
        """Write the results and the Markdown report, which take almost no time."""
        self.collected.write(self.out)
        text = markdown_report(self.suite, self.collected.every, self.not_run)
        write_atomically(self.out / _REPORT, text.encode(), BenchmarkError)

    def write(self) -> None:
        """Write the results, both reports, and each table in files of its own."""
        self.write_text()
        page = html_report(self.suite, self.collected.every, self.not_run, self.out)
        write_atomically(self.out / _PAGE, page.encode(), BenchmarkError)
        write_tables(
            self.out / _TABLES, suite_report(self.suite, with_shown_labels(self.collected.every), self.not_run)
        )

    def print_outcome(self) -> None:
        """Print the short comparison with others, how many runs were made, and where the files are."""
        rows = rows_of(with_shown_labels(self.collected.every))
        plain_console.print(to_markdown([Table(comparison_table(self.suite, rows))]), highlight=False, markup=False)
        planned, out = self.collected.planned, self.out
        statuses = Counter(result["status"] for result in planned)
        made, left = len(planned) - statuses[NOT_RUN], f", {statuses[NOT_RUN]} not made" if statuses[NOT_RUN] else ""
        plain_console.print(f"{made} runs, {statuses[FAILED]} failed{left}, {len(self.absent)} recordings not run.")
        if (kept := len(self.collected.every) - len(planned)) > 0:
            plain_console.print(f"Also in the report: {kept} runs of earlier calls.")
        plain_console.print(
            f"Report: {out / _PAGE}, {out / _REPORT}; tables as CSV and LaTeX: {out / _TABLES};"
            f" figures: {out / RESULTS}; each run in {out}/SEQUENCE/PRESET/SEED"
        )


def _name(result: Mapping[str, Any]) -> str:
    return f"{row_name(result['sequence'], result['label'])}, seed {result['seed']}"


def _line(result: Mapping[str, Any]) -> str:
    """Describe a result in one line."""
    if result["status"] != DONE:
        return f"{_name(result)}: {result['problem']}"
    ate = result["ate_rmse_m"]
    known = f"ATE {ate:.4f} m" if ate is not None else f"no ATE ({result['evaluation_problem']})"
    return f"{_name(result)}: {known}, {result['tracked_percent']:.1f} % tracked"


def check_suite_name(name: str) -> None:
    """Refuse a name that is no suite.

    Raises:
        BenchmarkError: If it is none; the message suggests a suite, or a command below `bench`, with a similar name.
    """
    if name in suites() or Path(name).exists():
        return
    commands = [command.words[1] for command in COMMANDS if command.words[0] == "bench" and len(command.words) > 1]
    raise BenchmarkError(
        f"suite: expected a known one, a YAML file or a folder, got '{name}'{nearest(name, [*suites(), *commands])}"
    )


def list_suites(*, as_json: bool) -> None:
    """Print the suites that come with jaxslam, as a table or as JSON."""
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
    rows = [
        (suite["suite"], f"{suite['sequences']}, {suite['runs']}", ", ".join(suite["presets"]), suite["about"])
        for suite in known
    ]
    console.print(make_table("Suites", "suite", "sequences,\nruns", "presets", "about", rows=rows, left=4))
