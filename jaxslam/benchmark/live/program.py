"""A program that is timed: how it is started, what it prints, how much memory it takes."""

import shlex
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import psutil

from jaxslam.benchmark.live.figures import LiveFigures, parse_figures
from jaxslam.benchmark.process_ending import last_words
from jaxslam.errors import BenchmarkError

_LOOK_EVERY_S = 0.1


@dataclass(frozen=True)
class Program:
    """A program that tracks a recording live and prints its figures.

    Attributes:
        name: Name in the table.
        command: Words of its command line.
    """

    name: str
    command: tuple[str, ...]


def parse_program(text: str, values: Mapping[str, str]) -> Program:
    """Read `NAME=COMMAND`, and put values where the command has their names in braces.

    Args:
        text: Value of the option `--with`.
        values: Values by name, such as the folder of the recording.

    Raises:
        BenchmarkError: If there is no name, no command, or an unknown name in braces.
    """
    name, _, command = text.partition("=")
    if not name.strip() or not command.strip():
        raise BenchmarkError(f"--with: expected NAME=COMMAND, got '{text}'")
    try:
        words = tuple(word.format_map(values) for word in shlex.split(command))
    except (KeyError, ValueError, IndexError) as problem:
        known = ", ".join(f"{{{value}}}" for value in values)
        raise BenchmarkError(f"--with: expected a command with {known} at most, got '{command}': {problem}") from None
    return Program(name.strip(), words)


def run_program(program: Program) -> LiveFigures:
    """Run a program to its end, and return what it printed of itself with its peak memory.

    Raises:
        BenchmarkError: If it cannot be started, fails, or prints no figures.
    """
    try:
        process = subprocess.Popen(program.command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    except OSError as problem:
        raise BenchmarkError(f"{program.name}: '{program.command[0]}' cannot be run: {problem.strerror}") from None
    memory = _PeakMemory(process.pid)
    try:
        printed, errors = process.communicate()
    except BaseException:
        process.kill()
        raise
    finally:
        memory.stop()
    if process.returncode:
        raise BenchmarkError(f"{program.name}: exit code {process.returncode}: {last_words(errors)}")
    return replace(parse_figures(program.name, printed), peak_mb=memory.peak_mb)


def ours(options: Mapping[str, str], settings: Sequence[str]) -> Program:
    """Return the program that tracks a recording with jaxslam; see `own_run`.

    Args:
        options: Values of `own_run.OPTIONS`.
        settings: Settings as `key=value`.
    """
    words = [*(f"--{name}={value}" for name, value in options.items()), *(f"--set={setting}" for setting in settings)]
    return Program("jaxslam", (sys.executable, "-m", "jaxslam.benchmark.live.own_run", *words))


class _PeakMemory:
    """Watches the resident memory of a process, in a thread.

    Attributes:
        peak_mb: Peak so far, megabytes.
    """

    def __init__(self, pid: int) -> None:
        self.peak_mb = 0.0
        self._pid, self._stopped = pid, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        try:
            process = psutil.Process(self._pid)
            while True:
                self.peak_mb = max(self.peak_mb, process.memory_info().rss / 1e6)
                if self._stopped.wait(_LOOK_EVERY_S):
                    return
        except psutil.Error:  # it has ended
            return
