"""Matching: against exhaustive loops, and on pictures whose poses are known."""

import numpy as np
import pytest
from room_views import features as room_features
from room_views import picture, room

from jaxslam.features.matching import (
    hamming,
    hamming_pairs,
    match_by_projection,
    match_descriptors,
    predicted_octave,
    same_turn,
)
from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.geometry.se3 import to_local, transform


def bits(descriptor: np.ndarray) -> np.ndarray:
    return np.unpackbits(descriptor, axis=1).astype(int)


def flipped(descriptor: np.ndarray, number: int, random: np.random.Generator) -> np.ndarray:
    """With some bits of each the other way round."""
    changed = np.unpackbits(descriptor, axis=1)
    for row in changed:
        row[random.choice(256, number, replace=False)] ^= 1
    return np.packbits(changed, axis=1)


def some_features(n: int, random: np.random.Generator, **given: np.ndarray) -> Features:
    uv = random.uniform(0, (320, 240), (n, 2)).T.astype(np.float32)
    return Features(
        uv_raw=uv,
        uv=uv,
        depth=np.ones(n, np.float32),
        octave=random.integers(0, 8, n).astype(np.uint8),
        angle=np.zeros(n, np.float32),
        descriptor=random.integers(0, 256, (n, 32)).astype(np.uint8),
    )._replace(**given)


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (1, 1), (70, 41)])
def test_hamming(n, m):
    random = np.random.default_rng(0)
    a, b = (random.integers(0, 256, (count, 32)).astype(np.uint8) for count in (n, m))
    expected = (bits(a)[:, None] != bits(b)[None]).sum(axis=2)
    np.testing.assert_array_equal(hamming(a, b), expected)
    same = min(n, m)
    np.testing.assert_array_equal(hamming_pairs(a[:same], b[:same]), np.diag(expected))


def test_hamming_of_what_does_not_lie_in_one_piece():
    a = np.random.default_rng(0).integers(0, 256, (20, 32)).astype(np.uint8)
    np.testing.assert_array_equal(hamming(a[::2], a[::-3]), hamming(a[::2].copy(), a[::-3].copy()))


def test_finds_what_is_alike():
    random = np.random.default_rng(1)
    a = some_features(200, random)
    order = random.permutation(200)
    b = some_features(200, random, descriptor=flipped(a.descriptor[order], 30, random))
    i, j = match_descriptors(a, b)
    np.testing.assert_array_equal(i, np.arange(200))
    np.testing.assert_array_equal(order[j], i)
    assert match_descriptors(a, b, max_distance=29).shape == (2, 0)


def test_drops_what_is_ambiguous_and_what_is_another_ones_best():
    random = np.random.default_rng(2)
    a = some_features(50, random)
    twice = np.concatenate([a.descriptor, flipped(a.descriptor[:1], 3, random)])
    b = some_features(51, random, descriptor=twice)
    assert 0 not in match_descriptors(a, b._replace(descriptor=flipped(twice, 20, random)))[0]
    i, j = match_descriptors(b, a)  # both would have a's first feature, but the exact copy is nearer
    assert (i[j == 0] == 0).all()
    assert len(i) == 50


def test_drops_patches_that_turned_otherwise():
    random = np.random.default_rng(3)
    a = some_features(100, random)
    angle = np.full(100, 0.5, np.float32)
    angle[:5] = [2.0, 3.0, 4.0, -1.0, -2.0]
    b = a._replace(angle=angle)
    np.testing.assert_array_equal(match_descriptors(a, b)[0], np.arange(5, 100))
    assert match_descriptors(a, b, check_turn=False).shape == (2, 100)
    around = np.linspace(-0.09, 0.09, 50, dtype=np.float32) + np.float32(2 * np.pi)
    assert same_turn(around).all()
    assert same_turn(np.zeros(0, np.float32)).shape == (0,)


def test_nothing_matches_nothing():
    random = np.random.default_rng(4)
    none, one, some = (some_features(n, random) for n in (0, 1, 5))
    for a, b in ((none, some), (some, none), (none, none)):
        assert match_descriptors(a, b).shape == (2, 0)
    np.testing.assert_array_equal(match_descriptors(one, one), [[0], [0]])
    for points, features in ((none, some), (some, none)):
        found = match_by_projection(points.uv, points.octave, points.descriptor, features, radius_px=10.0)
        assert found.shape == (2, 0)


def test_octave_goes_with_the_inverse_of_depth():
    found = predicted_octave(
        np.array([0, 0, 3, 3, 7]), np.array([2.0, 2, 2, 2, 2]), np.array([1.0, 4, 2, 2 * 1.2**2, 1])
    )
    np.testing.assert_array_equal(found, [4, 0, 3, 1, 7])


