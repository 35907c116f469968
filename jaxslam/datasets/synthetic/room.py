"""The room and what stands in it: boxes and capsules with materials, all static.

World axes: z up, origin on the floor in the middle of the room; see `camera_path`.
"""

import numpy as np

from jaxslam.datasets.synthetic.primitives import PlacedSolid, box, capsule, pill, upright
from jaxslam.datasets.synthetic.texture import Material

ROOM_HALF_M = (2.7, 2.5, 1.4)
"""Half the length, width and height of the room."""


PLASTER = Material((0.62, 0.60, 0.53), (0.74, 0.73, 0.68), noise_per_m=1.5, noise=0.35)
WHITE = Material((0.80, 0.80, 0.78), (0.84, 0.84, 0.82), noise_per_m=1.0, noise=0.15)
BRICKS = Material(
    (0.50, 0.25, 0.18),
    (0.72, 0.46, 0.34),
    noise_per_m=4.0,
    noise=0.6,
    cell_m=(0.26, 0.09),
    joint_m=0.012,
    cell_contrast=0.35,
)
PLANKS = Material(
    (0.42, 0.29, 0.19),
    (0.70, 0.52, 0.35),
    dark=(0.26, 0.17, 0.10),
    noise_per_m=5.0,
    stretch=8.0,
    noise=0.7,
    cell_m=(0.14, 1.3),
    joint_m=0.006,
    cell_contrast=0.25,
)
WOOD = Material((0.45, 0.30, 0.18), (0.70, 0.51, 0.33), noise_per_m=6.0, stretch=7.0, noise=0.7)
LAMINATE = Material((0.70, 0.66, 0.58), (0.80, 0.77, 0.70), noise_per_m=3.0, noise=0.3)
METAL = Material((0.30, 0.31, 0.33), (0.42, 0.43, 0.45), noise_per_m=4.0, noise=0.3)
CARTON = Material(
    (0.55, 0.42, 0.27),
    (0.68, 0.54, 0.37),
    noise_per_m=4.0,
    stretch=3.0,
    patch_m=0.3,
    patch_density=0.45,
    patch_contrast=0.9,
)
BOOKS = Material(
    (0.36, 0.30, 0.26),
    (0.62, 0.55, 0.47),
    noise_per_m=5.0,
    stretch=4.0,
    noise=0.6,
    cell_m=(0.045, 0.33),
    joint_m=0.008,
    cell_contrast=0.9,
    patch_m=0.22,
    patch_density=0.5,
)
POSTER = Material(
    (0.75, 0.72, 0.65),
    (0.90, 0.88, 0.84),
    noise_per_m=4.0,
    patch_m=0.32,
    patch_density=0.8,
    patch_contrast=1.0,
)
SCREEN = Material(
    (0.16, 0.19, 0.26),
    (0.24, 0.30, 0.40),
    (0.05, 0.06, 0.09),
    (0.85, 0.88, 0.92),
    noise_per_m=6.0,
    noise=0.4,
    patch_m=0.2,
    patch_density=0.7,
)
KEYS = Material(
    (0.12, 0.12, 0.13),
    (0.22, 0.22, 0.24),
    noise_per_m=10.0,
    noise=0.3,
    cell_m=(0.02, 0.02),
    joint_m=0.005,
    cell_contrast=0.2,
)
CLOTH = Material((0.22, 0.30, 0.45), (0.40, 0.50, 0.66), noise_per_m=7.0, noise=0.7)


def furnish(seed: int) -> list[PlacedSolid]:
    """The static scene.

    Args:
        seed: Chooses textures, colors and where the small things lie; the furniture stays where it is.

    Returns:
        Everything that stands still; first the room itself, a box to be seen from inside.
    """
    rng = np.random.default_rng([seed, 100])
    walls = [PLASTER, PLASTER, PLASTER, BRICKS, PLANKS, WHITE]
    room = PlacedSolid(upright(0.0, 0.0, ROOM_HALF_M[2]), box(ROOM_HALF_M, walls, rng))
    tables = [thing for side in (-1.0, 1.0) for thing in _table(0.42 * side, rng)]
    return [room, *tables, *_things_on_tables(rng), *_storage(rng), *_posters(rng)]


def printed(look: Material, rng: np.random.Generator) -> Material:
    """The same material printed in colors of its own."""
    dark, bright = rng.uniform(0.02, 0.55, 3), rng.uniform(0.35, 1.0, 3)
    return look._replace(dark=tuple(dark), bright=tuple(bright))


