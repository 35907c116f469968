"""`jaxslam bench kernels`: time of each kernel over sizes, compared with other libraries."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.table import Table

from jaxslam.cli.console import console, make_table, plain_console, print_json, progress_bar
from jaxslam.cli.shared_options import WithJson, check_at_least
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder

if TYPE_CHECKING:
    from jaxslam.benchmark.kernels.case import Case

_ROUNDS, _QUICK_ROUNDS, _QUICK_SIZES = 30, 5, 2

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Kernels(WithJson):
    """Options of `jaxslam bench kernels`."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Names of the kernels to measure. By default, all of them."""
    out: Path = Path("results") / "bench" / "kernels"
    """Folder for the table, the plot, and the figures. Those of an earlier measurement are replaced."""
    rounds: int | None = None
    """Number of calls of each kernel at each size. By default 30, and fewer if a call takes seconds."""
    quick: bool = False
    """Measure only the two smallest sizes with 5 calls each, to check that everything works."""

    def main(self) -> None:
        """Run the command."""
        if self.rounds is not None:
            check_at_least("--rounds", self.rounds, 1)
        from jaxslam.benchmark.kernels.registry import chosen  # noqa: PLC0415
        from jaxslam.benchmark.kernels.report import markdown_report, picture  # noqa: PLC0415
        from jaxslam.cli.measurement_files import write_measurements  # noqa: PLC0415
        from jaxslam.runtime.threads import prefer_one_thread  # noqa: PLC0415

        cases = chosen(self.only)
        make_folder(self.out, BenchmarkError)
        prefer_one_thread()  # before JAX makes the first array
        rounds = self.rounds or (_QUICK_ROUNDS if self.quick else _ROUNDS)
        rows = _measured(cases, rounds, _QUICK_SIZES if self.quick else None)
        content = _content(cases, rows, rounds, quick=self.quick)
        if self.json:
            print_json(content)
        else:
            _print_tables(cases, rows)
        write_measurements(self.out, "kernels", content, markdown_report(cases, rows, content), picture(cases, rows))


def _content(cases: Sequence["Case"], rows: Sequence[dict[str, Any]], rounds: int, *, quick: bool) -> dict[str, Any]:
    """Collect what the file of figures holds."""
    from jaxslam.benchmark.kernels.registry import versions  # noqa: PLC0415
    from jaxslam.runtime.machine import machine  # noqa: PLC0415

    here = machine()
    here["versions"] |= versions()
    return {**here, "rounds": rounds, "quick": quick, "kernels": _described(cases, rows), "rows": rows}


def _print_tables(cases: Sequence["Case"], rows: Sequence[dict[str, Any]]) -> None:
    from jaxslam.benchmark.kernels.report import about  # noqa: PLC0415

    for case in cases:
        case_rows = [row for row in rows if row["kernel"] == case.name]
        console.print(case_table(case, case_rows))
        longest = max(row["compile_s"] for row in case_rows)
        plain_console.print(f"{case.name} {about(case, case_rows)}; compiled in {longest:.1f} s at most")


def _measured(cases: Sequence["Case"], rounds: int, num_sizes: int | None) -> list[dict[str, Any]]:
    """Measure every kernel at its first sizes on every device, with a progress bar."""
    from jaxslam.benchmark.kernels.measure import devices, measure  # noqa: PLC0415

    jobs = [(case, size, device) for case in cases for size in case.sizes[:num_sizes] for device in devices()]
    rows = []
    with progress_bar("{task.description}", redraw=False) as progress:
        task = progress.add_task("", total=len(jobs))
        for case, size, device in jobs:
            progress.update(task, description=f"{case.name}, {case.label(size)}", refresh=True)
            rows.append(measure(case, size, device, rounds))
            progress.advance(task)
        progress.update(task, description="Kernels", refresh=True)
    return rows


def _described(cases: Sequence["Case"], rows: Sequence[dict[str, Any]]) -> Mapping[str, dict[str, Any]]:
    """Describe what was compared for each kernel, with the slopes of its times over size."""
    from jaxslam.benchmark.kernels.report import slopes  # noqa: PLC0415

    return {
        case.name: {
            "axis": case.axis,
            "reference": case.reference,
            "compared": case.compared,
            "difference": case.difference,
            "limit": case.limit,
            "slopes": slopes([row for row in rows if row["kernel"] == case.name]),
        }
        for case in cases
    }


def case_table(case: "Case", rows: Sequence[dict[str, Any]]) -> Table:
    """Make a table of the rows of one kernel for a terminal, without its name and the compile times."""
    from jaxslam.benchmark.kernels.report import COLUMNS, cells  # noqa: PLC0415

    return make_table(case.name, *COLUMNS[1:-1], rows=(cells(row)[1:-1] for row in rows), gap=1)
