"""The command line: the commands are listed in `jaxslam.cli.command_table`, and `jaxslam --help` prints that list."""

import logging
import os
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from jaxslam.cli.command_table import COMMANDS, Command, ExitCode, below, find_command
from jaxslam.errors import JaxSlamError, MissingModelError, nearest
from jaxslam.runtime.platform_choice import prefer_cpu

_ABOUT = "Real-time visual SLAM for dynamic scenes. Start with: jaxslam demo"
_HELP = ("-h", "--help")
_OPTIONS = {"-h, --help": "Print this help.", "--version": "Print versions, the processor, and where caches are."}
_WIDTH = 80


def main(arguments: Sequence[str] | None = None) -> None:
    """The `jaxslam` command, which ends as `ExitCode` says: a known error is one line."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        _run(list(sys.argv[1:] if arguments is None else arguments))
    except JaxSlamError as error:
        _end(ExitCode.USAGE if isinstance(error, MissingModelError) else ExitCode.KNOWN_ERROR, str(error))
    except BrokenPipeError:  # what reads the output has read enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to flush goes nowhere
        sys.exit(ExitCode.KNOWN_ERROR)
    except KeyboardInterrupt:
        _end(ExitCode.INTERRUPTED, "interrupted")


def _run(words: list[str]) -> None:
    """Do what the words of a command line say."""
    if words[:1] == ["--version"]:
        from jaxslam.cli.version import version_text  # noqa: PLC0415 - it imports JAX

        print(version_text())
        sys.exit(ExitCode.DONE)
    command = find_command(words)
    if command is None or command.place is None:
        _list_commands(command, words)
    if not command.takes_gpu:
        prefer_cpu()
    import tyro  # noqa: PLC0415 - not needed to list commands, and neither is rich

    from jaxslam.cli.console import messages_for  # noqa: PLC0415

    rest = words[len(command.words) :]
    called: Any = tyro.cli(
        command.options(), prog=f"jaxslam {command.name}", args=rest, description=command.description
    )
    with messages_for(called):
        called.main()


def _list_commands(group: Command | None, words: list[str]) -> NoReturn:
    """Print the help of `jaxslam`, or of a group of commands; an error if it was not asked for.

    Args:
        group: The group that the words begin with, if any.
        words: The command line.
    """
    words, commands = (words, COMMANDS) if group is None else (words[len(group.words) :], below(group))
    text = _help() if group is None else _help_of(group)
    if not words:
        _end(ExitCode.USAGE, "expected a command", text)
    if words[0] in _HELP:
        print(text)
        sys.exit(ExitCode.DONE)
    names = dict.fromkeys(command.words[0 if group is None else len(group.words)] for command in commands)
    options = ("--help", "--version") if group is None else ("--help",)
    _end(ExitCode.USAGE, f"expected a command, got '{words[0]}'{nearest(words[0], (*names, *options))}")


def _end(code: ExitCode, problem: str, before: str = "") -> NoReturn:
    """Leave with an exit code and one line that says why, behind a text if there is one."""
    if before:
        print(before, file=sys.stderr)
    print(f"error: {problem}", file=sys.stderr)
    sys.exit(code)


def _help() -> str:
    """The help of `jaxslam` itself."""
    codes = {str(int(code)): f"{code.text[0].upper()}{code.text[1:]}." for code in ExitCode}
    commands = {command.name: command.about for command in COMMANDS}
    sections = {"commands": commands, "options": _OPTIONS, "exit codes": codes}
    return _text("usage: jaxslam [-h] [--version] COMMAND ...", _ABOUT, sections)


def _help_of(group: Command) -> str:
    """The help of a group of commands."""
    commands = {command.name: command.about for command in below(group)}
    return _text(f"usage: jaxslam {group.name} [-h] COMMAND ...", group.about, {"commands": commands})


def _text(usage: str, about: str, sections: Mapping[str, Mapping[str, str]]) -> str:
    widest = max(len(name) for rows in sections.values() for name in rows)
    lines = [usage, "", about]
    for title, rows in sections.items():
        lines += ["", f"{title}:", *(_row(name, text, widest) for name, text in rows.items())]
    return "\n".join([*lines, "", "The options of a command: jaxslam COMMAND --help"])


def _row(name: str, text: str, widest: int) -> str:
    indent = " " * (widest + 4)
    return textwrap.fill(text, _WIDTH, initial_indent=f"  {name:<{widest}}  ", subsequent_indent=indent)
