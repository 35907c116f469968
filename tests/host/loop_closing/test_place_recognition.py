"""Recognizing places: the index against exhaustive search, poses against the truth, and nothing where nothing is."""

from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from room_views import FRAMES, STILL, features, map_of, room, sensor
from scipy.spatial.transform import Rotation, Slerp

from jaxslam.config.schema import TrackConfig
from jaxslam.datasets import Dataset, open_dataset
from jaxslam.features import pose_from_matches as feature_pose
from jaxslam.features import view_matching
from jaxslam.features.orb import Features, features_of
from jaxslam.features.pose_from_matches import PLACE_GATES
from jaxslam.features.view_matching import match_views
from jaxslam.geometry.se3 import angle, between
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.loop_closing.place_recognition import Recognition, recognize, verify
from jaxslam.map.edit import with_keyframe
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.sensors.frame_arrays import frame_arrays
from jaxslam.sensors.sensor_model import sensor_model

ROOM_DEPTH_M = 4.0
"""At most, of the median point of a view."""
ROUND = range(0, FRAMES, 120)


def described(descriptor: np.ndarray) -> Features:
    n = len(descriptor)
    nothing = np.zeros(n, np.float32)
    uv = np.zeros((2, n), np.float32)
    return Features(uv, uv, nothing, np.zeros(n, np.uint8), nothing, descriptor)


def like(descriptor: np.ndarray, share: float, random: np.random.Generator) -> np.ndarray:
    return descriptor ^ np.packbits(random.random((len(descriptor), 256)) < share, axis=1)


@pytest.fixture(scope="module")
def places() -> list[Features]:
    """Twenty places that share some of their features."""
    random = np.random.default_rng(0)
    common = random.integers(0, 256, (40, 32)).astype(np.uint8)
    own = random.integers(0, 256, (20, 60, 32)).astype(np.uint8)
    shared = [common[random.permutation(40)[:20]] for _ in own]
    return [
        described(random.permutation(np.concatenate([a, like(b, 0.03, random)])))
        for a, b in zip(own, shared, strict=True)
    ]


def index_of(places: list[Features], order: Iterator[int] | range) -> PlaceIndex:
    index = PlaceIndex()
    for place in order:
        index.add(place, places[place])
    return index


def exhaustive(places: list[Features], ids: set[int], sought: Features) -> list[tuple[int, float]]:
    """The scores of places that share four features or more, by comparing everything with everything."""
    holds = np.zeros((len(places), len(sought.descriptor)), bool)
    for place in ids:
        for entry in places[place].descriptor[::2]:
            differing = np.unpackbits(sought.descriptor ^ entry, axis=1).sum(axis=1)
            keys = (sought.descriptor[:, :24] == entry[:24]).reshape(-1, 8, 3).all(axis=2).any(axis=1)
            holds[place] |= keys & (differing <= 40)
    score = holds @ np.log((len(ids) + 1) / np.maximum(holds.sum(axis=0), 1))
    best = sorted(ids, key=lambda place: (-score[place], place))
    return [(place, score[place]) for place in best if holds[place].sum() >= 4]


def test_scores_are_those_of_an_exhaustive_search(places):
    random = np.random.default_rng(1)
    changed = like(places[7].descriptor, 0.06, random)
    changed[::2] = like(places[7].descriptor[::2], 0.17, random)  # about as many bits as may differ
    changed[:, :3] = places[7].descriptor[:, :3]
    of_each = [place.descriptor[:10] for place in places]
    sought, index = described(np.concatenate([changed, *of_each])), index_of(places, range(20))
    found, expected = index.query(sought, limit=100), exhaustive(places, set(range(20)), sought)
    assert [place for place, _ in found] == [place for place, _ in expected]
    np.testing.assert_allclose([score for _, score in found], [score for _, score in expected], rtol=1e-12)
    assert found[0][0] == 7
    assert found[0][1] > 2 * found[1][1]
    assert len(found) > 10


def test_answers_do_not_depend_on_the_order_of_adding(places):
    random = np.random.default_rng(2)
    queries = [described(like(places[place].descriptor, 0.1, random)) for place in range(20)]
    straight = index_of(places, range(20))
    for _ in range(3):
        shuffled = index_of(places, iter(random.permutation(20).tolist()))
        for query in queries:
            assert shuffled.query(query, limit=20) == straight.query(query, limit=20)


