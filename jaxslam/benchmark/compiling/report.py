"""Report on what compiling costs: a table of the programs, and one of the functions of each large program."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from jaxslam.benchmark.compiling.self_times import NUM_TRACED
from jaxslam.benchmark.machine_names import compiled_with, machine_name
from jaxslam.benchmark.reports.document import Block, Heading, Paragraph, Table, to_markdown

COLUMNS = ("part", "program", "instructions", "kernels", "trace, s", "lower, s", "compile, s", "peak, MB")
FUNCTION_COLUMNS = ("function", "instructions", "kernels", "executed", "self, ms")
_LARGE = 100
"""Instructions of a program that has a row of its own."""

Rows = Sequence[Mapping[str, Any]]


def program_cells(rows: Rows) -> list[list[str]]:
    """Make the cells below `COLUMNS`: a row for each large program, and one for all small programs of a part."""
    cells = []
    for part in dict.fromkeys(row["part"] for row in rows):
        of_part = [row for row in rows if row["part"] == part]
        large = [row for row in of_part if row["instructions"] >= _LARGE]
        small = [row for row in of_part if row["instructions"] < _LARGE]
        cells += [_cells(row) for row in large]
        if small:
            total = {name: sum(row[name] for row in small) for name in ("instructions", "kernels", *_TIMES)}
            peak_mb = max(row["peak_mb"] for row in small)
            cells.append(_cells({"part": part, "program": f"({len(small)} small)", "peak_mb": peak_mb, **total}))
    return cells


def large_programs(rows: Rows) -> list[Mapping[str, Any]]:
    """Return the rows of the programs that have a row of their own."""
    return [row for row in rows if row["instructions"] >= _LARGE]


def function_cells(row: Mapping[str, Any], most: int) -> list[list[str]]:
    """Make the cells below `FUNCTION_COLUMNS` for the dearest functions of a program."""
    return [
        [
            of["function"],
            f"{of['instructions']:,}",
            f"{of['kernels']:,}",
            "-" if of["executed"] is None else f"{of['executed']:,.0f}",
            "-" if of["self_ms"] is None else f"{of['self_ms']:.2f}",
        ]
        for of in row["functions"][:most]
    ]


def program_title(row: Mapping[str, Any]) -> str:
    """Name a program, with its size and what it executes per frame if it was run."""
    size = f"{row['program']}: {row['instructions']:,} instructions, {row['kernels']:,} kernels"
    executed, self_ms = (_total(row["functions"], name) for name in ("executed", "self_ms"))
    if executed is None or self_ms is None:
        return size
    return f"{size}; {executed:,.0f} executed per frame in {self_ms:.1f} ms"


def markdown_report(content: Mapping[str, Any]) -> str:
    """Return the content of `compile.json` as tables, and how it was measured."""
    blocks: list[Block] = [Heading("What compiling costs", 1), Table([COLUMNS, *program_cells(content["rows"])])]
    blocks.append(Paragraph(how(content)))
    for row in large_programs(content["rows"]):
        blocks += [
            Heading(program_title(row), 2),
            Table([FUNCTION_COLUMNS, *function_cells(row, content["functions"])]),
        ]
    return to_markdown(blocks)


def how(content: Mapping[str, Any]) -> str:
    """Say what the figures mean, and on which machine they were measured."""
    return (
        "Instructions of the optimized HLO without parameters, tuples, constants and bitcasts; kernels: those outside"
        " fused computations. Trace, lower, compile: seconds apart, without JAX's caches; writing and reading the trace"
        " for jaxslam's cache are in the first. Peak: most resident memory of the part's own process so far, libraries"
        f" included. Executed and self time: of XLA's trace of at most {NUM_TRACED} frames, with its own cost."
        f" Scene: {content['scene']}. Processor: {machine_name(content)}, XLA in {_threads(content['threads'])};"
        f" {compiled_with(content)}. jaxslam: {content['commit'] or content['versions']['jaxslam']}."
    )


_TIMES = ("trace_s", "lower_s", "compile_s")


def _cells(row: Mapping[str, Any]) -> list[str]:
    counts = (f"{row[name]:,}" for name in ("instructions", "kernels"))
    return [row["part"], row["program"], *counts, *(f"{row[name]:.1f}" for name in _TIMES), f"{row['peak_mb']:,.0f}"]


def _total(functions: Iterable[Mapping[str, Any]], name: str) -> float | None:
    found = [of[name] for of in functions if of[name] is not None]
    return sum(found) if found else None


def _threads(number: int) -> str:
    return "one thread" if number == 1 else f"{number} threads"
