"""Consoles, tables, and progress bars of the commands.

The terminal wraps long lines, so that paths can be copied. No text is read as rich markup, not even in tables, because
the names of runs, files, and settings may contain brackets.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)
from rich.table import Table

from jaxslam.cli.shared_options import WithJson

console = Console(soft_wrap=True, markup=False)
"""Console that colors numbers and paths."""
plain_console = Console(soft_wrap=True, markup=False, highlight=False)
"""Console for texts in which numbers should not be colored."""


@contextmanager
def messages_for(command: object) -> Iterator[None]:
    """Print the messages of a command with `--json` to standard error, so that the document stands alone.

    Args:
        command: The command to run; one without the option `--json` prints its messages to standard output.
    """
    before = console.stderr, plain_console.stderr
    if isinstance(command, WithJson) and command.json:
        console.stderr = plain_console.stderr = True
    try:
        yield
    finally:
        console.stderr, plain_console.stderr = before


def print_json(document: Any) -> None:
    """Print a document to standard output; a float that is not finite becomes null, as JSON has no number for it."""
    print(json.dumps(_finite(document), indent=2, allow_nan=False))


def _finite(document: Any) -> Any:
    """Replace every float that is not finite by `None`."""
    if isinstance(document, float):
        return document if math.isfinite(document) else None
    if isinstance(document, Mapping):
        return {key: _finite(value) for key, value in document.items()}
    return [_finite(value) for value in document] if isinstance(document, list | tuple) else document


def make_table(
    title: str,
    *headings: str,
    rows: Iterable[Sequence[str]] = (),
    left: int = 1,
    wrap_first: bool = False,
    gap: int = 2,
) -> Table:
    """Make a table that fits 80 columns; a word too long for its cell continues on the next line and is never cut off.

    Args:
        title: Text above the table; empty for none.
        headings: Headings of the columns. The words of a heading above figures are printed one below the other.
        rows: Cells of each row; more rows can be added later.
        left: Number of columns, from the first, that hold left-aligned text. The others hold right-aligned figures.
        wrap_first: Whether the cells of the first column may be broken too. They usually hold names to be copied.
        gap: Number of spaces between columns, 1 or more.
    """
    table = Table(title=title or None, title_justify="left", box=SIMPLE_HEAD, padding=(0, 0, 0, gap - 1))
    for index, heading in enumerate(headings):
        is_text = index < left
        whole = index == 0 and not wrap_first
        text = heading if is_text else heading.replace(" ", "\n")
        table.add_column(text, justify="left" if is_text else "right", overflow="fold", no_wrap=whole)
    for cells in rows:
        table.add_row(*cells)
    return table


def text_column(text: str) -> TextColumn:
    """Make a progress bar column whose text may contain brackets."""
    return TextColumn(text, markup=False)


def progress_bar(text: str, *columns: ProgressColumn, elapsed: bool = True, redraw: bool = True) -> Progress:
    """Make a progress bar that counts tasks on `console`.

    Args:
        text: Text before the bar; it may name fields of a task, such as `{task.description}`.
        columns: Columns to show after the count.
        elapsed: Whether to show the elapsed time.
        redraw: Whether a thread redraws the bar. Without it the bar is drawn only where the caller asks: during a
            measurement, such a thread would run on a core that is being measured.
    """
    times = [TimeElapsedColumn()] if elapsed else []
    shown = (text_column(text), BarColumn(), MofNCompleteColumn(), *times, *columns)
    return Progress(*shown, console=console, auto_refresh=redraw)


def download_bar() -> Progress:
    """Make a progress display on `plain_console` whose tasks count bytes."""
    columns = (
        text_column("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=plain_console)
