"""Call commands as a shell would, and read what they print."""

import json
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

from jaxslam.cli.entry_point import main

Fails = Callable[..., str]


def failing(*command: str, code: int = 1) -> Fails:
    """What takes `capsys` and the rest of a command's arguments: it must end with a code and one line, `error: ...`.

    Returns:
        Of the line, what comes after `error: `.
    """

    def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
        with pytest.raises(SystemExit) as stop:
            main([*command, *arguments])
        assert stop.value.code == code
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert lines[0].startswith("error: ")
        return lines[0].removeprefix("error: ")

    return fails


def printed_json(capsys: pytest.CaptureFixture[str]) -> tuple[Any, str]:
    """Read what a command with `--json` has printed.

    Returns:
        The only JSON document on standard output, in which NaN and infinity are not allowed, and the messages on
        standard error.
    """

    def not_json(text: str) -> NoReturn:
        raise AssertionError(f"expected null for a figure that is not finite, got {text}")

    out, err = capsys.readouterr()
    return json.loads(out, parse_constant=not_json), err
