"""States of the points of the map: what passes before them, what becomes of that in the map, and what it weighs."""

import contextlib
import csv
import functools
import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from exact_map import exact_map
from room_round import TRACK
from small_map import CAMERA, same, small_map
from small_scene import Clip
from wall_map import POINTS, at, seen_from

from jaxslam.config.cue_sections import OcclusionConfig
from jaxslam.config.loading import load_config
from jaxslam.config.schema import Config, DynamicsConfig, TrackConfig
from jaxslam.datasets.synthetic import SceneDetector, SyntheticConfig, SyntheticDataset
from jaxslam.dynamics.occlusion import PointState, state_weights
from jaxslam.errors import MapFileError
from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.features.pose_from_matches import FeaturePose
from jaxslam.geometry.se3 import IDENTITY, between, to_local
from jaxslam.map.edit import with_keyframe, with_observations, with_points, with_states, without_points
from jaxslam.map.npz_file import _name_in_version, load_map, save_map
from jaxslam.map.partial_map import extract_around, merge_back
from jaxslam.map.point_fusion import with_fused_points
from jaxslam.map.point_records import NONE, rows
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.map.validate import problems
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan, adjust_all, adjust_around
from jaxslam.mapping.local_map_tracking import match_local_map
from jaxslam.mapping.local_mapping import LocalMapping, NewKeyframe, mapping_plan
from jaxslam.mapping.map_point_matching import feature_observations
from jaxslam.mapping.occlusion_states import PointStates, StateChanges, occluded_shares, with_changes
from jaxslam.mapping.point_creation import new_points
from jaxslam.results.run_results import RunInfo, write_results
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

STATIC, BLOCKED, OCCLUDED = (int(state) for state in PointState)
SHAPE = CAMERA.height, CAMERA.width
CLEAR = np.zeros(SHAPE, bool)
LEFT = np.arange(CAMERA.width)[None, :] < np.full((CAMERA.height, 1), 31)
EVERYWHERE = ~CLEAR


def arrays(mask: np.ndarray = CLEAR, depth_m: float | np.ndarray = 0.0) -> FrameArrays:
    """A frame in which a mask is not trusted; without depth, if not given."""
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), mask.shape).copy()
    parts: Any = (np.zeros(mask.shape, np.uint8), depth, mask, np.float32(0.03), np.float32(0))
    return FrameArrays(*parts)


def wall(*shown: int) -> Map:
    """A wall two meters ahead, of which keyframes at one place show so many points."""
    return seen_from([at()] * len(shown), list(shown))


def states_of(slam_map: Map, *, guard: bool = True, camera: Camera = CAMERA) -> PointStates:
    config = OcclusionConfig(enabled=True, guard=guard)
    return PointStates(config, sensor_model(camera, TrackConfig()), slam_map, POINTS)


def look(
    states: PointStates, slam_map: Map, frame: FrameArrays, pose: np.ndarray = IDENTITY, keyframe: int = 0
) -> float:
    return states.see(slam_map, keyframe, pose, np.zeros(6, np.float32), frame)


def now(states: PointStates, slam_map: Map) -> np.ndarray:
    """The state of every point of a map."""
    return states._of(slam_map, slam_map.points.ids)


def left_of_the_mask(slam_map: Map) -> np.ndarray:
    X = slam_map.points.X_world
    return np.round(CAMERA.fx * X[0] / X[2] + CAMERA.cx) < 31


