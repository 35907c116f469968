"""Changes of the map: what each does, and that any sequence of them leaves a whole map and older ones as they were."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import logm
from small_map import NUM_FEATURES, arrays, keyframe, observations, points, pose, small_map

from jaxslam.geometry.se3 import between, compose, inverse, to_local, transform
from jaxslam.geometry.so3 import matrices
from jaxslam.map.edit import (
    transformed,
    with_keyframe,
    with_loop,
    with_observations,
    with_points,
    with_positions,
    without_observations,
    without_points,
)
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_fusion import with_fused_points
from jaxslam.map.point_records import NONE, Observations
from jaxslam.map.types import Map, point_submaps
from jaxslam.map.validate import problems

RNG = np.random.Generator


def pairs(slam_map: Map) -> list[tuple[int, int, int]]:
    seen = slam_map.observations
    return list(zip(seen.keyframe.tolist(), seen.point.tolist(), seen.feature.tolist(), strict=True))


def some(ids: np.ndarray, rng: RNG, most: int = 4) -> np.ndarray:
    return rng.choice(ids, min(len(ids), int(rng.integers(1, most + 1))), replace=False)


def random_keyframe(slam_map: Map, rng: RNG) -> Map:
    submap = int(rng.integers(0, 3))
    inside = slam_map.ids[slam_map.submap == submap]
    parent = int(rng.choice(inside)) if len(inside) else NONE
    return with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), parent, submap)


def random_points(slam_map: Map, rng: RNG) -> Map:
    makers = np.concatenate([slam_map.ids, slam_map.culled.ids])
    return with_points(slam_map, points(slam_map, rng.choice(makers, rng.integers(0, 8)), rng))


def random_observations(slam_map: Map, rng: RNG) -> Map:
    at, point = rng.integers(0, len(slam_map.ids), 30), rng.integers(0, max(len(slam_map.points.ids), 1), 30)
    if not len(slam_map.points.ids):
        return slam_map
    fits = slam_map.submap[at] == point_submaps(slam_map)[point]
    feature = rng.integers(NONE, NUM_FEATURES, int(fits.sum()))
    return with_observations(
        slam_map, observations(slam_map, slam_map.ids[at[fits]], slam_map.points.ids[point[fits]], feature, rng)
    )


def random_move(slam_map: Map, rng: RNG) -> Map:
    which, what = some(slam_map.ids, rng), rng.permutation(slam_map.points.ids)[:5]
    poses = np.array([pose(rng) for _ in which])
    return with_positions(slam_map, which, poses, what, rng.normal(size=(3, len(what))))


def random_fusion(slam_map: Map, rng: RNG) -> Map:
    submaps = point_submaps(slam_map)
    if not len(submaps):
        return slam_map
    own = slam_map.points.ids[submaps == rng.choice(submaps)]
    return with_fused_points(slam_map, *rng.choice(own, (2, int(rng.integers(0, 6)))))


def random_removal(slam_map: Map, rng: RNG) -> Map:
    slam_map = without_points(slam_map, rng.permutation(slam_map.points.ids)[:2])
    return without_observations(slam_map, rng.random(len(slam_map.observations.point)) < 0.1)


def random_cull(slam_map: Map, rng: RNG) -> Map:
    chosen = int(rng.choice(slam_map.ids))
    alone = (slam_map.submap == slam_map.submap[slam_map.row(chosen)]).sum() == 1
    return slam_map if alone else without_keyframe(slam_map, chosen)


def random_merge(slam_map: Map, rng: RNG) -> Map:
    return transformed(slam_map, pose(rng), *rng.integers(0, 3, 2).tolist())


def random_loop(slam_map: Map, rng: RNG) -> Map:
    ends = some(slam_map.ids, rng, 2)
    return with_loop(slam_map, int(ends[0]), int(ends[1]), pose(rng), np.eye(6)) if len(ends) == 2 else slam_map


EDITS: list[Callable[[Map, RNG], Map]] = [
    random_keyframe,
    random_points,
    random_observations,
    random_move,
    random_fusion,
    random_removal,
    random_cull,
    random_merge,
    random_loop,
]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from(EDITS), max_size=25), st.integers(0, 2**32))
def test_any_sequence_leaves_a_whole_map_and_older_ones_as_they_were(edits, seed):
    rng = np.random.default_rng(seed)
    slam_map = small_map(seed=seed)
    older = []
    for edit in edits:
        older.append((slam_map, {name: array.tobytes() for name, array in arrays(slam_map).items()}))
        slam_map = edit(slam_map, rng)
        assert problems(slam_map) == []
    for snapshot, contents in older:
        assert {name: array.tobytes() for name, array in arrays(snapshot).items()} == contents


class TestWithKeyframe:
    def test_adds_one(self):
        slam_map, rng = small_map(), np.random.default_rng(1)
        new, T = keyframe(slam_map, rng), pose(rng)
        after = with_keyframe(slam_map, new, T, 2, 0)
        assert after.keyframe(4) is new
        assert (after.parent[-1], after.submap[-1], after.next_keyframe) == (2, 0, 5)
        np.testing.assert_allclose(after.pose(4), T, atol=1e-15)
        assert after.points is slam_map.points

    @pytest.mark.parametrize(
        ("number", "parent", "submap", "message"),
        [
            (3, 0, 0, "expected the next one, 4, got 3"),
            (4, 1, 7, "keyframe 1 is not in submap 7"),
            (4, NONE, 0, "submap 0 has a first keyframe already"),
        ],
    )
    def test_refuses(self, number, parent, submap, message):
        slam_map, rng = small_map(), np.random.default_rng(1)
        with pytest.raises(ValueError, match=message):
            with_keyframe(slam_map, keyframe(slam_map, rng)._replace(id=number), pose(rng), parent, submap)

    def test_refuses_a_pose_that_is_not_finite(self):
        slam_map, rng = small_map(), np.random.default_rng(1)
        with pytest.raises(ValueError, match="not finite"):
            with_keyframe(slam_map, keyframe(slam_map, rng), np.full(7, np.nan), 0, 0)


class TestWithPoints:
    def test_adds_them(self):
        slam_map, rng = small_map(num_points=3), np.random.default_rng(1)
        new = points(slam_map, np.array([1, 2]), rng)
        after = with_points(slam_map, new)
        assert after.points.ids.tolist() == [0, 1, 2, 3, 4]
        assert after.next_point == 5
        np.testing.assert_array_equal(after.points.X_world[:, 3:], new.X_world)
        np.testing.assert_array_equal(after.points.descriptor[3:], new.descriptor)

    def test_refuses_old_ids_and_unknown_makers(self):
        slam_map, rng = small_map(), np.random.default_rng(1)
        new = points(slam_map, np.array([1, 2]), rng)
        with pytest.raises(ValueError, match="expected 10 to 11 in order"):
            with_points(slam_map, new._replace(ids=np.array([9, 10])))
        with pytest.raises(KeyError, match="77"):
            with_points(slam_map, new._replace(reference_keyframe=np.array([1, 77])))


def one_by_one(old: list[tuple[int, int, int]], new: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """What `with_observations` keeps, written as a loop."""
    kept = list(old)
    for which, point, feature in new:
        rivals = [k for k in kept if k[0] == which and (k[1] == point or (k[2] == feature != NONE))]
        kept += [] if rivals else [(which, point, feature)]
    return kept


class TestWithObservations:
    @settings(max_examples=50, deadline=None)
    @given(st.integers(0, 2**32))
    def test_keeps_the_first_as_a_loop_would(self, seed):
        rng = np.random.default_rng(seed)
        slam_map = small_map(num_keyframes=3, num_points=6)
        slam_map = without_observations(slam_map, rng.random(len(slam_map.observations.point)) < 0.7)
        new = observations(slam_map, rng.integers(0, 3, 25), rng.integers(0, 6, 25), rng.integers(NONE, 4, 25), rng)
        offered = list(zip(new.keyframe.tolist(), new.point.tolist(), new.feature.tolist(), strict=True))
        assert pairs(with_observations(slam_map, new)) == one_by_one(pairs(slam_map), offered)

    def test_refuses_a_feature_or_a_submap_that_is_not_there(self):
        slam_map, rng = small_map(), np.random.default_rng(1)
        with pytest.raises(ValueError, match="keyframe 1 has no feature 12"):
            with_observations(slam_map, observations(slam_map, np.array([1]), np.array([2]), np.array([12]), rng))
        slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), NONE, 1)
        with pytest.raises(ValueError, match="another submap"):
            with_observations(slam_map, observations(slam_map, np.array([4]), np.array([2]), np.array([3]), rng))


def test_numbers_out_of_range_do_not_get_in():
    slam_map, rng = small_map(), np.random.default_rng(1)
    new = observations(
        without_points(slam_map, slam_map.points.ids[1:]), np.array([1]), np.array([0]), np.array([NONE]), rng
    )
    with pytest.raises(ValueError, match="uv: holds a number that is not finite"):
        with_observations(slam_map, new._replace(uv=new.uv * np.nan))
    with pytest.raises(ValueError, match="weight: expected 0 to 1"):
        with_points(slam_map, points(slam_map, np.array([1]), rng)._replace(weight=np.full(1, 2, np.float32)))
    frame = keyframe(slam_map, rng)
    with pytest.raises(ValueError, match="depth: expected 0 or more"):
        with_keyframe(
            slam_map, frame._replace(features=frame.features._replace(depth=-frame.features.depth)), pose(rng), 0, 0
        )
    with pytest.raises(ValueError, match="from keyframe 1 to itself"):
        with_loop(slam_map, 1, 1, pose(rng), np.eye(6))


def test_moved_moves_these_and_no_others():
    slam_map, rng = small_map(), np.random.default_rng(1)
    T, X = np.array([pose(rng), pose(rng)]), rng.normal(size=(3, 2))
    after = with_positions(slam_map, np.array([3, 1]), T, np.array([7, 2]), X)
    np.testing.assert_allclose(after.T_world_cam[[3, 1]], T, atol=1e-15)
    np.testing.assert_array_equal(after.points.X_world[:, [7, 2]], X)
    np.testing.assert_array_equal(after.T_world_cam[[0, 2]], slam_map.T_world_cam[[0, 2]])
    np.testing.assert_array_equal(
        np.delete(after.points.X_world, [7, 2], 1), np.delete(slam_map.points.X_world, [7, 2], 1)
    )
    with pytest.raises(ValueError, match="not finite"):
        with_positions(slam_map, slam_map.ids[:0], np.zeros((0, 7)), np.array([7]), np.full((3, 1), np.inf))


def fused_one_by_one(slam_map: Map, links: list[tuple[int, int]]) -> tuple[list[int], list[tuple[int, int, int]]]:
    """Ids of points and pairs that `fused` leaves, written as loops."""
    groups = {point: {point} for point in slam_map.points.ids.tolist()}
    for keep, drop in links:
        union = groups[keep] | groups[drop]
        groups |= dict.fromkeys(union, union)
    dropped = {drop for keep, drop in links if keep != drop}
    name = {point: min(group - dropped or group) for point, group in groups.items()}
    kept: list[tuple[int, int, int]] = []
    for which, point, feature in pairs(slam_map):
        if (which, name[point]) not in [entry[:2] for entry in kept]:
            kept.append((which, name[point], feature))
    return sorted(set(name.values())), kept


class TestFused:
    @settings(max_examples=50, deadline=None)
    @given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=6), st.integers(0, 2**32))
    def test_does_what_loops_would(self, links, seed):
        slam_map = small_map(num_keyframes=3, num_points=8, seed=seed)
        slam_map = without_observations(slam_map, np.random.default_rng(seed).random(24) < 0.4)
        after = with_fused_points(slam_map, *np.array(links).T)
        assert (after.points.ids.tolist(), pairs(after)) == fused_one_by_one(slam_map, links)

    def test_resolves_chains_and_circles(self):
        slam_map = small_map(num_points=10)
        after = with_fused_points(slam_map, np.array([2, 5, 7, 8, 0]), np.array([5, 6, 8, 7, 0]))
        assert after.points.ids.tolist() == [0, 1, 2, 3, 4, 7, 9]
        assert len(after.observations.point) == 4 * 7

    def test_first_observation_stays(self):
        slam_map = small_map(num_keyframes=2, num_points=4)
        bare = without_observations(slam_map, np.isin(np.arange(8), [2, 3]))  # keyframe 0 sees neither 2 nor 3
        after = with_fused_points(bare, np.array([2, 3]), np.array([0, 1]))
        assert pairs(after) == [(0, 2, 0), (0, 3, NONE), (1, 2, 0), (1, 3, NONE)]
        assert problems(after) == []

    def test_descriptor_is_carried_over(self):
        slam_map = small_map(num_points=3)
        slam_map = slam_map.with_arrays(points=slam_map.points._replace(has_descriptor=np.array([False, False, True])))
        after = with_fused_points(slam_map, np.array([0, 0]), np.array([1, 2]))
        assert after.points.has_descriptor.tolist() == [True]
        np.testing.assert_array_equal(after.points.descriptor[0], slam_map.points.descriptor[2])
        np.testing.assert_array_equal(after.points.X_world[:, 0], slam_map.points.X_world[:, 0])

    def test_place_and_weight_are_those_of_the_one_seen_most(self):
        slam_map = small_map(num_keyframes=3, num_points=4)
        seen = slam_map.observations
        slam_map = without_observations(
            slam_map, ((seen.point == 0) & (seen.keyframe > 0)) | ((seen.point == 2) & (seen.keyframe > 1))
        )
        after = with_fused_points(slam_map, np.array([0, 0]), np.array([1, 2]))
        assert after.points.ids.tolist() == [0, 3]
        np.testing.assert_array_equal(after.points.X_world, slam_map.points.X_world[:, [1, 3]])
        np.testing.assert_array_equal(after.points.weight, slam_map.points.weight[[1, 3]])

    def test_refuses_points_of_two_submaps(self):
        slam_map, rng = small_map(num_points=2), np.random.default_rng(1)
        slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), NONE, 1)
        slam_map = with_points(slam_map, points(slam_map, np.array([4]), rng))
        with pytest.raises(ValueError, match="different submaps"):
            with_fused_points(slam_map, np.array([0]), np.array([2]))


def test_without_points_takes_their_observations_along():
    after = without_points(small_map(num_points=4), np.array([1, 3]))
    assert after.points.ids.tolist() == [0, 2]
    assert set(after.observations.point.tolist()) == {0, 2}


def only(slam_map: Map, seen: dict[int, list[int]]) -> Map:
    """The observations of each keyframe cut down to some points."""
    keep = [point in seen[number] for number, point, _ in pairs(slam_map)]
    return without_observations(slam_map, ~np.array(keep))


class TestWithoutKeyframe:
    def test_children_hang_on_who_shares_most_but_not_on_each_other_in_a_circle(self):
        slam_map = small_map(num_keyframes=5, num_points=10)
        slam_map = slam_map._replace(parent=np.array([NONE, 0, 1, 1, 3]))  # 1 goes; 2 and 3 hang on it, 4 on 3
        slam_map = only(slam_map, {0: [9], 1: [0], 2: [1, 2, 3], 3: [1, 2, 9], 4: [1, 2, 3]})
        after = without_keyframe(slam_map, 1)
        assert dict(zip(after.ids.tolist(), after.parent.tolist(), strict=True)) == {0: NONE, 2: 4, 3: 0, 4: 3}
        assert problems(after) == []

    def test_children_who_share_nothing_hang_where_it_hung(self):
        slam_map = small_map(num_keyframes=3, num_points=3)
        after = without_keyframe(only(slam_map, {0: [0], 1: [1], 2: [2]}), 1)
        assert after.parent.tolist() == [NONE, 0]
        assert after.points.ids.tolist() == [0, 2]

    def test_first_hands_over_to_the_child_that_shares_most(self):
        slam_map = small_map(num_keyframes=4, num_points=6)
        slam_map = slam_map._replace(parent=np.array([NONE, 0, 0, 2]))
        slam_map = only(slam_map, {0: [0, 1, 2], 1: [0, 5], 2: [1, 2], 3: [5]})
        after = without_keyframe(slam_map, 0)
        assert dict(zip(after.ids.tolist(), after.parent.tolist(), strict=True)) == {1: 3, 2: NONE, 3: 2}
        assert after.culled.anchor.tolist() == [2]

    def test_the_last_of_a_submap_stays(self):
        with pytest.raises(ValueError, match="keyframe 0 is the only one of its submap"):
            without_keyframe(small_map(num_keyframes=1), 0)

    def test_culled_follow_what_holds_them(self):
        slam_map, rng = small_map(), np.random.default_rng(1)
        T_1, T_2 = slam_map.pose(1), slam_map.pose(2)
        after = without_keyframe(without_keyframe(slam_map, 2), 1)  # 2 is held by 1, which is held by 0
        np.testing.assert_allclose(after.pose(2), T_2, atol=1e-14)
        T_new_old = pose(rng)
        after = transformed(after, T_new_old, 0, 0)
        np.testing.assert_allclose(after.pose(1), compose(T_new_old, T_1), atol=1e-14)
        np.testing.assert_allclose(after.pose(2), compose(T_new_old, T_2), atol=1e-14)

    @pytest.mark.parametrize("ends", [(2, 0), (0, 2)])
    def test_loops_keep_their_error(self, ends):
        slam_map, rng = small_map(), np.random.default_rng(1)
        root = rng.normal(size=(6, 6))
        T = compose(between(slam_map.pose(ends[0]), slam_map.pose(ends[1])), pose(rng))
        slam_map = with_loop(slam_map, ends[0], ends[1], T, root @ root.T)
        after = without_keyframe(slam_map, 2)
        assert (after.loops.source[1], after.loops.target[1]) == tuple(1 if end == 2 else end for end in ends)
        np.testing.assert_allclose(loop_cost(after, 1), loop_cost(slam_map, 1), rtol=1e-9)

    def test_loop_to_its_anchor_goes(self):
        slam_map = with_loop(small_map(), 2, 1, pose(np.random.default_rng(1)), np.eye(6))
        assert len(without_keyframe(slam_map, 2).loops.source) == 1


def loop_cost(slam_map: Map, row: int) -> float:
    """Squared error of a loop, by the logarithm of matrices."""
    actual = between(slam_map.pose(int(slam_map.loops.source[row])), slam_map.pose(int(slam_map.loops.target[row])))
    error = between(slam_map.loops.T_source_target[row], actual)
    M = np.vstack([np.column_stack([matrices(error[:4]), error[4:]]), [0, 0, 0, 1]])
    log = np.real(logm(M))
    tangent = np.array([*log[:3, 3], log[2, 1], log[0, 2], log[1, 0]])
    return float(tangent @ slam_map.loops.information[row] @ tangent)


class TestTransformed:
    def test_carries_one_submap_into_another(self):
        slam_map, rng = small_map(num_keyframes=2, num_points=3), np.random.default_rng(1)
        slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), NONE, 1)
        slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), 2, 1)
        slam_map = with_points(slam_map, points(slam_map, np.array([2, 3, 3]), rng))
        slam_map = with_observations(
            slam_map, observations(slam_map, np.full(3, 2), np.array([3, 4, 5]), np.full(3, NONE), rng)
        )
        slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), 0, 0)
        slam_map = without_keyframe(slam_map, 3)  # made points 4 and 5
        T_new_old = pose(rng)
        after = transformed(slam_map, T_new_old, 1, 0)
        assert (after.submap.tolist(), after.parent.tolist()) == ([0, 0, 0, 0], [NONE, 0, 0, 0])
        np.testing.assert_allclose(after.T_world_cam[2], compose(T_new_old, slam_map.T_world_cam[2]), atol=1e-15)
        np.testing.assert_allclose(after.points.X_world[:, 3:], transform(T_new_old, slam_map.points.X_world[:, 3:]))
        np.testing.assert_array_equal(after.points.X_world[:, :3], slam_map.points.X_world[:, :3])
        np.testing.assert_array_equal(after.T_world_cam[[0, 1, 3]], slam_map.T_world_cam[[0, 1, 3]])
        assert transformed(slam_map, T_new_old, 1, 0, parent=1).parent.tolist() == [NONE, 0, 1, 0]
        with pytest.raises(ValueError, match="keyframe 2 is not in submap 0"):
            transformed(slam_map, T_new_old, 1, 0, parent=2)

    def test_the_tree_is_hung_on_the_other_where_they_touch(self):
        """The second submap is a chain 3-4-5-6 with 7 on 4; it is known to touch keyframe 1 in 5."""
        slam_map, rng = small_map(num_keyframes=3, num_points=3), np.random.default_rng(1)
        for parent in (NONE, 3, 4, 5, 4):
            slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng), parent, 1)
        after = transformed(slam_map, pose(rng), 1, 0, parent=1, child=5)
        assert after.parent.tolist() == [NONE, 0, 1, 4, 5, 1, 5, 4]
        assert problems(after) == []
        first = transformed(slam_map, pose(rng), 1, 0, parent=1, child=3)
        assert first.parent.tolist() == [NONE, 0, 1, 1, 3, 4, 5, 4]
        with pytest.raises(ValueError, match="keyframe 2 is not in submap 1"):
            transformed(slam_map, pose(rng), 1, 0, parent=1, child=2)

    def test_what_cameras_see_stays(self):
        slam_map, T = small_map(), pose(np.random.default_rng(1), 1.0, 5.0)
        after = transformed(slam_map, T, 0, 4)
        assert set(after.submap.tolist()) == {4}
        for number in slam_map.ids.tolist():
            seen = [to_local(m.pose(number), m.points.X_world) for m in (slam_map, after)]
            np.testing.assert_allclose(seen[1], seen[0], atol=1e-13)
        back = transformed(after, inverse(T), 4, 0)
        np.testing.assert_allclose(back.points.X_world, slam_map.points.X_world, atol=1e-13)


def test_empty_edits_change_nothing():
    slam_map = small_map()
    none = np.zeros(0, np.int64)
    assert with_positions(slam_map, none, np.zeros((0, 7)), none, np.zeros((3, 0))) is slam_map
    assert with_fused_points(slam_map, none, none) is slam_map
    after = with_observations(slam_map, Observations(*(array[..., :0] for array in slam_map.observations)))
    assert pairs(after) == pairs(slam_map)
