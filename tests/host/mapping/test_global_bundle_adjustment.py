"""Global bundle adjustment on maps of exact geometry, perturbed."""

import tracemalloc
from itertools import count
from typing import Any

import numpy as np
import pytest
from exact_map import exact_map
from scipy.optimize import least_squares
from test_local_bundle_adjustment import SPOILT, apart, disturbed

from jaxslam.geometry.se3 import between, displacement, inverse, retract, rotate, to_local
from jaxslam.map.edit import transformed, with_keyframe, with_loop, without_points
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_records import NONE, observations_at, rows
from jaxslam.map.types import Map
from jaxslam.map.validate import problems
from jaxslam.mapping import global_bundle_adjustment as module
from jaxslam.mapping.global_bundle_adjustment import AdjustedSubmap, adjust_submap, with_adjusted_submap
from jaxslam.mapping.keyframe_equations import KeyframeEquations
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan, measurements

PLAN = AdjustPlan()


def adjusted(slam_map: Map, plan: AdjustPlan = PLAN) -> AdjustedSubmap:
    found = adjust_submap(slam_map, 0, plan)
    assert found is not None
    return found


def noisy(slam_map: Map, seed: int = 3, outliers: float = 0.0) -> Map:
    """Observations with noise of their standard deviation, and some of them far off."""
    rng, seen = np.random.default_rng(seed), slam_map.observations
    wrong = rng.random(len(seen.point)) < outliers
    uv = seen.uv + 0.3 * rng.normal(size=seen.uv.shape) + np.where(wrong, rng.uniform(10, 60, seen.uv.shape), 0)
    depth = np.where(seen.depth > 0, seen.depth + 0.01 * rng.normal(size=len(seen.depth)), 0)
    return slam_map.with_arrays(observations=seen._replace(uv=uv.astype(np.float32), depth=depth.astype(np.float32)))


@pytest.fixture(scope="module")
def truth() -> Map:
    return exact_map()


def test_comes_back_to_the_truth(truth):
    before = disturbed(truth, truth.ids[1:], meters=0.02)
    after = with_adjusted_submap(before, adjusted(before))
    assert problems(after) == []
    np.testing.assert_array_equal(after.T_world_cam[0], truth.T_world_cam[0])
    assert apart(before, truth, truth.ids).max() > 0.03
    assert apart(after, truth, truth.ids).max() < 1e-5
    often = np.flatnonzero(np.bincount(truth.observations.point)[truth.points.ids] > 1)
    np.testing.assert_allclose(after.points.X_world[:, often], truth.points.X_world[:, often], atol=1e-4)


def test_optimum_is_that_of_scipy(monkeypatch):
    """A dense solver with numeric derivatives, of the same robust cost of noisy observations with outliers."""
    monkeypatch.setattr(module, "_TOLERANCE", 1e-12)
    monkeypatch.setattr(module, "_MAX_STEPS", 200)
    monkeypatch.setattr("jaxslam.mapping.keyframe_equations.STRONG", 0)  # no edges
    slam_map = disturbed(noisy(exact_map(num_keyframes=4, num_points=40), outliers=0.1), np.arange(1, 4))
    found = adjusted(slam_map)
    seen = slam_map.observations
    seen = observations_at(seen, np.flatnonzero(np.isin(seen.point, found.points)))
    measured = measurements(slam_map, seen, PLAN)
    camera, point = rows(found.keyframes, seen.keyframe), rows(found.points, seen.point)

    def residuals(values: np.ndarray) -> np.ndarray:
        """Vectors whose squared norm is the robust loss of each observation."""
        steps, X_world = np.concatenate([np.zeros(6), values[:18]]).reshape(4, 6), values[18:].reshape(3, -1)
        T_cam_world = inverse(retract(slam_map.T_world_cam, steps))[camera]
        X = (rotate(T_cam_world, X_world[:, point].T) + T_cam_world[:, 4:]).T
        r = np.concatenate([X[:2] / X[2] - measured.xy, (X[2] - measured.depth)[None]]) * measured.precision
        chi2, scale2 = np.square(r).sum(axis=0), PLAN.loss_scale**2
        return (r * np.sqrt(measured.weights * scale2 * np.log1p(chi2 / scale2) / np.maximum(chi2, 1e-30))).ravel()

    tangents = displacement(slam_map.T_world_cam, found.T_world_cam)
    ours = np.concatenate([tangents[1:].ravel(), found.X_world.ravel()])
    assert 0.5 * np.square(residuals(ours)).sum() == pytest.approx(found.cost, rel=1e-6)
    theirs = least_squares(residuals, ours, method="trf", xtol=1e-12, ftol=1e-12, gtol=1e-10, max_nfev=10)
    assert found.cost == pytest.approx(theirs.cost, rel=1e-6)
    np.testing.assert_allclose(ours[:18], theirs.x[:18], atol=1e-5)
    assert found.cost < 0.5 * found.initial_cost


