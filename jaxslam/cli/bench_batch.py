"""`jaxslam bench batch`: throughput of the whole tracker on many clips at once, compared with clip by clip."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from jaxslam.cli.console import console, make_table, plain_console, print_json, progress_bar
from jaxslam.cli.shared_options import WithJson, check_at_least, image_size
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder

_LEFT_OUT = ("loop", "worst, m")
"""Columns for which a terminal has no room."""
_MIN_FRAMES = 3

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Batch(WithJson):
    """Options of `jaxslam bench batch`."""

    clips: tuple[int, ...] = (1, 4, 16, 64)
    """Numbers of clips to track at once; each number is measured."""
    frames: int = 30
    """Number of frames of each clip."""
    size: str = "320x240"
    """Width and height of the images, in pixels."""
    rounds: int = 3
    """Number of times that each measurement is repeated."""
    out: Path = Path("results") / "bench" / "batch"
    """Folder for the table, the plot, and the figures. Those of an earlier measurement are replaced."""

    def main(self) -> None:
        """Run the command."""
        width, height = self._checked()
        make_folder(self.out, BenchmarkError)
        import jax  # noqa: PLC0415

        from jaxslam.benchmark.batch_throughput import DIFFERENT  # noqa: PLC0415
        from jaxslam.benchmark.reports.batch import how, markdown_report, picture  # noqa: PLC0415
        from jaxslam.cli.measurement_files import write_measurements  # noqa: PLC0415
        from jaxslam.runtime.machine import machine  # noqa: PLC0415

        counts = sorted(set(self.clips))  # ascending, as the peak of memory is that of the largest count so far
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
        write_measurements(self.out, "batch", content, markdown_report(content), picture(content))

    def _checked(self) -> tuple[int, int]:
        """Check all options, and return the width and height of the images."""
        if not self.clips or min(self.clips) < 1:
            raise BenchmarkError(f"--clips: expected numbers of at least 1, got {' '.join(map(str, self.clips))}")
        if self.frames < _MIN_FRAMES:
            raise BenchmarkError(
                f"--frames: expected at least {_MIN_FRAMES}, to align them with the ground truth, got {self.frames}"
            )
        check_at_least("--rounds", self.rounds, 1)
        return image_size(self.size)

    def _measured(self, counts: Sequence[int], different: int, width: int, height: int) -> list[dict[str, Any]]:
        """Render the clips, and measure each count with a progress bar."""
        from jaxslam.benchmark.batch_throughput import make_task, measure  # noqa: PLC0415

        rows: list[dict[str, Any]] = []
        with progress_bar("{task.description}", redraw=False) as progress:
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
    """Make a table of the rows of `measure` for a terminal, without the columns for which it has no room."""
    from jaxslam.benchmark.reports.batch import COLUMNS, cells  # noqa: PLC0415

    shown = [index for index, column in enumerate(COLUMNS) if column not in _LEFT_OUT]
    headings = (COLUMNS[index] for index in shown)
    texts = ([cells(row)[index] for index in shown] for row in rows)
    return make_table("Clips at once", *headings, rows=texts, left=2, gap=1)
