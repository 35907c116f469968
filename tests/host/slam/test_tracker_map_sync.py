"""The tracker and the map kept in step: corrections against closed forms, and what hangs on what."""

from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from jaxlie import SE3
from small_map import CAMERA, features, png, small_map
from small_map import pose as random_pose

from jaxslam.geometry.se3 import IDENTITY, between, compose, to_local, transform
from jaxslam.map.edit import transformed, with_keyframe, with_positions
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.mapping.local_mapping import NewKeyframe
from jaxslam.mapping.track_table import TrackId
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays, frame_arrays
from jaxslam.slam.keyframe_reload import reload_keyframe
from jaxslam.slam.tracker_map_sync import AnchoredPose, TrackerMapSync
from jaxslam.tracking.initial_state import init_state
from jaxslam.tracking.points import KeyframeMatches
from jaxslam.tracking.state import TrackOutput, TrackPlan, TrackState, TrackStatus

PLAN = TrackPlan(num_points=8, num_levels=2, num_keyframes=3, num_reloaded=2, num_sources=1, points_per_source=4)
SHAPE = (CAMERA.height, CAMERA.width)


class Tracker(NamedTuple):
    """A tracker's state as its keyframes make it, without tracking."""

    link: TrackerMapSync
    state: Any
    map: Map


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def blank() -> Any:
    return jax.device_get(init_state(*SHAPE, PLAN))


def frame() -> FrameArrays:
    return frame_arrays(Frame(0, np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.float32)), 0.03)


def output(
    pose: np.ndarray, X_world: np.ndarray, status: TrackStatus = TrackStatus.OK, ids: np.ndarray | None = None
) -> TrackOutput:
    """What the tracker says of a keyframe at a pose where it follows points, and has found none again."""
    n, m = PLAN.num_points, PLAN.points_per_source
    none: Any = np.zeros((3, m), np.float32)
    found = KeyframeMatches(none, none[:2], none[0], none[0].astype(np.int32), none[0], none[0, 0])
    values: dict[str, Any] = dict.fromkeys(TrackOutput._fields, np.float32(0))
    values |= {
        "T_world_cam": SE3(pose.astype(np.float32)),  # type: ignore[arg-type]
        "status": np.int32(status),
        "uv": np.full((2, n), 20, np.float32),
        "weights": np.ones(n, np.float32),
        "X_world": X_world.astype(np.float32),
        "id": np.arange(n, dtype=np.int32) if ids is None else ids,
        "keyframe_matches": found,
        "twist": np.zeros(6, np.float32),
    }
    return TrackOutput(**values)


