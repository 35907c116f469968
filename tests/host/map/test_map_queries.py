"""Questions to the map, and the check of what must hold in it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from small_map import CAMERA, keyframe, pose, small_map

from jaxslam.map.edit import with_keyframe, without_observations
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_records import NONE, distinct, has, rows
from jaxslam.map.spanning_tree import children, subtree
from jaxslam.map.types import Map, covisible, empty_map, neighborhood, point_submaps, surviving_keyframes, visibility
from jaxslam.map.validate import problems


def seen_by(slam_map: Map, seen: dict[int, list[int]]) -> Map:
    """Observations cut down to these points of each keyframe."""
    keep = [
        point in seen[number]
        for number, point in zip(
            slam_map.observations.keyframe.tolist(), slam_map.observations.point.tolist(), strict=True
        )
    ]
    return without_observations(slam_map, ~np.array(keep))


def test_rows_and_has():
    ids = np.array([2, 5, 9])
    assert has(ids, np.array([9, 0, 5, 10])).tolist() == [True, False, True, False]
    assert rows(ids, np.array([9, 2, 9])).tolist() == [2, 0, 2]
    assert has(ids[:0], np.array([1])).tolist() == [False]
    with pytest.raises(KeyError, match=r"\[3\]"):
        rows(ids, np.array([2, 3]))


@pytest.mark.parametrize("span", [6000, 10**12])
def test_rows_and_has_of_many(span):
    random = np.random.default_rng(0)
    ids = np.unique(random.integers(-span, span, 3000))
    row = random.integers(0, len(ids), 5000)
    np.testing.assert_array_equal(rows(ids, ids[row]), row)
    wanted = np.append(random.integers(-2 * span, 2 * span, 4000), [ids[0], ids[-1], ids[0] - 1, ids[-1] + 1])
    np.testing.assert_array_equal(has(ids, wanted), np.isin(wanted, ids))
    with pytest.raises(KeyError, match="not in the map"):
        rows(ids, wanted)


@pytest.mark.parametrize("span", [1, 6000, 10**12])
@pytest.mark.parametrize("number", [0, 1, 5000])
def test_distinct(number, span):
    ids = np.random.default_rng(0).integers(-span, span, number)
    for found, expected in zip(distinct(ids), np.unique(ids, return_counts=True), strict=True):
        np.testing.assert_array_equal(found, expected)


class TestPose:
    def test_of_one_that_was_never_there(self):
        with pytest.raises(KeyError, match="keyframe 9 was never in this map"):
            small_map().pose(9)

    def test_of_one_in_the_map(self):
        slam_map = small_map()
        np.testing.assert_allclose(slam_map.pose(2), slam_map.T_world_cam[2], atol=1e-15)
        assert slam_map.keyframe(2).id == 2


def test_visibility_counts_points_in_common():
    slam_map = seen_by(small_map(num_keyframes=3, num_points=5), {0: [0, 1, 2], 1: [2, 3], 2: [0, 1, 2, 4]})
    seen = visibility(slam_map)
    assert seen.shape == (3, 5)
    assert (seen @ seen.T).toarray().tolist() == [[3, 1, 3], [1, 2, 1], [3, 1, 4]]


class TestCovisible:
    MAP = seen_by(
        small_map(num_keyframes=5, num_points=6), {0: [0, 1, 2, 3], 1: [0, 1], 2: [0, 1, 2], 3: [2, 3], 4: [5]}
    )

    def test_most_first_then_newest(self):
        ids, counts = covisible(self.MAP, 0, at_least=1)
        assert (ids.tolist(), counts.tolist()) == ([2, 3, 1], [3, 2, 2])

    def test_enough_in_common(self):
        assert covisible(self.MAP, 0, at_least=3)[0].tolist() == [2]
        assert covisible(self.MAP, 4, at_least=1)[0].tolist() == []

    def test_neighborhood(self):
        ids, seen = neighborhood(self.MAP, 0, at_least=2, at_most=2)
        assert (ids.tolist(), seen.tolist()) == ([0, 2, 3], [0, 1, 2, 3])

    def test_neighborhood_takes_the_parent_along(self):
        assert neighborhood(self.MAP, 4, at_least=1)[0].tolist() == [4, 3]
        assert neighborhood(self.MAP, 2, at_least=1, at_most=1)[0].tolist() == [2, 1]


def test_tree():
    slam_map = small_map(num_keyframes=6)._replace(parent=np.array([NONE, 0, 0, 1, 3, 2]))
    assert children(slam_map, 0).tolist() == [1, 2]
    assert subtree(slam_map, 1).tolist() == [1, 3, 4]
    assert subtree(slam_map, 5).tolist() == [5]


def test_submap_of_points_whose_keyframe_is_gone():
    slam_map, rng = small_map(), np.random.default_rng(1)
    slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), NONE, 3)
    slam_map = without_keyframe(without_keyframe(slam_map, 2), 1)
    assert surviving_keyframes(slam_map, np.array([2, 4, 1, 3])).tolist() == [0, 4, 0, 3]
    assert set(point_submaps(slam_map).tolist()) == {0}
    with pytest.raises(KeyError):
        surviving_keyframes(slam_map, np.array([5]))


def test_empty_map_is_whole():
    assert problems(empty_map(CAMERA)) == []


def broken(**changes: Callable[[Any], Any]) -> Map:
    """A small map, after a keyframe was culled, with some fields changed: `points__ids` is `points.ids`."""
    slam_map = without_keyframe(small_map(num_keyframes=5), 2)
    for key, change in changes.items():
        name, _, field = key.partition("__")
        record = getattr(slam_map, name)
        after = record._replace(**{field: change(getattr(record, field))}) if field else change(record)
        of_arrays = name in ("points", "observations")
        slam_map = slam_map.with_arrays(**{name: after}) if of_arrays else slam_map._replace(**{name: after})
    return slam_map


def put(index: Any, number: float) -> Callable[[np.ndarray], np.ndarray]:
    """A copy with one place changed."""

    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[index] = number
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"submap": lambda a: a.astype(np.int64)}, r"submap: expected int32 \(4,\), got int64 \(4,\)"),
        ({"points__X_world": lambda a: a[:, 1:]}, r"points.X_world: expected float64 \(3, 10\), got float64 \(3, 9\)"),
        ({"ids": put(1, 7)}, "ids: not those of the keyframes"),
        ({"next_keyframe": lambda _: 4}, "ids: expected them to ascend from 0 and end before 4"),
        ({"points__ids": put(3, 2)}, "points.ids: expected them to ascend from 0 and end before 10"),
        ({"culled__ids": put(0, 3)}, "culled.ids: one is given twice, or still in the map"),
        ({"parent": put(2, 2)}, "parent: 2 is not in the map"),
        ({"points__reference_keyframe": put(0, 12)}, "points.reference_keyframe: 12 is not in the map"),
        ({"observations__keyframe": put(0, 2)}, "observations.keyframe: 2 is not in the map"),
        ({"observations__point": put(0, 99)}, "observations.point: 99 is not in the map"),
        ({"loops__target": put(0, 2)}, "loops.target: 2 is not in the map"),
        ({"culled__anchor": put(0, 99)}, "culled.anchor: 99 is not in the map"),
        ({"T_world_cam": put((0, 5), np.nan)}, "T_world_cam: holds a number that is not finite"),
        ({"T_world_cam": put((0, 0), 3.0)}, "T_world_cam: a quaternion is not of unit length"),
        ({"observations__weight": put(0, 1.5)}, "observations.weight: expected 0 to 1"),
        ({"observations__sigma_px": put(0, 0)}, "observations.sigma_px: expected more than 0"),
        ({"observations__depth": put(0, -1)}, "observations.depth: expected 0 or more"),
        ({"points__weight": put(0, -0.5)}, "points.weight: expected 0 to 1"),
        ({"parent": lambda a: np.array([1, 3, 0, 0], a.dtype)}, "parent: goes round in a circle"),
        ({"parent": put(1, NONE)}, "parent: expected one tree in each submap"),
        ({"submap": put(3, 1)}, "parent: expected one tree in each submap"),
        ({"loops__source": put(0, 4)}, "loops: one leads from a keyframe to itself"),
        ({"observations__point": put(0, 1)}, "observations: a keyframe sees a point twice"),
        ({"observations__feature": put(1, 0)}, "observations: two points are one feature"),
        ({"observations__feature": put(1, 12)}, "observations.feature: the keyframe has no such feature"),
        ({"culled__anchor": put(0, 2)}, "culled.anchor: goes round in a circle"),
    ],
)
def test_problems_names_what_is_wrong(changes, message):
    assert problems(broken()) == []
    with pytest.raises(AssertionError, match=message):
        raise AssertionError("\n".join(problems(broken(**changes))))


def test_problems_looks_into_keyframes():
    slam_map = small_map(num_keyframes=1)
    first = slam_map.keyframes[0]
    cut = first._replace(features=first.features._replace(angle=first.features.angle[1:]))
    assert problems(slam_map._replace(keyframes=(cut,))) == [
        "keyframe 0: angle: expected float32 (12,), got float32 (11,)"
    ]


def test_problems_knows_submaps():
    slam_map, rng = small_map(num_keyframes=2), np.random.default_rng(1)
    slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), NONE, 1)
    seen = slam_map.observations._replace(keyframe=put(0, 2)(slam_map.observations.keyframe))
    assert problems(slam_map.with_arrays(observations=seen)) == [
        "observations: a keyframe sees a point of another submap"
    ]
