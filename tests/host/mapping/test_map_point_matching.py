"""Points of the map found in a keyframe, and points that are in the map twice."""

import numpy as np
import pytest
from exact_map import CAMERA

from jaxslam.features.orb import DEFAULT_PLAN, Features, no_features
from jaxslam.geometry.se3 import IDENTITY, retract, to_local
from jaxslam.map.edit import with_keyframe, with_observations, with_points, without_observations
from jaxslam.map.point_records import NONE, MapPoints, rows
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.map.validate import problems
from jaxslam.mapping.map_point_matching import (
    DescribedPoints,
    described_points_in,
    feature_observations,
    features_at,
    find_points,
    fuse_duplicates,
)

COUNT = 200
POSES = [retract(IDENTITY, np.r_[0.1 * k, 0, 0.02 * k, 0, 0.01 * k, 0]) for k in range(3)]


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    return np.random.default_rng(0).uniform([[-0.9], [-0.7], [2.2]], [[1.0], [0.7], [3.2]], (3, COUNT))


@pytest.fixture(scope="module")
def descriptors() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (COUNT, 32)).astype(np.uint8)


def seen(places: np.ndarray, descriptors: np.ndarray, T_world_cam: np.ndarray) -> Features:
    """The places as features in order, exactly where a camera sees them."""
    X = to_local(T_world_cam, places)
    uv = X[:2] / X[2] * [[CAMERA.fx], [CAMERA.fy]] + [[CAMERA.cx], [CAMERA.cy]]
    ones = np.ones(len(descriptors), np.float32)
    uv, depth = uv.astype(np.float32), X[2].astype(np.float32)
    return Features(uv, uv, depth, (2 * ones).astype(np.uint8), 0 * ones, descriptors)


def made(slam_map: Map, keyframe_id: int, places: np.ndarray, index: np.ndarray) -> Map:
    """Features of a keyframe as points."""
    features = slam_map.keyframe(keyframe_id).features
    points = MapPoints(
        ids=slam_map.next_point + np.arange(len(index)),
        X_world=places[:, index],
        weight=np.ones(len(index), np.float32),
        descriptor=features.descriptor[index],
        has_descriptor=np.ones(len(index), bool),
        reference_keyframe=np.full(len(index), keyframe_id, np.int64),
        state=np.zeros(len(index), np.int8),
    )
    found = feature_observations(keyframe_id, features, points.ids, index, DEFAULT_PLAN)
    return with_observations(with_points(slam_map, points), found)


@pytest.fixture(scope="module")
def three(places, descriptors) -> Map:
    """Three keyframes without points."""
    slam_map = empty_map(CAMERA)
    for number, pose in enumerate(POSES):
        frame = Keyframe(number, number, seen(places, descriptors, pose), b"")
        slam_map = with_keyframe(slam_map, frame, pose, number - 1 if number else NONE, 0)
    return slam_map


def found_in(slam_map: Map, points: DescribedPoints, features: Features, **settings: float) -> np.ndarray:
    return find_points(slam_map, points, features, POSES[1], DEFAULT_PLAN, **({"radius_px": 3.0} | settings))  # type: ignore[arg-type]


class TestFindPoints:
    @pytest.fixture
    def points(self, three, places) -> DescribedPoints:
        return described_points_in(made(three, 0, places, np.arange(COUNT)), np.array([0]), DEFAULT_PLAN)

    def test_finds_those_in_view(self, three, places, points):
        index, feature = found_in(three, points, three.keyframes[1].features)
        np.testing.assert_array_equal(index, feature)
        uv = three.keyframes[1].features.uv
        inside = (uv > 0).all(axis=0) & (uv[0] < CAMERA.width) & (uv[1] < CAMERA.height)
        np.testing.assert_array_equal(index, np.flatnonzero(inside))

    def test_not_where_the_depth_is_another(self, three, points):
        features = three.keyframes[1].features
        farther = features.depth * np.where(np.arange(COUNT) % 2, np.float32(1.2), np.float32(1.05))
        index, _ = found_in(three, points, features._replace(depth=farther))
        assert len(index) > COUNT // 3
        assert (index % 2 == 0).all()
        unknown, _ = found_in(three, points, features._replace(depth=0 * features.depth))
        assert len(unknown) > 2 * COUNT // 3

    def test_not_far_from_where_it_should_be_nor_if_it_looks_otherwise(self, three, points):
        features = three.keyframes[1].features
        shifted = features._replace(uv=features.uv + np.array([[0], [5]], np.float32))
        assert len(found_in(three, points, shifted)[0]) < COUNT // 20
        assert len(found_in(three, points, shifted, radius_px=6.0)[0]) > COUNT // 2
        assert found_in(three, points, features._replace(descriptor=~features.descriptor)).shape == (2, 0)

    def test_not_at_another_size(self, three, points):
        features = three.keyframes[1].features
        coarse = features._replace(octave=features.octave + np.uint8(3))
        assert found_in(three, points, coarse).shape == (2, 0)

    def test_nothing_behind_the_camera_or_at_it(self, three, points):
        for X_world in (points.X_world * [[1], [1], [-1]], np.tile(POSES[1][4:, None], (1, COUNT))):
            assert found_in(three, points._replace(X_world=X_world), three.keyframes[1].features).shape == (2, 0)

    def test_nothing_among_nothing(self, three, points):
        none = DescribedPoints(*(c[..., :0] if c.ndim < 2 or len(c) == 3 else c[:0] for c in points))
        assert found_in(three, none, three.keyframes[1].features).shape == (2, 0)


