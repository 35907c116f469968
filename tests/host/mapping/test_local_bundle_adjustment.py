"""Local adjustment on maps of exact geometry, perturbed."""

from collections.abc import Callable

import numpy as np
import pytest
from compile_counts import num_compiled
from exact_map import exact_map
from small_map import same

from jaxslam.geometry.se3 import retract as shifted
from jaxslam.geometry.se3 import to_local
from jaxslam.map.edit import with_positions
from jaxslam.map.point_records import observations_at, rows
from jaxslam.map.types import Map
from jaxslam.map.validate import problems
from jaxslam.mapping import local_bundle_adjustment as module
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan, adjust_all, adjust_around, compile_adjustment

PLAN = AdjustPlan()


def disturbed(slam_map: Map, keyframes: np.ndarray, seed: int = 1, meters: float = 0.01) -> Map:
    """Keyframes and all points out of place."""
    rng = np.random.default_rng(seed)
    tangents = rng.normal(0, [meters] * 3 + [meters / 2] * 3, (len(keyframes), 6))
    poses = np.array(
        [shifted(slam_map.pose(int(number)), tangent) for number, tangent in zip(keyframes, tangents, strict=True)]
    )
    return with_positions(
        slam_map,
        keyframes,
        poses,
        slam_map.points.ids,
        slam_map.points.X_world + rng.normal(0, meters, slam_map.points.X_world.shape),
    )


def apart(first: Map, second: Map, keyframes: np.ndarray) -> np.ndarray:
    at = rows(first.ids, keyframes)
    return np.linalg.norm(first.T_world_cam[at, 4:] - second.T_world_cam[at, 4:], axis=1)


@pytest.fixture(scope="module")
def truth() -> Map:
    return exact_map()


def test_window_comes_back_to_where_it_was_seen(truth):
    free = np.arange(8, 16)
    before = disturbed(truth, free)
    after = adjust_around(before, 15, PLAN)
    assert problems(after) == []
    assert apart(before, truth, free).max() > 0.01
    assert apart(after, truth, free).max() < 1e-4
    ids, views = np.unique(truth.observations.point[truth.observations.keyframe >= 8], return_counts=True)
    at = rows(after.points.ids, ids[views > 1])
    assert np.abs(after.points.X_world[:, at] - truth.points.X_world[:, at]).max() < 1e-3
    assert len(after.observations.point) == len(truth.observations.point), "a good observation was dropped"


def test_points_that_only_one_keyframe_sees_move_along_with_it(truth):
    alone = ~np.isin(truth.observations.point, truth.points.ids[::7]) | (truth.observations.keyframe == 15)
    slam_map = truth.with_arrays(observations=observations_at(truth.observations, alone))
    lone = np.intersect1d(slam_map.points.ids[::7], slam_map.observations.point)
    assert len(lone) > 20
    before = disturbed(slam_map, np.arange(8, 16))
    after = adjust_around(before, 15, PLAN)
    places = [to_local(m.pose(15), m.points.X_world[:, rows(m.points.ids, lone)]) for m in (before, after)]
    np.testing.assert_allclose(places[1], places[0], atol=1e-9)
    assert apart(after, truth, np.arange(8, 16)).max() < 1e-4


def test_far_from_the_origin_of_the_world(truth):
    """In float32, a millimeter is not told apart at ten kilometers; windows are solved around their keyframe."""
    far = np.array([1e4, -1e4, 5e3])
    moved_away = with_positions(
        truth,
        truth.ids,
        truth.T_world_cam + np.concatenate([np.zeros(4), far]),
        truth.points.ids,
        truth.points.X_world + far[:, None],
    )
    after = adjust_around(disturbed(moved_away, np.arange(8, 16)), 15, PLAN)
    assert apart(after, moved_away, np.arange(8, 16)).max() < 1e-4


def test_what_is_outside_the_window_stays(truth):
    before = disturbed(truth, np.arange(16), meters=0.003)
    after = adjust_around(before, 15, PLAN)
    np.testing.assert_array_equal(after.T_world_cam[:8], before.T_world_cam[:8])
    outside = ~np.isin(before.points.ids, before.observations.point[before.observations.keyframe >= 8])
    assert outside.any()
    np.testing.assert_array_equal(after.points.X_world[:, outside], before.points.X_world[:, outside])
    assert not np.array_equal(after.T_world_cam[8:], before.T_world_cam[8:])


def test_only_what_may_move_moves(truth):
    before = disturbed(truth, np.arange(16), meters=0.003)
    movable = np.array([3, 13, 15])
    after = adjust_around(before, 15, PLAN, movable)
    changed = before.ids[(after.T_world_cam != before.T_world_cam).any(axis=1)]
    assert changed.tolist() == [13, 15]  # 3 shares nothing with 15