def exhaustive(uv, octave, descriptor, features, radius_px, max_distance, ratio, scale):
    """Every point, every feature, one after the other."""
    claims: dict[int, tuple[int, int]] = {}
    for point in range(len(octave)):
        near = []
        for feature in range(len(features.octave)):
            distance_px = np.hypot(*(uv[:, point] - features.uv[:, feature]).astype(float))
            apart = abs(int(features.octave[feature]) - int(octave[point]))
            if apart <= 1 and distance_px <= radius_px * scale ** octave[point]:
                differing = int(
                    (bits(descriptor[point : point + 1]) != bits(features.descriptor[feature : feature + 1])).sum()
                )
                near.append((differing, feature))
        near.sort()
        if not near or near[0][0] > max_distance:
            continue
        rival = len(near) > 1 and features.octave[near[1][1]] == features.octave[near[0][1]]
        if rival and near[0][0] >= ratio * near[1][0]:
            continue
        feature = near[0][1]
        claims[feature] = min(claims.get(feature, (999, 0)), (near[0][0], point))
    return sorted((point, feature) for feature, (_, point) in claims.items())


@pytest.mark.parametrize("ratio", [0.8, 1.0])
def test_projection_matches_an_exhaustive_search(ratio):
    random = np.random.default_rng(5)
    features = some_features(120, random)
    source = random.integers(0, 120, 150)
    uv = features.uv[:, source] + random.normal(0, 4, (2, 150))
    uv[:, 7] = np.nan
    octave = np.clip(features.octave[source].astype(int) + random.integers(-2, 3, 150), 0, 7)
    descriptor = np.concatenate(
        [flipped(features.descriptor[source[:75]], 40, random), features.descriptor[source[75:]]]
    )
    found = match_by_projection(
        uv, octave, descriptor, features, radius_px=6.0, max_distance=110, ratio=ratio, plan=FeaturePlan()
    )
    expected = exhaustive(uv, octave, descriptor, features, 6.0, 110, ratio, 1.2)
    assert [tuple(pair) for pair in found.T.tolist()] == expected
    assert 30 < len(expected) < 120
    assert len(set(found[1])) == found.shape[1]


def test_several_images_match_as_one_after_the_other():
    random = np.random.default_rng(6)
    features = some_features(800, random)
    source = random.integers(0, 800, 900)
    of_feature = random.integers(0, 8, 800)  # one of eight images
    of_point = np.where(random.random(900) < 0.8, of_feature[source], random.integers(0, 8, 900))
    uv = features.uv[:, source] + random.normal(0, 4, (2, 900))
    octave = features.octave[source].astype(int)
    descriptor = flipped(features.descriptor[source], 40, random)
    apart = []
    for image in range(8):
        points, there = np.flatnonzero(of_point == image), np.flatnonzero(of_feature == image)
        alone = Features(*(array.take(there, axis=-1 if array is not features.descriptor else 0) for array in features))
        found = match_by_projection(uv[:, points], octave[points], descriptor[points], alone, radius_px=6.0)
        apart.append(np.stack([points[found[0]], there[found[1]]]))
    expected = np.concatenate(apart, axis=1)
    found = match_by_projection(uv, octave, descriptor, features, radius_px=6.0, images=(of_point, of_feature))
    np.testing.assert_array_equal(found, expected[:, np.argsort(expected[0])])
    assert 400 < found.shape[1] < 800


@pytest.fixture(scope="module")
def pair() -> tuple[Features, Features, np.ndarray, np.ndarray]:
    """Two pictures taken a second apart; where the features of the first are in the second, and their depth there."""
    first, second, camera = room_features(0), room_features(30), room().camera
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    rays = np.linalg.solve(K, np.concatenate([first.uv, np.ones((1, len(first.depth)))]))
    X_world = transform(room().T_world_cam[0], rays * first.depth)
    X_cam = to_local(room().T_world_cam[30], X_world)
    expected = np.where(first.depth > 0, (K @ X_cam)[:2] / X_cam[2], np.nan)
    assert picture(0).image.shape == picture(30).image.shape
    return first, second, expected, X_cam[2]


def errors(pairs: np.ndarray, second: Features, expected: np.ndarray) -> np.ndarray:
    """Pixels of octave 0 between where a match is and where it should be, of those whose depth is known."""
    error = np.linalg.norm(second.uv[:, pairs[1]] - expected[:, pairs[0]], axis=0)
    error /= FeaturePlan().scale(second.octave[pairs[1]])
    return error[np.isfinite(error)]


def test_matches_of_two_pictures_are_right(pair):
    first, second, expected, _ = pair
    error = errors(match_descriptors(first, second), second, expected)
    assert len(error) > 150
    assert np.mean(error < 3) > 0.95


def test_projection_finds_more_than_descriptors_alone(pair):
    first, second, expected, depth = pair
    known = np.flatnonzero(first.depth > 0)
    octave = predicted_octave(first.octave[known], first.depth[known], depth[known])
    found = match_by_projection(expected[:, known], octave, first.descriptor[known], second, radius_px=4.0)
    assert found.shape[1] > 1.3 * match_descriptors(first, second).shape[1]
    error = errors(np.stack([known[found[0]], found[1]]), second, expected)
    assert np.median(error) < 1
