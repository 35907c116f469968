"""Options that several commands share."""

import itertools
import re
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import tyro

from jaxslam.errors import BenchmarkError

Settings: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""`key=value` texts: one tuple for each time that the option was given."""

_MIN_PX, _MAX_PX = 64, 8192

ALLOW_MISSING_MODEL = "semantics.missing_model=allow"
"""Setting behind `--allow-missing-model`."""


@dataclass(frozen=True, kw_only=True)
class WithJson:
    """Base of the commands that print figures or lists."""

    json: bool = False
    """Print a single JSON document to standard output and nothing else; messages go to standard error."""


def flat(settings: Settings) -> tuple[str, ...]:
    """Return all `key=value` texts in the order in which they were given."""
    return tuple(itertools.chain(*settings))


def check_at_least(option: str, value: int, least: int) -> None:
    """Raise `BenchmarkError` if the value of an option is below the least."""
    if value < least:
        raise BenchmarkError(f"{option}: expected at least {least}, got {value}")


def image_size(text: str) -> tuple[int, int]:
    """Return the width and height that `--size` gives, pixels.

    Raises:
        BenchmarkError: If it gives none, or one that is too small or too large.
    """
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    sides = tuple(map(int, found.groups())) if found else ()
    if not sides or not all(_MIN_PX <= side <= _MAX_PX for side in sides):
        raise BenchmarkError(f"--size: expected WIDTHxHEIGHT of {_MIN_PX} to {_MAX_PX} pixels each, got '{text}'")
    return sides[0], sides[1]