def test_what_is_removed_or_excluded_is_not_found(places):
    index = index_of(places, range(20))
    for place in range(0, 20, 2):
        index.remove(place)
    assert len(index) == 10
    assert 4 not in index
    assert 5 in index
    rebuilt = index_of(places, range(1, 20, 2))
    for place in range(20):
        assert index.query(places[place], limit=20) == rebuilt.query(places[place], limit=20)
        assert all(found % 2 for found, _ in index.query(places[place], limit=20))
    assert index.query(places[5])[0][0] == 5
    without = index.query(places[5], exclude={5})
    assert without == index.query(places[5], limit=6)[1:]
    more = [described(np.random.default_rng(100 + n).integers(0, 256, (90, 32)).astype(np.uint8)) for n in range(40)]
    for place, extra in enumerate(more, 20):  # merging blocks drops what was removed
        index.add(place, extra)
    assert sum(len(block.keyframe) for block in index._blocks) < 40 * 50 + 40 * 45
    assert index.query(places[5])[0][0] == 5


@pytest.mark.parametrize("in_common", [0, 1, 3, 4])
def test_too_few_features_in_common_are_none(in_common):
    random = np.random.default_rng(3)
    place, sought = random.integers(0, 256, (2, 60, 32)).astype(np.uint8)
    sought[:in_common] = place[: 2 * in_common : 2]
    index = index_of([described(place)], range(1))
    assert [found for found, _ in index.query(described(sought))] == [0] * (in_common >= 4)


def test_an_id_is_added_once(places):
    index = index_of(places, range(3))
    with pytest.raises(ValueError, match="keyframe 1 was added before"):
        index.add(1, places[1])
    index.remove(1)
    with pytest.raises(KeyError):
        index.remove(1)
    with pytest.raises(ValueError, match="keyframe 1 was added before"):
        index.add(1, places[1])


def test_an_empty_index_and_an_empty_image(places):
    assert PlaceIndex().query(places[0]) == []
    nothing = described(np.zeros((0, 32), np.uint8))
    index = index_of(places, range(3))
    index.add(3, nothing)
    assert index.query(nothing) == []
    assert index.query(places[2])[0][0] == 2


@pytest.fixture(scope="module")
def round_map() -> Map:
    return map_of(ROUND)


@pytest.fixture(scope="module")
def round_index(round_map) -> PlaceIndex:
    return PlaceIndex.from_map(round_map)


def error(slam_map: Map, found: Recognition, T_world_cam: np.ndarray) -> tuple[float, float]:
    """Meters and radians."""
    wrong = between(between(slam_map.pose(found.keyframe), T_world_cam), found.T_keyframe_cam)
    return float(np.linalg.norm(wrong[4:])), float(angle(wrong))


def test_recognizes_places_of_the_room(round_map, round_index):
    recognized = [(i, recognize(round_map, round_index, features(i), sensor())) for i in range(10, FRAMES, 80)]
    sure = [(index, found) for index, found in recognized if found is not None]
    assert len(sure) >= 8
    for index, found in sure:
        meters, radians = error(round_map, found, room().T_world_cam[index])
        assert meters < 0.01
        assert radians < np.radians(0.4)
        assert found.num_inliers == found.pairs.shape[1] >= PLACE_GATES.min_inliers
        np.testing.assert_array_equal(found.covariance, found.covariance.T)
        assert 0 < np.linalg.eigvalsh(found.covariance[:3, :3])[-1] <= (PLACE_GATES.max_sigma * ROOM_DEPTH_M) ** 2
        assert meters**2 < 25 * found.covariance[:3, :3].trace()
    near = [recognize(round_map, round_index, features(index + 10), sensor()) for index in ROUND]
    assert [found.keyframe for found in near if found is not None] == round_map.ids.tolist()


def test_same_call_same_bytes(round_map):
    found = [recognize(round_map, PlaceIndex.from_map(round_map), features(130), sensor()) for _ in range(2)]
    assert found[0] is not None
    for first, second in zip(*found, strict=True):
        assert np.asarray(first).tobytes() == np.asarray(second).tobytes()


def test_passes_over_what_is_excluded_or_no_longer_in_the_map(round_map, round_index):
    sought, best = features(130), 1
    found = recognize(round_map, round_index, sought, sensor())
    assert found is not None
    assert found.keyframe == best
    other = recognize(round_map, round_index, sought, sensor(), exclude={best})
    assert other is None or other.keyframe != best
    culled = without_keyframe(round_map, best)
    elsewhere = recognize(culled, round_index, sought, sensor())
    assert elsewhere is None or elsewhere.keyframe != best


def test_another_room_is_not_recognized(round_map, round_index):
    for seed in range(1, 4):
        for index in range(0, FRAMES, 160):
            sought = features(index, seed)
            assert recognize(round_map, round_index, sought, sensor()) is None
            assert all(verify(keyframe, sought, sensor()) is None for keyframe in round_map.keyframes)


