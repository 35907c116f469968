"""`jaxslam bench live`: time of a frame at the rate of the camera, beside other programs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxslam.cli.console import console, make_table, plain_console, print_json, progress_bar
from jaxslam.cli.shared_options import Settings, WithJson, check_at_least, flat
from jaxslam.errors import BenchmarkError
from jaxslam.io.atomic_files import make_folder

if TYPE_CHECKING:
    from jaxslam.benchmark.live.program import Program

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Live(WithJson):
    """Options of `jaxslam bench live`."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Folder of a recording."""
    others: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="with", metavar="NAME=COMMAND")
    ] = ()
    """Another program to time in turn. Its command line may hold {recording}, {rate}, {start}, {stop} and {every}.
    It prints a line of JSON with frames, tracked, median_ms, p95_ms and cpu_ms, or words: `160 frames, 158 OK; median
    20.0 ms, p95 25.9; processor time 36.2 ms`. Repeatable."""
    rounds: int = 5
    """Number of runs of each program."""
    rate: float | None = None
    """Frames a second; by default, those of the camera."""
    start: int = 0
    """Index of the first frame."""
    stop: int | None = None
    """Index after the last frame; by default, the end."""
    every: int = 1
    """Step between frames, such as 3 for every third one."""
    preset: str = "default"
    """Preset to start from."""
    out: Path = Path("results") / "bench" / "live"
    """Folder for the table, the plot, and the figures. Those of an earlier measurement are replaced."""
    set: Settings = ()
    """Settings, such as `--set semantics.model=null`. Repeatable."""

    def main(self) -> None:
        """Run the command."""
        for name, value, least in (("rounds", self.rounds, 1), ("start", self.start, 0), ("every", self.every, 1)):
            check_at_least(f"--{name}", value, least)
        if self.rate is not None and not 0 < self.rate < float("inf"):
            raise BenchmarkError(f"--rate: expected frames a second, more than 0, got {self.rate:g}")
        from jaxslam.benchmark.live.program import ours, parse_program  # noqa: PLC0415
        from jaxslam.benchmark.reports.live import MEANING, conditions, markdown_report, picture  # noqa: PLC0415
        from jaxslam.cli.measurement_files import write_measurements  # noqa: PLC0415
        from jaxslam.config.loading import load_config  # noqa: PLC0415
        from jaxslam.datasets import Subset, open_dataset  # noqa: PLC0415
        from jaxslam.runtime.machine import machine  # noqa: PLC0415

        load_config(self.preset, None, flat(self.set))  # so that a wrong setting is said before anything runs
        dataset = Subset(open_dataset(self.recording), self.start, self.stop, self.every)
        rate_hz = dataset.camera.fps if self.rate is None else self.rate
        values = {
            "recording": str(self.recording),
            "rate": f"{rate_hz:g}",
            "start": str(self.start),
            "stop": str(dataset.indices.stop),
            "every": str(self.every),
        }
        others = [parse_program(text, values) for text in self.others]
        make_folder(self.out, BenchmarkError)
        own = ours({**values, "preset": self.preset}, flat(self.set))
        runs = self._measured([own, *others])
        content = {
            **machine(),
            "recording": dataset.name,
            "rate_hz": rate_hz,
            "preset": self.preset,
            "settings": list(flat(self.set)),
            "rounds": self.rounds,
            "runs": runs,
        }
        if self.json:
            print_json(content)
        else:
            _print_tables(runs)
            plain_console.print(f"{conditions(content)} {MEANING}")
        write_measurements(self.out, "live", content, markdown_report(content), picture(content))

    def _measured(self, programs: "Sequence[Program]") -> list[dict[str, Any]]:
        """Run all programs in turn, with a progress bar; the first run of jaxslam compiles, and is not counted."""
        from jaxslam.benchmark.live.program import run_program  # noqa: PLC0415

        runs: list[dict[str, Any]] = []
        with progress_bar("{task.description}", redraw=False) as progress:
            bar = progress.add_task("compiling", total=1 + self.rounds * len(programs))
            progress.refresh()
            run_program(programs[0])
            progress.advance(bar)
            for number in range(self.rounds):
                for program in programs:
                    progress.update(bar, description=f"round {number + 1}, {program.name}", refresh=True)
                    runs.append({"program": program.name, "round": number, **asdict(run_program(program))})
                    progress.advance(bar)
            progress.update(bar, description="Live", refresh=True)
        return runs


def _print_tables(runs: Sequence[dict[str, Any]]) -> None:
    from jaxslam.benchmark.reports.live import COLUMNS, RATIO_COLUMNS, ratio_rows, rows  # noqa: PLC0415

    console.print(make_table("Live", *COLUMNS, rows=rows(runs), gap=1))
    if ratios := ratio_rows(runs):
        console.print(make_table("Ratios", *RATIO_COLUMNS, rows=ratios, gap=1))
