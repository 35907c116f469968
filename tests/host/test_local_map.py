"""The pose of a frame from the points of the map around it."""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from room_round import TRACK, room

from jaxslam.config import Config
from jaxslam.features import Features, features_of
from jaxslam.frame import Frame
from jaxslam.frame_arrays import frame_arrays
from jaxslam.local_map import local_keyframes, match_local_map
from jaxslam.local_mapping import mapping_plan
from jaxslam.map import Map, empty_map
from jaxslam.pose import angle, between, compose, inverse, moved
from jaxslam.slam import Slam, track_params
from jaxslam.state import TrackReason, TrackStatus
from jaxslam.tracked import Tracked

CONFIG = Config(track=TRACK)
ALWAYS_WEAK = replace(CONFIG, track=replace(TRACK, weak_inliers=10_000))
PLAN = mapping_plan(CONFIG.mapping, TRACK).features
NUM_FRAMES, LATER = 60, 50


@functools.cache
def mapped() -> tuple[Map, tuple[Tracked, ...]]:
    """The map of the first frames, and where each was."""
    with Slam(room().camera, CONFIG) as slam:
        results = tuple(slam.track(frame) for frame in room().frames[:NUM_FRAMES])
        slam.finish()
        return slam.map, results


def features(index: int, image: np.ndarray | None = None) -> Features:
    frame = room()[index]
    frame = frame if image is None else replace(frame, image=image)
    return features_of(frame_arrays(frame, 1 / 15), np.zeros(6, np.float32), params(), PLAN)


def params() -> Any:
    return track_params(room().camera, TRACK)


def nearest_keyframe(map: Map, T_world_cam: np.ndarray) -> int:
    return int(map.ids[np.argmin(np.linalg.norm(map.T_world_cam[:, 4:] - T_world_cam[4:], axis=1))])


def match(map: Map, index: int, error: np.ndarray, seen: Features | None = None) -> tuple[Any, np.ndarray]:
    """What comes of a frame whose pose is wrong by `error`, and its pose in the axes of the same keyframe."""
    pose = mapped()[1][index].T_world_cam
    keyframe_id = nearest_keyframe(map, pose)
    true = between(map.pose(keyframe_id), pose)
    seen = features(index) if seen is None else seen
    return match_local_map(map, keyframe_id, moved(true, error), seen, params(), PLAN), true


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
        map = mapped()[0]
        points = map.points._replace(weight=np.zeros_like(map.points.weight))
        assert match(map._replace(points=points), LATER, np.zeros(6))[0] is None

    def test_local_keyframes_begin_with_the_one_asked_for(self) -> None:
        map = mapped()[0]
        near = local_keyframes(map, int(map.ids[-1]))
        assert near[0] == map.ids[-1]
        assert len(np.unique(near)) == len(near) > 1


class TestWeakFrames:
    def test_are_held_to_the_map(self) -> None:
        """Every frame counts as weak here: each is matched, and the poses are as good as those of flow."""
        with Slam(room().camera, ALWAYS_WEAK) as slam:
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
        slam = Slam(room().camera, CONFIG)
        for frame in room().frames[:40]:
            slam.track(frame)
        weak = slam._params._replace(weak_inliers=np.float32(1e6))
        monkeypatch.setattr(slam, "_params", weak)
        result = slam.track(room()[40])
        assert result.num_matched >= CONFIG.track.weak_inliers
        assert (result.status, result.reason) == (TrackStatus.OK, TrackReason.NONE.text)

    def test_of_a_wrong_pose_are_put_right(self) -> None:
        """Flow goes on from a state that is 4 cm off."""
        slam = Slam(room().camera, ALWAYS_WEAK)
        for frame in room().frames[:LATER]:
            slam.track(frame)
        pose = slam._last_pose
        wrong = compose(pose, np.array([1.0, 0, 0, 0, 0.04, 0, 0]))
        state = slam._back._link.moved(slam._state, compose(wrong, inverse(pose)), is_keyframe=False)
        slam._state = state._replace(keyframes=state.keyframes._replace(weight=0 * state.keyframes.weight))
        result = slam.track(room()[LATER])
        assert result.num_matched > 0
        off = np.linalg.norm(between(mapped()[1][LATER].T_world_cam, result.T_world_cam)[4:])
        print(f"{off * 1e3:.1f} mm off")
        assert off < 0.015


class TestLostFrames:
    def test_are_sought_in_the_local_map_first(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """No place is recognised here; the map around where the camera may be shows it."""
        monkeypatch.setattr("jaxslam.back_end.recognise", lambda *_, **__: None)
        with Slam(room().camera, CONFIG) as slam:
            for frame in room().frames[:40]:
                slam.track(frame)
            last, arrays = slam._last_pose, frame_arrays(room()[40], 1 / 15)
            placed, _ = slam._back.regain(arrays, last)
            assert placed is not None
            assert np.linalg.norm((slam._back.pose(placed.hung) - mapped()[1][40].T_world_cam)[4:]) < 0.015
            assert slam._back.regain(arrays, None) == (None, True)

    def test_go_on_from_there(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A camera turned too fast for flow, while no place is recognised."""
        monkeypatch.setattr("jaxslam.back_end.recognise", lambda *_, **__: None)
        with Slam(room().camera, CONFIG) as slam:
            for frame in room().frames[:LATER]:
                slam.track(frame)
            slam._state = slam._state._replace(
                points=slam._state.points._replace(valid=np.zeros(TRACK.num_points, bool))
            )
            result = slam.track(room()[LATER])
            assert result.status is TrackStatus.RELOCALISED
            assert result.num_matched >= 30
            off_m = np.linalg.norm((result.T_world_cam - mapped()[1][LATER].T_world_cam)[4:])
            print(f"{result.num_matched} points, {off_m * 1e3:.1f} mm off")
            assert off_m < 0.015
            assert slam.track(room()[LATER + 1]).status is TrackStatus.OK


def test_nothing_in_an_empty_map() -> None:
    """The first frames come before the map is there."""
    frame: Frame = room()[0]
    with Slam(room().camera, ALWAYS_WEAK, map=empty_map(room().camera)) as slam:
        assert slam.track(frame).num_matched == 0