def test_recognizable_are_those_seen_by_a_feature(three, places):
    slam_map = made(three, 0, places, np.arange(10))
    slam_map = slam_map.with_arrays(points=slam_map.points._replace(has_descriptor=np.arange(10) > 2))
    assert described_points_in(slam_map, np.array([0]), DEFAULT_PLAN).ids.tolist() == list(range(3, 10))
    assert described_points_in(slam_map, np.array([1]), DEFAULT_PLAN).ids.tolist() == []
    by_flow = slam_map.with_arrays(observations=slam_map.observations._replace(feature=np.full(10, NONE, np.int32)))
    assert described_points_in(by_flow, np.array([0]), DEFAULT_PLAN).ids.tolist() == []


def test_a_tracked_point_is_shown_by_the_nearest_feature(three):
    """Within two pixels; a feature shows one point."""
    features = three.keyframes[0].features
    uv = features.uv_raw[:, :6] + np.array([[0.5, 0.1, 1.9, 2.1, 0.0, 0.3], [0.0] * 6], np.float32)
    uv[:, 0] = features.uv_raw[:, 1] + np.array([0.5, 0], np.float32)  # nearer to it is the second point
    shown = features_at(features, uv)
    assert shown.tolist() == [NONE, 1, 2, NONE, 4, 5]
    assert features_at(features, uv[:, :0]).tolist() == []
    assert features_at(no_features(), uv).tolist() == [NONE] * 6


class TestFuse:
    def test_points_that_are_there_twice_become_one(self, three, places):
        """Keyframes 0 and 1 have made points of the same features, 100 of them each."""
        slam_map = made(made(three, 0, places, np.arange(100)), 1, places, np.arange(100))
        after, keep, drop = fuse_duplicates(slam_map, 1, np.array([0]), DEFAULT_PLAN, radius_px=3.0)
        assert problems(after) == []
        np.testing.assert_array_equal(drop, keep + 100)
        assert len(drop) > 90
        assert len(after.points.ids) == 200 - len(drop)
        seen = after.observations.point == keep[0]
        assert sorted(after.observations.keyframe[seen].tolist()) == [0, 1]

    def test_features_that_are_no_point_yet_become_observations(self, three, places):
        slam_map = made(three, 1, places, np.arange(100))
        after, keep, drop = fuse_duplicates(slam_map, 1, np.array([0, 2]), DEFAULT_PLAN, radius_px=3.0)
        assert problems(after) == []
        assert len(keep) == len(drop) == 0
        assert np.bincount(rows(after.points.ids, after.observations.point)).mean() > 2.7
        at = rows(after.points.ids, after.observations.point)
        np.testing.assert_array_equal(after.observations.feature, at)  # features and points are in one order

    def test_chains_over_several_neighbors(self, three, places):
        """Every keyframe has points of its own for the same features: they all become those of the first."""
        slam_map = three
        for number in range(3):
            slam_map = made(slam_map, number, places, np.arange(50))
        after, keep, drop = fuse_duplicates(slam_map, 2, np.array([1, 0]), DEFAULT_PLAN, radius_px=3.0)
        assert problems(after) == []
        assert len(after.points.ids) < 60 + 50
        assert (keep < drop).all()
        again, _, _ = fuse_duplicates(after, 1, np.array([0, 2]), DEFAULT_PLAN, radius_px=3.0)
        assert len(again.points.ids) < 65

    def test_nobody_near(self, three, places):
        slam_map = made(three, 1, places, np.arange(10))
        after, keep, _ = fuse_duplicates(slam_map, 1, np.zeros(0, np.int64), DEFAULT_PLAN, radius_px=3.0)
        assert len(keep) == 0
        assert len(after.observations.point) == 10
        bare = without_observations(slam_map, np.ones(10, bool))
        assert len(fuse_duplicates(bare, 1, np.array([0]), DEFAULT_PLAN, radius_px=3.0)[0].observations.point) == 0
