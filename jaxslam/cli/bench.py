"""`jaxslam bench`: options that run a suite of recordings with presets and write a report."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxslam.cli.console import print_json
from jaxslam.cli.shared_options import Settings, WithJson
from jaxslam.errors import BenchmarkError

if TYPE_CHECKING:
    from jaxslam.benchmark.suites.suite import Suite
    from jaxslam.cli.suite_run import SuitePlan

LOCAL = "local"
"""Value of `--executor` that runs everything on this machine."""

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class RunsOfSuite(WithJson):
    """Options that say how a suite is run and where its results are written."""

    root: Path | None = None
    """Folder in which to look for recordings first."""
    presets: tuple[str, ...] = ()
    """Presets to run instead of those of the suite."""
    runs: int | None = None
    """Number of runs of each sequence with each preset. By default, the number that the suite gives."""
    workers: int | None = None
    """Number of runs at the same time on this machine. Times are only meaningful with 1, which is the default."""
    executor: str = LOCAL
    """Where to run: local, or dask://HOST:PORT for the scheduler of a Dask cluster. The workers of a cluster have the
    recordings and --root on their own machines and make as many runs at a time as they have threads; start them with
    `dask worker --nthreads 1` to measure times."""
    resume: bool = False
    """Keep the results that are already in the folder, and make the missing runs."""
    out: Path | None = None
    """Folder for the results. By default, results/bench/SUITE."""
    allow_missing_model: bool = False
    """Run a preset without its network if the network is not on this machine. All results say that it was missing."""
    set: Settings = ()
    """Settings for all runs, such as `--set track.num_points=400`. They override those of the suite. Repeatable."""
    sweep: Settings = ()
    """Settings with several values each, such as `track.num_points=256,512`. All combinations are run."""

    def plan(self, name: str) -> "SuitePlan":
        """List the runs of a suite with these options.

        Args:
            name: Name of the suite.

        Raises:
            BenchmarkError: If there is no such suite, or an option is wrong.
            ConfigError: If a setting is unknown or has a wrong value.
            ModelError: If runs are made on this machine and a network that a preset needs is not on it.
        """
        from jaxslam.cli.suite_run import plan_suite  # noqa: PLC0415

        return plan_suite(self, name)

    def results(self, name: str, rows: Collection[str] | None = None) -> list[dict[str, Any]]:
        """Make the runs that have not been made yet, write the report, and return the results of all planned runs.

        Args:
            name: Name of the suite.
            rows: Rows of the suite to run, by `row_name`; `None` for all.

        Raises:
            BenchmarkError: If an option is wrong, or results cannot be read or written.
        """
        from jaxslam.cli.suite_run import run_suite  # noqa: PLC0415

        return run_suite(self, name, rows)

    def with_systems(self, suite: "Suite") -> "Suite":
        """The suite with the other systems that are judged by this command.

        Args:
            suite: Suite as in its file.

        Raises:
            BenchmarkError: If the suite has other systems, of which this command knows nothing.
        """
        if suite.systems:
            raise BenchmarkError(f"{suite.name}: systems: expected none for this command, got {suite.systems[0].name}")
        return suite

    @property
    def runs_here(self) -> bool:
        """Whether runs are made on this machine and not on a cluster."""
        return self.executor == LOCAL


@dataclass(frozen=True)
class Bench(RunsOfSuite):
    """Options of `jaxslam bench`."""

    suite: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE")] = None
    """Name of a known suite, a YAML file, or a folder of recordings."""
    others: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="with", metavar="NAME=DIR")] = ()
    """Another system and the folder of its trajectories, which are judged beside ours: SEQUENCE.txt, or a file a run in
    SEQUENCE/0.txt, ..., in the format of TUM, KITTI or EuRoC; or an experiment of VSLAM-LAB. Repeatable. A suite can
    also name commands, under `systems`."""

    def with_systems(self, suite: "Suite") -> "Suite":
        """The suite with the systems of `--with` too.

        Raises:
            BenchmarkError: If a system is given in another form, has no folder, or is named twice.
        """
        from jaxslam.benchmark.suites.system import parse_system  # noqa: PLC0415

        return replace(suite, systems=(*suite.systems, *map(parse_system, self.others)))

    def main(self) -> None:
        """Run the command."""
        from jaxslam.benchmark.suites.collected_results import as_table  # noqa: PLC0415
        from jaxslam.benchmark.suites.job import DONE  # noqa: PLC0415
        from jaxslam.cli.suite_run import check_suite_name, list_suites  # noqa: PLC0415

        if self.suite is None:
            list_suites(as_json=self.json)
            return
        check_suite_name(self.suite)
        results = self.results(self.suite)
        if self.json:
            print_json(as_table(results))
        failed = sum(result["status"] != DONE for result in results)
        if failed or not results:
            raise BenchmarkError(f"{failed} of {len(results)} runs failed" if results else "nothing could be run")
