"""Pictures of the synthetic room with their features and poses, for tests of matching and recognition."""

import functools
from collections.abc import Sequence

import numpy as np

from jaxslam.config.schema import TrackConfig
from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.features.orb import Features, features_of
from jaxslam.map.edit import with_keyframe
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Keyframe, Map, empty_map
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.frame_arrays import frame_arrays
from jaxslam.sensors.sensor_model import SensorModel, sensor_model

STILL = np.zeros(6)
FRAMES = 960
"""Of a whole round of the room."""


@functools.cache
def room(seed: int = 0) -> SyntheticDataset:
    return SyntheticDataset(SyntheticConfig(seed=seed, frames=FRAMES, path="loop", people=0))


@functools.cache
def picture(index: int, seed: int = 0) -> Frame:
    return room(seed)[index]


@functools.cache
def features(index: int, seed: int = 0) -> Features:
    return features_of(frame_arrays(picture(index, seed), 1 / 30), STILL, sensor(seed))


@functools.cache
def sensor(seed: int = 0) -> SensorModel:
    return sensor_model(room(seed).camera, TrackConfig())


def map_of(indices: Sequence[int], seed: int = 0) -> Map:
    """Keyframe `k` is picture `indices[k]`, at its true pose."""
    slam_map = empty_map(room(seed).camera)
    for index in indices:
        keyframe = Keyframe(slam_map.next_keyframe, int(room(seed).timestamps_ns[index]), features(index, seed), b"")
        parent = slam_map.next_keyframe - 1 if slam_map.keyframes else NONE
        slam_map = with_keyframe(slam_map, keyframe, room(seed).T_world_cam[index], parent, 0)
    return slam_map