def test_too_little_to_be_certain(round_map):
    """The same picture, but only what lies in a corner of it, or only a few features, or none with depth."""
    keyframe, whole = round_map.keyframes[0], features(0)
    assert verify(keyframe, whole, sensor()) is not None
    take = lambda index: Features(
        *(array[..., index] if array.ndim < 2 or len(array) == 2 else array[index] for array in whole)
    )
    corner = np.flatnonzero((whole.uv[0] < 240) & (whole.uv[1] < 200))
    assert len(corner) > 2 * PLACE_GATES.min_inliers
    for index in (corner, np.arange(0, 1000, 40), np.arange(0)):
        assert verify(keyframe, take(index), sensor()) is None
    flat = keyframe._replace(features=keyframe.features._replace(depth=np.zeros_like(whole.depth)))
    assert verify(flat, whole, sensor()) is None
    few, anywhere = PLACE_GATES._replace(min_cells=1), PLACE_GATES._replace(max_sigma=1.0)
    for gates, certain in (
        (anywhere, False),
        (few, False),
        (few._replace(max_sigma=1.0), True),
    ):  # each alone refuses it
        matched = match_views(keyframe.features, take(corner), sensor(), jax.random.key(0), gates=gates)
        assert (matched is not None) == certain


@pytest.mark.slow
def test_compiles_once(round_map, monkeypatch):
    for module, name in ((view_matching, "_agreed"), (feature_pose, "_refined")):
        monkeypatch.setattr(
            module, name, jax.jit(eqx.debug.assert_max_traces(getattr(module, name).__wrapped__, max_traces=1))
        )
    found = [verify(round_map.keyframes[0], features(index), sensor()) for index in (0, 10)]
    assert all(found)


def true_motion(dataset: Dataset, time_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose and velocity of the camera at a time, from ground truth."""
    truth = dataset.ground_truth
    assert truth is not None
    seconds = (truth.timestamps_ns - time_ns) * 1e-9
    turns = Slerp(seconds, Rotation.from_quat(truth.T_world_cam[:, [1, 2, 3, 0]]))

    def pose(s: float) -> np.ndarray:
        s = float(np.clip(s, seconds[0], seconds[-1]))
        position = [np.interp(s, seconds, axis) for axis in truth.T_world_cam[:, 4:].T]
        return np.concatenate([turns(s).as_quat()[[3, 0, 1, 2]], position])

    step = between(pose(-0.015), pose(0.015))
    return pose(0), np.concatenate([step[4:], 2 * np.sign(step[0]) * step[1:4]]) / 0.03


def recorded(dataset: Dataset, indices: range, *, moving: bool) -> tuple[list[Features], list[np.ndarray]]:
    of_camera, found, poses = sensor_model(dataset.camera, TrackConfig()), [], []
    for index in indices:
        frame = dataset[index]
        pose, twist = true_motion(dataset, frame.timestamp_ns)
        found.append(features_of(frame_arrays(frame, 1 / 30), twist if moving else STILL, of_camera))
        poses.append(pose)
    return found, poses


def recorded_map(dataset: Dataset, found: list[Features], poses: list[np.ndarray]) -> Map:
    slam_map = empty_map(dataset.camera)
    for one, pose in zip(found, poses, strict=True):
        slam_map = with_keyframe(
            slam_map,
            Keyframe(slam_map.next_keyframe, slam_map.next_keyframe, one, b""),
            pose,
            NONE,
            slam_map.next_keyframe,
        )
    return slam_map


@pytest.mark.slow
def test_real_places(data_dir: Path):
    """TUM fr1_rpy: revisits are recognized where they are; Bonn's lecture hall is not, nor the other way round."""
    desk = open_dataset(data_dir / "tum" / "rgbd_dataset_freiburg1_rpy_excerpt")
    hall = open_dataset(data_dir / "bonn" / "rgbd_bonn_crowd")
    seen, poses = recorded(desk, range(0, 160, 5), moving=True)
    others, places = recorded(hall, range(0, 900, 60), moving=False)
    slam_map = recorded_map(desk, seen[::2], poses[::2])
    index, of_camera = PlaceIndex.from_map(slam_map), sensor_model(desk.camera, TrackConfig())
    errors = []
    for i, (one, pose) in enumerate(zip(seen, poses, strict=True)):
        neighbors = {k for k in range(len(slam_map.ids)) if abs(10 * k - 5 * i) <= 15}
        found = recognize(slam_map, index, one, of_camera, exclude=neighbors)
        if found is not None:
            errors.append(error(slam_map, found, pose))
    meters, radians = np.transpose(errors)
    assert len(errors) >= 0.75 * len(seen)
    assert np.median(meters) < 0.012
    assert meters.max() < 0.08
    assert np.degrees(radians).max() < 4
    assert all(recognize(slam_map, index, one, of_camera, limit=10) is None for one in others)
    elsewhere, hall_sensor = recorded_map(hall, others, places), sensor_model(hall.camera, TrackConfig())
    hall_index = PlaceIndex.from_map(elsewhere)
    assert all(recognize(elsewhere, hall_index, one, hall_sensor, limit=10) is None for one in seen)
