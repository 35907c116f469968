"""`jaxslam bench compile`: what compiling the programs of jaxslam costs, and the budget of the step."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxslam.cli.console import console, make_table, plain_console, print_json, progress_bar
from jaxslam.cli.shared_options import WithJson
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import check_writable, make_folder

_MIN_PX, _MAX_PX = 64, 8192
_BUDGET = Path(".ci") / "compile_budget.json"

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Compile(WithJson):
    """Options of `jaxslam bench compile`."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PART ...")] = ()
    """Parts to measure: flow, step, gradient, mapping, loop-closing, dense. By default, all of them."""
    recording: Path | None = None
    """Folder of a recording whose camera and frames are taken, instead of a rendered room seen through the lens of the
    camera `bonn`."""
    gradient_size: str = "160x120"
    """Width and height of the images that the gradient is taken of, in pixels."""
    by_function: bool = False
    """Also track frames with the parts flow and step, and print what each function of the source executes."""
    functions: int = 25
    """Number of functions to print for each program."""
    out: Path = Path("results") / "bench" / "compile"
    """Folder for the tables and the figures. Those of an earlier measurement are replaced."""
    check_budget: bool = False
    """Only count the two programs of a frame, and fail if they are off their budget."""
    update_budget: bool = False
    """Only count the two programs of a frame, and write the counts as the new budget."""
    budget: Path = _BUDGET
    """File of the budget."""

    def main(self) -> None:
        """Run the command."""
        size = self._checked()
        if self.check_budget or self.update_budget:
            self._judge_budget()
            return
        from jaxslam.benchmark.compiling.part_process import PartJob, check_parts  # noqa: PLC0415
        from jaxslam.benchmark.compiling.report import how, markdown_report  # noqa: PLC0415
        from jaxslam.cli.measurement_files import write_measurements  # noqa: PLC0415
        from jaxslam.runtime.machine import machine  # noqa: PLC0415
        from jaxslam.runtime.threads import prefer_one_thread  # noqa: PLC0415

        prefer_one_thread()  # for the processes of the parts, and so that it is said of them
        names = check_parts(self.only)
        make_folder(self.out, BenchmarkError)
        recording = None if self.recording is None else str(self.recording.expanduser().resolve())
        rows = _measured([PartJob(name, recording, size, self.by_function) for name in names])
        content = {
            **machine(),
            "scene": "a rendered room through the lens of the camera bonn" if recording is None else recording,
            "gradient_size": size,
            "functions": self.functions,
            "rows": rows,
        }
        if self.json:
            print_json(content)
        else:
            _print_tables(rows, self.functions if self.by_function else 0)
            plain_console.print(how(content))
        write_measurements(self.out, "compile", content, markdown_report(content))

    def _checked(self) -> tuple[int, int]:
        """Check the options, and return the width and height of the images for the gradient."""
        if self.functions < 1:
            raise BenchmarkError(f"--functions: expected at least 1, got {self.functions}")
        of_budget = self.check_budget or self.update_budget
        if of_budget and (self.only or self.recording is not None or self.by_function):
            raise BenchmarkError("the budget is of flow and step with the default camera: expected no other option")
        if self.check_budget and self.update_budget:
            raise BenchmarkError("expected --check-budget or --update-budget, got both")
        found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", self.gradient_size)
        sides = tuple(map(int, found.groups())) if found else ()
        if not sides or not all(_MIN_PX <= side <= _MAX_PX for side in sides):
            raise BenchmarkError(
                f"--gradient-size: expected WIDTHxHEIGHT of {_MIN_PX} to {_MAX_PX} pixels, got '{self.gradient_size}'"
            )
        return sides[0], sides[1]

    def _judge_budget(self) -> None:
        """Count the two programs of a frame, and write the budget or compare with it."""
        from jaxslam.benchmark.compiling import budget as budgets  # noqa: PLC0415
        from jaxslam.benchmark.compiling.part_process import PartJob  # noqa: PLC0415
        from jaxslam.runtime.machine import machine  # noqa: PLC0415

        if self.update_budget:
            check_writable(self.budget, "--budget", BenchmarkError)
        before = None if self.update_budget else budgets.load_budget(self.budget)
        rows = _measured([PartJob(part) for part in budgets.BUDGET_PARTS], plain=True)
        now = budgets.make_budget(rows, machine())
        if self.json:
            print_json({name: vars(program) for name, program in now.programs.items()})
        for name, program in now.programs.items():
            plain_console.print(f"{name}: {program.instructions:,} instructions, {program.kernels:,} kernels")
        if before is None:
            budgets.save_budget(self.budget, now)
            plain_console.print(f"Budget: {self.budget}")
            return
        off = budgets.off_budget(before, now)
        for complaint in off:
            plain_console.print(complaint)
        if off:
            raise BenchmarkError(f"{len(off)} counts are off {self.budget}. {budgets.advice(before, now)}")
        plain_console.print(f"Within {self.budget}.")


def _measured(jobs: Sequence[Any], *, plain: bool = False) -> list[dict[str, Any]]:
    """Measure parts one after the other with a progress bar."""
    from jaxslam.benchmark.compiling.part_process import measure_part  # noqa: PLC0415

    rows: list[dict[str, Any]] = []
    with progress_bar("{task.description}", redraw=False) as progress:
        task = progress.add_task("", total=len(jobs))
        for job in jobs:
            progress.update(task, description=job.part, refresh=True)
            rows += measure_part(job, plain=plain)
            progress.advance(task)
        progress.update(task, description="Parts", refresh=True)
    return rows


def _print_tables(rows: Sequence[Mapping[str, Any]], functions: int) -> None:
    """Print the table of the programs and, with a number of functions, those of the programs that were run."""
    from jaxslam.benchmark.compiling.report import (  # noqa: PLC0415
        COLUMNS,
        FUNCTION_COLUMNS,
        function_cells,
        large_programs,
        program_cells,
        program_title,
    )

    console.print(make_table("What compiling costs", *COLUMNS, rows=program_cells(rows), left=2, gap=1))
    for row in large_programs(rows) if functions else ():
        cells = function_cells(row, functions)
        console.print(make_table(program_title(row), *FUNCTION_COLUMNS, rows=cells, wrap_first=True))
