"""Points and observations of a map: as whole arrays, or in blocks that edits of other blocks share."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxslam.geometry.types import Ids
from jaxslam.map.point_records import (
    MapPoints,
    Observations,
    distinct,
    empty_observations,
    empty_points,
    has,
    joined,
    observations_at,
    points_at,
)

_NO_IDS = np.zeros(0, np.int64)
_SPAN_BITS = 10
"""A block has the points of 1,024 ids in a row, which a keyframe made, or some after one another."""


class Block(NamedTuple):
    """The points of some ids in a row.

    Attributes:
        points: The points.
        observations: All observations of these points.
        keyframes: Ids of the keyframes that observe them.
    """

    points: MapPoints
    observations: Observations
    keyframes: frozenset[int]


class MapContents:
    """The points of a map and their observations. Immutable.

    A part of a map, which a new keyframe edits many times, holds them as whole arrays. A map holds them in blocks, so
    that putting an edited part back costs what the part has, not what the map has. Either form is made from the other
    when it is first asked for, and kept.
    """

    def __init__(self, points: MapPoints, observations: Observations) -> None:
        """Hold whole arrays."""
        self.points, self.observations = points, observations

    @classmethod
    def _of_blocks(cls, blocks: dict[int, Block], of_keyframe: dict[int, frozenset[int]]) -> "MapContents":
        """Hold blocks.

        Args:
            blocks: The blocks, by the number that the ids of their points have in common.
            of_keyframe: Numbers of the blocks with points that a keyframe observes, by the id of the keyframe.
        """
        made = cls.__new__(cls)
        made.blocks, made._of_keyframe = blocks, of_keyframe
        return made

    @cached_property
    def points(self) -> MapPoints:
        """All points."""
        return self._joined[0]

    @cached_property
    def observations(self) -> Observations:
        """All observations."""
        return self._joined[1]

    @cached_property
    def blocks(self) -> dict[int, Block]:
        """The blocks, by the number that the ids of their points have in common."""
        return _split(self.points, self.observations)

    @property
    def has_blocks(self) -> bool:
        """True once the points are held in blocks."""
        return "blocks" in self.__dict__

    @property
    def num_points(self) -> int:
        """Number of points."""
        if not self.has_blocks:
            return len(self.points.ids)
        return sum(len(block.points.ids) for block in self.blocks.values())

    @property
    def nbytes(self) -> int:
        """Size of the arrays, bytes."""
        records = ((block.points, block.observations) for block in self.blocks.values())
        return sum(array.nbytes for both in records for record in both for array in record)

    def as_blocks(self) -> "MapContents":
        """Return the same in blocks only, without whole arrays."""
        return MapContents._of_blocks(self.blocks, self._of_keyframe)

    def have(self, point_ids: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return which of some ids are of points that are here."""
        return has(self.around(_NO_IDS, point_ids[point_ids >= 0]).points.ids, point_ids)

    def around(self, keyframe_ids: Ids, point_ids: Ids) -> "MapContents":
        """Return the blocks with points that some keyframes observe, or with some points, as whole arrays.

        Contents that are not in blocks are those of a part, which is small: they are returned whole.

        Args:
            keyframe_ids: Ids of the keyframes.
            point_ids: Ids of the points.
        """
        if not self.has_blocks:
            return self
        numbers = set(distinct(point_ids >> _SPAN_BITS)[0].tolist()) & self.blocks.keys()
        numbers.update(*(self._of_keyframe.get(id, frozenset()) for id in keyframe_ids.tolist()))
        return MapContents(*_join([self.blocks[number] for number in sorted(numbers)]))

    def replaced(self, point_ids: Ids, part: "MapContents") -> "MapContents":
        """Replace points and their observations by those of an edited part.

        Args:
            point_ids: Ascending ids of the points to replace.
            part: The points and observations instead of them, as whole arrays.
        """
        blocks, of_keyframe = self.blocks.copy(), self._of_keyframe.copy()
        numbers = distinct(np.concatenate([point_ids, part.points.ids]) >> _SPAN_BITS)[0].tolist()
        old = {number: blocks.pop(number) for number in numbers if number in blocks}
        points, observations = _join(list(old.values()))
        stay, seen = ~has(point_ids, points.ids), ~has(point_ids, observations.point)
        points = joined([points_at(points, stay), part.points])
        order = np.argsort(points.ids, kind="stable")
        observations = joined([observations_at(observations, seen), part.observations])
        new = _split(points_at(points, order), observations)
        blocks |= new
        for number in numbers:
            before = old[number].keyframes if number in old else frozenset()
            now = new[number].keyframes if number in new else frozenset()
            for keyframe in before - now:
                left = of_keyframe[keyframe] - {number}
                if left:
                    of_keyframe[keyframe] = left
                else:
                    del of_keyframe[keyframe]
            for keyframe in now - before:
                of_keyframe[keyframe] = of_keyframe.get(keyframe, frozenset()) | {number}
        return MapContents._of_blocks(blocks, of_keyframe)

    @cached_property
    def _joined(self) -> tuple[MapPoints, Observations]:
        return _join([self.blocks[number] for number in sorted(self.blocks)])

    @cached_property
    def _of_keyframe(self) -> dict[int, frozenset[int]]:
        """Numbers of the blocks with points that a keyframe observes, by the id of the keyframe."""
        of_keyframe: dict[int, set[int]] = {}
        for number, block in self.blocks.items():
            for keyframe in block.keyframes:
                of_keyframe.setdefault(keyframe, set()).add(number)
        return {keyframe: frozenset(numbers) for keyframe, numbers in of_keyframe.items()}


def _join(blocks: list[Block]) -> tuple[MapPoints, Observations]:
    """Join blocks, given in the order of their ids."""
    points = joined([block.points for block in blocks] or [empty_points()])
    return points, joined([block.observations for block in blocks] or [empty_observations()])


def _split(points: MapPoints, observations: Observations) -> dict[int, Block]:
    """Split points, given in the order of their ids, and their observations into blocks.

    Arrays are copied: a view would keep all others of its block alive when those have long been replaced.
    """
    of_point = points.ids >> _SPAN_BITS
    numbers, _ = distinct(of_point)
    order = np.argsort(observations.point >> _SPAN_BITS, kind="stable")
    of_observation = observations.point[order] >> _SPAN_BITS
    begin, end = (np.searchsorted(of_point, numbers, side).tolist() for side in ("left", "right"))
    first, last = (np.searchsorted(of_observation, numbers, side).tolist() for side in ("left", "right"))
    blocks = {}
    for row, number in enumerate(numbers.tolist()):
        own = points_at(points, np.arange(begin[row], end[row]))
        seen = observations_at(observations, order[first[row] : last[row]])
        blocks[number] = Block(own, seen, frozenset(distinct(seen.keyframe)[0].tolist()))
    return blocks
