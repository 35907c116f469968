"""The tables of a report as files for papers and spreadsheets: LaTeX with the rules of `booktabs`, and CSV."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from jaxslam.benchmark.reports.document import Block, Table
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder, write_atomically

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
}


def write_tables(folder: Path, blocks: Iterable[Block]) -> None:
    """Write each table of a report that has a name to `NAME.csv` and `NAME.tex`; tables of earlier reports are removed.

    Args:
        folder: Folder of the files, created if it does not exist.
        blocks: Blocks of the report.

    Raises:
        BenchmarkError: If a file cannot be written.
    """
    tables = {block.name: block.lines for block in blocks if isinstance(block, Table) and block.name}
    make_folder(folder, BenchmarkError)
    texts = {f"{name}.csv": to_csv(lines) for name, lines in tables.items() if lines}
    texts |= {f"{name}.tex": to_latex(lines) for name, lines in tables.items() if lines}
    for old in (*folder.glob("*.csv"), *folder.glob("*.tex")):
        if old.name not in texts:
            old.unlink(missing_ok=True)
    for name, text in texts.items():
        write_atomically(folder / name, text.encode(), BenchmarkError)


def to_csv(lines: Sequence[Sequence[str]]) -> str:
    """Render a table as CSV; the first line holds the headings."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def to_latex(lines: Sequence[Sequence[str]]) -> str:
    """Render a table as a LaTeX `tabular` that needs the package `booktabs`; the first line holds the headings."""
    head, *rows = ([_escaped(cell) for cell in line] for line in lines)
    columns = "l" + "r" * (len(head) - 1)
    body = [_latex_row(row) for row in rows]
    return "\n".join(
        [
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            _latex_row(head),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _latex_row(cells: Sequence[str]) -> str:
    return rf"{' & '.join(cells)} \\"


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)
