"""Prompts of a promptable segmenter: points and a box of an object in an image."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

BESIDE, ON, TOP_LEFT, BOTTOM_RIGHT = range(4)
"""SAM's labels of points: on the object, beside it, and the two corners of a box."""
NO_POINT = -1
"""SAM's label of a padding point."""


class Prompt(NamedTuple):
    """Prompt of one object in an image.

    Attributes:
        points: `(n, 2)` x and y in pixels from the top-left corner of the image, as in boxes.
        kinds: Label of each point: `ON`, `BESIDE`, or a corner of the box.
        label: Name of the object's class.
    """

    points: Float32[np.ndarray, "n 2"]
    kinds: tuple[int, ...]
    label: str

    @property
    def box(self) -> tuple[float, float, float, float] | None:
        """Left, top, right and bottom of the box in pixels; `None` without a box."""
        if TOP_LEFT not in self.kinds:
            return None
        corners = [self.points[self.kinds.index(kind)].tolist() for kind in (TOP_LEFT, BOTTOM_RIGHT)]
        return (corners[0][0], corners[0][1], corners[1][0], corners[1][1])


def prompt(
    label: str,
    *,
    box: Sequence[float] | np.ndarray | None = None,
    on: Iterable[Sequence[float]] = (),
    beside: Iterable[Sequence[float]] = (),
) -> Prompt:
    """Make a prompt from a box, points, or both.

    Args:
        label: Name of the object's class.
        box: Left, top, right and bottom in pixels; the box covers `image[top:bottom, left:right]`.
        on: Pixels `(u, v)` of the object; (0, 0) is the center of the top-left pixel.
        beside: Pixels `(u, v)` beside the object.
    """
    rows = [(ON, u + 0.5, v + 0.5) for u, v in on] + [(BESIDE, u + 0.5, v + 0.5) for u, v in beside]
    if box is not None:
        left, top, right, bottom = (float(edge) for edge in box)
        rows += [(TOP_LEFT, left, top), (BOTTOM_RIGHT, right, bottom)]
    points = np.array([row[1:] for row in rows], np.float32).reshape(-1, 2)
    return Prompt(points, tuple(int(row[0]) for row in rows), label)
