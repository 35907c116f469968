"""The pose of a frame from the points of the map around it, and which keyframes show what is in view."""

import functools
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from room_round import CAMERA, TRACK, room
from wall_map import BEHIND, POINTS, at, seen_from

from jaxslam.config.schema import Config
from jaxslam.features.orb import Features, features_of
from jaxslam.features.pose_from_matches import PLACE_GATES
from jaxslam.geometry.se3 import IDENTITY, angle, between, compose, inverse, retract
from jaxslam.map.point_records import observations_at
from jaxslam.map.types import Map, empty_map
from jaxslam.mapping import local_map_tracking
from jaxslam.mapping.local_map_tracking import (
    RADII_PX,
    WIDE_RADII_PX,
    keyframes_in_view,
    local_keyframes,
    match_local_map,
)
from jaxslam.mapping.local_mapping import mapping_plan
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import frame_arrays
from jaxslam.sensors.sensor_model import sensor_model
from jaxslam.slam import localization_stage
from jaxslam.slam.frame_result import FrameResult
from jaxslam.slam.slam import Slam
from jaxslam.slam.tracker import KeyframeDemand
from jaxslam.tracking.state import TrackReason, TrackStatus

CONFIG = Config(track=TRACK)
ALWAYS_WEAK = replace(CONFIG, track=replace(TRACK, weak_inliers=10_000))
PLAN = mapping_plan(CAMERA, CONFIG).features
NUM_FRAMES, LATER = 60, 50


@functools.cache
def mapped() -> tuple[Map, tuple[FrameResult, ...]]:
    """The map of the first frames, and where each was."""
    with Slam(CAMERA, CONFIG) as slam:
        results = tuple(slam.track(frame) for frame in room().frames[:NUM_FRAMES])
        slam.finish()
        return slam.map, results


def features(index: int, image: np.ndarray | None = None) -> Features:
    frame = room()[index]
    frame = frame if image is None else replace(frame, image=image)
    return features_of(frame_arrays(frame, 1 / 15), np.zeros(6, np.float32), sensor(), PLAN)


def sensor() -> Any:
    return sensor_model(CAMERA, TRACK)


def nearest_keyframe(slam_map: Map, T_world_cam: np.ndarray) -> int:
    return int(slam_map.ids[np.argmin(np.linalg.norm(slam_map.T_world_cam[:, 4:] - T_world_cam[4:], axis=1))])


def match(
    slam_map: Map, index: int, error: np.ndarray, seen: Features | None = None, radii_px: tuple[float, ...] = RADII_PX
) -> tuple[Any, np.ndarray]:
    """What comes of a frame whose pose is wrong by `error`, and its pose in the axes of the same keyframe."""
    pose = mapped()[1][index].T_world_cam
    keyframe_id = nearest_keyframe(slam_map, pose)
    true = between(slam_map.pose(keyframe_id), pose)
    seen = features(index) if seen is None else seen
    about = retract(true, error)
    return match_local_map(slam_map, keyframe_id, about, seen, sensor(), PLAN, radii_px=radii_px), true