def some_points(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform([[-1], [-1], [1.5]], [[1], [1], [4]], (3, PLAN.num_points))


def put(state: TrackState, slot: int, pose: np.ndarray, X_world: np.ndarray) -> TrackState:
    """The state after the tracker has made a keyframe."""
    kept = state.keyframes
    poses, X = np.array(kept.T_world_cam), np.array(kept.X_world)
    poses[slot], X[slot] = pose, X_world
    return state._replace(
        keyframes=kept._replace(T_world_cam=poses, X_world=X),
        T_world_cam=SE3(pose.astype(np.float32)),  # type: ignore[arg-type]
        points=state.points._replace(X_world=X_world.astype(np.float32)),
    )


def add(slam_map: Map, new: NewKeyframe, rng: np.random.Generator) -> Map:
    """What mapping does with a keyframe, as far as poses go."""
    pose = new.T_parent_keyframe if new.parent == NONE else compose(slam_map.pose(new.parent), new.T_parent_keyframe)
    submap = new.submap if new.parent == NONE else int(slam_map.submap[slam_map.row(new.parent)])
    return with_keyframe(slam_map, Keyframe(new.id, new.id, features(rng), png(new.id)), pose, new.parent, submap)


def tracker(blank: Any, rng: np.random.Generator, made: int = 3, mapped: int = 3) -> Tracker:
    """A tracker with so many keyframes, of which some are in the map."""
    slam_map = empty_map(CAMERA)
    link, state = TrackerMapSync(PLAN, slam_map), blank
    for number in range(made):
        pose, X = random_pose(rng), some_points(rng)
        status = TrackStatus.OK if number else TrackStatus.STARTED
        new = link.register_keyframe(number, frame(), output(pose, X, status), None)
        state = put(state, number % PLAN.num_keyframes, pose, X)
        slam_map = add(slam_map, new, rng) if number < mapped else slam_map
    state, correction = link.apply_map(state, slam_map)
    np.testing.assert_allclose(correction, IDENTITY, atol=1e-6)
    return Tracker(link, state, slam_map)


def moved_by(slam_map: Map, changes: np.ndarray) -> Map:
    """The map with each keyframe carried over by a transform."""
    nothing = np.zeros(0, np.int64)
    return with_positions(slam_map, slam_map.ids, compose(changes, slam_map.T_world_cam), nothing, np.zeros((3, 0)))


def changes(rng: np.random.Generator, count: int, scale: float = 0.1) -> np.ndarray:
    return np.stack([random_pose(rng, scale, scale) for _ in range(count)])


def corrected(now: Tracker, slam_map: Map) -> tuple[Any, np.ndarray]:
    state, correction = now.link.apply_map(now.state, slam_map)
    return jax.device_get(state), correction


def poses_agree(actual: Any, expected: np.ndarray, atol: float = 3e-6) -> None:
    apart = between(np.asarray(actual, np.float64), expected)
    np.testing.assert_allclose(apart[..., 4:], 0, atol=atol)
    np.testing.assert_allclose(np.abs(apart[..., 0]), 1, atol=atol)
    np.testing.assert_allclose(apart[..., 1:4], 0, atol=atol)


class TestCorrections:
    def test_each_keyframe_rigidly_by_its_own(self, blank: Any, rng: np.random.Generator) -> None:
        """Its pose and its points; the camera and the points followed, with the keyframe they hang on."""
        now = tracker(blank, rng)
        by = changes(rng, 3)
        state, correction = corrected(now, moved_by(now.map, by))
        poses_agree(correction, by[2])
        for slot in range(3):
            poses_agree(state.keyframes.T_world_cam[slot], compose(by[slot], now.state.keyframes.T_world_cam[slot]))
            expected = transform(by[slot], now.state.keyframes.X_world[slot].astype(np.float64))
            np.testing.assert_allclose(state.keyframes.X_world[slot], expected, atol=3e-6)
        poses_agree(state.T_world_cam.wxyz_xyz, compose(by[2], np.asarray(now.state.T_world_cam.wxyz_xyz)))
        np.testing.assert_allclose(
            state.points.X_world, transform(by[2], now.state.points.X_world.astype(np.float64)), atol=3e-6
        )

    def test_nothing_else_changes(self, blank: Any, rng: np.random.Generator) -> None:
        now = tracker(blank, rng)
        state, _ = corrected(now, moved_by(now.map, changes(rng, 3)))
        rest = lambda s: (s.points.uv, s.points.id, s.keyframes.uv, s.keyframes.images, s.twist, s.next_id)
        jax.tree.map(np.testing.assert_array_equal, rest(state), rest(now.state))

    def test_ring_wraps(self, blank: Any, rng: np.random.Generator) -> None:
        """Five keyframes in three slots: the last three count, in the slots they were put in."""
        now = tracker(blank, rng, made=5, mapped=5)
        assert now.link.latest() == [3, 4, 2]
        by = changes(rng, 5)
        state, _ = corrected(now, moved_by(now.map, by))
        for slot, number in enumerate((3, 4, 2)):
            poses_agree(state.keyframes.T_world_cam[slot], compose(by[number], now.state.keyframes.T_world_cam[slot]))

    def test_keyframes_on_their_way_move_with_their_parents(self, blank: Any, rng: np.random.Generator) -> None:
        now = tracker(blank, rng, made=3, mapped=1)
        by = changes(rng, 1)
        state, correction = corrected(now, moved_by(now.map, by))
        poses_agree(correction, by[0])
        poses_agree(state.keyframes.T_world_cam[:3], compose(by, now.state.keyframes.T_world_cam[:3]))

    def test_of_a_culled_keyframe(self, blank: Any, rng: np.random.Generator) -> None:
        """It moves with the one that holds its place."""
        now = tracker(blank, rng)
        culled = without_keyframe(now.map, 1)
        anchor = int(culled.culled.anchor[0])
        by = changes(rng, 2)
        state, _ = corrected(now, moved_by(culled, by))
        expected = compose(by[culled.row(anchor)], now.state.keyframes.T_world_cam[1])
        poses_agree(state.keyframes.T_world_cam[1], expected)

    def test_small_ones_add_up(self, blank: Any, rng: np.random.Generator) -> None:
        """Each below what is worth a correction; none is forgotten, on either side."""
        now = tracker(blank, rng)
        step, slam_map = np.array([1.0, 0, 0, 0, 4e-7, 0, 0]), now.map
        state, total = now.state, IDENTITY
        for _ in range(100):
            slam_map = moved_by(slam_map, np.tile(step, (3, 1)))
            state, correction = now.link.apply_map(state, slam_map)
            total = compose(correction, total)
        assert abs(total[4] - 4e-5) < 1e-6
        shift = np.asarray(state.keyframes.T_world_cam)[:3, 4] - now.state.keyframes.T_world_cam[:3, 4]
        np.testing.assert_allclose(shift, 4e-5, atol=5e-6)
        poses_agree(now.link.tracker_pose(2), slam_map.pose(2), atol=1e-6)

    def test_thousand(self, blank: Any, rng: np.random.Generator) -> None:
        """The quaternions stay of unit length, and the tracker where the map has it, to the rounding of float32."""
        now = tracker(blank, rng)
        state, slam_map = now.state, now.map
        for _ in range(1000):
            slam_map = moved_by(slam_map, changes(rng, 3, 0.02))
            state, _ = now.link.apply_map(state, slam_map)
        poses = np.asarray(state.keyframes.T_world_cam)[:3]
        camera = np.asarray(state.T_world_cam.wxyz_xyz)
        np.testing.assert_allclose(np.linalg.norm(poses[:, :4], axis=1), 1, atol=5e-7)
        np.testing.assert_allclose(np.linalg.norm(camera[:4]), 1, atol=5e-7)
        scale = np.abs(slam_map.T_world_cam[:, 4:]).max()
        poses_agree(poses, slam_map.T_world_cam, atol=2e-5 * max(scale, 1))


class TestHung:
    def test_is_where_the_tracker_has_it_until_the_map_moves(self, blank: Any, rng: np.random.Generator) -> None:
        now = tracker(blank, rng, made=4, mapped=3)
        pose = random_pose(rng)
        anchored = now.link.anchor(pose)
        assert anchored.keyframe == 3
        np.testing.assert_allclose(now.link.pose(anchored), pose, atol=1e-12)

    def test_moves_with_its_keyframe(self, blank: Any, rng: np.random.Generator) -> None:
        """Also after the keyframe was culled, and if it hangs on one that is still on its way."""
        now = tracker(blank, rng, made=4, mapped=3)
        pose = random_pose(rng)
        anchored, by = now.link.anchor(pose), changes(rng, 3)
        corrected(now, moved_by(now.map, by))
        np.testing.assert_allclose(now.link.pose(anchored), compose(by[2], pose), atol=1e-6)
        of_culled = AnchoredPose(1, IDENTITY)
        before, slam_map = now.link.pose(of_culled), without_keyframe(now.link.map, 1)
        now.link.apply_map(now.state, slam_map)
        np.testing.assert_allclose(now.link.pose(of_culled), before, atol=1e-12)

    def test_keyframe_that_never_came(self, blank: Any, rng: np.random.Generator) -> None:
        """A mistake of the caller."""
        now = tracker(blank, rng)
        with pytest.raises(KeyError, match="never in this map"):
            now.link.pose(AnchoredPose(7, IDENTITY))


class TestKeyframes:
    def test_tree(self, blank: Any, rng: np.random.Generator) -> None:
        """Each hangs on the one before, by the relative pose of the two."""
        link, poses, made = TrackerMapSync(PLAN, empty_map(CAMERA)), [], []
        for number in range(3):
            poses.append(random_pose(rng))
            said = output(poses[-1], some_points(rng), TrackStatus.OK if number else TrackStatus.STARTED)
            made.append(link.register_keyframe(number, frame(), said, None))
        assert [(new.id, new.parent, new.submap) for new in made] == [(0, NONE, 0), (1, 0, 0), (2, 1, 0)]
        poses_agree(made[0].T_parent_keyframe, poses[0], atol=1e-6)
        poses_agree(made[2].T_parent_keyframe, between(poses[1], poses[2]), atol=1e-6)
        for new in made:
            np.testing.assert_allclose(np.linalg.norm(new.T_parent_keyframe[:4]), 1, atol=1e-12)

    def test_tracks(self, rng: np.random.Generator) -> None:
        """Points in the axes of the camera, with the tracker's numbers; a reloaded point keeps that of the map."""
        pose, X = random_pose(rng), some_points(rng)
        ids = np.concatenate([np.arange(4), TrackId.of_map_points(np.array([0, 3, 9, 11]))]).astype(np.int32)
        new = TrackerMapSync(PLAN, empty_map(CAMERA)).register_keyframe(
            0, frame(), output(pose, X, TrackStatus.STARTED, ids), None
        )
        np.testing.assert_array_equal(new.tracks.id[: len(ids)], ids)
        np.testing.assert_allclose(new.tracks.X_cam[:, : len(ids)], to_local(pose, X), atol=1e-5)
        np.testing.assert_array_equal(new.tracks.weight, [1] * PLAN.num_points + [0] * PLAN.points_per_source)

    def test_ids_go_on_after_those_of_a_map(self, rng: np.random.Generator) -> None:
        slam_map = without_keyframe(small_map(5), 4)
        link = TrackerMapSync(PLAN, slam_map)
        link.set_reference_keyframe(2)
        pose = random_pose(rng)
        new = link.register_keyframe(0, frame(), output(pose, some_points(rng)), AnchoredPose(2, IDENTITY))
        assert (new.id, new.parent) == (5, 2)
        poses_agree(new.T_parent_keyframe, between(slam_map.pose(2), pose), atol=1e-6)


class TestSubmaps:
    def test_begin_where_nothing_ties_a_frame_to_the_others(self, blank: Any, rng: np.random.Generator) -> None:
        now = tracker(blank, rng)
        assert now.link.submap_now() == 0
        started = output(random_pose(rng), some_points(rng), TrackStatus.STARTED)
        second = now.link.register_keyframe(9, frame(), started, None)
        assert (second.parent, second.submap, now.link.submap_now()) == (NONE, 1, 1)

    def test_recognized_place_is_in_its_own(self, blank: Any, rng: np.random.Generator) -> None:
        """After a second submap has begun the camera comes back to the first, and goes on there."""
        now = tracker(blank, rng)
        started = output(random_pose(rng), some_points(rng), TrackStatus.STARTED)
        slam_map = add(now.map, now.link.register_keyframe(9, frame(), started, None), rng)
        state, _ = now.link.apply_map(now.state, slam_map)
        now.link.set_reference_keyframe(1)
        assert now.link.submap_now() == 0
        new = now.link.register_keyframe(10, frame(), started, AnchoredPose(1, IDENTITY))
        assert new.parent == 1
        assert now.link.submap_now() == 0  # on its way, it hangs on one of the first
        now.link.apply_map(state, without_keyframe(add(slam_map, new, rng), 1))
        now.link.set_reference_keyframe(4)
        assert now.link.submap_now() == 0
        now.link.set_reference_keyframe(3)
        assert now.link.submap_now() == 1

    def test_of_a_culled_keyframe(self, blank: Any, rng: np.random.Generator) -> None:
        """The frames hang on a keyframe of the first submap, which is dropped after a second one had begun."""
        now = tracker(blank, rng)
        started = output(random_pose(rng), some_points(rng), TrackStatus.STARTED)
        slam_map = add(now.map, now.link.register_keyframe(9, frame(), started, None), rng)
        state, _ = now.link.apply_map(now.state, slam_map)
        now.link.set_reference_keyframe(1)
        now.link.apply_map(state, without_keyframe(slam_map, 1))
        assert now.link.submap_now() == 0

    def test_become_one(self, blank: Any, rng: np.random.Generator) -> None:
        """The later one is carried over as a whole, and the camera in it."""
        now = tracker(blank, rng)
        pose, X = random_pose(rng), some_points(rng)
        second = now.link.register_keyframe(9, frame(), output(pose, X, TrackStatus.STARTED), None)
        state = put(now.state, 0, pose, X)
        slam_map = add(now.map, second, rng)
        state, _ = now.link.apply_map(state, slam_map)
        anchored, change = now.link.anchor(pose), random_pose(rng)
        state, correction = now.link.apply_map(state, transformed(slam_map, change, 1, 0, 2))
        poses_agree(correction, change)
        poses_agree(np.asarray(state.T_world_cam.wxyz_xyz), compose(change, pose))
        poses_agree(now.link.pose(anchored), compose(change, pose))
        assert now.link.submap_now() == 0


class TestRecalled:
    def test_points_are_where_the_map_has_them(self, blank: Any, rng: np.random.Generator) -> None:
        slam_map = small_map(4, 6)
        link = TrackerMapSync(PLAN, slam_map)
        keyframe = reload_keyframe(slam_map, 2, PLAN.num_points)
        slot = PLAN.num_keyframes
        assert link.slot_for(2, {2}) == slot
        state = jax.device_get(link.load_keyframe(jax.device_put(blank), slot, keyframe))
        used = state.keyframes.weight[slot] > 0
        ids = -1 - state.keyframes.id[slot][used]
        np.testing.assert_array_equal(np.sort(ids), slam_map.points.ids)
        X_world = slam_map.points.X_world[:, np.searchsorted(slam_map.points.ids, ids)]
        np.testing.assert_allclose(state.keyframes.X_world[slot][:, used], X_world, atol=2e-6)
        poses_agree(state.keyframes.T_world_cam[slot], slam_map.pose(2))
        assert link.slot_for(2, {2}) is None  # it is there

    def test_moves_with_its_keyframe(self, blank: Any, rng: np.random.Generator) -> None:
        slam_map = small_map(4, 6)
        link = TrackerMapSync(PLAN, slam_map)
        link.set_reference_keyframe(0)
        state = link.load_keyframe(
            jax.device_put(blank), PLAN.num_keyframes, reload_keyframe(slam_map, 2, PLAN.num_points)
        )
        before, by = np.asarray(state.keyframes.T_world_cam[PLAN.num_keyframes]), changes(rng, 4)
        state, correction = link.apply_map(state, moved_by(slam_map, by))
        poses_agree(correction, by[0])
        poses_agree(state.keyframes.T_world_cam[PLAN.num_keyframes], compose(by[2], before))

    def test_none_in_place_of_another_that_is_wanted(self, blank: Any) -> None:
        """As many as there is room for, one after the other: all of them are there in the end."""
        slam_map = small_map(6, 6)
        link, state = TrackerMapSync(PLAN, slam_map), jax.device_put(blank)
        for wanted in ([1, 2], [2, 3], [4, 3], [0, 5]):
            for number in wanted:
                slot = link.slot_for(number, set(wanted))
                if slot is not None:
                    state = link.load_keyframe(state, slot, reload_keyframe(slam_map, number, PLAN.num_points))
            there = np.asarray(state.keyframes.T_world_cam)[PLAN.num_keyframes :]
            poses_agree(there[np.argsort(there[:, 4])], _sorted(slam_map.T_world_cam[np.array(wanted)]))

    def test_not_one_that_is_gone(self) -> None:
        slam_map = without_keyframe(small_map(4, 6), 2)
        assert TrackerMapSync(PLAN, slam_map).slot_for(2, {2}) is None


def _sorted(poses: np.ndarray) -> np.ndarray:
    return poses[np.argsort(poses[:, 4])]
