"""What a promptable segmenter is asked for: a thing in an image, by points and a box."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

BESIDE, ON, TOP_LEFT, BOTTOM_RIGHT = range(4)
"""SAM's numbers for points: on the thing or beside it, and two corners that make a box."""
NO_POINT = -1
"""SAM's number for a row that holds no point."""


class Prompt(NamedTuple):
    """One thing in an image.

    Attributes:
        points: `(n, 2)` x and y in pixels from the image's top left corner, as boxes are measured.
        kinds: What each point is: `ON`, `BESIDE`, or a corner of the box.
        label: What the thing is called.
    """

    points: Float32[np.ndarray, "n 2"]
    kinds: tuple[int, ...]
    label: str

    @property
    def box(self) -> tuple[float, float, float, float] | None:
        """Left, top, right, bottom, if it has a box."""
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
    """A prompt of a box, of points, or of both.

    Args:
        label: What the thing is called.
        box: Left, top, right, bottom in pixels: `image[top:bottom, left:right]` is what it covers.
        on: Pixels `(u, v)` of the thing, (0, 0) the center of the top left one.
        beside: Pixels that are not of it.
    """
    rows = [(ON, u + 0.5, v + 0.5) for u, v in on] + [(BESIDE, u + 0.5, v + 0.5) for u, v in beside]
    if box is not None:
        left, top, right, bottom = (float(edge) for edge in box)
        rows += [(TOP_LEFT, left, top), (BOTTOM_RIGHT, right, bottom)]
    points = np.array([row[1:] for row in rows], np.float32).reshape(-1, 2)
    return Prompt(points, tuple(int(row[0]) for row in rows), label)
