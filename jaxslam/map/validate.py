"""Invariants of a map, checked when a map file is read or written and in tests."""

from collections.abc import Iterator
from typing import NamedTuple, TypeAlias, get_type_hints

import numpy as np
from jaxtyping import AbstractArray

from jaxslam.dynamics.occlusion import PointState
from jaxslam.features.orb import Features
from jaxslam.map.point_records import NONE, MapPoints, Observations, has, rows
from jaxslam.map.types import Culled, Loops, Map, point_submaps

Record: TypeAlias = Map | MapPoints | Observations | Loops | Culled | Features

_UNIT = 1e-6
"""Largest difference of a quaternion's length from 1."""
_FARTHEST_M = 1e12
"""Largest valid coordinate, meters; beyond it, squared distances would overflow the tracker's float32."""


class ArrayField(NamedTuple):
    """The declared type of an array in a record.

    Attributes:
        dtype: Type of the numbers.
        dims: Length of each axis: a number, or the letter that names it in the record.
    """

    dtype: np.dtype
    dims: tuple[str, ...]

    def shape(self, lengths: dict[str, int]) -> tuple[int, ...]:
        """Return the shape, given the length of each letter."""
        return tuple(lengths[dim] if dim in lengths else int(dim) for dim in self.dims)


def array_fields(record: type) -> dict[str, ArrayField]:
    """Return the annotated array fields of a record such as `MapPoints`, in order."""
    hints = get_type_hints(record)
    return {
        name: ArrayField(np.dtype(hint.dtypes[0]), tuple(hint.dim_str.split()))
        for name, hint in hints.items()
        if isinstance(hint, type) and issubclass(hint, AbstractArray)
    }


def problems(slam_map: Map) -> list[str]:
    """Describe all violated invariants of a map; empty if it is valid.

    Types and shapes are checked first; if one is wrong, nothing else is checked.
    """
    wrong = list(_structure(slam_map))
    if not wrong:
        wrong = [*_identity(slam_map), *_numbers(slam_map)]
    return wrong or [*_tree(slam_map), *_observations(slam_map)]


def _records(slam_map: Map) -> dict[str, Record]:
    """Return all records of a map by the prefix of their arrays' names in messages."""
    records: dict[str, Record] = {"": slam_map, "points.": slam_map.points, "observations.": slam_map.observations}
    records |= {"loops.": slam_map.loops, "culled.": slam_map.culled}
    return records | {f"keyframe {keyframe.id}: ": keyframe.features for keyframe in slam_map.keyframes}


def _structure(slam_map: Map) -> Iterator[str]:
    """Check types and shapes."""
    lengths = {"k": len(slam_map.keyframes), "p": len(slam_map.points.ids), "s": len(slam_map.observations.point)}
    lengths |= {"l": len(slam_map.loops.source), "c": len(slam_map.culled.ids)}
    for prefix, record in _records(slam_map).items():
        if isinstance(record, Features):
            lengths["n"] = len(record.octave)
        for name, field in array_fields(type(record)).items():
            array, shape = getattr(record, name), field.shape(lengths)
            if array.dtype != field.dtype or array.shape != shape:
                yield f"{prefix}{name}: expected {field.dtype} {shape}, got {array.dtype} {array.shape}"


def _identity(slam_map: Map) -> Iterator[str]:
    """Check that ids ascend, were assigned, and exist wherever they are referenced."""
    if slam_map.ids.tolist() != [keyframe.id for keyframe in slam_map.keyframes]:
        yield "ids: not those of the keyframes"
    for name, ids, after in (
        ("ids", slam_map.ids, slam_map.next_keyframe),
        ("points.ids", slam_map.points.ids, slam_map.next_point),
    ):
        if (np.diff(ids) <= 0).any() or ((ids < 0) | (ids >= after)).any():
            yield f"{name}: expected them to ascend from 0 and end before {after}"
    culled = np.sort(slam_map.culled.ids)
    if (
        (np.diff(culled) == 0).any()
        or np.isin(culled, slam_map.ids).any()
        or ((culled < 0) | (culled >= slam_map.next_keyframe)).any()
    ):
        yield "culled.ids: one is given twice, or still in the map, or was never given"
    known = np.concatenate([slam_map.ids, culled])
    mentions = {
        "parent": (slam_map.parent, np.append(slam_map.ids, NONE)),
        "points.reference_keyframe": (slam_map.points.reference_keyframe, known),
        "observations.keyframe": (slam_map.observations.keyframe, slam_map.ids),
        "observations.point": (slam_map.observations.point, slam_map.points.ids),
        "loops.source": (slam_map.loops.source, slam_map.ids),
        "loops.target": (slam_map.loops.target, slam_map.ids),
        "culled.anchor": (slam_map.culled.anchor, known),
    }
    for name, (ids, among) in mentions.items():
        if not np.isin(ids, among).all():
            yield f"{name}: {ids[~np.isin(ids, among)][0]} is not in the map"


