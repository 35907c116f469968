"""Files that the commands which measure leave behind: figures as JSON, tables as Markdown, maybe a plot as PNG."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxslam.cli.console import console
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import write_atomically


def write_measurements(
    out: Path, name: str, content: Mapping[str, Any], markdown: str, plot_png: bytes | None = None
) -> None:
    """Write `NAME.json`, `NAME.md`, and `NAME.png` if there is a plot, and print where they are.

    Args:
        out: Existing folder for the files; files of the same names are replaced.
        name: Name of the files without their endings.
        content: Figures and the conditions under which they were measured.
        markdown: Report with the table.
        plot_png: Plot as a PNG file; `None` for none.

    Raises:
        BenchmarkError: If a file cannot be written.
    """
    figures, report, plot = (out / f"{name}.{ending}" for ending in ("json", "md", "png"))
    write_atomically(figures, (json.dumps(content, indent=1) + "\n").encode(), BenchmarkError)
    write_atomically(report, markdown.encode(), BenchmarkError)
    if plot_png is None:
        console.print(f"Table: {report}; figures: {figures}")
        return
    write_atomically(plot, plot_png, BenchmarkError)
    console.print(f"Table and plot: {report}, {plot}; figures: {figures}")
