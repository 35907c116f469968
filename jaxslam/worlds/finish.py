"""The finish of things: a look as the renderer takes it."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TypeAlias

import numpy as np

from jaxslam.datasets.synthetic.room import printed
from jaxslam.datasets.synthetic.texture import Material
from jaxslam.worlds.description import Look


class Finish:
    """A look, which gives each thing colors of its own if it is printed."""

    def __init__(self, look: Look) -> None:
        fields = asdict(look)
        self._printed = fields.pop("printed")
        self._material = Material(**fields)

    def material(self, rng: np.random.Generator) -> Material:
        """Return the material of one thing; `rng` chooses the colors of its own."""
        return printed(self._material, rng) if self._printed else self._material


Finishes: TypeAlias = Mapping[str, Finish]
"""Finishes by the name of their look."""
