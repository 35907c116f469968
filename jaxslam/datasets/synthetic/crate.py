"""A box with a pattern, such as a crate: how it looks; where it is, who moves it says."""

import numpy as np

from jaxslam.datasets.synthetic.primitives import Solid, box
from jaxslam.datasets.synthetic.texture import Material

Color = tuple[float, float, float]


class Crate:
    """One textured box, whose frame is in its center, along its edges.

    Attributes:
        half_m: Half its length along x, y and z.
    """

    label = "box"

    def __init__(self, half_m: np.ndarray, colors: tuple[Color, Color], rng: np.random.Generator) -> None:
        """A box of that size, with dark patches on a noise between two colors."""
        self.half_m = half_m
        look = Material(
            *colors,
            dark=tuple(rng.uniform(0.0, 0.4, 3)),
            noise_per_m=5.0,
            stretch=2.0,
            noise=0.6,
            patch_m=0.22,
            patch_density=0.6,
        )
        self.solids: list[Solid] = [box((half_m[0], half_m[1], half_m[2]), look, rng)]

    def parts(self, time_s: np.ndarray) -> np.ndarray:
        """The box lies along the axes of its frame: `(t, 1, 4, 4)` identities."""
        return np.broadcast_to(np.eye(4), (len(time_s), 1, 4, 4))
