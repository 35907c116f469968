"""Small maps of noise, for the tests of the map, its file and its exports."""

import cv2
import numpy as np

from jaxslam.features.orb import Features
from jaxslam.geometry.se3 import to_local
from jaxslam.map.edit import (
    with_keyframe,
    with_loop,
    with_observations,
    with_points,
    without_observations,
    without_points,
)
from jaxslam.map.point_records import NONE, MapPoints, Observations
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.sensors.camera import Camera

CAMERA = Camera("small", 64, 48, 50.0, 51.0, 31.0, 24.5)
NUM_FEATURES = 12


def png(seed: int, camera: Camera = CAMERA) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 256, (camera.height // 8, camera.width // 8), np.uint8)
    gray = cv2.resize(noise, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
    return cv2.imencode(".png", gray)[1].tobytes()


def features(rng: np.random.Generator, count: int = NUM_FEATURES) -> Features:
    uv = rng.uniform(0, 48, (2, count)).astype(np.float32)
    return Features(
        uv_raw=uv,
        uv=uv + np.float32(0.25),
        depth=rng.uniform(0, 4, count).astype(np.float32),
        octave=rng.integers(0, 8, count).astype(np.uint8),
        angle=rng.uniform(-np.pi, np.pi, count).astype(np.float32),
        descriptor=rng.integers(0, 256, (count, 32)).astype(np.uint8),
    )


def keyframe(slam_map: Map, rng: np.random.Generator, count: int = NUM_FEATURES) -> Keyframe:
    """The next one of a map."""
    number = slam_map.next_keyframe
    return Keyframe(number, 10**18 + 33_333_333 * number, features(rng, count), png(number))


def pose(rng: np.random.Generator, turn: float = 0.1, move: float = 0.3) -> np.ndarray:
    wxyz = np.array([1.0, 0, 0, 0]) + turn * rng.normal(size=4)
    return np.concatenate([wxyz / np.linalg.norm(wxyz), move * rng.normal(size=3)])


def points(slam_map: Map, reference_keyframe: np.ndarray, rng: np.random.Generator) -> MapPoints:
    """New ones in front of the origin, half of them with a descriptor."""
    count = len(reference_keyframe)
    recognizable = rng.random(count) < 0.5
    return MapPoints(
        ids=slam_map.next_point + np.arange(count),
        X_world=rng.uniform([[-0.6], [-0.5], [2.0]], [[0.6], [0.5], [3.0]], (3, count)),
        weight=rng.random(count).astype(np.float32),
        descriptor=rng.integers(0, 256, (count, 32)).astype(np.uint8) * recognizable[:, None],
        has_descriptor=recognizable,
        reference_keyframe=np.asarray(reference_keyframe, np.int64),
        state=(np.arange(count) % 3).astype(np.int8),
    )


def observations(
    slam_map: Map, keyframes: np.ndarray, point_ids: np.ndarray, feature: np.ndarray, rng: np.random.Generator
) -> Observations:
    """Where the camera without distortion would see the points, with half a pixel of noise."""
    keyframes, point_ids = np.asarray(keyframes, np.int64), np.asarray(point_ids, np.int64)
    X = slam_map.points.X_world[:, np.searchsorted(slam_map.points.ids, point_ids)]
    local = np.zeros((3, len(keyframes)))
    for column, number in enumerate(keyframes.tolist()):
        local[:, column] = to_local(slam_map.pose(number), X[:, column : column + 1])[:, 0]
    camera = slam_map.camera
    uv = np.stack([camera.fx * local[0] / local[2] + camera.cx, camera.fy * local[1] / local[2] + camera.cy])
    uv = (uv + 0.5 * rng.normal(size=uv.shape)).astype(np.float32)
    return Observations(
        keyframe=keyframes,
        point=point_ids,
        feature=np.asarray(feature, np.int32),
        uv_raw=uv,
        uv=uv,
        depth=np.maximum(local[2], 0).astype(np.float32),
        sigma_px=np.ones(len(keyframes), np.float32),
        weight=rng.random(len(keyframes)).astype(np.float32),
    )


def small_map(num_keyframes: int = 4, num_points: int = 10, seed: int = 0, camera: Camera = CAMERA) -> Map:
    """One submap; every keyframe sees every point, half of them by a feature; one loop from the first to the last."""
    rng = np.random.default_rng(seed)
    made = empty_map(camera)
    for number in range(num_keyframes):
        made = with_keyframe(made, keyframe(made, rng), pose(rng, 0.01, 0.05), number - 1 if number else NONE, 0)
    made = with_points(made, points(made, rng.integers(0, num_keyframes, num_points), rng))
    which, point = np.divmod(np.arange(num_keyframes * num_points), num_points)
    by_feature = np.where((point % 2 == 0) & (point < NUM_FEATURES), point, NONE)
    made = with_observations(made, observations(made, which, point, by_feature, rng))
    return with_loop(made, 0, num_keyframes - 1, pose(rng), 7.0 * np.eye(6)) if num_keyframes > 1 else made


def arrays(slam_map: Map) -> dict[str, np.ndarray]:
    """All arrays of a map by a name of their own."""
    records = {
        "map": slam_map,
        "points": slam_map.points,
        "observations": slam_map.observations,
        "loops": slam_map.loops,
        "culled": slam_map.culled,
    }
    records |= {f"keyframe {number.id}": number.features for number in slam_map.keyframes}
    return {
        f"{prefix}.{name}": value
        for prefix, record in records.items()
        for name, value in record._asdict().items()
        if isinstance(value, np.ndarray)
    }


def same(first: Map, second: Map) -> bool:
    """Whether two maps are equal to the bit, types included."""
    one, two = arrays(first), arrays(second)
    plain = [
        (m.camera, m.next_keyframe, m.next_point, [(f.id, f.timestamp_ns, f.image_file) for f in m.keyframes])
        for m in (first, second)
    ]
    return (
        plain[0] == plain[1]
        and one.keys() == two.keys()
        and all(
            one[name].dtype == two[name].dtype
            and one[name].shape == two[name].shape
            and one[name].tobytes() == two[name].tobytes()
            for name in one
        )
    )


def thinned(seed: int, num_keyframes: int = 6, num_points: int = 40) -> Map:
    """Every keyframe sees about a third of the points."""
    slam_map = small_map(num_keyframes, num_points, seed)
    slam_map = without_observations(
        slam_map, np.random.default_rng(seed).random(len(slam_map.observations.point)) < 0.65
    )
    return without_points(slam_map, np.setdiff1d(slam_map.points.ids, slam_map.observations.point))


def in_order(slam_map: Map) -> Map:
    """The observations in the order of keyframes and points: an edit of a part moves those of the part to the end."""
    order = np.lexsort((slam_map.observations.point, slam_map.observations.keyframe))
    columns = (column[..., order] for column in slam_map.observations)
    return slam_map.with_arrays(observations=Observations(*columns))
