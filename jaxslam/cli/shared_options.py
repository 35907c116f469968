"""Options that several commands share."""

import itertools
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import tyro

Settings: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""`key=value` texts, by the times that the option was given."""

ALLOW_MISSING_MODEL = "semantics.missing_model=allow"
"""The setting behind `--allow-missing-model`."""


@dataclass(frozen=True, kw_only=True)
class WithJson:
    """What the commands that print figures or lists share."""

    json: bool = False
    """Print one JSON document to standard output, and nothing else there; messages go to standard error."""


def flat(settings: Settings) -> tuple[str, ...]:
    """All of them, in their order."""
    return tuple(itertools.chain(*settings))
