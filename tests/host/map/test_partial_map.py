"""Parts of maps: cutting one out and putting it back, and that edits of it are edits of the whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_map import arrays, keyframe, pose, same, sightings, small_map

from jaxslam.map.edit import (
    fused,
    moved,
    with_keyframe,
    with_sightings,
    without_keyframe,
    without_points,
    without_sightings,
)
from jaxslam.map.partial_map import most_shared, part_around, put_back
from jaxslam.map.types import NONE, Map, covisible
from jaxslam.map.validate import problems


def thinned(seed: int, num_keyframes: int = 6, num_points: int = 40) -> Map:
    """Every keyframe sees about a third of the points."""
    map = small_map(num_keyframes, num_points, seed)
    map = without_sightings(map, np.random.default_rng(seed).random(len(map.sightings.point)) < 0.65)
    return without_points(map, np.setdiff1d(map.points.ids, map.sightings.point))


def in_order(map: Map) -> Map:
    """The sightings in the order of keyframes and points: which of them came first is lost on the way."""
    order = np.lexsort((map.sightings.point, map.sightings.keyframe))
    return map._replace(sightings=type(map.sightings)(*(column[..., order] for column in map.sightings)))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.sets(st.integers(0, 5), max_size=4), st.sets(st.integers(0, 39), max_size=3))
def test_cut_out_and_put_back_is_the_same(seed, around, besides):
    map = thinned(seed % 1000)
    ids, more = np.array(sorted(around), np.int64), np.intersect1d(np.array(sorted(besides), np.int64), map.points.ids)
    part = part_around(map, ids, more)
    wanted = np.union1d(map.sightings.point[np.isin(map.sightings.keyframe, ids)], more)
    assert part.map.points.ids.tolist() == wanted.tolist()
    assert np.count_nonzero(np.isin(map.sightings.point, wanted)) == len(part.map.sightings.point)
    assert problems(part.map) == []
    assert same(in_order(put_back(map, part, part.map)), in_order(map))
    for number in ids.tolist():
        for whole, here in zip(covisible(map, number, 1), covisible(part.map, number, 1), strict=True):
            np.testing.assert_array_equal(here, whole)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 999))
def test_edits_of_a_part_are_edits_of_the_whole(seed):
    rng, map = np.random.default_rng(seed), thinned(seed)
    before = {name: array.copy() for name, array in arrays(map).items()}
    part = part_around(map, np.array([2, 3, 4, 5]))  # 3 hangs on 2, which goes

    def edited(map: Map, ids: np.ndarray) -> Map:
        rng = np.random.default_rng(seed)
        map = fused(map, ids[:1], ids[3:4])
        map = moved(map, np.array([4]), pose(rng)[None], ids[5:7], rng.normal(size=(3, 2)))
        map = without_points(map, ids[8:9])
        map = with_keyframe(map, keyframe(map, rng), pose(rng), 5, 0)
        map = with_sightings(map, sightings(map, np.full(3, 6), ids[9:12], np.array([0, 1, NONE]), rng))
        return without_points(without_keyframe(map, 2), np.zeros(0, np.int64))

    ids = rng.permutation(part.map.points.ids)
    if len(ids) < 12:
        return
    after, expected = put_back(map, part, edited(part.map, ids)), edited(map, ids)
    assert problems(after) == []
    assert same(in_order(after), in_order(expected))
    for name, array in arrays(map).items():
        np.testing.assert_array_equal(array, before[name])


def test_most_shared():
    map = thinned(3)
    wanted = map.points.ids[::2]
    counts = {
        number: np.isin(map.sightings.point[map.sightings.keyframe == number], wanted).sum() for number in range(6)
    }
    order = sorted(counts, key=lambda number: (-counts[number], -number))
    assert most_shared(map, wanted, 4).tolist() == order[:4]
    assert most_shared(map, wanted[:0], 4).tolist() == []


def test_an_id_that_was_never_given():
    with pytest.raises(IndexError):
        part_around(small_map(), np.array([77]))
