"""A program that is timed live: its command line, and the figures that it prints of itself."""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import BinaryIO

from jaxslam.benchmark.external_program import Program, command_words, named_value, run_to_its_end
from jaxslam.benchmark.live.figures import LiveFigures, parse_figures
from jaxslam.benchmark.process_ending import last_words
from jaxslam.errors import BenchmarkError


def parse_program(text: str, values: Mapping[str, str]) -> Program:
    """Read `NAME=COMMAND`, and put values where the command has their names in braces.

    Args:
        text: Value of the option `--with`.
        values: Values by name, such as the folder of the recording.

    Raises:
        BenchmarkError: If there is no name, no command, or an unknown name in braces.
    """
    name, command = named_value("--with", text, "COMMAND")
    return Program(name, command_words(command, values, "--with"))


def run_program(program: Program, *, limit_s: float | None = None) -> LiveFigures:
    """Run a program to its end, and return what it printed of itself with its peak memory.

    Args:
        program: Program to run.
        limit_s: Time after which it is killed with all its children, seconds; `None` for no limit.

    Raises:
        BenchmarkError: If it cannot be started, fails, is killed, or prints no figures.
    """
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as errors:
        ended = run_to_its_end(program, printed, errors, limit_s=limit_s)
        if ended.exit_code is None:
            raise BenchmarkError(f"{program.name}: timed out after {limit_s:g} s and was killed")
        if ended.exit_code:
            raise BenchmarkError(f"{program.name}: exit code {ended.exit_code}: {last_words(_text(errors))}")
        return replace(parse_figures(program.name, _text(printed)), peak_mb=ended.peak_mb)


def ours(options: Mapping[str, str], settings: Sequence[str]) -> Program:
    """Return the program that tracks a recording with jaxslam; see `own_run`.

    Args:
        options: Values of `own_run.OPTIONS`.
        settings: Settings as `key=value`.
    """
    words = [*(f"--{name}={value}" for name, value in options.items()), *(f"--set={setting}" for setting in settings)]
    return Program("jaxslam", (sys.executable, "-m", "jaxslam.benchmark.live.own_run", *words), is_ours=True)


def _text(file: BinaryIO) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")
