"""Figures that a module draws, kept to look into them."""

from types import ModuleType
from typing import Any

import pytest
from matplotlib.figure import Figure


def recorded_figures(module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Have a module keep the figures that it makes from now on, and return the growing list of them."""
    drawn: list[Figure] = []

    class Recorded(Figure):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            drawn.append(self)

    monkeypatch.setattr(module, "Figure", Recorded)
    return drawn
