"""Commands as a shell would call them, and what they say when they cannot."""

from collections.abc import Callable

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