class TestFrames:
    """A mask passes before a wall of points."""

    def test_blocked_while_it_passes_and_occluded_afterwards(self) -> None:
        slam_map = wall(POINTS)
        states, left = states_of(slam_map), left_of_the_mask(slam_map)
        assert 20 < left.sum() < 80
        assert look(states, slam_map, arrays()) == 0
        assert (now(states, slam_map) == STATIC).all()
        assert look(states, slam_map, arrays(LEFT)) == 0
        np.testing.assert_array_equal(now(states, slam_map), np.where(left, BLOCKED, STATIC))
        assert look(states, slam_map, arrays()) == pytest.approx(left.mean())
        np.testing.assert_array_equal(now(states, slam_map), np.where(left, OCCLUDED, STATIC))
        look(states, slam_map, arrays(EVERYWHERE))
        np.testing.assert_array_equal(now(states, slam_map), np.where(left, OCCLUDED, BLOCKED))

    def test_only_points_of_the_reference_keyframe(self) -> None:
        slam_map = wall(40, POINTS)
        states = states_of(slam_map)
        look(states, slam_map, arrays(EVERYWHERE), keyframe=0)
        assert now(states, slam_map).tolist() == [BLOCKED] * 40 + [STATIC] * 60

    def test_what_is_blocked_is_followed_on_from_another_keyframe(self) -> None:
        """One that was made while something stood there, and does not see the points behind."""
        slam_map = seen_from([at(), at(x=0.1)], [POINTS, 30])
        states = states_of(slam_map)
        look(states, slam_map, arrays(EVERYWHERE), keyframe=0)
        share = look(states, slam_map, arrays(LEFT), at(x=-0.1), keyframe=1)  # the same pose, in its axes
        np.testing.assert_array_equal(now(states, slam_map), np.where(left_of_the_mask(slam_map), BLOCKED, OCCLUDED))
        assert share == pytest.approx((~left_of_the_mask(slam_map)[:30]).mean())

    def test_not_into_another_submap(self) -> None:
        """Its world is another."""
        slam_map = seen_from([at(), at()], [POINTS, POINTS], [0, 1])
        states = states_of(slam_map)
        look(states, slam_map, arrays(EVERYWHERE), keyframe=0)
        look(states, slam_map, arrays(), keyframe=1)
        assert now(states, slam_map).tolist() == [BLOCKED] * POINTS + [STATIC] * POINTS

    @pytest.mark.parametrize("pose", [at(x=5.0), at(turn=np.pi), at(z=1.9)], ids=["beside", "behind", "close"])
    def test_outside_the_picture_nothing_is_learnt(self, pose: np.ndarray) -> None:
        """Beside it, behind the camera, or all but one at its sides."""
        slam_map = wall(POINTS)
        states = states_of(slam_map)
        look(states, slam_map, arrays(LEFT))
        before = now(states, slam_map)
        X = to_local(pose, slam_map.points.X_world)
        z = np.where(X[2] > 0.15, X[2], np.inf)
        u, v = CAMERA.fx * X[0] / z + CAMERA.cx, CAMERA.fy * X[1] / z + CAMERA.cy
        outside = ~(np.isfinite(z) & (np.abs(u - 31.5) < 31) & (np.abs(v - 23.5) < 23))
        assert outside.sum() > 90
        look(states, slam_map, arrays(), pose)
        np.testing.assert_array_equal(now(states, slam_map)[outside], before[outside])

    def test_pixels_of_the_lens(self) -> None:
        """Each point is where OpenCV's model of the same lens has it."""
        camera = replace(CAMERA, distortion=(1.0, -0.3, 0.05, -0.04, 0.05))
        slam_map = wall(POINTS)
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        X = np.ascontiguousarray(slam_map.points.X_world.T)
        uv = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0].reshape(-1, 2)
        bent = np.hypot(*(uv - X[:, :2] / 2 * [CAMERA.fx, CAMERA.fy] - [CAMERA.cx, CAMERA.cy]).T)
        assert bent.max() > 1
        clear = np.abs(np.mod(uv, 1) - 0.5).min(axis=1) > 0.02  # not between two pixels
        mask = np.zeros(SHAPE, bool)
        u, v = np.round(uv).astype(int).T
        mask[v[::4], u[::4]] = True
        states = states_of(slam_map, camera=camera)
        look(states, slam_map, arrays(mask))
        np.testing.assert_array_equal(now(states, slam_map)[clear], np.where(mask[v, u], BLOCKED, STATIC)[clear])


