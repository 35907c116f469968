"""Points and observations of a map in blocks: the same as whole arrays, and shared where nothing changed."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from small_map import arrays, in_order, same, small_map, thinned

from jaxslam.map.edit import with_positions, without_points
from jaxslam.map.partial_map import extract_around, merge_back
from jaxslam.map.types import Map, empty_map
from jaxslam.map.validate import problems


def spread(seed: int, apart: int) -> Map:
    """A map whose point ids are so far apart that many blocks have some."""
    slam_map = thinned(seed)
    points, seen = slam_map.points, slam_map.observations
    slam_map = slam_map.with_arrays(points._replace(ids=points.ids * apart), seen._replace(point=seen.point * apart))
    return slam_map._replace(next_point=slam_map.next_point * apart)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 999), st.integers(1, 900))
def test_blocks_are_the_same_as_whole_arrays(seed, apart):
    slam_map = spread(seed, apart)
    blocks = slam_map.in_blocks()
    assert blocks.contents.num_points == len(slam_map.points.ids)
    assert blocks.contents.nbytes == sum(array.nbytes for array in (*slam_map.points, *slam_map.observations))
    assert same(in_order(blocks), in_order(slam_map))
    assert problems(blocks) == []


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 999), st.integers(1, 900), st.sets(st.integers(0, 5), max_size=3))
def test_around_has_all_observations_of_what_keyframes_observe(seed, apart, keyframes):
    slam_map, ids = spread(seed, apart), np.array(sorted(keyframes), np.int64)
    more = slam_map.points.ids[::7]
    near = slam_map.in_blocks().around(ids, more)
    wanted = np.union1d(slam_map.observations.point[np.isin(slam_map.observations.keyframe, ids)], more)
    assert np.isin(wanted, near.points.ids).all()
    seen, all_seen = np.isin(near.observations.point, wanted), np.isin(slam_map.observations.point, wanted)
    assert seen.sum() == all_seen.sum()
    assert problems(near) == []


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 999), st.integers(1, 900))
def test_ids_that_are_here(seed, apart):
    slam_map = spread(seed, apart)
    asked = np.random.default_rng(seed).integers(-2, slam_map.next_point + 2000, 50)
    asked = np.append(asked, slam_map.points.ids[:5])
    expected = np.isin(asked, slam_map.points.ids)
    np.testing.assert_array_equal(slam_map.contents.have(asked), expected)
    np.testing.assert_array_equal(slam_map.in_blocks().contents.have(asked), expected)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 999), st.integers(1, 900), st.integers(0, 5))
def test_an_edit_shares_the_blocks_that_it_does_not_touch(seed, apart, keyframe):
    whole = spread(seed, apart).in_blocks()
    before = {name: array.copy() for name, array in arrays(whole).items()}
    part = extract_around(whole, np.array([keyframe]))
    ids = part.map.points.ids
    X_world = np.random.default_rng(seed).normal(size=(3, len(ids)))

    def edited(slam_map: Map) -> Map:
        slam_map = with_positions(slam_map, np.zeros(0, np.int64), np.zeros((0, 7)), ids, X_world)
        return without_points(slam_map, ids[::3])

    after, expected = merge_back(whole, part, edited(part.map)), edited(whole)
    assert same(in_order(after), in_order(expected))
    touched = set((ids >> 10).tolist())
    for number, block in after.contents.blocks.items():
        assert (block is whole.contents.blocks.get(number)) == (number not in touched)
    for name, array in arrays(whole).items():
        np.testing.assert_array_equal(array, before[name])


def test_nothing_in_blocks():
    nothing = empty_map(small_map().camera).in_blocks()
    assert nothing.contents.num_points == nothing.contents.nbytes == 0
    assert not len(nothing.points.ids)
    assert not nothing.contents.have(np.array([0, 1])).any()
    assert not len(nothing.around(np.array([3])).observations.point)
