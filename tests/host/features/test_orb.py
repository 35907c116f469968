"""ORB features: where they are, how they are spread, and what is known of their place."""

import inspect

import cv2
import equinox as eqx
import jax
import numpy as np
import pytest
from room_views import STILL, picture

from jaxslam import Camera
from jaxslam.config.schema import TrackConfig
from jaxslam.features import orb as module
from jaxslam.features.matching import match_descriptors
from jaxslam.features.orb import FeaturePlan, extract, features_of
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.sensors.frame_arrays import FrameArrays, frame_arrays
from jaxslam.sensors.sensor_model import sensor_model

HEIGHT, WIDTH = 480, 640


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    return to_gray(picture(0).image)


def dots(contrast: int, seed: int = 0) -> np.ndarray:
    """Squares on a gray wall, lighter than it by `contrast`."""
    image = np.full((HEIGHT, WIDTH), 100, np.uint8)
    for u, v in np.random.default_rng(seed).integers(30, (WIDTH - 30, HEIGHT - 30), (150, 2)):
        image[v : v + 7, u : u + 7] = 100 + contrast
    return image


def cells(uv: np.ndarray) -> int:
    """How many of 192 cells hold a feature."""
    return len(np.unique((uv // 40).astype(int), axis=1).T)


def test_quota_and_spread(gray):
    patches, plan = extract(gray), FeaturePlan()
    assert plan.quotas().sum() == 1000
    assert len(patches.octave) == 1000
    np.testing.assert_array_equal(np.bincount(patches.octave), plan.quotas())
    assert (patches.uv_raw > 15).all()
    assert (patches.uv_raw < [[WIDTH - 15], [HEIGHT - 15]]).all()
    plain = cv2.KeyPoint.convert(cv2.ORB.create(1000).detect(gray, None)).T
    assert cells(patches.uv_raw) > 1.5 * cells(plain)


def test_same_image_same_bytes(gray):
    for first, second in zip(extract(gray), extract(gray.copy()), strict=True):
        assert first.tobytes() == second.tobytes()


def test_positions_of_every_octave_are_those_of_the_image():
    """A mirrored picture has its features in the mirror: no octave is shifted by the halves of its larger pixels."""
    image = cv2.GaussianBlur(dots(80), (0, 0), 1.0)
    patches, mirrored = extract(image), extract(np.ascontiguousarray(image[:, ::-1]))
    for octave in range(8):
        there = patches.uv_raw[:, patches.octave == octave]
        back = mirrored.uv_raw[:, mirrored.octave == octave] * [[-1], [1]] + [[WIDTH - 1], [0]]
        distance = np.linalg.norm(there[:, :, None] - back[:, None, :], axis=0).min(axis=1)
        assert np.median(distance) < 0.01


def test_weak_corners_count_only_where_there_are_no_others():
    image = dots(12)
    image[:, WIDTH // 2 :] = dots(100, seed=1)[:, WIDTH // 2 :]
    strong = extract(image, plan=FeaturePlan(min_fast_threshold=20)).uv_raw
    assert (strong[0] > WIDTH // 2 - 30).all()
    assert (extract(image).uv_raw[0] < WIDTH // 2 - 30).sum() > 100


def test_cells_take_turns():
    """Two cells of 10 x 10: one has a strong corner and so gives no weak one, the other has weak ones alone."""
    uv = np.array([[1, 3, 6, 12, 14, 17, 18.0], [1, 5, 2, 8, 1, 4, 4.0]], np.float32)
    response = np.array([10, 25, 40, 9, 8, 15, 15], np.float32)
    assert module._spread(uv, response, (10, 20), 2, fast_threshold=20).tolist() == [2, 5]
    stacked = np.concatenate(
        [uv + np.array([[0], [v]], np.float32) for v in (0, 10, 20)], axis=1
    )  # thrice as many cells
    found = module._spread(stacked, np.tile(response, 3), (30, 20), 6, fast_threshold=20)
    assert found.tolist() == [2, 9, 16, 5, 12, 19]
    alone = module._spread(uv, response, (10, 20), 7, fast_threshold=41)
    assert sorted(alone.tolist()) == list(range(7))


def test_a_second_round_gives_the_second_best():
    uv = np.array([[1, 3, 6, 12], [1, 5, 2, 8]], np.float32)
    response = np.array([30, 25, 40, 9], np.float32)
    assert module._spread(uv, response, (40, 40), 4, fast_threshold=20).tolist() == [2, 0, 1]
    assert module._spread(uv, response, (40, 40), 4, fast_threshold=7).tolist() == [2, 0, 1, 3]


def test_nothing_where_it_is_ignored(gray):
    ignore = np.zeros(gray.shape, bool)
    ignore[150:330, 200:440] = True
    patches = extract(gray, ignore)
    u, v = patches.uv_raw
    scale = FeaturePlan().scale(patches.octave)
    outside = np.hypot(np.maximum(np.maximum(200 - u, u - 439), 0), np.maximum(np.maximum(150 - v, v - 329), 0))
    assert (outside > 7 * scale).all()
    assert len(patches.octave) > 800


def test_without_what_a_later_mask_ignores(gray):
    patches, ignore = extract(gray), np.zeros(gray.shape, bool)
    ignore[:, :320] = True
    left = patches.without(ignore)
    kept = np.rint(patches.uv_raw[0]) >= 320
    assert 0 < kept.sum() < len(kept)
    for some, every in zip(left, patches, strict=True):
        np.testing.assert_array_equal(some, every.compress(kept, axis=every.shape.index(len(kept))))


@pytest.mark.parametrize("shape", [(8, 8), (50, 60), (HEIGHT, WIDTH)])
def test_nothing_to_see(shape):
    for image, ignore in ((np.zeros(shape, np.uint8), None), (np.eye(*shape, dtype=np.uint8), np.ones(shape, bool))):
        patches = extract(image, ignore)
        assert patches.uv_raw.shape == (2, 0)
        assert patches.descriptor.shape == (0, 32)
        assert [array.dtype for array in patches] == [np.float32, np.uint8, np.float32, np.uint8]


def test_a_turned_picture_has_the_same_features_turned(gray):
    square = np.ascontiguousarray(gray[:, 80:560])
    frame = lambda image: frame_arrays(Frame(0, image, np.ones(image.shape, np.float32)), 1 / 30)
    camera = Camera("square", 480, 480, 525, 525, 239.5, 239.5)
    sensor = sensor_model(camera, TrackConfig())
    first = features_of(frame(square), STILL, sensor)
    second = features_of(frame(np.ascontiguousarray(np.rot90(square, k=-1))), STILL, sensor)  # u becomes v
    i, j = match_descriptors(first, second)
    assert len(i) > 500
    expected = np.stack([479 - first.uv_raw[1, i], first.uv_raw[0, i]])
    assert np.mean(np.linalg.norm(second.uv_raw[:, j] - expected, axis=0) < 2) > 0.98
    turn = (second.angle[j] - first.angle[i]) % (2 * np.pi)
    assert abs(np.median(turn) - np.pi / 2) < 0.01


def with_depth(depth: np.ndarray) -> FrameArrays:
    return frame_arrays(Frame(0, picture(0).image, depth), 1 / 30)


def test_distortion_is_removed_and_depth_checked():
    camera = Camera.load("tum_fr1")
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth[:, :200] = 0
    depth[:, 400:] = 3.0
    depth[:, 500:] = 9.0
    features = features_of(with_depth(depth), STILL, sensor_model(camera, TrackConfig()))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    expected = cv2.undistortPoints(
        features.uv_raw.T.astype(np.float64), matrix, np.array(camera.distortion), P=matrix, criteria=criteria
    )
    np.testing.assert_allclose(features.uv, expected[:, 0].T, atol=1e-2)
    column = np.round(features.uv_raw[0])
    on_edge = (np.abs(column - 199.5) < 2) | (np.abs(column - 399.5) < 2) | (np.abs(column - 499.5) < 2)
    expected = np.select([column < 200, column < 400, column < 500], [0.0, 2.0, 3.0], 0.0)
    np.testing.assert_array_equal(features.depth[~on_edge], expected[~on_edge])
    at_step = np.abs(column - 399.5) < 1
    assert at_step.any()
    assert (features.depth[at_step] == 0).all()


def test_rolling_shutter_is_removed():
    """A camera that turns right sees everything move left: the upper rows are early, so they are too far right."""
    camera = Camera("rolling", WIDTH, HEIGHT, 525, 525, 319.5, 239.5, readout_s=0.02)
    turn = np.array([0, 0, 0, 0, 1.0, 0])
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    features = features_of(with_depth(depth), turn, sensor_model(camera, TrackConfig()))
    x, y = (features.uv_raw - [[camera.cx], [camera.cy]]) / 525
    late_s = (features.uv_raw[1] / (HEIGHT - 1) - 0.5) * camera.readout_s
    expected = features.uv_raw + 525 * late_s * np.stack([1 + x * x, x * y])
    assert np.abs(expected - features.uv_raw).max() > 4
    np.testing.assert_allclose(features.uv, expected, atol=1e-2)
    backward = with_depth(depth)._replace(readout_sign=np.float32(-1))
    features = features_of(backward, turn, sensor_model(camera, TrackConfig()))
    np.testing.assert_allclose(features.uv, 2 * features.uv_raw - expected, atol=1e-2)


def test_compiles_once_however_many_features_there_are(monkeypatch):
    monkeypatch.setattr(
        module, "_ideal", jax.jit(eqx.debug.assert_max_traces(inspect.unwrap(module._ideal), max_traces=1))
    )
    sensor = sensor_model(Camera.load("tum_fr1"), TrackConfig())
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    counts = []
    for image in (dots(0), dots(60), picture(0).image):
        features = features_of(frame_arrays(Frame(0, image, depth), 1 / 30), STILL, sensor)
        counts.append(len(features.octave))
        assert features.uv.shape == features.uv_raw.shape == (2, counts[-1])
        assert all(type(array) is np.ndarray for array in features)
    assert counts[0] == 0 < counts[1] < counts[2] == 1000