class TestGuard:
    """Depth that contradicts takes a point back."""

    @staticmethod
    def after(depth_m: float | np.ndarray, *, guard: bool = True, first: np.ndarray = EVERYWHERE) -> np.ndarray:
        """States of points that were blocked, then seen where they should be, then with this depth."""
        slam_map = wall(POINTS)
        states = states_of(slam_map, guard=guard)
        look(states, slam_map, arrays(first))
        look(states, slam_map, arrays(CLEAR, 2.0))
        assert (now(states, slam_map) == (OCCLUDED if first.any() else STATIC)).all()
        look(states, slam_map, arrays(CLEAR, depth_m))
        return now(states, slam_map)

    @pytest.mark.parametrize("depth_m", [3.0, 2.3, 1.7, 1.0])
    def test_another_surface(self, depth_m: float) -> None:
        """Behind, where a thing has gone; in front, where nobody can tell."""
        assert (self.after(depth_m) == STATIC).all()
        assert (self.after(depth_m, guard=False) == OCCLUDED).all()

    @pytest.mark.parametrize("depth_m", [2.0, 2.05, 1.95, 0.0, np.nan, 50.0])
    def test_noise_and_no_depth_say_nothing(self, depth_m: float) -> None:
        assert (self.after(depth_m) == OCCLUDED).all()

    def test_edges_say_nothing(self) -> None:
        """Two pixels wide: an error of the pose would do."""
        stripes = np.where(np.arange(CAMERA.width) % 4 < 2, 2.0, 3.0)
        assert (self.after(np.tile(stripes, (CAMERA.height, 1))) == OCCLUDED).all()

    def test_what_is_hidden_by_what_no_mask_covers_is_not_seen_again(self) -> None:
        slam_map = wall(POINTS)
        states = states_of(slam_map)
        look(states, slam_map, arrays(EVERYWHERE))
        look(states, slam_map, arrays(CLEAR, 1.0))
        assert (now(states, slam_map) == STATIC).all()

    def test_depth_under_the_mask_says_nothing(self) -> None:
        """It is that of what passes."""
        slam_map = wall(POINTS)
        states = states_of(slam_map)
        for mask in (EVERYWHERE, CLEAR, EVERYWHERE):
            look(states, slam_map, arrays(mask, np.where(mask, 1.0, 2.0)))
        assert (now(states, slam_map) == OCCLUDED).all()


