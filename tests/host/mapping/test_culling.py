"""Which keyframes leave: isolated ones, and those of a map that takes too much memory."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from room_round import TRACK, room
from wall_map import BEHIND, POINTS, at, seen_from

from jaxslam.config.schema import Config, MappingConfig
from jaxslam.map.types import Map
from jaxslam.map.validate import problems
from jaxslam.mapping.culling import KEEP_LATEST, memory_bytes, within_memory, without_isolated
from jaxslam.slam.slam import Slam
from jaxslam.tracking.state import TrackStatus

MAX_MB = 3.0
OLD_HERE, OLD_ELSEWHERE = 4, 3
LATEST = OLD_HERE + OLD_ELSEWHERE + KEEP_LATEST - 1


def rooms() -> Map:
    """A wall that many keyframes show, the first of them long ago, and another one that three showed after them."""
    elsewhere = range(OLD_HERE, OLD_HERE + OLD_ELSEWHERE)
    submaps = [int(number in elsewhere) for number in range(LATEST + 1)]
    return seen_from([at(x=0.01 * number) for number in range(LATEST + 1)], [POINTS] * (LATEST + 1), submaps)


def test_a_map_that_fits_stays() -> None:
    slam_map = rooms()
    assert within_memory(slam_map, LATEST, memory_bytes(slam_map)) is slam_map


def test_the_oldest_that_others_show_leaves_first() -> None:
    slam_map = rooms()
    smaller = within_memory(slam_map, LATEST, memory_bytes(slam_map) - 1)
    assert smaller.culled.ids.tolist() == [0]
    assert memory_bytes(smaller) < memory_bytes(slam_map)
    assert not problems(smaller)


def test_the_farthest_leaves_then_and_the_latest_and_every_place_stay() -> None:
    slam_map = within_memory(rooms(), LATEST, 0)
    assert slam_map.culled.ids.tolist() == [0, 1, 2, 3]  # four at once
    slam_map = within_memory(slam_map, LATEST, 0)
    assert slam_map.culled.ids.tolist() == [0, 1, 2, 3, 4, 5]
    assert slam_map.ids.tolist() == list(range(6, LATEST + 1))
    assert within_memory(slam_map, LATEST, 0) is slam_map
    assert not problems(slam_map)


def test_of_views_that_nothing_else_shows_the_farther_leaves() -> None:
    poses = [at(x=0.4), at(x=0.0), at(x=0.2), *(at() for _ in range(KEEP_LATEST))]
    slam_map = seen_from(poses, [POINTS, POINTS, POINTS, *([1] * KEEP_LATEST)])
    slam_map = within_memory(slam_map, len(poses) - 1, memory_bytes(slam_map) - 1)
    assert slam_map.culled.ids.tolist() == [0]


def isolated(pose: np.ndarray, num_shown: int) -> Map:
    """A wall that all keyframes but the second show, which is no longer one of the latest."""
    return seen_from([at(), pose, *[at()] * KEEP_LATEST], [POINTS, num_shown, *[POINTS] * KEEP_LATEST])


@pytest.mark.parametrize("num_shown", [0, 14])
def test_a_keyframe_that_shares_few_points_leaves_where_others_show_its_view(num_shown: int) -> None:
    slam_map = isolated(at(x=0.05), num_shown)
    smaller = without_isolated(slam_map, 1 + KEEP_LATEST)
    assert smaller.culled.ids.tolist() == [1]
    assert not problems(smaller)


@pytest.mark.parametrize(
    ("pose", "num_shown", "latest", "what"),
    [
        (at(), 15, 1 + KEEP_LATEST, "it shares enough points"),
        (BEHIND, 0, 1 + KEEP_LATEST, "nothing else shows its view"),
        (at(), 0, KEEP_LATEST, "the root of the submap"),
        (at(), 0, KEEP_LATEST - 5, "a young one"),
    ],
)
def test_a_keyframe_stays(pose: np.ndarray, num_shown: int, latest: int, what: str) -> None:
    slam_map = isolated(pose, num_shown)
    assert without_isolated(slam_map, latest) is slam_map, what


def test_a_keyframe_leaves_once() -> None:
    slam_map = without_isolated(isolated(at(), 0), 1 + KEEP_LATEST)
    assert without_isolated(slam_map, 1 + KEEP_LATEST) is slam_map


@pytest.mark.slow
def test_a_tracker_whose_map_is_full_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    many = replace(TRACK, keyframe_below=1.0, keyframe_views=1000)
    counts, poses = [], []
    for max_mb in (None, MAX_MB):
        config = Config(track=many, mapping=MappingConfig(max_mb=max_mb))
        with caplog.at_level(logging.INFO), Slam(room().camera, config) as slam:
            results = [slam.track(frame) for frame in room().frames[:40]]
            slam.finish()
            slam_map = slam.map
        assert all(result.status != TrackStatus.LOST for result in results)
        assert not problems(slam_map)
        counts.append(len(slam_map.ids))
        poses.append(slam.trajectory.T_world_cam)
        if max_mb is not None:
            assert memory_bytes(slam_map) < 1e6 * max_mb
    assert counts[1] < counts[0]
    assert f"the map takes {MAX_MB:g} MB (mapping.max_mb)" in caplog.text
    assert len(poses[0]) == len(poses[1]) == 40  # those of frames whose keyframes have left as well
    assert np.abs(poses[0] - poses[1]).max() < 0.02
