"""What holds in every map, whoever made it: checked in files that are read, and in tests."""

from collections.abc import Iterator
from typing import NamedTuple, TypeAlias, get_type_hints

import numpy as np
from jaxtyping import AbstractArray

from jaxslam.dynamics.occlusion import PointState
from jaxslam.features.orb import Features
from jaxslam.map.types import NONE, Culled, Loops, Map, MapPoints, Sightings, has, point_submaps, rows

Record: TypeAlias = Map | MapPoints | Sightings | Loops | Culled | Features

_UNIT = 1e-6
"""How far from 1 the length of a quaternion may be."""


_FARTHEST_M = 1e12
"""Coordinates beyond it are damage: the square of a distance would soon overflow the float32 of the tracker."""


class ArrayField(NamedTuple):
    """What an array of a record is declared to be.

    Attributes:
        dtype: Of its numbers.
        dims: Lengths of its axes, as numbers or as the letter that its record gives them.
    """

    dtype: np.dtype
    dims: tuple[str, ...]

    def shape(self, lengths: dict[str, int]) -> tuple[int, ...]:
        """Its shape, given what the letters stand for."""
        return tuple(lengths[dim] if dim in lengths else int(dim) for dim in self.dims)


def array_fields(record: type) -> dict[str, ArrayField]:
    """The arrays that a record such as `MapPoints` holds, as annotated, in order."""
    hints = get_type_hints(record)
    return {
        name: ArrayField(np.dtype(hint.dtypes[0]), tuple(hint.dim_str.split()))
        for name, hint in hints.items()
        if isinstance(hint, type) and issubclass(hint, AbstractArray)
    }


def problems(map: Map) -> list[str]:
    """All that is wrong with a map, in words; nothing, if it is whole.

    Types and shapes come first; if one is wrong, nothing else is looked at.
    """
    wrong = list(_structure(map))
    if not wrong:
        wrong = [*_identity(map), *_numbers(map)]
    return wrong or [*_tree(map), *_sightings(map)]


def _records(map: Map) -> dict[str, Record]:
    """All records of a map, and what to put before the names of their arrays."""
    records: dict[str, Record] = {"": map, "points.": map.points, "sightings.": map.sightings}
    records |= {"loops.": map.loops, "culled.": map.culled}
    return records | {f"keyframe {keyframe.id}: ": keyframe.features for keyframe in map.keyframes}


def _structure(map: Map) -> Iterator[str]:
    """Types and shapes."""
    lengths = {"k": len(map.keyframes), "p": len(map.points.ids), "s": len(map.sightings.point)}
    lengths |= {"l": len(map.loops.source), "c": len(map.culled.ids)}
    for prefix, record in _records(map).items():
        if isinstance(record, Features):
            lengths["n"] = len(record.octave)
        for name, field in array_fields(type(record)).items():
            array, shape = getattr(record, name), field.shape(lengths)
            if array.dtype != field.dtype or array.shape != shape:
                yield f"{prefix}{name}: expected {field.dtype} {shape}, got {array.dtype} {array.shape}"


def _identity(map: Map) -> Iterator[str]:
    """Ids that ascend, were given, and exist where they are mentioned."""
    if map.ids.tolist() != [keyframe.id for keyframe in map.keyframes]:
        yield "ids: not those of the keyframes"
    for name, ids, after in (("ids", map.ids, map.next_keyframe), ("points.ids", map.points.ids, map.next_point)):
        if (np.diff(ids) <= 0).any() or ((ids < 0) | (ids >= after)).any():
            yield f"{name}: expected them to ascend from 0 and end before {after}"
    culled = np.sort(map.culled.ids)
    if (
        (np.diff(culled) == 0).any()
        or np.isin(culled, map.ids).any()
        or ((culled < 0) | (culled >= map.next_keyframe)).any()
    ):
        yield "culled.ids: one is given twice, or still in the map, or was never given"
    known = np.concatenate([map.ids, culled])
    mentions = {
        "parent": (map.parent, np.append(map.ids, NONE)),
        "points.made_by": (map.points.made_by, known),
        "sightings.keyframe": (map.sightings.keyframe, map.ids),
        "sightings.point": (map.sightings.point, map.points.ids),
        "loops.source": (map.loops.source, map.ids),
        "loops.target": (map.loops.target, map.ids),
        "culled.anchor": (map.culled.anchor, known),
    }
    for name, (ids, among) in mentions.items():
        if not np.isin(ids, among).all():
            yield f"{name}: {ids[~np.isin(ids, among)][0]} is not in the map"


