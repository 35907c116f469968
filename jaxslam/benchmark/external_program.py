"""Another program that is run to its end: its command line, its time limit, what it takes, and how it is stopped."""

import contextlib
import os
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import psutil

from jaxslam.errors import BenchmarkError
from jaxslam.runtime.platform_choice import environment_of_user

_LOOK_EVERY_S = 0.1
_LOOKS_PER_SEARCH = 10
"""Memory is read each time, children are searched for once in so many: a search reads every process of the machine."""


@dataclass(frozen=True)
class Program:
    """A program that is run without a shell.

    Attributes:
        name: Name in tables.
        command: Words of its command line.
        is_ours: Whether it is of jaxslam, and takes the platform of JAX that a command of jaxslam chose; others have
            the environment of the user.
    """

    name: str
    command: tuple[str, ...]
    is_ours: bool = False


@dataclass(frozen=True)
class Ended:
    """Exit status, time and memory of a program that has ended.

    Attributes:
        exit_code: Exit status, the negative number of the signal if one ended it; `None` if the time limit did.
        wall_s: Time from its start to its end, seconds.
        cpu_s: Processor time of the program and of the children that it waited for, seconds; `None` where the system
            does not tell.
        peak_mb: Peak resident memory of the program and its children together, megabytes, looked at every 0.1 s.
    """

    exit_code: int | None
    wall_s: float
    cpu_s: float | None
    peak_mb: float


def named_value(option: str, text: str, what: str) -> tuple[str, str]:
    """Split `NAME=VALUE`.

    Args:
        option: Option that was given, for the error.
        text: Its value.
        what: What the value is, in capitals, for the error.

    Raises:
        BenchmarkError: If there is no name or no value.
    """
    name, _, value = (part.strip() for part in text.partition("="))
    if not name or not value:
        raise BenchmarkError(f"{option}: expected NAME={what}, got '{text}'")
    return name, value


def command_words(command: str, values: Mapping[str, str], place: str) -> tuple[str, ...]:
    """Split a command line into words as a shell would, and put values where it has their names in braces.

    Args:
        command: Command line, such as `run_slam --fps {rate} {recording}`.
        values: Values by name. A value is never split, whatever it contains.
        place: Option or key that holds the command, for the error.

    Raises:
        BenchmarkError: If there is no word, a quote is open, or a name in braces is unknown.
    """
    try:
        words = tuple(word.format_map(values) for word in shlex.split(command))
    except (KeyError, ValueError, IndexError, AttributeError) as problem:
        known = ", ".join(f"{{{value}}}" for value in values)
        raise BenchmarkError(f"{place}: expected a command with {known} at most, got '{command}': {problem}") from None
    if not words:
        raise BenchmarkError(f"{place}: expected a command, got '{command}'")
    return words


def run_to_its_end(
    program: Program,
    printed: BinaryIO,
    errors: BinaryIO,
    *,
    limit_s: float | None = None,
    folder: Path | None = None,
) -> Ended:
    """Run a program without a shell and without input, and kill whatever it leaves running.

    Args:
        program: Program to run.
        printed: File for its standard output.
        errors: File for its standard error.
        limit_s: Time after which it is killed with all its children, seconds; `None` for no limit.
        folder: Working directory; `None` for that of this process.

    Raises:
        BenchmarkError: If it cannot be started.
    """
    cpu_before_s, began = _children_cpu_s(), time.perf_counter()
    try:
        # Files instead of pipes: a child that outlives the program would keep a pipe open for ever.
        process = subprocess.Popen(
            program.command,
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=errors,
            cwd=folder,
            env=None if program.is_ours else environment_of_user(),
            start_new_session=True,
        )
    except (OSError, ValueError) as problem:
        reason = problem.strerror if isinstance(problem, OSError) else problem
        raise BenchmarkError(f"{program.name}: '{program.command[0]}' cannot be run: {reason}") from None
    memory = _PeakMemory(process.pid)
    exit_code = None
    try:
        with contextlib.suppress(subprocess.TimeoutExpired):
            exit_code = process.wait(limit_s)
    finally:  # after Ctrl-C too
        wall_s = time.perf_counter() - began
        memory.stop()
        kill_with_children(process.pid)
        process.wait()
    cpu_s = None if cpu_before_s is None else (_children_cpu_s() or 0.0) - cpu_before_s
    return Ended(exit_code, wall_s, cpu_s, memory.peak_mb)


def kill_with_children(pid: int) -> None:
    """Kill a process and all that it has started: its descendants, and what is left of its session."""
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        for member in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                member.kill()
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):  # none is left
            os.killpg(pid, signal.SIGKILL)


def _children_cpu_s() -> float | None:
    """Return the processor time of all children that have ended; `None` where the system keeps none."""
    if os.name == "nt":
        return None
    times = os.times()
    return times.children_user + times.children_system


class _PeakMemory:
    """Watches the resident memory of a process and its descendants, in a thread.

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
        family: Sequence[psutil.Process] = ()
        looks = 0
        try:
            process = psutil.Process(self._pid)
            while True:
                if looks % _LOOKS_PER_SEARCH == 0:
                    family = process.children(recursive=True)
                looks += 1
                self.peak_mb = max(self.peak_mb, _rss_mb(process) + sum(_rss_mb_or_none(child) for child in family))
                if self._stopped.wait(_LOOK_EVERY_S):
                    return
        except psutil.Error:  # it has ended
            return


def _rss_mb(process: psutil.Process) -> float:
    return process.memory_info().rss / 1e6


def _rss_mb_or_none(process: psutil.Process) -> float:
    """Resident memory of a process that may have ended, which has none."""
    with contextlib.suppress(psutil.Error):
        return _rss_mb(process)
    return 0.0
