"""Loops: what closes one, what must not, and what closing it does to the map."""

import functools

import numpy as np
import pytest
from room_views import FRAMES, features, map_of, room, sensor
from small_map import pose as any_pose
from small_map import same, small_map

from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.features.orb import DEFAULT_PLAN, Features, features_of
from jaxslam.geometry.se3 import IDENTITY, between, compose, retract, to_local
from jaxslam.loop_closing import loop_detector as module
from jaxslam.loop_closing.essential_graph import poses_with_loop
from jaxslam.loop_closing.loop_correction import with_loop_closed
from jaxslam.loop_closing.loop_detector import LoopClosing, LoopClosure
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.loop_closing.visibility_check import see_through_ratio
from jaxslam.map.edit import transformed, with_keyframe
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Keyframe, Map, surviving_keyframes
from jaxslam.map.validate import problems
from jaxslam.sensors.frame_arrays import frame_arrays

STEP = 48
ROUND = [*range(0, FRAMES, STEP), *range(STEP // 4, 3 * STEP, STEP)]
"""A whole round of the room, and on to what was seen first."""
TIGHT = np.linalg.inv(np.diag([0.01**2] * 3 + [0.005**2] * 3))
FARTHEST_M = 6.0


def drifted(slam_map: Map, meters: float, radians: float, seed: int = 0) -> Map:
    """Every keyframe's step from the one before wrong by as much, at random: relative poses stay nearly right."""
    rng, poses = np.random.default_rng(seed), slam_map.T_world_cam.copy()
    for row in range(1, len(poses)):
        step = between(slam_map.T_world_cam[row - 1], slam_map.T_world_cam[row])
        error = rng.normal(0, [meters] * 3 + [radians] * 3)
        poses[row] = compose(poses[row - 1], retract(step, error))
    return slam_map._replace(T_world_cam=poses)


def errors(slam_map: Map, truth: Map) -> np.ndarray:
    """`(k,)` meters."""
    return np.linalg.norm(slam_map.T_world_cam[:, 4:] - truth.T_world_cam[:, 4:], axis=1)


def look_at_all(slam_map: Map, prefix: bool = True) -> list[LoopClosure]:
    """What loop closing finds in a recording whose keyframes come one by one, until it finds one."""
    closing, found = LoopClosing(PlaceIndex(), sensor(), DEFAULT_PLAN), []
    for keyframe_id in slam_map.ids.tolist():
        found.append(closing.look(until(slam_map, keyframe_id) if prefix else slam_map, keyframe_id))
    return [closure for closure in found if closure is not None]


def until(slam_map: Map, keyframe_id: int) -> Map:
    """The map when a keyframe was the latest."""
    num = slam_map.row(keyframe_id) + 1
    parts = {name: getattr(slam_map, name)[:num] for name in ("keyframes", "ids", "T_world_cam", "parent", "submap")}
    return slam_map._replace(**parts, next_keyframe=keyframe_id + 1)


@pytest.fixture(scope="module")
def truth() -> Map:
    return map_of(ROUND)


class TestLook:
    def test_a_round_of_the_room_is_closed(self, truth):
        """Drift of the order that odometry may have is found where the round ends, and most of it goes."""
        before = drifted(truth, 0.006, 0.004)
        loops = look_at_all(before)
        assert len(loops) == 1  # as the map does not have it yet, it is not found again
        loop = loops[0]
        assert loop.source <= 2
        assert loop.target > 15
        measured = between(between(truth.pose(loop.source), truth.pose(loop.target)), loop.T_source_target)
        assert np.linalg.norm(measured[4:]) < 0.01
        slam_map = until(before, loop.target)
        after = with_loop_closed(slam_map, loop)
        there = until(truth, loop.target)
        assert problems(after) == []
        assert errors(slam_map, there)[-1] > 0.03
        assert errors(after, there)[-1] < 0.4 * errors(slam_map, there)[-1]
        assert np.sqrt(np.mean(errors(after, there) ** 2)) < 0.7 * np.sqrt(np.mean(errors(slam_map, there) ** 2))
        assert after.loops.target.tolist() == [loop.target]

    def test_what_was_seen_just_now_is_no_loop(self):
        assert look_at_all(map_of(range(0, 9 * 8, 8))) == []

    def test_one_keyframe_alone_closes_nothing(self, truth):
        before = drifted(truth, 0.006, 0.004)
        last = look_at_all(before)[0].target
        assert look_at_all(until(before, last - 1)) == []

    def test_candidates_that_do_not_agree_close_nothing(self, truth, monkeypatch):
        monkeypatch.setattr(module, "_AGREE_REACH", 1e-6)
        assert look_at_all(drifted(truth, 0.006, 0.004)) == []

    def test_a_keyframe_that_is_gone_is_passed_over(self, truth):
        closing = LoopClosing(PlaceIndex(), sensor(), DEFAULT_PLAN)
        assert closing.look(without_keyframe(truth, 3), 3) is None

    def test_two_submaps_that_show_one_place_become_one(self, truth):
        """The second half of the round, and back at the first, is a submap with a world of its own."""
        split = 8
        away = any_pose(np.random.default_rng(1), 1.0, 5.0)
        poses, submap = truth.T_world_cam.copy(), np.where(truth.ids < split, 0, 1).astype(np.int32)
        poses[split:] = compose(np.tile(away, (len(poses) - split, 1)), poses[split:])
        parent = truth.parent.copy()
        parent[split] = NONE
        two = truth._replace(T_world_cam=poses, submap=submap, parent=parent)
        loops = look_at_all(two)
        assert loops
        assert len(loops[0].keyframes) == 0
        one = with_loop_closed(two, loops[0])
        assert problems(one) == []
        assert set(one.submap.tolist()) == {0}
        assert errors(one, truth).max() < 0.03
        assert one.parent[one.row(loops[0].target)] == loops[0].source  # the tree leads over the loop, and nowhere else
        assert one.parent[split:].tolist() == [*range(split + 1, loops[0].target + 1), loops[0].source,
                                               *range(loops[0].target, len(two.ids) - 1)]  # fmt: skip


@functools.cache
def crowded(index: int, seed: int) -> Features:
    """Features of a picture of the room with people and boxes, which nobody masks."""
    return features_of(frame_arrays(crowd(seed)[index], 1 / 30), np.zeros(6), sensor(seed))


@functools.cache
def crowd(seed: int) -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(seed=seed, frames=FRAMES, path="loop", people=3, boxes=2))


def rng_direction(rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


class TestWrongLoops:
    """A recognition that contradicts the odometry must be refused, however sure it is of itself."""

    def accepted(self, slam_map: Map, error: np.ndarray, information: np.ndarray = TIGHT) -> bool:
        source, target = int(slam_map.ids[0]), int(slam_map.ids[-1])
        measured = retract(between(slam_map.pose(source), slam_map.pose(target)), error)
        return poses_with_loop(slam_map, source, target, measured, information, FARTHEST_M) is not None

    @pytest.mark.parametrize("meters", [0.3, 0.5, 1.0, 3.0])
    def test_by_meters(self, truth, meters):
        rng = np.random.default_rng(4)
        for _ in range(5):
            assert not self.accepted(truth, np.r_[meters * rng_direction(rng), 0, 0, 0])

    @pytest.mark.parametrize("degrees", [5, 20, 90, 180])
    def test_by_degrees(self, truth, degrees):
        rng = np.random.default_rng(5)
        for _ in range(5):
            assert not self.accepted(truth, np.r_[0, 0, 0, np.deg2rad(degrees) * rng_direction(rng)])

    def test_right_ones_are_accepted(self, truth):
        """After drift of the order of the graph's uncertainty, 5 mm + 0.5 % and 2 mrad + 0.5 %: nearly always."""
        source, target = int(truth.ids[0]), int(truth.ids[-1])
        measured = between(truth.pose(source), truth.pose(target))
        found = [
            poses_with_loop(drifted(truth, 0.006, 0.003, seed), source, target, measured, TIGHT, FARTHEST_M)
            for seed in range(20)
        ]
        assert sum(one is not None for one in found) >= 19

    def test_uncertain_ones_may_be_farther_off(self, truth):
        shift = np.r_[0.0, 0.3, np.zeros(4)]
        assert not self.accepted(truth, shift)
        assert self.accepted(truth, shift, TIGHT / 400)

    def test_a_loop_that_contradicts_an_earlier_one(self, truth):
        before = drifted(truth, 0.006, 0.003, 1)
        source, target = 0, int(truth.ids[-1])
        first = LoopClosure(
            source,
            target,
            between(truth.pose(source), truth.pose(target)),
            25 * TIGHT,
            *(np.zeros(0, np.int64), np.zeros((0, 7))),
        )
        wrong = np.r_[0.1, np.zeros(5)]
        assert self.accepted(before, wrong)
        closed = with_loop_closed(before, first)
        assert not self.accepted(closed, wrong, 25 * TIGHT)


class TestAliased:
    """Things that look the same and are not: no loop must come of them."""

    @pytest.mark.parametrize(
        "seed", [0, 2, 4, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 20, 2))]
    )
    def test_two_rooms_one_after_the_other(self, seed):
        """Furniture and lights of both are alike, textures are not."""
        assert look_at_all(self.joined([seed, seed + 1], shift=0.5)) == []

    @pytest.mark.parametrize("seed", range(10))
    def test_the_same_room_at_another_place(self, seed):
        """A recording that comes to a place that looks the same to the last pixel, but cannot be it."""
        assert look_at_all(self.joined([seed, seed], shift=2.0)) == []

    @pytest.mark.parametrize("seeds", [(0, 1), (2, 2)])
    def test_with_people_and_boxes_in_it(self, seeds):
        assert look_at_all(self.joined(list(seeds), shift=2.0, moving=True)) == []

    def test_it_would_be_a_loop_if_it_could_be(self):
        """The same, but the odometry has the place nearby: the tests above refuse by that alone."""
        assert len(look_at_all(self.joined([0, 0], shift=0.05))) == 1

    def test_a_place_that_the_map_has_there_already(self):
        assert look_at_all(self.joined([0, 0], shift=0.0)) == []

    def joined(self, seeds: list[int], shift: float, *, moving: bool = False) -> Map:
        """A sixth of a round of some rooms, one after the other, each shifted against the one before."""
        joined = map_of([])
        for part, seed in enumerate(seeds):
            where = retract(IDENTITY, np.r_[0, shift * part, 0.5 * shift * part, 0, 0, 0])
            for index in range(0, 200, 40):
                number = joined.next_keyframe
                seen = crowded(index, seed) if moving else features(index, seed)
                pose = compose(where, room(seed).T_world_cam[index])
                frame = Keyframe(number, 40_000_000 * number, seen, b"")
                joined = with_keyframe(joined, frame, pose, number - 1 if number else NONE, 0)
            joined = self.waited(joined)
        return joined

    def waited(self, slam_map: Map) -> Map:
        """Keyframes that show nothing, so that what was seen is not the latest any more."""
        blank = slam_map.keyframes[-1].features
        blank = type(blank)(*(a[:0] if n == "descriptor" else a[..., :0] for n, a in blank._asdict().items()))
        for _ in range(10):
            number = slam_map.next_keyframe
            frame = slam_map.keyframes[-1]._replace(id=number, features=blank)
            slam_map = with_keyframe(slam_map, frame, slam_map.T_world_cam[-1], number - 1, 0)
        return slam_map


