"""Rooms: the solids they are built of."""

from typing import NamedTuple

import numpy as np

from jaxslam.datasets.synthetic.primitives import PlacedSolid, box, upright
from jaxslam.worlds.description import Opening, Room, Side
from jaxslam.worlds.finish import Finishes

_PICTURE_M, _HUNG_M, _TRIES = ((0.35, 0.35), (0.9, 0.8)), (1.25, 1.75), 20


class _Wall(NamedTuple):
    """A wall of a room: middle of its inner side on the floor, directions along it and out of the room, length."""

    middle: np.ndarray
    along: np.ndarray
    outward: np.ndarray
    length_m: float


def _wall(room: Room, side: Side) -> _Wall:
    length, width, _ = room.size_m
    x, y = room.at_m
    if side in {"north", "south"}:
        sign = 1.0 if side == "north" else -1.0
        middle, along, outward = (x, y + sign * 0.5 * width), (1.0, 0.0), (0.0, sign)
        return _Wall(np.array(middle), np.array(along), np.array(outward), length)
    sign = 1.0 if side == "east" else -1.0
    middle, along, outward = (x + sign * 0.5 * length, y), (0.0, 1.0), (sign, 0.0)
    return _Wall(np.array(middle), np.array(along), np.array(outward), width)


def room_solids(room: Room, looks: Finishes, rng: np.random.Generator) -> list[PlacedSolid]:
    """The solids of a room: floor, ceiling, walls around their openings, and pictures."""
    length, width, height = room.size_m
    (x, y), thick = room.at_m, room.wall_m
    slab = (0.5 * length + thick, 0.5 * width + thick, 0.05)
    solids = [
        PlacedSolid(upright(x, y, -0.05), box(slab, looks[room.floor].material(rng), rng)),
        PlacedSolid(upright(x, y, height + 0.05), box(slab, looks[room.ceiling].material(rng), rng)),
    ]
    material = looks[room.walls].material(rng)
    sides: tuple[Side, ...] = ("north", "south", "east", "west")
    for side in sides:
        wall, openings = _wall(room, side), [opening for opening in room.openings if opening.wall == side]
        for low_m, high_m, bottom_m, top_m in _wall_pieces(wall.length_m + 2.0 * thick, height, openings):
            piece = _on_wall(wall, 0.5 * (low_m + high_m), 0.5 * (bottom_m + top_m), 0.5 * thick)
            half = _wall_box(wall, 0.5 * (high_m - low_m), 0.5 * thick, 0.5 * (top_m - bottom_m))
            solids.append(PlacedSolid(piece, box(half, material, rng)))
    return solids + _pictures(room, looks, rng)


def _wall_pieces(length_m: float, height_m: float, openings: list[Opening]) -> list[tuple[float, float, float, float]]:
    """The parts of a wall around its openings: from, to along it, from, to above the floor."""
    pieces, reached = [], -0.5 * length_m
    for opening in sorted(openings, key=lambda opening: opening.along_m):
        low, high = opening.along_m - 0.5 * opening.width_m, opening.along_m + 0.5 * opening.width_m
        pieces += [
            (reached, low, 0.0, height_m),
            (low, high, 0.0, opening.bottom_m),
            (low, high, opening.top_m, height_m),
        ]
        reached = high
    pieces.append((reached, 0.5 * length_m, 0.0, height_m))
    return [piece for piece in pieces if piece[1] > piece[0] and piece[3] > piece[2]]


def _on_wall(wall: _Wall, along_m: float, height_m: float, outward_m: float) -> np.ndarray:
    x, y = wall.middle + along_m * wall.along + outward_m * wall.outward
    return upright(float(x), float(y), height_m)


def _wall_box(wall: _Wall, half_along: float, half_out: float, half_up: float) -> tuple[float, float, float]:
    along, out = np.abs(wall.along), np.abs(wall.outward)
    x, y = half_along * along + half_out * out
    return float(x), float(y), half_up


def _pictures(room: Room, looks: Finishes, rng: np.random.Generator) -> list[PlacedSolid]:
    """Pictures on the walls, beside the openings and each other where there is space."""
    hung: dict[Side, list[tuple[float, float]]] = {"north": [], "south": [], "east": [], "west": []}
    for opening in room.openings:
        hung[opening.wall].append((opening.along_m, opening.width_m))
    solids = []
    for _ in range(room.pictures):
        for _ in range(_TRIES):
            side = rng.choice(sorted(hung))
            wall = _wall(room, side)
            (width, height), up = rng.uniform(*_PICTURE_M), rng.uniform(*_HUNG_M)
            along = rng.uniform(-0.5, 0.5) * (wall.length_m - width)
            if all(abs(along - other) > 0.5 * (width + taken) + 0.05 for other, taken in hung[side]):
                hung[side].append((along, width))
                half = _wall_box(wall, 0.5 * width, 0.01, 0.5 * height)
                picture = box(half, looks["poster"].material(rng), rng)
                solids.append(PlacedSolid(_on_wall(wall, along, up, -0.01), picture))
                break
    return solids
