"""Keyframes of the synthetic room as the tracker hands them over, with tracks known to the true position."""

import functools

import numpy as np
from room_views import features, picture, room, sensor

from jaxslam.config.schema import Config
from jaxslam.geometry.se3 import between, retract, to_local, transform
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map
from jaxslam.mapping.local_mapping import LocalMapping, MappingPlan, NewKeyframe, TrackedObservations, mapping_plan
from jaxslam.sensors.frame_arrays import FrameArrays, frame_arrays

PLAN: MappingPlan = mapping_plan(room().camera, Config())
STEP = 24
"""Pictures between two keyframes: 9 degrees of a round of the room."""
_NOISE_PX = 0.2


@functools.cache
def arrays(index: int, seed: int = 0) -> FrameArrays:
    return frame_arrays(picture(index, seed), 1 / 30)


@functools.cache
def followed(seed: int = 0, indices: range = range(0, 10 * STEP, STEP), each: int = 120) -> np.ndarray:
    """`(3, n)` what the tracker follows: corners of some pictures where their depth puts them."""
    places = []
    for index in indices:
        found = features(index, seed)
        best = np.flatnonzero(found.depth > 0)[:: max(len(found.depth) // each, 1)]
        places.append(transform(room(seed).T_world_cam[index], _in_camera(found.uv[:, best], found.depth[best], seed)))
    return np.concatenate(places, axis=1)


def _in_camera(uv: np.ndarray, depth: np.ndarray, seed: int) -> np.ndarray:
    camera = room(seed).camera
    rays = (uv - [[camera.cx], [camera.cy]]) / [[camera.fx], [camera.fy]]
    return np.concatenate([rays, np.ones((1, uv.shape[1]))]) * depth


def tracks(index: int, seed: int = 0) -> TrackedObservations:
    """Those of `followed` that a picture shows, with a little noise; the others have weight 0."""
    camera, X_world = room(seed).camera, followed(seed)
    X_cam = to_local(room(seed).T_world_cam[index], X_world)
    z = np.where(X_cam[2] > 0.2, X_cam[2], 1.0)
    uv = X_cam[:2] / z * [[camera.fx], [camera.fy]] + [[camera.cx], [camera.cy]]
    inside = (X_cam[2] > 0.2) & (uv > 4).all(axis=0) & (uv < [[camera.width - 5], [camera.height - 5]]).all(axis=0)
    u, v = np.where(inside, uv, 0).round().astype(int)
    measured = np.asarray(arrays(index, seed).depth)[v, u]
    shown = inside & (np.abs(measured - X_cam[2]) < 0.05)
    noise = np.random.default_rng(index).normal(0, _NOISE_PX, uv.shape)
    return TrackedObservations(
        id=np.arange(X_world.shape[1]),
        uv_raw=np.where(shown, uv + noise, 0).astype(np.float32),
        X_cam=X_cam.astype(np.float32),
        weight=shown.astype(np.float32),
    )


def new_keyframe(
    number: int, index: int, before: int | None, seed: int = 0, error: np.ndarray | None = None
) -> NewKeyframe:
    """Picture `index` as keyframe `number`, which hangs on the one before, of picture `before`; `error` in its pose."""
    truth = room(seed).T_world_cam
    pose = truth[index] if before is None else between(truth[before], truth[index])
    return NewKeyframe(
        id=number,
        timestamp_ns=int(room(seed).timestamps_ns[index]),
        frame=arrays(index, seed),
        parent=NONE if before is None else number - 1,
        T_parent_keyframe=retract(pose, np.zeros(6) if error is None else error),
        submap=0,
        twist=np.zeros(6, np.float32),
        tracks=tracks(index, seed),
    )


def errors_of(seed: int, count: int) -> np.ndarray:
    """`(count, 6)` errors of relative poses as a tracker makes them: 3 mm and 2 mrad."""
    return np.random.default_rng(seed).normal(0, [0.003] * 3 + [0.002] * 3, (count, 6))


def mapped(count: int, *, noisy: bool = True) -> tuple[LocalMapping, list[Map]]:
    """Keyframes of the room taken in, and the map after each."""
    mapping, maps = LocalMapping(room().camera, sensor(), PLAN), []
    for number, error in enumerate(errors_of(3, count)):
        before = (number - 1) * STEP if number else None
        maps.append(mapping.add(new_keyframe(number, number * STEP, before, error=error if noisy and number else None)))
    return mapping, maps


def pose_errors(slam_map: Map, seed: int = 0, step: int = STEP) -> np.ndarray:
    """`(k,)` meters between where keyframes are and the truth, seen from the first."""
    truth = room(seed).T_world_cam[slam_map.ids * step]
    ours = between(slam_map.T_world_cam[:1], slam_map.T_world_cam)
    return np.linalg.norm((between(truth[:1], truth) - ours)[:, 4:], axis=1)