class TestSeenThrough:
    def test_places_that_are_what_they_are_said_to_be(self, truth):
        for first, second in ((0, 1), (3, 4), (0, 20)):
            relative = between(truth.pose(first), truth.pose(second))
            assert see_through_ratio(truth.camera, features(ROUND[first]), features(ROUND[second]), relative) < 0.1

    def test_places_that_are_not(self, truth):
        """Half a meter too far back, the walls would have to be seen through."""
        relative = retract(between(truth.pose(0), truth.pose(1)), np.r_[0, 0, 0.6, 0, 0, 0])
        assert see_through_ratio(truth.camera, features(ROUND[0]), features(ROUND[1]), relative) > 0.8

    def test_what_cannot_be_compared_says_nothing(self, truth):
        back = np.r_[0.0, 0, 1, 0, 0, 0, 0]  # turned round
        assert see_through_ratio(truth.camera, features(0), features(0), back) == 0
        bare = features(0)._replace(depth=0 * features(0).depth)
        assert see_through_ratio(truth.camera, bare, features(0), IDENTITY) == 0
        assert see_through_ratio(truth.camera, features(0), bare, IDENTITY) == 0

    def test_a_keyframe_that_contradicts_its_surroundings_is_not_taken(self, truth, monkeypatch):
        before = drifted(truth, 0.006, 0.004)
        monkeypatch.setattr(module, "see_through_ratio", lambda *_: 0.5)
        assert look_at_all(before) == []


