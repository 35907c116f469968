"""Parts of maps: cutting one out and putting it back, and that edits of it are edits of the whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_map import arrays, in_order, keyframe, observations, pose, same, small_map, thinned

from jaxslam.map.edit import with_keyframe, with_observations, with_positions, without_points
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.partial_map import extract_around, merge_back
from jaxslam.map.point_fusion import with_fused_points
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map, covisible, observers
from jaxslam.map.validate import problems


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.sets(st.integers(0, 5), max_size=4), st.sets(st.integers(0, 39), max_size=3))
def test_cut_out_and_put_back_is_the_same(seed, around, besides):
    slam_map = thinned(seed % 1000)
    ids, more = (
        np.array(sorted(around), np.int64),
        np.intersect1d(np.array(sorted(besides), np.int64), slam_map.points.ids),
    )
    part = extract_around(slam_map, ids, more)
    wanted = np.union1d(slam_map.observations.point[np.isin(slam_map.observations.keyframe, ids)], more)
    assert part.map.points.ids.tolist() == wanted.tolist()
    assert np.count_nonzero(np.isin(slam_map.observations.point, wanted)) == len(part.map.observations.point)
    assert problems(part.map) == []
    assert same(in_order(merge_back(slam_map, part, part.map)), in_order(slam_map))
    for number in ids.tolist():
        for whole, here in zip(covisible(slam_map, number, 1), covisible(part.map, number, 1), strict=True):
            np.testing.assert_array_equal(here, whole)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 999))
def test_edits_of_a_part_are_edits_of_the_whole(seed):
    rng, slam_map = np.random.default_rng(seed), thinned(seed)
    before = {name: array.copy() for name, array in arrays(slam_map).items()}
    part = extract_around(slam_map, np.array([2, 3, 4, 5]))  # 3 hangs on 2, which goes

    def edited(slam_map: Map, ids: np.ndarray) -> Map:
        rng = np.random.default_rng(seed)
        slam_map = with_fused_points(slam_map, ids[:1], ids[3:4])
        slam_map = with_positions(slam_map, np.array([4]), pose(rng)[None], ids[5:7], rng.normal(size=(3, 2)))
        slam_map = without_points(slam_map, ids[8:9])
        slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), 5, 0)
        slam_map = with_observations(
            slam_map, observations(slam_map, np.full(3, 6), ids[9:12], np.array([0, 1, NONE]), rng)
        )
        return without_points(without_keyframe(slam_map, 2), np.zeros(0, np.int64))

    ids = rng.permutation(part.map.points.ids)
    if len(ids) < 12:
        return
    after, expected = merge_back(slam_map, part, edited(part.map, ids)), edited(slam_map, ids)
    assert problems(after) == []
    assert same(in_order(after), in_order(expected))
    for name, array in arrays(slam_map).items():
        np.testing.assert_array_equal(array, before[name])


def test_observers():
    slam_map = thinned(3)
    wanted = slam_map.points.ids[::2]
    counts = {
        number: np.isin(slam_map.observations.point[slam_map.observations.keyframe == number], wanted).sum()
        for number in range(6)
    }
    order = sorted(counts, key=lambda number: (-counts[number], -number))
    ids, shared = observers(slam_map, wanted)
    assert ids.tolist() == [number for number in order if counts[number]]
    assert shared.tolist() == [counts[number] for number in ids]
    assert observers(slam_map, wanted[:0])[0].tolist() == []


def test_an_id_that_was_never_given():
    with pytest.raises(IndexError):
        extract_around(small_map(), np.array([77]))