def _table(y: float, rng: np.random.Generator) -> list[PlacedSolid]:
    """A table with its chair, screen, keyboard and mug."""
    legs = [(x, y + side) for x in (0.05, 0.75) for side in (-0.36, 0.36)]
    turn = rng.uniform(-15.0, 15.0)
    return [
        PlacedSolid(upright(0.4, y, 0.73), box((0.40, 0.41, 0.015), WOOD, rng)),
        *(PlacedSolid(upright(*leg, 0.357), box((0.025, 0.025, 0.357), METAL, rng)) for leg in legs),
        PlacedSolid(upright(0.72, y, 0.45), box((0.21, 0.22, 0.02), CLOTH, rng)),
        PlacedSolid(upright(0.92, y, 0.75), box((0.02, 0.21, 0.24), CLOTH, rng)),
        PlacedSolid(upright(0.72, y, 0.215), box((0.03, 0.03, 0.215), METAL, rng)),
        PlacedSolid(upright(0.50, y, 1.02, turn), box((0.02, 0.26, 0.17), SCREEN, rng)),
        PlacedSolid(upright(0.52, y, 0.80, turn), box((0.05, 0.07, 0.055), METAL, rng)),
        PlacedSolid(upright(0.22, y + 0.05, 0.757, turn), box((0.07, 0.20, 0.012), KEYS, rng)),
        PlacedSolid(upright(0.14, y - 0.28, 0.795), pill((0.04, 0.04, 0.01), 0.08, printed(POSTER, rng), rng)),
    ]


def _things_on_tables(rng: np.random.Generator) -> list[PlacedSolid]:
    things = [PlacedSolid(upright(0.65, 0.02, 0.875), capsule(0.13, 0.0, printed(POSTER, rng), rng))]
    for y, half_height in ((-0.05, 0.06), (0.10, 0.10), (-0.78, 0.09), (0.78, 0.13)):
        place = upright(0.2 + rng.uniform(-0.05, 0.15), y, 0.745 + half_height, rng.uniform(-40.0, 40.0))
        things.append(PlacedSolid(place, box((0.10, 0.055, half_height), printed(CARTON, rng), rng)))
    return things


_CABINETS = (  # x, y, half x, half y, height, material
    (2.48, -1.55, 0.20, 0.45, 1.90, BOOKS),
    (2.45, -0.45, 0.22, 0.50, 0.90, LAMINATE),
    (2.45, 0.70, 0.22, 0.45, 1.25, BOOKS),
    (2.42, 1.75, 0.25, 0.40, 2.05, WOOD),
    (-0.30, 2.30, 0.60, 0.18, 0.95, BOOKS),
    (1.20, 2.30, 0.40, 0.18, 1.60, LAMINATE),
    (-1.70, 2.32, 0.40, 0.16, 1.80, BOOKS),
    (0.40, -2.30, 0.70, 0.18, 1.10, WOOD),
    (-1.40, -2.32, 0.45, 0.16, 1.70, BOOKS),
    (-2.48, 0.20, 0.20, 0.60, 1.15, BOOKS),
    (-2.46, -1.30, 0.22, 0.40, 1.75, WOOD),
)
_LOW_CABINETS = tuple(cabinet for cabinet in _CABINETS if cabinet[4] < 1.2)
_CARTONS_ON_FLOOR = ((2.2, -2.2), (-2.2, 1.5), (2.2, 0.12))


def _storage(rng: np.random.Generator) -> list[PlacedSolid]:
    """Cabinets and shelves along the walls, cartons on the low ones and on the floor."""
    things = []
    for x, y, half_x, half_y, height, look in _CABINETS:
        colors = printed(look, rng) if look is BOOKS else look
        things.append(PlacedSolid(upright(x, y, height / 2), box((half_x, half_y, height / 2), colors, rng)))
    places = [(x, y, height) for x, y, _, _, height, _ in _LOW_CABINETS]
    for x, y, z in (*places, *((x, y, 0.0) for x, y in _CARTONS_ON_FLOOR)):
        a, b, c = rng.uniform(0.11, 0.19, 3)
        things.append(
            PlacedSolid(upright(x, y, z + c, rng.uniform(-25.0, 25.0)), box((a, b, c), printed(CARTON, rng), rng))
        )
    return things


_POSTERS = (  # x, y, z, half x, half y, half z
    (2.69, -0.75, 1.75, 0.01, 0.36, 0.50),
    (2.69, 0.35, 1.95, 0.01, 0.30, 0.42),
    (2.69, 1.05, 1.90, 0.01, 0.25, 0.35),
    (-2.69, -0.50, 1.60, 0.01, 0.35, 0.45),
    (-2.69, 1.30, 1.50, 0.01, 0.35, 0.45),
    (-0.60, -2.49, 1.75, 0.35, 0.01, 0.45),
    (0.55, -2.49, 1.85, 0.35, 0.01, 0.45),
    (1.90, -2.49, 1.50, 0.35, 0.01, 0.45),
    (-0.90, 2.49, 1.70, 0.40, 0.01, 0.45),
    (0.30, 2.49, 1.75, 0.40, 0.01, 0.45),
)


def _posters(rng: np.random.Generator) -> list[PlacedSolid]:
    return [PlacedSolid(upright(x, y, z), box((a, b, c), printed(POSTER, rng), rng)) for x, y, z, a, b, c in _POSTERS]