def number_problems(record: Record, prefix: str = "") -> list[str]:
    """Describe the numbers of a record that are not finite or out of range; empty if there are none."""
    wrong = [
        f"{prefix}{name}: holds a number that is not finite"
        for name, array in record._asdict().items()
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all()
    ]
    if isinstance(record, MapPoints | Observations) and ((record.weight < 0) | (record.weight > 1)).any():
        wrong.append(f"{prefix}weight: expected 0 to 1")
    if isinstance(record, MapPoints) and ((record.state < min(PointState)) | (record.state > max(PointState))).any():
        wrong.append(f"{prefix}state: expected {min(PointState)} to {max(PointState)}")
    if isinstance(record, Observations | Features) and (record.depth < 0).any():
        wrong.append(f"{prefix}depth: expected 0 or more")
    if isinstance(record, Observations) and (record.sigma_px <= 0).any():
        wrong.append(f"{prefix}sigma_px: expected more than 0")
    return wrong


def _numbers(slam_map: Map) -> Iterator[str]:
    """Check the ranges of numbers and the length of quaternions."""
    for prefix, record in _records(slam_map).items():
        yield from number_problems(record, prefix)
    poses = {"T_world_cam": slam_map.T_world_cam, "loops.T_source_target": slam_map.loops.T_source_target}
    poses["culled.T_anchor_keyframe"] = slam_map.culled.T_anchor_keyframe
    for name, T in poses.items():
        if (np.abs(np.linalg.norm(T[:, :4], axis=1) - 1) > _UNIT).any():
            yield f"{name}: a quaternion is not of unit length"
    places = {name: T[:, 4:] for name, T in poses.items()} | {"points.X_world": slam_map.points.X_world}
    for name, X in places.items():
        if (np.abs(X) > _FARTHEST_M).any():
            yield f"{name}: expected coordinates of at most {_FARTHEST_M:g} m, got {np.abs(X).max():g}"


def _tree(slam_map: Map) -> Iterator[str]:
    """Check that each submap has one spanning tree, and that each loop connects two keyframes."""
    roots = slam_map.parent == NONE
    parent = np.arange(len(slam_map.ids))
    parent[~roots] = rows(slam_map.ids, slam_map.parent[~roots])
    if not roots[_ends(parent)].all():
        yield "parent: goes round in a circle"
    if (slam_map.submap != slam_map.submap[parent]).any() or len(np.unique(slam_map.submap)) != roots.sum():
        yield "parent: expected one tree in each submap"
    if (slam_map.loops.source == slam_map.loops.target).any():
        yield "loops: one leads from a keyframe to itself"


def _observations(slam_map: Map) -> Iterator[str]:
    seen = slam_map.observations
    if _repeats(seen.keyframe, seen.point):
        yield "observations: a keyframe sees a point twice"
    by_feature = seen.feature != NONE
    if _repeats(seen.keyframe[by_feature], seen.feature[by_feature]):
        yield "observations: two points are one feature"
    at = rows(slam_map.ids, seen.keyframe)
    num_features = np.array([len(keyframe.features.octave) for keyframe in slam_map.keyframes], np.int64)
    if ((seen.feature < NONE) | (seen.feature >= num_features[at])).any():
        yield "observations.feature: the keyframe has no such feature"
    if _circle_of_culled(slam_map):
        yield "culled.anchor: goes round in a circle"
    elif (slam_map.submap[at] != point_submaps(slam_map)[rows(slam_map.points.ids, seen.point)]).any():
        yield "observations: a keyframe sees a point of another submap"


def _circle_of_culled(slam_map: Map) -> bool:
    order = np.argsort(slam_map.culled.ids)
    ids, anchor = slam_map.culled.ids[order], slam_map.culled.anchor[order]
    inner = has(ids, anchor)
    following = np.arange(len(ids))
    following[inner] = rows(ids, anchor[inner])
    return bool(inner[_ends(following)].any())


def _ends(following: np.ndarray) -> np.ndarray:
    """Return the end of the walk from each row along `following`, if it ends; every round doubles the steps."""
    for _ in range(len(following).bit_length()):
        following = following[following]
    return following


def _repeats(first: np.ndarray, second: np.ndarray) -> bool:
    pairs = np.stack([first, second])
    return np.unique(pairs, axis=1).shape[1] < pairs.shape[1]
