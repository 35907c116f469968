"""Options that hold settings, and may be given several times."""

import itertools
from typing import Annotated, TypeAlias

import tyro

Settings: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""`key=value` texts, by the times that the option was given."""


def flat(settings: Settings) -> tuple[str, ...]:
    """All of them, in their order."""
    return tuple(itertools.chain(*settings))
