"""`jaxslam bench kernels`: how long each kernel takes, beside other libraries and over sizes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn
from rich.table import Table

from jaxslam.benchmark.kernels.case import Case
from jaxslam.benchmark.kernels.measure import devices, measure
from jaxslam.benchmark.kernels.registry import chosen, versions
from jaxslam.benchmark.kernels.report import COLUMNS, about, cells, markdown_report, picture, slopes
from jaxslam.cli.console import console, make_table, plain_console, print_json, text_column
from jaxslam.cli.shared_options import WithJson
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder, write_atomically
from jaxslam.runtime.compile_cache import prefer_one_thread
from jaxslam.runtime.machine import machine

_ROUNDS, _QUICK_ROUNDS, _QUICK_SIZES = 30, 5, 2
_JSON, _MARKDOWN, _PICTURE = "kernels.json", "kernels.md", "kernels.png"


@dataclass(frozen=True)
class Kernels(WithJson):
    """Options of `jaxslam bench kernels`."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Kernels, instead of all of them."""
    out: Path = Path("results") / "bench" / "kernels"
    """Folder for the table, the picture and the figures; those of an earlier time are replaced."""
    rounds: int | None = None
    """How often each is called; 30 if not given. Calls of seconds are fewer."""
    quick: bool = False
    """The two smallest sizes only, 5 calls each: to see that it works."""

    def main(self) -> None:
        """Run the command."""
        if self.rounds is not None and self.rounds < 1:
            raise BenchmarkError(f"--rounds: expected at least 1, got {self.rounds}")
        cases = chosen(self.only)
        make_folder(self.out, BenchmarkError)
        prefer_one_thread()  # before the first array
        rounds = self.rounds or (_QUICK_ROUNDS if self.quick else _ROUNDS)
        rows = _measured(cases, rounds, _QUICK_SIZES if self.quick else None)
        content = _content(cases, rows, rounds, quick=self.quick)
        if self.json:
            print_json(content)
        else:
            _print_tables(cases, rows)
        self._write(cases, content)
        console.print(f"Table and picture: {self.out / _MARKDOWN}, {self.out / _PICTURE}; figures: {self.out / _JSON}")

    def _write(self, cases: Sequence[Case], content: Mapping[str, Any]) -> None:
        rows: Sequence[dict[str, Any]] = content["rows"]
        files = {
            _JSON: (json.dumps(content, indent=1) + "\n").encode(),
            _MARKDOWN: markdown_report(cases, rows, content).encode(),
            _PICTURE: picture(cases, rows),
        }
        for name, data in files.items():
            write_atomically(self.out / name, data, BenchmarkError)


def _content(cases: Sequence[Case], rows: Sequence[dict[str, Any]], rounds: int, *, quick: bool) -> dict[str, Any]:
    """What the file of figures holds."""
    on = machine()
    on["versions"] |= versions()
    return {**on, "rounds": rounds, "quick": quick, "kernels": _described(cases, rows), "rows": rows}


def _print_tables(cases: Sequence[Case], rows: Sequence[dict[str, Any]]) -> None:
    for case in cases:
        of_it = [row for row in rows if row["kernel"] == case.name]
        console.print(case_table(case, of_it))
        longest = max(row["compile_s"] for row in of_it)
        plain_console.print(f"{case.name} {about(case, of_it)}; compiled in {longest:.1f} s at most")


def _measured(cases: Sequence[Case], rounds: int, num_sizes: int | None) -> list[dict[str, Any]]:
    jobs = [(case, size, device) for case in cases for size in case.sizes[:num_sizes] for device in devices()]
    columns = text_column("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    rows = []
    # Drawn between measurements only: a thread that draws would run on the core where they are taken.
    with Progress(*columns, console=console, auto_refresh=False) as progress:
        task = progress.add_task("", total=len(jobs))
        for case, size, device in jobs:
            progress.update(task, description=f"{case.name}, {case.label(size)}", refresh=True)
            rows.append(measure(case, size, device, rounds))
            progress.advance(task)
        progress.update(task, description="Kernels", refresh=True)
    return rows


def _described(cases: Sequence[Case], rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
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


def case_table(case: Case, rows: Sequence[dict[str, Any]]) -> Table:
    """In a terminal, without the name and the time of compiling."""
    drawn = make_table(case.name, *COLUMNS[1:-1], gap=1)
    for row in rows:
        drawn.add_row(*cells(row)[1:-1])
    return drawn