class TestExchange:
    """What the tracker has seen, and what the map has."""

    def test_goes_over_once_and_comes_back(self) -> None:
        slam_map = wall(POINTS)
        states = states_of(slam_map)
        look(states, slam_map, arrays(LEFT))
        first = states.handed_over()
        assert first.ids.tolist() == slam_map.points.ids[left_of_the_mask(slam_map)].tolist()
        assert set(first.states.tolist()) == {BLOCKED}
        look(states, slam_map, arrays())
        assert first.states.max() == BLOCKED  # a copy
        second = states.handed_over()
        assert second.number > first.number
        assert (second.ids.tolist(), set(second.states.tolist())) == (first.ids.tolist(), {OCCLUDED})
        assert len(states.handed_over().ids) == 0
        whole = with_changes(with_changes(slam_map, first), second)
        np.testing.assert_array_equal(whole.points.state, now(states, slam_map))
        states.arrived(whole, second.number)
        np.testing.assert_array_equal(now(states, whole), whole.points.state)

    def test_what_has_changed_meanwhile_stays_ahead(self) -> None:
        """A map is late: it knows what was handed over with its keyframe, and no more."""
        slam_map = wall(POINTS)
        states, left = states_of(slam_map), left_of_the_mask(slam_map)
        look(states, slam_map, arrays(LEFT))
        first = states.handed_over()
        look(states, slam_map, arrays())
        late = with_changes(slam_map, first)
        assert set(late.points.state[left].tolist()) == {BLOCKED}
        states.arrived(late, first.number)
        np.testing.assert_array_equal(now(states, late), np.where(left, OCCLUDED, STATIC))
        assert look(states, late, arrays()) == pytest.approx(left.mean())

    def test_the_map_knows_better_what_it_has(self) -> None:
        """As of a point that has become one with one that is OCCLUDED."""
        slam_map = wall(POINTS)
        states = states_of(slam_map)
        look(states, slam_map, arrays(LEFT))
        changes = states.handed_over()
        other = with_states(with_changes(slam_map, changes), changes.ids[:1], np.array([OCCLUDED]))
        states.arrived(other, changes.number)
        assert now(states, other)[changes.ids[0]] == OCCLUDED

    def test_new_points_and_points_that_have_left(self) -> None:
        slam_map = wall(POINTS)
        states = states_of(slam_map)
        look(states, slam_map, arrays(EVERYWHERE))
        changes = states.handed_over()
        smaller = without_points(slam_map, slam_map.points.ids[::2])
        bigger = with_points(smaller, new_points(smaller, 0, np.full((3, 7), 2.0)))
        merged = with_changes(bigger, changes)
        assert merged.points.state.tolist() == [BLOCKED] * (POINTS // 2) + [STATIC] * 7
        states.arrived(merged, changes.number)
        look(states, merged, arrays())
        assert now(states, merged).tolist() == [OCCLUDED] * (POINTS // 2) + [STATIC] * 7

    def test_weights(self) -> None:
        """Those of points that are OCCLUDED by now, whatever the map knows of it; their average is one."""
        slam_map = wall(POINTS)
        states, left = states_of(slam_map), left_of_the_mask(slam_map)
        look(states, slam_map, arrays(LEFT))
        assert set(states.weights(slam_map, slam_map.points.ids).tolist()) == {1.0}
        look(states, slam_map, arrays())
        weights = states.weights(slam_map, slam_map.points.ids)
        np.testing.assert_allclose(weights, np.where(left, 3, 1) / (1 + 2 * left.mean()), rtol=1e-6)
        assert len(states.weights(slam_map, slam_map.points.ids[:0])) == 0


class TestMap:
    def test_new_points_are_static(self) -> None:
        assert new_points(wall(3), 0, np.ones((3, 4))).state.tolist() == [STATIC] * 4

    def test_highest_state_survives_fusion(self) -> None:
        """Also along a chain, and whichever of them is kept."""
        slam_map = with_states(small_map(), np.arange(10), np.array([0, 1, 2, 0, 0, 1, 2, 1, 0, 0]))
        after = with_fused_points(slam_map, np.array([0, 1, 3, 5, 8]), np.array([2, 7, 4, 6, 3]))
        kept = dict(zip(after.points.ids.tolist(), after.points.state.tolist(), strict=True))
        assert kept == {0: OCCLUDED, 1: BLOCKED, 5: OCCLUDED, 8: STATIC, 9: STATIC}
        assert slam_map.points.state.tolist() == [0, 1, 2, 0, 0, 1, 2, 1, 0, 0]
        assert problems(after) == []

    def test_with_states_changes_these_and_refuses_others(self) -> None:
        slam_map = small_map()
        after = with_states(slam_map, np.array([7, 2]), np.array([OCCLUDED, STATIC], np.int8))
        assert (after.points.state[7], after.points.state[2], after.points.state.dtype) == (OCCLUDED, STATIC, np.int8)
        assert np.count_nonzero(after.points.state != slam_map.points.state) <= 2
        with pytest.raises(ValueError, match="states: expected 0 to 2"):
            with_states(slam_map, np.array([7]), np.array([3]))
        with pytest.raises(KeyError, match="77"):
            with_states(slam_map, np.array([77]), np.array([1]))

    def test_part_of_a_map(self) -> None:
        slam_map = wall(40, POINTS)
        part = extract_around(slam_map, np.array([0]))
        assert len(part.map.points.state) == 40
        after = merge_back(slam_map, part, with_states(part.map, np.arange(40), np.full(40, OCCLUDED)))
        assert after.points.state.tolist() == [OCCLUDED] * 40 + [STATIC] * 60

    def test_share_of_each_keyframe(self) -> None:
        slam_map = wall(40, POINTS, 0)
        slam_map = with_states(slam_map, np.arange(20), np.full(20, OCCLUDED))
        assert occluded_shares(slam_map).tolist() == pytest.approx([0.5, 0.2, 0.0])
        assert occluded_shares(empty_map(CAMERA)).tolist() == []

    def test_checked(self) -> None:
        slam_map = small_map()
        wrong = slam_map.with_arrays(points=slam_map.points._replace(state=slam_map.points.state + np.int8(1)))
        assert problems(wrong) == ["points.state: expected 0 to 2"]

    def test_file(self, tmp_path: Path) -> None:
        slam_map = small_map()
        assert set(slam_map.points.state.tolist()) == {STATIC, BLOCKED, OCCLUDED}
        save_map(tmp_path / "a.map", slam_map)
        assert same(load_map(tmp_path / "a.map"), slam_map)

    def test_file_of_version_1(self, tmp_path: Path) -> None:
        """It has no states: nothing is known to have passed before anything."""
        path, slam_map = tmp_path / "a.map", small_map()
        save_map(path, slam_map)
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        header = json.loads(members["header.json"])
        counts = {_name_in_version(name, 1): count for name, count in header["counts"].items()}
        arrays = {f"{_name_in_version(name.removesuffix('.npy'), 1)}.npy": data for name, data in members.items()}
        old = arrays | {"header.json": json.dumps(header | {"version": 1, "counts": counts}).encode()}
        del old["points.state.npy"], old["header.json.npy"]
        path.write_bytes(_packed(old))
        points = slam_map.points._replace(state=np.zeros(len(slam_map.points.ids), np.int8))
        assert same(load_map(path), slam_map.with_arrays(points=points))
        path.write_bytes(_packed(old | {"points.state.npy": members["points.state.npy"]}))
        with pytest.raises(MapFileError, match=r"unknown or missing members: points\.state\.npy"):
            load_map(path)


def _packed(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


EXACT = Camera("exact", 640, 480, 525.0, 525.0, 319.5, 239.5)
PLAN = FeaturePlan()
MOVED_M = 0.01


class TestMotionOnly:
    """The pose of a frame from points of which half are wrong: those that are OCCLUDED are right."""

    @staticmethod
    def found(config: OcclusionConfig | None, occluded: np.ndarray | None = None) -> tuple[FeaturePose, float]:
        """The pose, and how far it is from the truth."""
        count, rng = 300, np.random.default_rng(3)
        places = rng.uniform([[-1], [-0.8], [2]], [[1], [0.8], [3]], (3, count))
        seen = Features(
            *(_pixels(places) for _ in range(2)),
            depth=places[2].astype(np.float32),
            octave=np.full(count, 2, np.uint8),
            angle=np.zeros(count, np.float32),
            descriptor=rng.integers(0, 256, (count, 32)).astype(np.uint8),
        )
        slam_map = with_keyframe(empty_map(EXACT), Keyframe(0, 0, seen, b""), IDENTITY, NONE, 0)
        wrong = np.arange(count) % 2 == 0
        points = new_points(slam_map, 0, places + MOVED_M * wrong * np.eye(3)[:, :1], seen.descriptor)
        slam_map = with_observations(
            with_points(slam_map, points),
            feature_observations(0, seen, points.ids, np.arange(count, dtype=np.int32), PLAN),
        )
        state = np.where(~wrong if occluded is None else occluded, OCCLUDED, STATIC)
        slam_map = with_states(slam_map, slam_map.points.ids, state)
        sensor = sensor_model(EXACT, TrackConfig())
        states = None if config is None else PointStates(config, sensor, slam_map, count)
        pose = match_local_map(slam_map, 0, IDENTITY, seen, sensor, PLAN, states)
        assert pose is not None
        return pose, float(np.linalg.norm(pose.T_origin_cam[4:]))

    def test_goes_to_the_occluded_points(self) -> None:
        errors = [self.found(OcclusionConfig(True, weight))[1] for weight in (0.2, 1.0, 3.0, 30.0)]
        print([f"{1e3 * error:.2f} mm" for error in errors])
        assert errors == sorted(errors, reverse=True)
        assert errors[1] > 0.1 * MOVED_M
        assert errors[2] < 0.5 * errors[1]

    def test_weight_of_one_is_off_to_the_bit(self) -> None:
        off, one = self.found(None)[0], self.found(OcclusionConfig(True, 1.0))[0]
        for first, second in zip(off, one, strict=True):
            np.testing.assert_array_equal(first, second)

    def test_only_ratios_count(self) -> None:
        """Where all are OCCLUDED nothing changes; and the pose is not called more certain where half are."""
        off, all_of_them = self.found(None)[0], self.found(OcclusionConfig(True, 3.0), np.ones(300, bool))[0]
        np.testing.assert_array_equal(all_of_them.T_origin_cam, off.T_origin_cam)
        half = self.found(OcclusionConfig(True, 3.0))[0]
        ratio = np.sqrt(np.diagonal(half.covariance) / np.diagonal(off.covariance))
        assert 0.7 < ratio.min() < ratio.max() < 1.3


def _pixels(X: np.ndarray) -> np.ndarray:
    return np.stack([EXACT.fx * X[0] / X[2] + EXACT.cx, EXACT.fy * X[1] / X[2] + EXACT.cy]).astype(np.float32)


class TestAdjustment:
    """Half the observations of the newest keyframe are off: those of points that are OCCLUDED are not."""

    @staticmethod
    @functools.cache
    def truth() -> Map:
        return exact_map()

    def wrong(self) -> Map:
        slam_map = self.truth()
        seen = slam_map.observations
        off = (seen.keyframe == 15) & (seen.point % 2 == 0)
        uv = seen.uv + np.float32(0.6) * off * np.array([[1], [0]], np.float32)
        slam_map = slam_map.with_arrays(observations=seen._replace(uv=uv))
        odd = slam_map.points.ids[1::2]
        return with_states(slam_map, odd, np.full(len(odd), OCCLUDED))

    def error_px(self, slam_map: Map) -> float:
        """How far from where they should be the newest keyframe has the points that it sees."""
        seen = self.truth().observations.point[self.truth().observations.keyframe == 15]
        X = self.truth().points.X_world[:, seen]
        apart = _pixels(to_local(slam_map.pose(15), X)) - _pixels(to_local(self.truth().pose(15), X))
        return float(np.hypot(*apart).mean())

    @pytest.mark.parametrize("everywhere", [False, True], ids=["local", "global"])
    def test_goes_to_the_occluded_points(self, everywhere: bool) -> None:
        def adjusted(weight: float) -> float:
            plan, slam_map = AdjustPlan(occluded_weight=weight), self.wrong()
            after = (
                adjust_all(slam_map, plan, slam_map.ids, sweeps=1) if everywhere else adjust_around(slam_map, 15, plan)
            )
            return self.error_px(after)

        errors = [adjusted(weight) for weight in (1.0, 3.0, 30.0)]
        print([f"{error:.3f} px" for error in errors])
        assert errors[0] > 0.1
        assert errors[1] < 0.75 * errors[0]
        assert errors[2] < errors[1]

    def test_off_to_the_bit(self) -> None:
        """Whatever states a map has that was made with the settings on."""
        slam_map = self.wrong()
        static = slam_map.with_arrays(points=slam_map.points._replace(state=np.zeros_like(slam_map.points.state)))
        first, second = adjust_around(slam_map, 15, AdjustPlan()), adjust_around(static, 15, AdjustPlan())
        assert same(first.with_arrays(points=first.points._replace(state=second.points.state)), second)

    def test_settings(self) -> None:
        plan = lambda dynamics: mapping_plan(CAMERA, Config(dynamics=dynamics))
        weights = {
            OcclusionConfig(): 1.0,
            OcclusionConfig(enabled=True): 3.0,
            OcclusionConfig(enabled=True, weight=1.5): 1.5,
            OcclusionConfig(weight=1.5): 1.0,
        }
        for occlusion, expected in weights.items():
            assert plan(DynamicsConfig(occlusion=occlusion)).adjust.occluded_weight == expected
        assert plan(DynamicsConfig()).adjust.occluded_weight == 1
        assert state_weights(np.array([STATIC, BLOCKED, OCCLUDED]), 3.0).tolist() == [1, 1, 3]


class TestPresets:
    def test_differ_by_the_weights_alone(self) -> None:
        with_them, without = load_config("occlusion-published"), load_config("occlusion-masks")
        assert with_them.dynamics.occlusion == OcclusionConfig(enabled=True, weight=3.0, guard=False)
        assert without.dynamics.occlusion == OcclusionConfig()
        assert replace(with_them, dynamics=without.dynamics) == without
        assert without.semantics.model is not None
        assert without.semantics.dilate_px > 0
        assert without.track == load_config("static").track


FRAMES = 45


@functools.cache
def _scene() -> tuple[Clip, SceneDetector]:
    """Three people who cross the picture."""
    settings = SyntheticConfig(width=320, height=240, frames=FRAMES, people=3, path="xyz", fps=15)
    dataset = SyntheticDataset(settings)
    rendered = [dataset.render(index) for index in range(FRAMES)]
    frames = [Frame(frame.timestamp_ns, frame.rgb, frame.depth_m) for frame in rendered]
    return Clip(dataset, frames), SceneDetector(dataset, rendered)


def settings(*overrides: str, preset: str = "occlusion-published") -> Config:
    config = load_config(preset, overrides=overrides)
    sizes = ("num_points", "num_levels", "num_keyframes", "num_hypotheses", "cell_px")
    return replace(config, track=replace(config.track, **{name: getattr(TRACK, name) for name in sizes}))


class _Run:
    """A recording tracked, and what came of it."""

    def __init__(self, config: Config, slam_map: Map | None = None, *, localize_only: bool = False) -> None:
        clip, detector = _scene()
        with Slam(clip.camera, config, slam_map=slam_map, localize_only=localize_only, detector=detector) as slam:
            self.results: list[FrameResult] = [slam.track(frame) for frame in clip.frames]
            slam.finish()
            self.map, self.trajectory = slam.map, slam.trajectory.T_world_cam
            assert problems(self.map) == []

    @property
    def shares(self) -> list[float | None]:
        return [result.occluded_share for result in self.results]

    @property
    def occluded(self) -> np.ndarray:
        return self.map.points.state == OCCLUDED


@functools.cache
def as_published() -> _Run:
    return _Run(settings())


class MappingError(Exception):
    """What goes wrong in these tests."""


@pytest.mark.slow
class TestRoomWithPeople:
    @pytest.mark.slow
    def test_points_that_people_passed(self) -> None:
        run = as_published()
        shares = [share for share in run.shares if share is not None]
        print(f"{run.occluded.sum()} of {len(run.occluded)} points; up to {max(shares):.0%} of a keyframe")
        assert run.occluded.sum() > 100
        assert len(shares) > FRAMES - 6
        assert all(0 <= share <= 1 for share in shares)
        assert max(shares) > 0.05
        assert occluded_shares(run.map).max() > 0.2

    @pytest.mark.slow
    def test_are_of_the_room(self) -> None:
        """They are where the empty room has a surface."""
        run, source = as_published(), _scene()[0].source
        empty = SyntheticDataset(replace(source.config, people=0))
        np.testing.assert_array_equal(empty.ground_truth.T_world_cam, source.ground_truth.T_world_cam)
        truth, X_world = source.ground_truth.T_world_cam, run.map.points.X_world[:, run.occluded]
        errors = np.full((3, X_world.shape[1]), np.nan)
        for row, index in enumerate((0, FRAMES // 2, FRAMES - 1)):
            X = to_local(between(truth[0], truth[index]), X_world)
            u, v = np.round(X[:2] / X[2] * [[empty.camera.fx], [empty.camera.fy]]).astype(int)
            u, v = u + round(empty.camera.cx), v + round(empty.camera.cy)
            inside = (X[2] > 0.3) & (u >= 0) & (v >= 0) & (u < 320) & (v < 240)
            depth = empty.render(index).depth_m[v[inside], u[inside]]
            errors[row, inside] = np.where(depth > 0, np.abs(depth - X[2, inside]) / X[2, inside], np.nan)
        known = np.isfinite(errors).any(axis=0)
        off = np.nanmin(errors[:, known], axis=0)
        print(f"{known.sum()} points, {np.mean(off < 0.05):.1%} within 5 % of the depth of the empty room")
        assert known.sum() > 100
        assert np.mean(off < 0.05) > 0.95

    @pytest.mark.slow
    def test_same_bytes_again(self, tmp_path: Path) -> None:
        first, again = as_published(), _Run(settings())
        assert again.shares == first.shares
        np.testing.assert_array_equal(again.trajectory, first.trajectory)
        for name, run in (("first", first), ("again", again)):
            save_map(tmp_path / name, run.map)
        assert (tmp_path / "first").read_bytes() == (tmp_path / "again").read_bytes()

    @pytest.mark.slow
    def test_states_alone_change_nothing(self) -> None:
        """With a weight of one, every pose and every point is to the bit that of a run without states."""
        off = _Run(settings(preset="occlusion-masks"))
        one = _Run(settings("dynamics.occlusion.weight=1.0"))
        assert set(off.shares) == {None}
        assert not off.map.points.state.any()
        assert one.occluded.sum() > 100
        np.testing.assert_array_equal(one.trajectory, off.trajectory)
        assert same(one.map.with_arrays(points=one.map.points._replace(state=off.map.points.state)), off.map)

    @pytest.mark.slow
    def test_off_computes_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def never(*_: object, **__: object) -> None:
            raise AssertionError("states were followed")

        monkeypatch.setattr(PointStates, "__init__", never)
        clip, detector = _scene()
        with Slam(clip.camera, settings(preset="occlusion-masks"), detector=detector) as slam:
            assert [slam.track(frame).occluded_share for frame in clip.frames[:8]] == [None] * 8
            slam.finish()

    @pytest.mark.slow
    def test_in_threads(self) -> None:
        run = _Run(settings("run.deterministic=false"))
        assert run.occluded.sum() > 100
        assert max(share for share in run.shares if share is not None) > 0.02

    @pytest.mark.slow
    def test_nothing_is_compiled_while_frames_come(self, compiled: list[str]) -> None:
        clip, detector = _scene()
        with Slam(clip.camera, settings(), detector=detector) as slam:
            slam.warm_up()
            compiled.clear()
            for frame in clip.frames:
                slam.track(frame)
            slam.finish()
            assert compiled == []

    def test_last_changes_are_in_the_map(self) -> None:
        """Those since the last keyframe; to finish again finds nothing new."""
        last = max(index for index, result in enumerate(as_published().results) if not result.is_keyframe)
        clip, detector = _scene()
        with Slam(clip.camera, settings(), detector=detector) as slam:
            for frame in clip.frames[: last + 1]:
                slam.track(frame)
            states = slam._back._states
            assert states is not None
            new = np.flatnonzero(states._change == states._number)
            expected = states._state[new]
            assert len(new) > 0
            slam.finish()
            first = slam.map
            np.testing.assert_array_equal(first.points.state[rows(first.points.ids, new)], expected)
            slam.finish()
            assert slam.map is first

    @pytest.mark.slow
    def test_nothing_is_lost_where_mapping_goes_wrong(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """What came with a keyframe is taken in though its points are not."""
        add, failed = LocalMapping.add, []

        def wrong(self: LocalMapping, new: NewKeyframe) -> Map:
            if new.states is not None and not failed and (new.states.states == OCCLUDED).sum() > 5:
                failed.append(new.states)
                raise MappingError
            return add(self, new)

        monkeypatch.setattr(LocalMapping, "add", wrong)
        clip, detector = _scene()
        with Slam(clip.camera, settings(), detector=detector) as slam:
            for frame in clip.frames:
                with contextlib.suppress(MappingError):
                    slam.track(frame)
                if slam._clock.last_ns != frame.timestamp_ns:
                    slam.track(frame)
            slam.finish()
            assert len(failed) == 1
            lost = with_changes(slam.map, failed[0])
            there = np.isin(failed[0].ids, slam.map.points.ids)
            assert there.sum() > 5
            index = rows(slam.map.points.ids, failed[0].ids[there])
            occluded = lost.points.state[index] == OCCLUDED
            assert (slam.map.points.state[index][occluded] == OCCLUDED).all()

    def test_in_a_map_that_stays_as_it_is(self) -> None:
        """States go on beside it, from those it has."""
        slam_map = as_published().map
        run = _Run(settings(), slam_map, localize_only=True)
        assert run.map is slam_map
        shares = [share for share in run.shares if share is not None]
        assert len(shares) > FRAMES // 2
        assert max(shares) > 0.2
        assert sum(result.status is TrackStatus.LOST for result in run.results) < FRAMES // 2

    @pytest.mark.slow
    def test_files_of_a_run(self, tmp_path: Path) -> None:
        clip, detector = _scene()
        clip = Clip(clip.source, clip.frames[:30])
        rows_of: dict[str, list[str]] = {}
        for preset in ("occlusion-published", "occlusion-masks"):
            with Slam(clip.camera, settings(preset=preset), detector=detector) as slam:
                records = slam.run(clip)
                summary, _ = write_results(tmp_path / preset, slam, records, RunInfo(clip, preset, 1.0))
                shares = occluded_shares(slam.map)
            table = csv.DictReader((tmp_path / preset / "frames.csv").read_text().splitlines())
            rows_of[preset] = [row["occluded_share"] for row in table]
            if preset == "occlusion-published":
                assert summary["occluded_share"]["mean"] == pytest.approx(shares.mean(), abs=1e-3)
                assert summary["occluded_share"]["mean"] > 0
            else:
                assert summary["occluded_share"] is None
        assert set(rows_of["occlusion-masks"]) == {""}
        assert max(float(share) for share in rows_of["occlusion-published"] if share) > 0


def test_changes_are_values() -> None:
    """What threads exchange shares no memory with what goes on."""
    slam_map = wall(POINTS)
    states = states_of(slam_map)
    look(states, slam_map, arrays(EVERYWHERE))
    changes = states.handed_over()
    assert isinstance(changes, StateChanges)
    assert not np.shares_memory(changes.states, states._state)
    after = with_changes(slam_map, changes)
    assert not np.shares_memory(after.points.state, slam_map.points.state)
    assert not slam_map.points.state.any()
