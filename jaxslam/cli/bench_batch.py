"""`jaxslam bench batch`: the whole tracker on many clips at once, beside clip by clip."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn
from rich.table import Table

from jaxslam.benchmark.batch_throughput import DIFFERENT, make_task, measure
from jaxslam.benchmark.reports.batch import COLUMNS, cells, how, markdown_report, picture
from jaxslam.cli.console import console, make_table, plain_console, print_json, text_column
from jaxslam.cli.shared_options import WithJson
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder, write_atomically
from jaxslam.runtime.machine import machine

_JSON, _MARKDOWN, _PICTURE = "batch.json", "batch.md", "batch.png"
_LEFT_OUT = ("loop", "worst, m")
"""Columns for which there is no room in a terminal."""
_FEWEST_FRAMES, _MIN_PX, _MAX_PX = 3, 64, 8192


@dataclass(frozen=True)
class Batch(WithJson):
    """Options of `jaxslam bench batch`."""

    clips: tuple[int, ...] = (1, 4, 16, 64)
    """Numbers of clips."""
    frames: int = 30
    """Frames of each."""
    size: str = "320x240"
    """Width and height of the images."""
    rounds: int = 3
    """How often each is timed."""
    out: Path = Path("results") / "bench" / "batch"
    """Folder for the table, the picture and the figures; those of an earlier time are replaced."""

    def main(self) -> None:
        """Run the command."""
        width, height = self._checked()
        make_folder(self.out, BenchmarkError)
        counts = sorted(set(self.clips))  # the peak of memory is that of the largest so far
        different = min(DIFFERENT, counts[-1])
        rows = self._measured(counts, different, width, height)
        content = {
            **machine(),
            "backend": jax.default_backend(),
            "device": jax.local_devices()[0].device_kind,
            "size": [width, height],
            "frames": self.frames,
            "rounds": self.rounds,
            "different": different,
            "rows": rows,
        }
        if self.json:
            print_json(content)
        else:
            console.print(clips_table(rows))
            plain_console.print(how(content))
        files = {
            _JSON: (json.dumps(content, indent=1) + "\n").encode(),
            _MARKDOWN: markdown_report(content).encode(),
            _PICTURE: picture(content),
        }
        for name, data in files.items():
            write_atomically(self.out / name, data, BenchmarkError)
        console.print(f"Table and picture: {self.out / _MARKDOWN}, {self.out / _PICTURE}; figures: {self.out / _JSON}")

    def _checked(self) -> tuple[int, int]:
        """The size of the images, if all options are fit."""
        if not self.clips or min(self.clips) < 1:
            raise BenchmarkError(f"--clips: expected numbers of at least 1, got {' '.join(map(str, self.clips))}")
        if self.frames < _FEWEST_FRAMES:
            raise BenchmarkError(
                f"--frames: expected at least {_FEWEST_FRAMES}, to be aligned with the truth, got {self.frames}"
            )
        if self.rounds < 1:
            raise BenchmarkError(f"--rounds: expected at least 1, got {self.rounds}")
        found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", self.size)
        sides = tuple(map(int, found.groups())) if found else ()
        if not sides or not all(_MIN_PX <= side <= _MAX_PX for side in sides):
            raise BenchmarkError(
                f"--size: expected WIDTHxHEIGHT of {_MIN_PX} to {_MAX_PX} pixels each, got '{self.size}'"
            )
        return sides[0], sides[1]

    def _measured(self, counts: Sequence[int], different: int, width: int, height: int) -> list[dict[str, Any]]:
        columns = text_column("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
        rows: list[dict[str, Any]] = []
        # Drawn between measurements only: a thread that draws would run on a core where they are taken.
        with Progress(*columns, console=console, auto_refresh=False) as progress:
            bar = progress.add_task(f"rendering {different} clips", total=1 + len(counts))
            progress.refresh()
            task = make_task(different, self.frames, width, height)
            for count in counts:
                progress.advance(bar)
                progress.update(bar, description=f"clips: {count}", refresh=True)
                rows += measure(task, count, self.rounds)
            progress.advance(bar)
            progress.update(bar, description="clips", refresh=True)
        return rows


def clips_table(rows: Sequence[dict[str, Any]]) -> Table:
    """The rows of `measure` for a terminal, but for columns for which there is no room."""
    shown = [index for index, column in enumerate(COLUMNS) if column not in _LEFT_OUT]
    drawn = make_table("Clips at once", *(COLUMNS[index] for index in shown), left=2, gap=1)
    for row in rows:
        texts = cells(row)
        drawn.add_row(*(texts[index] for index in shown))
    return drawn
