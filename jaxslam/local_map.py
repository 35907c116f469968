"""The pose of a frame from the points of the map around it, found by their descriptors: where flow is weak or lost.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III, "tracking against the local map".
"""

import numpy as np

from jaxslam.feature_pose import FeaturePose, fit_pose, matches_of
from jaxslam.features import FeaturePlan, Features
from jaxslam.map import Map, covisible, rows
from jaxslam.map_matching import find_points, recognisable_in
from jaxslam.pose import compose, to_local
from jaxslam.state import TrackParams

LOCAL_KEYFRAMES = 15
"""Keyframes, those that share most with one, whose points are the local map."""
_RADII_PX = (15.0, 5.0)
"""How far from where the pose puts a point it is sought, at octave 0: first and once the pose is better known."""


def local_keyframes(map: Map, keyframe_id: int) -> np.ndarray:
    """Ids of a keyframe and of those that share most points with it."""
    near, _ = covisible(map, keyframe_id, at_least=1)
    return np.append(np.int64(keyframe_id), near[:LOCAL_KEYFRAMES])


def match_local_map(
    map: Map, keyframe_id: int, T_keyframe_cam: np.ndarray, features: Features, params: TrackParams, plan: FeaturePlan
) -> FeaturePose | None:
    """Where a frame was taken, from the points of the local map that are found in it; `None` if that is not certain.

    Args:
        map: The map.
        keyframe_id: A keyframe in it, near which the frame was taken.
        T_keyframe_cam: `(7,)` about where, in its axes.
        features: Of the frame.
        params: Camera, and the errors of its depth.
        plan: How features were found.

    Returns:
        The pose in the axes of the keyframe.
    """
    origin, found = map.pose(keyframe_id), None
    points = recognisable_in(map, local_keyframes(map, keyframe_id))
    weight = map.points.weight[rows(map.points.ids, points.ids)]
    for radius_px in _RADII_PX:
        expected = compose(origin, T_keyframe_cam)
        index, feature = find_points(map, points, features, expected, plan, radius_px=radius_px)
        X, better_known = to_local(origin, points.X_world[:, index]), np.zeros(len(index))
        matches = matches_of(X, better_known, features, feature, plan, weight=weight[index])
        found = fit_pose(T_keyframe_cam, matches, params)
        if found is None:
            return None
        T_keyframe_cam = found.T_origin_cam
    return found
