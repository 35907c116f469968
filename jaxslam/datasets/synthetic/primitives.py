"""The two solids everything is made of: textured boxes and textured capsules."""

from typing import NamedTuple

import numpy as np

from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.texture import Material, scaled_surface, surface_row
from jaxslam.geometry.so3 import axis_rotation, matrices


class Solid(NamedTuple):
    """A solid in its own axes, centered on the origin.

    Attributes:
        size: `(3,)` meters: half extents of a box; radii of a capsule, the third one of its caps along its axis.
        stem: Half the length of a capsule's axis in units of the third radius, 0 for an ellipsoid; `None` for a box.
        surface: `(6, N_WORDS)` texture of the sides -x, +x, -y, +y, -z, +z.
    """

    size: np.ndarray
    stem: float | None
    surface: np.ndarray


class PlacedSolid(NamedTuple):
    """A solid and where it is: `T_world_solid` is `(4, 4)`."""

    T_world_solid: np.ndarray
    solid: Solid


def scaled_solid(solid: Solid, factor: float) -> Solid:
    """The same solid with all its lengths, those of its textures too, times a factor."""
    return Solid(factor * solid.size, solid.stem, scaled_surface(solid.surface, factor))


def box(half_m: tuple[float, float, float], look: Material | list[Material], rng: np.random.Generator) -> Solid:
    """A box of given half extents; `look` is one material or one for each side."""
    return Solid(np.array(half_m, np.float64), None, _surface(look, rng))


def capsule(radius_m: float, length_m: float, look: Material, rng: np.random.Generator) -> Solid:
    """A capsule along z, `length_m` between the centers of its round ends."""
    return Solid(np.full(3, radius_m), 0.5 * length_m / radius_m, _surface(look, rng))


def pill(radii_m: tuple[float, float, float], length_m: float, look: Material, rng: np.random.Generator) -> Solid:
    """A capsule of elliptic section along z; an ellipsoid if `length_m` is 0."""
    return Solid(np.array(radii_m, np.float64), 0.5 * length_m / radii_m[2], _surface(look, rng))


def upright(x: float, y: float, z: float, yaw_deg: float = 0.0) -> np.ndarray:
    """`(4, 4)` transform of something that stands upright at a place, turned about the vertical."""
    turn = matrices(axis_rotation(2, np.deg2rad(yaw_deg)))
    return transform(turn, np.array([x, y, z]))


def _surface(look: Material | list[Material], rng: np.random.Generator) -> np.ndarray:
    sides = [look] * 6 if isinstance(look, Material) else look
    first = int(rng.integers(0, 2**16))
    return np.stack([surface_row(material, first + side) for side, material in enumerate(sides)])
