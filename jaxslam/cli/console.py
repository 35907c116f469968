"""Where commands print: long lines are left to the terminal to wrap, so that paths can be copied.

No text is read as markup of rich, in tables neither: names of runs, files and settings may hold brackets.
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import TextColumn
from rich.table import Table

from jaxslam.cli.shared_options import WithJson

console = Console(soft_wrap=True, markup=False)
plain_console = Console(soft_wrap=True, markup=False, highlight=False)
"""For texts in which numbers should not be colored."""


@contextmanager
def messages_for(command: object) -> Iterator[None]:
    """While a command runs with `--json`, both consoles print to standard error: the document stands alone."""
    before = console.stderr, plain_console.stderr
    if isinstance(command, WithJson) and command.json:
        console.stderr = plain_console.stderr = True
    try:
        yield
    finally:
        console.stderr, plain_console.stderr = before


def print_json(document: Any) -> None:
    """Print a document to standard output; a figure that is not finite, which JSON has no number for, is null."""
    print(json.dumps(_finite(document), indent=2, allow_nan=False))


def _finite(document: Any) -> Any:
    """The document with `None` for floats that are not finite."""
    if isinstance(document, float):
        return document if math.isfinite(document) else None
    if isinstance(document, Mapping):
        return {key: _finite(value) for key, value in document.items()}
    return [_finite(value) for value in document] if isinstance(document, list | tuple) else document


def make_table(title: str, *headings: str, left: int = 1, wrap_first: bool = False, gap: int = 2) -> Table:
    """A table that fits 80 columns: a word too long for its cell goes on in the next line instead of being cut off.

    Args:
        title: What stands above it; empty for none.
        headings: Of the columns; words one below the other.
        left: How many columns, from the first, hold texts. The others hold figures, which stand at the right.
        wrap_first: Whether the first column, whose names are mostly there to be copied, may be broken too.
        gap: Spaces between columns, 1 or more.
    """
    table = Table(title=title or None, title_justify="left", box=SIMPLE_HEAD, padding=(0, 0, 0, gap - 1))
    for index, heading in enumerate(headings):
        is_text = index < left
        whole = index == 0 and not wrap_first
        text = heading if is_text else heading.replace(" ", "\n")
        table.add_column(text, justify="left" if is_text else "right", overflow="fold", no_wrap=whole)
    return table


def text_column(text: str) -> TextColumn:
    """A column of a progress bar, whose text may hold brackets."""
    return TextColumn(text, markup=False)
