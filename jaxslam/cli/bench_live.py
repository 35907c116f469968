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

_SLACK_S, _SLOWEST = 300.0, 10.0
"""A program is killed five minutes after ten times the time that the frames of the recording take."""

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
    limit: float | None = None
    """Seconds after which a program that has not ended is killed; by default, five minutes and ten times the length of
    the recording."""
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
        for option, value, what in (("rate", self.rate, "frames a second"), ("limit", self.limit, "seconds")):
            if value is not None and not 0 < value < float("inf"):
                raise BenchmarkError(f"--{option}: expected {what}, more than 0, got {value:g}")
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
        limit_s = _SLACK_S + _SLOWEST * len(dataset) / rate_hz if self.limit is None else self.limit
        runs, problems = self._measured([own, *others], limit_s)
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
        if problems:
            raise BenchmarkError("; ".join([*problems, f"the other runs are in {self.out}"]))

    def _measured(self, programs: "Sequence[Program]", limit_s: float) -> tuple[list[dict[str, Any]], list[str]]:
        """Run all programs in turn, with a progress bar; the first run of jaxslam compiles, and is not counted.

        Returns:
            What was measured, and what went wrong in runs that are left out.

        Raises:
            BenchmarkError: If a program fails in its first run.
        """
        from jaxslam.benchmark.live.program import run_program  # noqa: PLC0415

        runs: list[dict[str, Any]] = []
        problems: list[str] = []
        with progress_bar("{task.description}", redraw=False) as progress:
            bar = progress.add_task("compiling", total=1 + self.rounds * len(programs))
            progress.refresh()
            run_program(programs[0], limit_s=limit_s)
            progress.advance(bar)
            for number in range(self.rounds):
                for program in programs:
                    progress.update(bar, description=f"round {number + 1}, {program.name}", refresh=True)
                    try:
                        figures = run_program(program, limit_s=limit_s)
                    except BenchmarkError as problem:
                        if number == 0:  # as wrong in every round
                            raise
                        problems.append(f"round {number + 1}: {problem}")
                    else:
                        runs.append({"program": program.name, "round": number, **asdict(figures)})
                    progress.advance(bar)
            progress.update(bar, description="Live", refresh=True)
        return runs, problems


def _print_tables(runs: Sequence[dict[str, Any]]) -> None:
    from jaxslam.benchmark.reports.live import COLUMNS, RATIO_COLUMNS, ratio_rows, rows  # noqa: PLC0415

    console.print(make_table("Live", *COLUMNS, rows=rows(runs), gap=1))
    if ratios := ratio_rows(runs):
        console.print(make_table("Ratios", *RATIO_COLUMNS, rows=ratios, gap=1))
