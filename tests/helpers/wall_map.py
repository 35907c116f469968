"""A wall of points in keyframes that show it from here and there, for tests of which of them are wanted."""

import numpy as np
from small_map import CAMERA, features, observations, png

from jaxslam.geometry.so3 import axis_rotation
from jaxslam.map.edit import with_keyframe, with_observations, with_points
from jaxslam.map.point_records import NONE, MapPoints
from jaxslam.map.types import Keyframe, Map, empty_map

POINTS = 100


def at(x: float = 0.0, z: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """A pose that was moved to the right and ahead, and then turned about the vertical."""
    return np.concatenate([axis_rotation(1, np.array(turn)), [x, 0, z]])


def seen_from(poses: list[np.ndarray], shown: list[int], submaps: list[int] | None = None) -> Map:
    """Make a map of a wall two meters ahead of the origin whose keyframes each show a number of its points.

    Every second point is tracked by optical flow.
    """
    rng = np.random.default_rng(0)
    made = empty_map(CAMERA)
    submaps = [0] * len(poses) if submaps is None else submaps
    for number, (pose, submap) in enumerate(zip(poses, submaps, strict=True)):
        first = submap not in made.submap
        parent = NONE if first else int(made.ids[made.submap == submap][0])
        made = with_keyframe(made, Keyframe(number, number, features(rng, POINTS), png(number)), pose, parent, submap)
    for submap in sorted(set(submaps)):
        ids = made.next_point + np.arange(POINTS)
        maker = int(made.ids[made.submap == submap][0])
        X = np.concatenate([rng.uniform(-0.5, 0.5, (2, POINTS)), np.full((1, POINTS), 2.0)])
        whole = np.ones(POINTS, np.float32)
        none, no_descriptor = np.zeros(POINTS, bool), np.zeros((POINTS, 32), np.uint8)
        reference_keyframe, static = np.full(POINTS, maker, np.int64), np.zeros(POINTS, np.int8)
        made = with_points(made, MapPoints(ids, X, whole, no_descriptor, none, reference_keyframe, static))
        for number in np.flatnonzero(np.array(submaps) == submap):
            some = ids[: shown[number]]
            by_feature = np.where(np.arange(len(some)) % 2, NONE, np.arange(len(some)))
            seen = observations(made, np.full(len(some), number), some, by_feature, rng)
            by_flow = np.where(by_feature == NONE, np.float32(0.3), np.float32(1.0))
            made = with_observations(made, seen._replace(sigma_px=by_flow))
    return made


BEHIND = at(z=4.0, turn=np.pi)
