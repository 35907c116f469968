"""Options that hold settings, and may be given several times."""

import itertools
from typing import Annotated, TypeAlias

import tyro

Settings: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""`key=value` texts, by the times that the option was given."""

ALLOW_MISSING_MODEL = "semantics.missing_model=allow"
"""The setting behind `--allow-missing-model`."""


def flat(settings: Settings) -> tuple[str, ...]:
    """All of them, in their order."""
    return tuple(itertools.chain(*settings))
