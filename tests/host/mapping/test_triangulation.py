"""Triangulation on exact geometry, and what it refuses."""

import numpy as np
import pytest

from jaxslam.features.orb import DEFAULT_PLAN, Features
from jaxslam.geometry.se3 import IDENTITY, retract, to_local
from jaxslam.mapping.triangulation import at_baseline, triangulate
from jaxslam.sensors.camera import Camera

CAMERA = Camera("exact", 640, 480, 525.0, 520.0, 319.5, 239.5)
COUNT = 150
SIDEWAYS = retract(IDENTITY, np.array([0.3, 0.05, -0.02, 0.02, -0.05, 0.01]))


def places(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([[-0.8], [-0.7], [2.0]], [[0.9], [0.7], [3.5]], (3, COUNT))


def seen(
    X_cam: np.ndarray, *, octave: np.ndarray | int = 0, noise_px: float = 0.0, order: np.ndarray | None = None
) -> Features:
    """Points as features without depth, each with a descriptor of its own; in another order if one is given."""
    rng, order = np.random.default_rng(7), np.arange(X_cam.shape[1]) if order is None else order
    uv = X_cam[:2] / X_cam[2] * [[CAMERA.fx], [CAMERA.fy]] + [[CAMERA.cx], [CAMERA.cy]]
    uv = (uv + np.random.default_rng(8).normal(0, noise_px, uv.shape)).astype(np.float32)[:, order]
    return Features(
        uv_raw=uv,
        uv=uv,
        depth=np.zeros(len(order), np.float32),
        octave=np.broadcast_to(np.asarray(octave, np.uint8), order.shape),
        angle=np.zeros(len(order), np.float32),
        descriptor=rng.integers(0, 256, (X_cam.shape[1], 32)).astype(np.uint8)[order],
    )


def test_finds_the_points():
    X, order = places(), np.random.default_rng(1).permutation(COUNT)
    found = triangulate(CAMERA, seen(X), seen(to_local(SIDEWAYS, X), order=order), SIDEWAYS, DEFAULT_PLAN)
    assert len(found.first) > 0.95 * COUNT
    np.testing.assert_array_equal(order[found.second], found.first)
    np.testing.assert_allclose(found.X_first, X[:, found.first], atol=1e-4)


def test_noise_of_half_a_pixel():
    X = places()
    found = triangulate(CAMERA, seen(X), seen(to_local(SIDEWAYS, X), noise_px=0.5), SIDEWAYS, DEFAULT_PLAN)
    assert len(found.first) > 0.9 * COUNT
    np.testing.assert_array_equal(found.first, found.second)
    assert np.abs(found.X_first[2] / X[2, found.first] - 1).max() < 0.05


def test_coarse_features_may_be_farther_off():
    X = places()
    number = {}
    for octave in (0, 7):
        second = seen(to_local(SIDEWAYS, X), noise_px=3.0, octave=octave)
        number[octave] = len(triangulate(CAMERA, seen(X, octave=octave), second, SIDEWAYS, DEFAULT_PLAN).first)
    assert number[7] > 0.9 * COUNT
    assert number[0] < 0.75 * COUNT  # two thirds are by chance near enough to the line


@pytest.mark.parametrize(
    ("name", "second", "T"),
    [
        ("too little parallax", lambda X, T: seen(to_local(T, X)), retract(IDENTITY, np.r_[0.02, np.zeros(5)])),
        ("only turned", lambda X, T: seen(to_local(T, X)), retract(IDENTITY, np.r_[0, 0, 0, 0.1, 0.1, 0])),
        (
            "off the line",
            lambda X, T: seen(to_local(T, X) + np.array([[0], [0.1], [0]])),
            retract(IDENTITY, np.r_[0.3, np.zeros(5)]),
        ),
        ("another scale", lambda X, T: seen(to_local(T, X), octave=4), SIDEWAYS),
        ("behind", lambda X, T: seen(to_local(T, -X)), SIDEWAYS),
        ("other things", lambda X, T: _other_descriptors(seen(to_local(T, X))), SIDEWAYS),
    ],
)
def test_refuses(name, second, T):
    X = places()
    first = seen(-X) if name == "behind" else seen(X)
    assert len(triangulate(CAMERA, first, second(X, T), T, DEFAULT_PLAN).first) == 0


def _other_descriptors(features: Features) -> Features:
    return features._replace(descriptor=~features.descriptor)


def test_what_looks_alike_along_one_line_is_not_matched():
    X = np.repeat(places()[:, :1], 2, axis=1) * [[1.0, 1.2]]
    first, second = seen(X), seen(to_local(SIDEWAYS, X))
    same = second._replace(descriptor=np.repeat(second.descriptor[:1], 2, axis=0))
    level = retract(IDENTITY, np.r_[0.3, np.zeros(5)])
    assert len(triangulate(CAMERA, first, same, level, DEFAULT_PLAN).first) == 0


@pytest.mark.parametrize("numbers", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_few_or_none(numbers):
    X = places()
    first, second = seen(X[:, : numbers[0]]), seen(to_local(SIDEWAYS, X)[:, : numbers[1]])
    found = triangulate(CAMERA, first, second, SIDEWAYS, DEFAULT_PLAN)
    assert found.X_first.shape == (3, min(numbers) and 1)


def test_baseline():
    depth = np.array([0, 2.0, 2.0, 2.0], np.float32)
    assert at_baseline(IDENTITY, SIDEWAYS, depth)
    assert not at_baseline(IDENTITY, retract(IDENTITY, np.r_[0.03, np.zeros(5)]), depth)
    assert not at_baseline(IDENTITY, SIDEWAYS, 0 * depth)
