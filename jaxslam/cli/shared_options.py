"""Options that several commands share."""

import itertools
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import tyro

Settings: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""`key=value` texts: one tuple for each time that the option was given."""

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