class TestBent:
    def test_all_that_the_loop_does_not_name_moves_along(self):
        """A keyframe made since, the points, and what was culled keep their place among those they hang on."""
        slam_map = small_map(num_keyframes=6, num_points=60, seed=2)
        named = slam_map.ids[:4]
        poses = np.array([retract(slam_map.pose(int(number)), 0.1 * number * np.ones(6)) for number in named])
        loop = LoopClosure(0, 3, between(poses[0], poses[3]), np.eye(6), named, poses)
        after = with_loop_closed(slam_map, loop)
        assert problems(after) == []
        np.testing.assert_allclose(after.T_world_cam[:4], poses, atol=1e-12)
        for child in (4, 5):
            parent = int(slam_map.parent[child])
            np.testing.assert_allclose(
                between(after.pose(parent), after.pose(child)),
                between(slam_map.pose(parent), slam_map.pose(child)),
                atol=1e-12,
            )
        for column, maker in enumerate(surviving_keyframes(slam_map, slam_map.points.reference_keyframe).tolist()):
            local = [to_local(m.pose(maker), m.points.X_world[:, column : column + 1]) for m in (slam_map, after)]
            np.testing.assert_allclose(local[1], local[0], atol=1e-12)

    def test_a_map_carried_elsewhere_since_is_bent_where_it_is(self):
        slam_map = small_map(num_keyframes=5, num_points=20, seed=2)
        poses = np.array([retract(slam_map.pose(int(number)), 0.1 * number * np.ones(6)) for number in slam_map.ids])
        loop = LoopClosure(0, 4, between(poses[0], poses[4]), np.eye(6), slam_map.ids, poses)
        away = any_pose(np.random.default_rng(1), 1.0, 5.0)
        then, now = with_loop_closed(slam_map, loop), with_loop_closed(transformed(slam_map, away, 0, 0), loop)
        np.testing.assert_allclose(now.points.X_world, transformed(then, away, 0, 0).points.X_world, atol=1e-9)
        carried = compose(np.tile(away, (5, 1)), then.T_world_cam)
        apart = between(carried, now.T_world_cam)
        np.testing.assert_allclose(np.abs(apart[:, 0]), 1, atol=1e-12)
        np.testing.assert_allclose(apart[:, 1:], 0, atol=1e-9)

    def test_keyframes_culled_since_are_left_out(self):
        slam_map = small_map(num_keyframes=5, num_points=20, seed=2)
        poses = np.array([retract(slam_map.pose(int(number)), 0.1 * number * np.ones(6)) for number in slam_map.ids])
        loop = LoopClosure(0, 4, between(poses[0], poses[4]), np.eye(6), slam_map.ids, poses)
        after = with_loop_closed(without_keyframe(slam_map, 2), loop)
        assert problems(after) == []
        np.testing.assert_allclose(after.T_world_cam, poses[[0, 1, 3, 4]], atol=1e-12)

    def test_a_loop_that_asks_for_nothing_changes_nothing(self):
        slam_map = small_map(num_keyframes=5, num_points=20, seed=2)
        loop = LoopClosure(
            0, 4, between(slam_map.pose(0), slam_map.pose(4)), np.eye(6), slam_map.ids, slam_map.T_world_cam
        )
        after = with_loop_closed(slam_map, loop)
        np.testing.assert_allclose(after.T_world_cam, slam_map.T_world_cam, atol=1e-12)
        np.testing.assert_allclose(after.points.X_world, slam_map.points.X_world, atol=1e-12)
        assert not same(after, slam_map)  # it has one loop more