class TestKeyframesInView:
    def test_those_that_show_the_points_in_view_from_alike_directions(self) -> None:
        """Not from the other side, nor from so far or near that the pictures differ."""
        poses = [at(), at(x=0.3), BEHIND, at(z=-2.5), at(z=1.2), at(x=4.0, turn=-1.1), at(z=-1.5)]
        made = seen_from(poses, [POINTS] * len(poses))
        assert sorted(keyframes_in_view(made, at(), 0, set(), 9)) == [0, 1, 6]
        assert keyframes_in_view(made, BEHIND, 0, set(), 9) == [2]

    def test_most_points_first(self) -> None:
        made = seen_from([at(), at(x=0.1), at(x=0.2), at(x=0.3)], [70, 100, 50, 100])
        assert keyframes_in_view(made, at(), 0, set(), 9) == [1, 3, 0]  # fifty are too few
        assert keyframes_in_view(made, at(), 0, set(), 2) == [1, 3]
        assert keyframes_in_view(made, at(), 0, {1}, 2) == [3, 0]
        assert keyframes_in_view(made, at(), 0, {0, 1, 3}, 2) == []

    def test_only_what_is_in_view(self) -> None:
        made = seen_from([at()], [POINTS])
        assert keyframes_in_view(made, at(x=3.0), 0, set(), 9) == []
        assert keyframes_in_view(made, at(turn=np.pi), 0, set(), 9) == []

    def test_of_the_submap(self) -> None:
        """Another one has its own world: what is at the same place there is somewhere else."""
        made = seen_from([at(), at(x=0.1), at()], [POINTS] * 3, [0, 0, 1])
        assert keyframes_in_view(made, at(), 0, set(), 9) == [0, 1]
        assert keyframes_in_view(made, at(), 1, set(), 9) == [2]
        assert keyframes_in_view(made, at(), 2, set(), 9) == []

    def test_of_an_empty_map(self) -> None:
        assert keyframes_in_view(empty_map(CAMERA), IDENTITY, 0, set(), 4) == []

    def test_the_nearest_are_looked_at(self):
        """However many there are: the cost does not grow with the map."""
        made = seen_from([at(x=0.001 * number) for number in range(80)], [POINTS] * 80)
        assert sorted(keyframes_in_view(made, at(), 0, set(), 99)) == list(range(64))


class TestMatchLocalMap:
    @pytest.mark.parametrize(
        "error",
        [[0, 0, 0, 0, 0, 0], [0.05, -0.03, 0.04, 0, 0, 0], [0, 0, 0, 0.02, -0.03, 0.04]],
        ids=["none", "shifted", "turned"],
    )
    def test_pose_is_found_again(self, error: list[float]) -> None:
        """Whatever the pose was taken to be, within the radius that is searched."""
        found, true = match(mapped()[0], LATER, np.array(error))
        assert found is not None
        apart = between(true, found.T_origin_cam)
        print(f"{len(found.agree)} points agree; {np.linalg.norm(apart[4:]) * 1e3:.1f} mm, {angle(apart):.4f} rad")
        assert np.linalg.norm(apart[4:]) < 0.015
        assert angle(apart) < 0.006
        assert 0 < np.linalg.eigvalsh(found.covariance).max() < 0.03**2

    def test_too_far_off(self) -> None:
        assert match(mapped()[0], LATER, np.array([0, 0, 0, 0, 0.5, 0]))[0] is None

    def test_another_place(self) -> None:
        assert match(mapped()[0], LATER, np.zeros(6), features(140))[0] is None

    @pytest.mark.parametrize("what", ["black", "noise"])
    def test_nothing_to_see(self, what: str) -> None:
        shape = room()[0].image.shape
        noise = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
        image = np.zeros(shape, np.uint8) if what == "black" else noise
        assert match(mapped()[0], LATER, np.zeros(6), features(LATER, image))[0] is None

    def test_points_that_count_for_nothing(self) -> None:
        """As those of a thing that moves: they are no part of what the frame is held to."""
        slam_map = mapped()[0]
        points = slam_map.points._replace(weight=np.zeros_like(slam_map.points.weight))
        assert match(slam_map.with_arrays(points=points), LATER, np.zeros(6))[0] is None

    def test_local_keyframes_begin_with_the_one_asked_for(self) -> None:
        slam_map = mapped()[0]
        near = local_keyframes(slam_map, int(slam_map.ids[-1]))
        assert near[0] == slam_map.ids[-1]
        assert len(np.unique(near)) == len(near) > 1