def test_observations_that_do_not_fit_are_dropped(truth):
    rng = np.random.default_rng(2)
    seen = truth.observations
    wrong = (rng.random(len(seen.point)) < 0.08) & (seen.keyframe >= 8)
    uv = seen.uv + np.where(wrong, rng.choice([-1, 1], seen.uv.shape) * rng.uniform(15, 60, seen.uv.shape), 0)
    before = disturbed(truth.with_arrays(observations=seen._replace(uv=uv.astype(np.float32))), np.arange(8, 16))
    after = adjust_around(before, 15, PLAN)
    assert apart(after, truth, np.arange(8, 16)).max() < 1e-3
    kept = {
        (k, p) for k, p in zip(after.observations.keyframe.tolist(), after.observations.point.tolist(), strict=True)
    }
    was = list(zip(seen.keyframe.tolist(), seen.point.tolist(), strict=True))
    dropped = np.array([pair not in kept for pair in was])
    in_window = np.isin(seen.point, seen.point[seen.keyframe == 15])
    assert np.mean(dropped[wrong & in_window]) > 0.98
    assert np.mean(dropped[~wrong]) < 0.02


def test_points_count_by_their_weight(truth):
    """A third of the points have moved together since, and are known to be worth nothing."""
    seen, gone = truth.observations, truth.points.ids % 3 == 0
    shift = np.where(gone[rows(truth.points.ids, seen.point)] & (seen.keyframe == 15), np.float32(6), 0)
    uv = seen.uv + np.stack([shift, 0 * shift]).astype(np.float32)
    weight = np.where(gone, np.float32(0), 1).astype(np.float32)
    weighted = truth.with_arrays(observations=seen._replace(uv=uv), points=truth.points._replace(weight=weight))
    after = adjust_around(disturbed(weighted, np.arange(8, 16)), 15, PLAN)
    assert apart(after, truth, np.arange(8, 16)).max() < 1e-4


def test_the_first_keyframe_holds_a_submap_that_fits_into_the_window():
    truth = exact_map(num_keyframes=4)
    after = adjust_around(disturbed(truth, np.arange(1, 4)), 3, PLAN)
    np.testing.assert_array_equal(after.T_world_cam[0], truth.T_world_cam[0])
    assert apart(after, truth, np.arange(4)).max() < 2e-3


def test_more_points_than_a_window_has_room_for():
    truth = exact_map(num_keyframes=14, num_points=6000, reach=1.5)
    before = disturbed(truth, np.arange(8, 14))
    after = adjust_around(before, 13, PLAN)
    assert apart(after, truth, np.arange(8, 14)).max() < 5e-4
    assert problems(after) == []


def test_adjust_all_spreads_what_is_known(truth):
    before = disturbed(truth, np.arange(1, 16), meters=0.002)  # more, and keyframes lose what they have in common
    after = adjust_all(before, PLAN, truth.ids)
    assert problems(after) == []
    np.testing.assert_array_equal(after.T_world_cam[0], before.T_world_cam[0])
    assert apart(after, truth, truth.ids).max() < 0.35 * apart(before, truth, truth.ids).max()  # 0.34 measured


def _in_common(slam_map: Map) -> Map:
    alone = np.isin(slam_map.observations.keyframe, [3]) == np.isin(
        slam_map.observations.point, slam_map.observations.point[::2]
    )
    return slam_map.with_arrays(observations=observations_at(slam_map.observations, alone))


def _points_at(slam_map: Map, X_world: np.ndarray) -> Map:
    return with_positions(slam_map, slam_map.ids[:0], np.zeros((0, 7)), slam_map.points.ids, X_world)


def _observations(slam_map: Map, **columns: np.ndarray) -> Map:
    return slam_map.with_arrays(observations=slam_map.observations._replace(**columns))


SPOILT: dict[str, Callable[[Map], Map]] = {
    "nothing in common": _in_common,
    "no observations": lambda slam_map: slam_map.with_arrays(
        observations=observations_at(slam_map.observations, np.arange(0))
    ),
    "behind the camera": lambda slam_map: _points_at(slam_map, slam_map.points.X_world * [[1], [1], [-1]]),
    "at the camera": lambda slam_map: _points_at(slam_map, 0 * slam_map.points.X_world),
    "all outliers": lambda slam_map: _observations(slam_map, uv=np.float32(480) - slam_map.observations.uv[::-1]),
    "no weight": lambda slam_map: _observations(slam_map, weight=0 * slam_map.observations.weight),
    "all in one place": lambda slam_map: with_positions(
        slam_map,
        slam_map.ids,
        np.tile(slam_map.T_world_cam[:1], (len(slam_map.ids), 1)),
        slam_map.ids[:0],
        np.zeros((3, 0)),
    ),
}
"""Maps on which a window of keyframe 3 cannot be solved well, or not at all."""


@pytest.mark.parametrize("kind", SPOILT)
def test_degenerate_windows_leave_a_whole_map(kind):
    before = SPOILT[kind](exact_map(num_keyframes=6, num_points=200))
    after = adjust_around(before, 3, PLAN)
    assert problems(after) == []
    assert np.abs(after.T_world_cam).max() < 1e3
    assert np.abs(after.points.X_world).max() < 1e4


def test_one_keyframe_has_nothing_to_adjust():
    slam_map = exact_map(num_keyframes=1)
    assert same(adjust_around(slam_map, 0, PLAN), slam_map)


def test_compiles_every_size_beforehand(truth, monkeypatch):
    compile_adjustment(PLAN)
    sizes = num_compiled(module._adjust)
    for slam_map in (truth, exact_map(num_keyframes=4, num_points=100), exact_map(14, 6000, reach=1.5)):
        adjust_around(slam_map, int(slam_map.ids[-1]), PLAN)
    assert num_compiled(module._adjust) == sizes