def number_problems(record: Record, prefix: str = "") -> list[str]:
    """What is wrong with the numbers of a record: one that is not finite, or out of its range."""
    wrong = [
        f"{prefix}{name}: holds a number that is not finite"
        for name, array in record._asdict().items()
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all()
    ]
    if isinstance(record, MapPoints | Sightings) and ((record.weight < 0) | (record.weight > 1)).any():
        wrong.append(f"{prefix}weight: expected 0 to 1")
    if isinstance(record, MapPoints) and not np.isin(record.state, list(PointState)).all():
        wrong.append(f"{prefix}state: expected {min(PointState)} to {max(PointState)}")
    if isinstance(record, Sightings | Features) and (record.depth < 0).any():
        wrong.append(f"{prefix}depth: expected 0 or more")
    if isinstance(record, Sightings) and (record.sigma_px <= 0).any():
        wrong.append(f"{prefix}sigma_px: expected more than 0")
    return wrong


def _numbers(map: Map) -> Iterator[str]:
    """Numbers in their ranges, and unit quaternions."""
    for prefix, record in _records(map).items():
        yield from number_problems(record, prefix)
    poses = {"T_world_cam": map.T_world_cam, "loops.T_source_target": map.loops.T_source_target}
    poses["culled.T_anchor_keyframe"] = map.culled.T_anchor_keyframe
    for name, T in poses.items():
        if (np.abs(np.linalg.norm(T[:, :4], axis=1) - 1) > _UNIT).any():
            yield f"{name}: a quaternion is not of unit length"
    places = {name: T[:, 4:] for name, T in poses.items()} | {"points.X_world": map.points.X_world}
    for name, X in places.items():
        if (np.abs(X) > _FARTHEST_M).any():
            yield f"{name}: expected coordinates of at most {_FARTHEST_M:g} m, got {np.abs(X).max():g}"


def _tree(map: Map) -> Iterator[str]:
    """One tree a submap, loops between two keyframes, and culled ones that are held by something."""
    roots = map.parent == NONE
    parent = np.arange(len(map.ids))
    parent[~roots] = rows(map.ids, map.parent[~roots])
    if not roots[_ends(parent)].all():
        yield "parent: goes round in a circle"
    if (map.submap != map.submap[parent]).any() or len(np.unique(map.submap)) != roots.sum():
        yield "parent: expected one tree in each submap"
    if (map.loops.source == map.loops.target).any():
        yield "loops: one leads from a keyframe to itself"


def _sightings(map: Map) -> Iterator[str]:
    seen = map.sightings
    if _repeats(seen.keyframe, seen.point):
        yield "sightings: a keyframe sees a point twice"
    by_feature = seen.feature != NONE
    if _repeats(seen.keyframe[by_feature], seen.feature[by_feature]):
        yield "sightings: two points are one feature"
    at = rows(map.ids, seen.keyframe)
    num_features = np.array([len(keyframe.features.octave) for keyframe in map.keyframes], np.int64)
    if ((seen.feature < NONE) | (seen.feature >= num_features[at])).any():
        yield "sightings.feature: the keyframe has no such feature"
    if _circle_of_culled(map):
        yield "culled.anchor: goes round in a circle"
    elif (map.submap[at] != point_submaps(map)[rows(map.points.ids, seen.point)]).any():
        yield "sightings: a keyframe sees a point of another submap"


def _circle_of_culled(map: Map) -> bool:
    order = np.argsort(map.culled.ids)
    ids, anchor = map.culled.ids[order], map.culled.anchor[order]
    inner = has(ids, anchor)
    following = np.arange(len(ids))
    following[inner] = rows(ids, anchor[inner])
    return bool(inner[_ends(following)].any())


def _ends(following: np.ndarray) -> np.ndarray:
    """Where a walk from each row ends, if it ends; every round doubles the steps."""
    for _ in range(len(following).bit_length()):
        following = following[following]
    return following


def _repeats(first: np.ndarray, second: np.ndarray) -> bool:
    pairs = np.stack([first, second])
    return np.unique(pairs, axis=1).shape[1] < pairs.shape[1]
