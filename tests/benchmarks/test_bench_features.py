"""Features, matching and the index of places beside OpenCV.

`pytest -m benchmark -n 0 tests/benchmarks/test_bench_features.py -s`
"""

import time

import cv2
import numpy as np
import pytest
from room_views import STILL, features, picture, sensor

from jaxslam.benchmark.timing import compare
from jaxslam.features.matching import hamming, match_by_projection, match_descriptors
from jaxslam.features.orb import Features, extract, features_of
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.loop_closing.place_recognition import verify
from jaxslam.map.types import Keyframe
from jaxslam.sensors.frame import to_gray
from jaxslam.sensors.frame_arrays import frame_arrays

pytestmark = pytest.mark.benchmark

KEYFRAMES = 2000


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    return to_gray(picture(0).image)


def test_extraction(gray):
    orb = cv2.ORB.create(1000)
    plain = lambda: orb.detectAndCompute(gray, None)
    ignore = np.zeros(gray.shape, bool)
    ignore[100:300, 200:400] = True
    frame = frame_arrays(picture(0), 1 / 30)
    extracted = compare(lambda: extract(gray), plain)
    print(f"\nextract, against cv2.ORB without spreading: {extracted}")
    print(f"masked: {compare(lambda: extract(gray, ignore), plain)}")
    print(f"features_of: {compare(lambda: features_of(frame, STILL, sensor()), plain)}")
    assert extracted.processor_ratio < 3


def test_matching():
    a, b = features(0), features(10)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    theirs = lambda: matcher.knnMatch(a.descriptor, b.descriptor, 2)
    distances = compare(lambda: hamming(a.descriptor, b.descriptor), theirs)
    print(f"\nhamming 1000 x 1000, against the two best of cv2.BFMatcher: {distances}")
    print(f"match_descriptors: {compare(lambda: match_descriptors(a, b), theirs)}")
    projected = lambda: match_by_projection(a.uv, a.octave, a.descriptor, b, radius_px=8.0)
    print(f"match_by_projection of 1000 points: {compare(projected, theirs)}")
    keyframe = Keyframe(0, 0, a, b"")
    print(f"verify: {compare(lambda: verify(keyframe, b, sensor()), theirs)}")
    assert distances.processor_ratio < 1.5


def test_index():
    """Of views of four rooms and, to have thousands, copies of them with every twelfth bit turned."""
    random = np.random.default_rng(0)
    views = [features(index, seed) for seed in range(4) for index in range(0, 960, 120)]
    index, took = PlaceIndex(), []
    for keyframe in range(KEYFRAMES):
        view = views[keyframe % len(views)]
        turned = np.packbits(random.random((len(view.descriptor), 256), np.float32) < 1 / 12, axis=1)
        copy: Features = view._replace(descriptor=view.descriptor ^ turned)
        began = time.perf_counter()
        index.add(keyframe, copy)
        took.append(1e3 * (time.perf_counter() - began))
    print(f"\nadd to {KEYFRAMES}: median {np.median(took):.2f} ms, mean {np.mean(took):.2f} ms, max {max(took):.0f} ms")
    stored = sum(array.nbytes for block in index._blocks for array in block)
    print(f"{stored / KEYFRAMES / 1e3:.0f} kB a keyframe, {len(index._blocks)} blocks")
    sought, other = features(10), features(0)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    queried = compare(lambda: index.query(sought), lambda: matcher.knnMatch(sought.descriptor, other.descriptor, 2))
    print(f"query of {KEYFRAMES}, against cv2.BFMatcher on one: {queried}")
    assert queried.processor_ratio < 4