def test_outliers_do_not_pull(truth):
    clean, spoilt = (disturbed(noisy(truth, outliers=share), truth.ids[1:]) for share in (0.0, 0.1))
    errors = [apart(with_adjusted_submap(each, adjusted(each)), truth, truth.ids).max() for each in (clean, spoilt)]
    assert errors[0] < 4e-3
    assert errors[1] < 1.5 * errors[0]


def test_a_chunk_more_or_less_makes_no_difference(truth, monkeypatch):
    """Also where the observations are in another order."""
    before = disturbed(noisy(truth), truth.ids[1:])
    whole = adjusted(before)
    order = np.random.default_rng(0).permutation(len(before.observations.point))
    again = adjusted(before.with_arrays(observations=observations_at(before.observations, order)))
    assert all(np.array_equal(one, other) for one, other in zip(whole, again, strict=True)), "not deterministic"
    monkeypatch.setattr(module, "_CHUNK", 512)
    parts = adjusted(before)
    assert parts.cost == pytest.approx(whole.cost, rel=1e-9)
    np.testing.assert_allclose(parts.T_world_cam, whole.T_world_cam, atol=1e-7)


def test_interrupted_between_any_two_chunks(truth):
    before = disturbed(truth, truth.ids[1:])
    calls = count()
    adjust_submap(before, 0, PLAN, lambda: next(calls) < 0)
    num = next(calls)
    assert num > 5
    for stop in (0, 1, num // 2, num - 1):
        calls = count()
        assert adjust_submap(before, 0, PLAN, lambda calls=calls, stop=stop: next(calls) >= stop) is None
        assert next(calls) == stop + 1, "went on after it was interrupted"


def test_memory_grows_with_the_observations_and_not_with_pairs_of_keyframes():
    """Equations of 2,000 keyframes along a corridor: as a dense matrix they would take 1.2 GB."""
    num = 2000
    tracemalloc.start()
    equations = KeyframeEquations(num)
    for start in range(0, num, 100):
        camera = (start + np.add.outer(np.arange(98), np.arange(3))).ravel()
        camera, m = np.minimum(camera, num - 1), 3 * 98
        arrays: Any = (
            np.ones((m, 6)),
            np.tile(8 * np.eye(6), (m, 1, 1)),
            np.tile(0.1 * np.eye(6)[:, :3], (m, 1, 1)),
            np.ones((3, 98)),
            np.ones((3, 3, 98)),
        )
        part = module.EliminatedChunk(*arrays)
        equations.add_chunk(part, camera, np.repeat(np.arange(98), 3))
    step = equations.solve(0, 1.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert not step[0].any()
    assert peak < 40e6


def test_keyframes_that_share_few_points_keep_their_relative_pose(truth):
    """The last one sees nothing that others see; the tree holds it, and a loop corrects it."""
    alone = (truth.observations.keyframe != 15) | ~np.isin(
        truth.observations.point, truth.observations.point[truth.observations.keyframe < 15]
    )
    slam_map = truth.with_arrays(observations=observations_at(truth.observations, alone))
    before = disturbed(slam_map, truth.ids[1:])
    after = with_adjusted_submap(before, adjusted(before))
    apart = between(between(before.pose(14), before.pose(15)), between(after.pose(14), after.pose(15)))
    np.testing.assert_allclose(apart[1:], 0, atol=1e-6)
    closed = with_loop(before, 0, 15, between(truth.pose(0), truth.pose(15)), 1e8 * np.eye(6))
    after = with_adjusted_submap(closed, adjusted(closed))
    assert np.linalg.norm(after.pose(15)[4:] - truth.pose(15)[4:]) < 1e-3


@pytest.fixture(scope="module")
def before(truth) -> Map:
    return disturbed(truth, truth.ids[1:])


@pytest.fixture(scope="module")
def found(before) -> AdjustedSubmap:
    return adjusted(before)


class TestMeanwhile:
    """The map goes on changing while a snapshot of it is adjusted."""

    def test_new_keyframes_and_points_move_along(self, before, found):
        new = before.keyframes[-1]._replace(id=16)
        now = with_keyframe(before, new, retract(before.pose(15), np.full(6, 0.1)), 15, 0)
        points = now.points._replace(reference_keyframe=np.where(now.points.ids == 0, 7, now.points.reference_keyframe))
        now = now.with_arrays(points=points)
        later = found._replace(points=found.points[found.points != 0], X_world=found.X_world[:, found.points != 0])
        after = with_adjusted_submap(now, later)
        assert problems(after) == problems(now) == []
        np.testing.assert_allclose(
            between(after.pose(15), after.pose(16)), between(now.pose(15), now.pose(16)), atol=1e-12
        )
        local = [to_local(each.pose(7), each.points.X_world[:, :1]) for each in (now, after)]
        np.testing.assert_allclose(local[1], local[0], atol=1e-12)

    def test_what_left_the_map_is_passed_over(self, before, found):
        now = without_points(without_keyframe(before, 9), before.points.ids[10:20])
        after = with_adjusted_submap(now, found)
        assert problems(after) == []
        stays = found.keyframes != 9
        np.testing.assert_allclose(after.T_world_cam, found.T_world_cam[stays], atol=1e-12)

    def test_a_submap_that_was_merged_stays_where_it_is_now(self, before, found):
        away = retract(np.array([1.0, 0, 0, 0, 0, 0, 0]), np.array([3.0, 1, 2, 0.1, 0.5, -0.2]))
        then = with_adjusted_submap(before, found)
        now = with_adjusted_submap(transformed(before, away, 0, 0), found)
        want = transformed(then, away, 0, 0)
        np.testing.assert_allclose(now.T_world_cam[:, 4:], want.T_world_cam[:, 4:], atol=1e-9)
        np.testing.assert_allclose(now.points.X_world, want.points.X_world, atol=1e-9)

    def test_a_map_without_any_of_it_stays_as_it_is(self, found):
        other = exact_map(num_keyframes=2, num_points=10)
        other = other._replace(ids=other.ids + 100)
        assert with_adjusted_submap(other, found) is other


def test_only_its_own_submap(truth):
    """The second half in a world of its own."""
    away = retract(np.array([1.0, 0, 0, 0, 0, 0, 0]), np.array([30.0, 0, 0, 0, 0, 0]))
    late = truth.ids >= 8
    of_late = np.isin(truth.points.ids, truth.observations.point[truth.observations.keyframe >= 12])
    apart_now = (truth.observations.keyframe >= 8) == of_late[rows(truth.points.ids, truth.observations.point)]
    parent = np.where(truth.ids == 8, NONE, truth.parent)
    two = truth.with_arrays(
        points=truth.points._replace(reference_keyframe=np.where(of_late, 8, 0)),
        observations=observations_at(truth.observations, apart_now),
    )._replace(submap=late.astype(np.int32), parent=parent)
    two = transformed(two, away, 1, 1)
    assert problems(two) == []
    before = disturbed(two, np.setdiff1d(two.ids, [0, 8]), meters=0.005)
    found = adjust_submap(before, 1, PLAN)
    assert found is not None
    assert found.anchor == 8
    after = with_adjusted_submap(before, found)
    np.testing.assert_array_equal(after.T_world_cam[:9], before.T_world_cam[:9])
    assert apart(after, two, two.ids[8:]).max() < 1e-4


@pytest.mark.parametrize("kind", SPOILT)
def test_degenerate_maps_stay_whole(kind):
    before = SPOILT[kind](exact_map(num_keyframes=6, num_points=200))
    found = adjust_submap(before, 0, PLAN)
    after = before if found is None else with_adjusted_submap(before, found)
    assert problems(after) == []
    assert np.abs(after.T_world_cam).max() < 1e3
    assert np.abs(after.points.X_world).max() < 1e4


def test_one_keyframe_or_none_has_nothing_to_adjust(truth):
    assert adjust_submap(exact_map(num_keyframes=1), 0, PLAN) is None
    assert adjust_submap(truth, 5, PLAN) is None