class TestPointsInView:
    """Of keyframes that share nothing with the one the frame hangs on."""

    @staticmethod
    def alone() -> Map:
        """The map, but the keyframe near `LATER` has no point."""
        slam_map = mapped()[0]
        lonely = nearest_keyframe(slam_map, mapped()[1][LATER].T_world_cam)
        others = np.flatnonzero(slam_map.observations.keyframe != lonely)
        slam_map = slam_map.with_arrays(observations=observations_at(slam_map.observations, others))
        assert local_keyframes(slam_map, lonely).tolist() == [lonely]
        return slam_map

    def test_are_used(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found, true = match(self.alone(), LATER, np.array([0.03, -0.02, 0.02, 0, 0, 0]))
        assert found is not None
        off_m = np.linalg.norm(between(true, found.T_origin_cam)[4:])
        print(f"{len(found.agree)} points, {off_m * 1e3:.1f} mm off")
        assert off_m < 0.015
        monkeypatch.setattr("jaxslam.mapping.local_map_tracking._IN_VIEW", 0)
        assert match(self.alone(), LATER, np.zeros(6))[0] is None

    def test_not_those_of_another_submap(self) -> None:
        slam_map = self.alone()
        lonely = nearest_keyframe(slam_map, mapped()[1][LATER].T_world_cam)
        apart = slam_map._replace(submap=np.where(slam_map.ids == lonely, slam_map.submap, slam_map.submap + 1))
        assert match(apart, LATER, np.zeros(6))[0] is None

    def test_more_than_without(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Also where the keyframe shares something with some of them."""
        with_them = match(mapped()[0], LATER, np.zeros(6))[0]
        monkeypatch.setattr("jaxslam.mapping.local_map_tracking._IN_VIEW", 0)
        monkeypatch.setattr("jaxslam.mapping.local_map_tracking.LOCAL_KEYFRAMES", 0)
        without = match(mapped()[0], LATER, np.zeros(6))[0]
        assert with_them is not None
        assert without is not None
        assert len(with_them.agree) > len(without.agree)


class TestNotFarFromWhereItWasThoughtToBe:
    """What is found further away is another place that looks alike."""

    @pytest.mark.parametrize("off_m", [0.12, 0.2])
    def test_meters(self, off_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
        ahead = np.array([0, 0, off_m, 0, 0, 0])
        assert (match(mapped()[0], LATER, ahead)[0] is not None) == (off_m < 0.15)
        monkeypatch.setattr("jaxslam.mapping.local_map_tracking._NEAR_REACH", 1.0)
        assert match(mapped()[0], LATER, ahead)[0] is not None

    @pytest.mark.parametrize("off_rad", [0.12, 0.2])
    def test_radians(self, off_rad: float, monkeypatch: pytest.MonkeyPatch) -> None:
        rolled = np.array([0, 0, 0, 0, 0, off_rad])
        wide = partial(match, mapped()[0], LATER, rolled, radii_px=WIDE_RADII_PX)
        assert (wide()[0] is not None) == (off_rad < 0.15)
        monkeypatch.setattr("jaxslam.mapping.local_map_tracking._NEAR_RAD", 1.0)
        assert wide()[0] is not None


class TestFewFeatures:
    @staticmethod
    def within(width: int, height: int, at_most: int, index: int = LATER) -> Features:
        """Those in the middle of the picture."""
        seen = features(index)
        u, v = seen.uv
        middle = (abs(u - CAMERA.cx) < width / 2) & (abs(v - CAMERA.cy) < height / 2)
        kept = np.flatnonzero(middle)[:at_most]
        fields = {name: field[..., kept] for name, field in seen._asdict().items() if name != "descriptor"}
        return Features(**fields, descriptor=seen.descriptor[kept])

    def test_few_cells_are_enough(self) -> None:
        """A person leaves little of the picture; a place is not recognized by so little."""
        found, true = match(mapped()[0], LATER, np.zeros(6), self.within(78, 60, 1000))
        assert found is not None
        off_m = np.linalg.norm(between(true, found.T_origin_cam)[4:])
        print(f"{len(found.agree)} points, {off_m * 1e3:.1f} mm off")
        assert off_m < 0.03

    def test_the_approximate_pose_tells_what_few_points_leave_open(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def off_and_sigma_m() -> np.ndarray:
            """Root mean squares over some frames."""
            each = []
            for index in range(LATER - 13, LATER - 6):
                found, true = match(mapped()[0], index, np.zeros(6), self.within(50, 30, 1000, index))
                assert found is not None
                off_m = np.linalg.norm(between(true, found.T_origin_cam)[4:])
                each.append([off_m, np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])])
            return np.sqrt(np.mean(np.square(each), axis=0))

        off_m, sigma_m = off_and_sigma_m()
        monkeypatch.setattr("jaxslam.mapping.local_map_tracking._with_prior", lambda found, *_: found)
        alone_m, alone_sigma_m = off_and_sigma_m()
        print("off and sigma in mm, then alone:", 1e3 * np.array([off_m, sigma_m, alone_m, alone_sigma_m]))
        assert off_m < 0.5 * alone_m
        assert sigma_m < 0.5 * alone_sigma_m
        assert off_m < sigma_m

    def test_fewer_are_not_enough_to_recognize_a_place(self, monkeypatch: pytest.MonkeyPatch) -> None:
        gates = local_map_tracking._GATES._replace(min_cells=PLACE_GATES.min_cells)
        monkeypatch.setattr(local_map_tracking, "_GATES", gates)
        assert match(mapped()[0], LATER, np.zeros(6), self.within(78, 60, 1000))[0] is None

    @pytest.mark.parametrize(("width", "height", "at_most"), [(24, 16, 1000), (320, 240, 14)])
    def test_too_few(self, width: int, height: int, at_most: int) -> None:
        assert match(mapped()[0], LATER, np.zeros(6), self.within(width, height, at_most))[0] is None


class TestWeakFrames:
    def test_are_held_to_the_map(self) -> None:
        """Every frame counts as weak here: each is matched, and the poses are as good as those of flow."""
        with Slam(CAMERA, ALWAYS_WEAK) as slam:
            results = [slam.track(frame) for frame in room().frames[:NUM_FRAMES]]
        weak = [result for result in results if result.status is TrackStatus.WEAK]
        matched = [result for result in weak if result.num_matched]
        assert len(weak) == NUM_FRAMES - 1
        assert len(matched) > 0.9 * len(weak)
        apart = [between(a.T_world_cam, b.T_world_cam) for a, b in zip(results, mapped()[1], strict=True)]
        print(f"{len(matched)} of {len(weak)} matched, by {np.median([r.num_matched for r in matched]):.0f} points")
        assert np.linalg.norm(np.array(apart)[:, 4:], axis=1).max() < 0.02

    def test_are_fine_with_enough_points(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The tracker calls it weak; the map knows better."""
        slam = Slam(CAMERA, CONFIG)
        for frame in room().frames[:40]:
            slam.track(frame)
        weak = slam._tracker.params._replace(weak_inliers=np.float32(1e6))
        monkeypatch.setitem(slam._tracker._params_for, KeyframeDemand.NORMAL, weak)
        result = slam.track(room()[40])
        assert result.num_matched >= CONFIG.track.weak_inliers
        assert (result.status, result.reason) == (TrackStatus.OK, TrackReason.NONE.text)

    @pytest.mark.slow
    def test_of_a_wrong_pose_are_put_right(self) -> None:
        """Flow goes on from a state that is 4 cm off."""
        slam = Slam(CAMERA, ALWAYS_WEAK)
        for frame in room().frames[:LATER]:
            slam.track(frame)
        pose = slam._localization.predicted()
        wrong = compose(pose, np.array([1.0, 0, 0, 0, 0.04, 0, 0]))
        state = slam._back._link.apply_correction(slam._tracker.state, compose(wrong, inverse(pose)), is_keyframe=False)
        slam._tracker.state = state._replace(keyframes=state.keyframes._replace(weight=0 * state.keyframes.weight))
        result = slam.track(room()[LATER])
        assert result.num_matched > 0
        off = np.linalg.norm(between(mapped()[1][LATER].T_world_cam, result.T_world_cam)[4:])
        print(f"{off * 1e3:.1f} mm off")
        assert off < 0.015


class TestFramesThatDisagreeWithTheMap:
    @pytest.mark.parametrize("min_views", [localization_stage._MIN_VIEWS, 1000])
    def test_are_matched_with_it(self, min_views: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """Flow goes on from a state that is 10 cm off, and finds enough points for a frame that is `OK`."""
        monkeypatch.setattr(localization_stage, "_MIN_VIEWS", min_views)
        with Slam(CAMERA, CONFIG) as slam:
            for frame in room().frames[:LATER]:
                slam.track(frame)
            pose = slam._localization.predicted()
            off = compose(compose(pose, np.array([1.0, 0, 0, 0, 0.1, 0, 0])), inverse(pose))
            slam._tracker.state = slam._back._link.apply_correction(slam._tracker.state, off, is_keyframe=False)
            result = slam.track(room()[LATER])
        off_m = np.linalg.norm(between(mapped()[1][LATER].T_world_cam, result.T_world_cam)[4:])
        print(f"{result.num_keyframe_matches} of {result.num_inliers} matched, {1e3 * off_m:.1f} mm off")
        assert result.status is TrackStatus.OK
        assert (result.num_matched > 0) == (off_m < 0.02) == (min_views < 1000)

    @pytest.mark.slow
    def test_none_does_if_no_keyframe_is_looked_into(self) -> None:
        with Slam(CAMERA, replace(CONFIG, track=replace(TRACK, num_sources=0))) as slam:
            results = [slam.track(frame) for frame in room().frames[:NUM_FRAMES]]
        assert {result.status for result in results[1:]} == {TrackStatus.OK}
        assert not any(result.num_keyframe_matches or result.num_matched for result in results)


class TestLostFrames:
    def test_are_sought_in_the_local_map_first(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """No place is recognized here; the map around where the camera may be shows it."""
        monkeypatch.setattr("jaxslam.slam.frame_localizer.recognize", lambda *_, **__: None)
        with Slam(CAMERA, CONFIG) as slam:
            for frame in room().frames[:40]:
                slam.track(frame)
            last, arrays = slam._localization.predicted(), frame_arrays(room()[40], 1 / 15)
            placed, _ = slam._back.localizer.relocalize(arrays, last)
            assert placed is not None
            assert np.linalg.norm((slam._back.pose(placed.anchored) - mapped()[1][40].T_world_cam)[4:]) < 0.015
            assert slam._back.localizer.relocalize(arrays, None) == (None, True)

    @pytest.mark.slow
    def test_go_on_from_there(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A camera turned too fast for flow, while no place is recognized."""
        monkeypatch.setattr("jaxslam.slam.frame_localizer.recognize", lambda *_, **__: None)
        with Slam(CAMERA, CONFIG) as slam:
            for frame in room().frames[:LATER]:
                slam.track(frame)
            slam._tracker.state = slam._tracker.state._replace(
                points=slam._tracker.state.points._replace(valid=np.zeros(TRACK.num_points, bool))
            )
            result = slam.track(room()[LATER])
            assert result.status is TrackStatus.RELOCALIZED
            assert result.num_matched >= 30
            off_m = np.linalg.norm((result.T_world_cam - mapped()[1][LATER].T_world_cam)[4:])
            print(f"{result.num_matched} points, {off_m * 1e3:.1f} mm off")
            assert off_m < 0.015
            assert slam.track(room()[LATER + 1]).status is TrackStatus.OK


def test_nothing_in_an_empty_map() -> None:
    """The first frames come before the map is there."""
    frame: Frame = room()[0]
    with Slam(CAMERA, ALWAYS_WEAK, slam_map=empty_map(CAMERA)) as slam:
        assert slam.track(frame).num_matched == 0
