"""Roads: their middle lines, the surfaces they are built of, and ways along them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.datasets.synthetic.homogeneous import transform
from jaxslam.datasets.synthetic.primitives import PlacedSolid, box
from jaxslam.datasets.synthetic.texture import Material
from jaxslam.errors import ConfigError
from jaxslam.geometry.so3 import axis_rotation, matrices
from jaxslam.worlds.description import Road, Row, Thing

_STEP_M = 1.0
"""Distance of the points of a middle line."""
_PIECE_M, _PIECE_TURN = 25.0, np.deg2rad(6.0)
"""Longest piece of a road, and the turn at which a piece ends before that."""
_THICK_M, _CURB_WIDTH_M, _DASH_M, _DASH_EVERY_M, _LINE_WIDTH_M = 0.3, 0.16, 3.0, 9.0, 0.14
_LEVEL_M, _LEVELS = 0.003, 3
"""Pieces that overlap in curves differ in height, so that one of them is seen and not both by turns."""


class MiddleLine(NamedTuple):
    """The middle of a road.

    Attributes:
        along_m: Distances along it, `(n,)` meters.
        points_m: Points at those, `(n, 2)`; of a closed road the last one is the first.
        headings: Directions there, `(n,)` radians, continuous.
    """

    along_m: np.ndarray
    points_m: np.ndarray
    headings: np.ndarray

    @property
    def length_m(self) -> float:
        """Its length."""
        return float(self.along_m[-1])

    def beside(self, along_m: np.ndarray, beside_m: np.ndarray | float) -> np.ndarray:
        """Points at distances along it and to its left, `(n, 2)`."""
        heading = self.heading(along_m)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        x, y = (np.interp(along_m, self.along_m, column) for column in self.points_m.T)
        return np.stack([x, y], axis=-1) + np.broadcast_to(beside_m, heading.shape)[:, None] * left

    def heading(self, along_m: np.ndarray) -> np.ndarray:
        """Directions at distances along it, `(n,)` radians."""
        return np.interp(along_m, self.along_m, self.headings)


def middle_line(road: Road) -> MiddleLine:
    """Return the middle of a road, with arcs for corners."""
    corners = np.array(road.points_m, np.float64)
    rounded = _rounded(corners, road.closed, road.corner_m)
    steps = np.linalg.norm(np.diff(rounded, axis=0), axis=1)
    rounded, steps = rounded[np.append(True, steps > 1e-6)], steps[steps > 1e-6]
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    along = np.linspace(0.0, reached[-1], max(round(reached[-1] / _STEP_M), 2) + 1)
    points = np.stack([np.interp(along, reached, column) for column in rounded.T], axis=1)
    ahead = np.diff(points, axis=0)
    between = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    first, last = between[:1], between[-1:]
    if road.closed:
        turns = 2.0 * np.pi * np.round((last - first) / (2.0 * np.pi))
        first, last = last - turns, first + turns
    wide = np.concatenate([first, between, last])
    return MiddleLine(along, points, 0.5 * (wide[:-1] + wide[1:]))


def _rounded(corners: np.ndarray, closed: bool, radius_m: float) -> np.ndarray:
    """Points of the line through corners that are replaced by arcs, `(n, 2)`."""
    num = len(corners)
    inner = range(num) if closed else range(1, num - 1)
    arcs = [_arc(corners[k - 1], corners[k], corners[(k + 1) % num], radius_m) for k in inner]
    if closed:
        return np.concatenate([*arcs, arcs[0][:1]])
    return np.concatenate([corners[:1], *arcs, corners[-1:]])


def _arc(before: np.ndarray, corner: np.ndarray, after: np.ndarray, radius_m: float) -> np.ndarray:
    """An arc that touches both lines to a corner, `(n, 2)`; just the corner where there is none."""
    back, ahead = before - corner, after - corner
    lengths = np.linalg.norm(back), np.linalg.norm(ahead)
    back, ahead = back / lengths[0], ahead / lengths[1]
    half = 0.5 * np.arccos(np.clip(back @ ahead, -1.0, 1.0))
    if radius_m == 0.0 or half < 1e-3 or half > 0.5 * np.pi - 1e-3:
        return corner[None]
    cut_m = min(radius_m / np.tan(half), 0.5 * min(lengths))
    start, middle = corner + cut_m * back, corner + (cut_m / np.cos(half)) * _unit(back + ahead)
    sweep = (np.pi - 2.0 * half) * np.sign(back[1] * ahead[0] - back[0] * ahead[1])
    turns = np.linspace(0.0, sweep, max(round(abs(sweep) / np.deg2rad(2.0)), 2) + 1)
    x, y = start - middle
    cos, sin = np.cos(turns), np.sin(turns)
    return middle + np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def points_along(
    roads: Mapping[str, Road],
    name: str,
    beside_m: float | Sequence[tuple[float, float]],
    from_m: float,
    until_m: float | None,
    ends: str,
) -> np.ndarray:
    """Points of a way along a road, `(n, 2)`.

    Args:
        roads: Roads by name.
        name: Name of the road.
        beside_m: See `description.Route`.
        from_m: Distance along the road at which the way begins.
        until_m: Distance at which it ends; `None` for the end of the road, or of the round.
        ends: What happens there; a `loop` needs a closed road, and goes all the way round.

    Raises:
        ConfigError: There is no such distance along the road, or it is not closed.
    """
    line, closed = middle_line(roads[name]), roads[name].closed
    if ends == "loop" and not closed:
        raise ConfigError(f"roads: {name}: closed: expected true for a way round in a loop, got false")
    length_m = line.length_m
    end_m = (from_m + length_m if closed else length_m) if until_m is None or ends == "loop" else until_m
    if not closed and max(from_m, end_m) > length_m + 1e-6:
        raise ConfigError(
            f"roads: {name}: expected distances up to its length, {length_m:.1f} m, got {from_m}, {end_m}"
        )
    along = np.linspace(from_m, end_m, max(round(abs(end_m - from_m) / _STEP_M), 1) + 1)
    lanes = np.array([(0.0, beside_m)] if isinstance(beside_m, float) else beside_m)
    beside = np.interp(along, *lanes[np.argsort(lanes[:, 0])].T)
    places = line.beside(np.mod(along, length_m) if closed else along, beside)
    return places[:-1] if ends == "loop" else places


def things_beside(road: Road, row: Row, rng: np.random.Generator) -> list[Thing]:
    """Things of a row, each in its place."""
    line = middle_line(road)
    end_m = line.length_m if row.until_m is None else min(row.until_m, line.length_m)
    sides = {"left": (1.0,), "right": (-1.0,), "both": (1.0, -1.0)}[row.side]
    things = []
    for along_m in np.arange(row.from_m + 0.5 * row.every_m, end_m, row.every_m):
        for side in sides:
            # Always as many random numbers a place: other shares leave the rest as it is.
            kind, (u, v, w, size, chance) = rng.integers(len(row.kinds)), rng.uniform(size=5)
            if chance >= row.share:
                continue
            place_m = np.array([along_m + (2.0 * u - 1.0) * row.vary_m[0]])
            x, y = line.beside(place_m, side * (row.beside_m + (2.0 * v - 1.0) * row.vary_m[1]))[0]
            facing = np.rad2deg(line.heading(place_m)[0]) - 90.0 * side
            turn = facing + row.turn_deg + (2.0 * w - 1.0) * row.vary_deg
            scale = row.scale[0] + size * (row.scale[1] - row.scale[0])
            things.append(Thing(row.kinds[kind], (float(x), float(y)), float(turn), float(scale)))
    return things


class RoadLooks(NamedTuple):
    """Materials of a road."""

    surface: Material
    paving: Material
    line: Material


def road_solids(road: Road, looks: RoadLooks, rng: np.random.Generator) -> list[PlacedSolid]:
    """The solids of a road; what is in front of others is above them."""
    if road.width_m == 0.0:
        return []
    line, solids = middle_line(road), []
    half = 0.5 * road.width_m
    for number, (start, end) in enumerate(_pieces(line)):
        ends = np.array([line.along_m[start], line.along_m[end]])
        up = _LEVEL_M * (1 + number % _LEVELS)
        solids.append(_strip(line, ends, (-half, half), up, looks.surface, rng))
        if road.sidewalk_m > 0.0:
            for side in (1.0, -1.0):
                curb = sorted((side * half, side * (half + _CURB_WIDTH_M)))
                walk = sorted((side * (half + _CURB_WIDTH_M), side * (half + road.sidewalk_m)))
                solids.append(_strip(line, ends, curb, up + road.curb_m + 0.01, looks.paving, rng))
                solids.append(_strip(line, ends, walk, up + road.curb_m, looks.paving, rng))
    for at_m in np.arange(0.0, line.length_m - _DASH_M, _DASH_EVERY_M):
        ends = np.array([at_m, at_m + _DASH_M])
        across = (-0.5 * _LINE_WIDTH_M, 0.5 * _LINE_WIDTH_M)
        solids.append(_strip(line, ends, across, _LEVEL_M * (_LEVELS + 2), looks.line, rng))
    return solids


def _pieces(line: MiddleLine) -> list[tuple[int, int]]:
    """First and last index of each piece: as long as it is straight enough."""
    pieces, start = [], 0
    for index in range(1, len(line.along_m)):
        is_long = line.along_m[index] - line.along_m[start] >= _PIECE_M
        turned = abs(line.headings[index] - line.headings[start])
        if is_long or turned >= _PIECE_TURN or index == len(line.along_m) - 1:
            pieces.append((start, index))
            start = index
    return pieces


def _strip(
    line: MiddleLine,
    ends_m: np.ndarray,
    across_m: Sequence[float],
    top_m: float,
    look: Material,
    rng: np.random.Generator,
) -> PlacedSolid:
    """A box along a piece, as long as its longer side, with its top at a height."""
    sides = [line.beside(ends_m, beside) for beside in across_m]
    length = max(float(np.linalg.norm(side[1] - side[0])) for side in sides)
    middle = np.mean(sides, axis=(0, 1))
    ahead = np.mean([side[1] - side[0] for side in sides], axis=0)
    half = (0.5 * length + 0.02, 0.5 * (across_m[1] - across_m[0]), 0.5 * _THICK_M)
    turn = matrices(axis_rotation(2, np.arctan2(ahead[1], ahead[0])))
    place = transform(turn, np.array([*middle, top_m - 0.5 * _THICK_M]))
    return PlacedSolid(place, box(half, look, rng))
