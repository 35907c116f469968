"""The pose of a frame from the points of the map around it, found by their descriptors: where flow is weak or lost.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III, "tracking against the local map".
"""

import numpy as np

from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.features.pose_from_matches import FeaturePose, fit_pose, matches_of
from jaxslam.geometry.se3 import angle, between, compose, to_local
from jaxslam.map.types import Map, covisible, rows
from jaxslam.mapping.map_point_matching import described_points_in, find_points
from jaxslam.mapping.occlusion_states import PointStates
from jaxslam.tracking.state import TrackParams

LOCAL_KEYFRAMES = 15
"""Keyframes, those that share most with one, whose points are the local map."""
_IN_VIEW = 5
"""Further keyframes: those that show most of what is in view, however long ago they were made."""
_NEAR_M, _NEAR_RAD = 0.15, 0.15
"""How far from where it was thought to be the camera is found at most."""
_MIN_INLIERS, _MIN_CELLS = 15, 4
"""Fewest points that agree, and cells of the image they lie in. Where a place is recognized it takes more, for things
that are there twice; here it is known where the camera is, and a person may leave little of the view."""
_RADII_PX = (15.0, 5.0)
"""How far from where the pose puts a point it is sought, at octave 0: first and once the pose is better known."""

_MIN_POINTS = 60
"""Fewest of its points in view for which a keyframe shows what is in view."""
_MAX_TURN = 0.7
"""Cosine of the largest angle between the directions from which a point is seen, then and now."""
_SCALES = (0.5, 2.0)
"""Bounds on how much nearer or farther a point was."""
_MARGIN_PX = 8


def local_keyframes(slam_map: Map, keyframe_id: int) -> np.ndarray:
    """Ids of a keyframe and of those that share most points with it."""
    near, _ = covisible(slam_map, keyframe_id, at_least=1)
    return np.append(np.int64(keyframe_id), near[:LOCAL_KEYFRAMES])


def keyframes_in_view(
    slam_map: Map, T_world_cam: np.ndarray, submap: int, exclude: set[int], at_most: int
) -> list[int]:
    """The keyframes that show most of what is in view, those with most points first.

    Args:
        slam_map: The map.
        T_world_cam: `(7,)` pose of the camera.
        submap: Number of the submap it is in.
        exclude: Keyframes not to name.
        at_most: How many.
    """
    camera = slam_map.camera
    X = to_local(T_world_cam, slam_map.points.X_world)
    z = np.where(X[2] > 0.1, X[2], np.inf)
    uv = np.stack([camera.fx * X[0] / z + camera.cx, camera.fy * X[1] / z + camera.cy])
    size = np.array([[camera.width], [camera.height]])
    inside = (X[2] > 0.1) & ((uv > _MARGIN_PX) & (uv < size - _MARGIN_PX)).all(axis=0)
    row, at = rows(slam_map.points.ids, slam_map.observations.point), rows(slam_map.ids, slam_map.observations.keyframe)
    shown = np.flatnonzero(inside[row] & (slam_map.submap[at] == submap))
    now = slam_map.points.X_world[:, row[shown]] - T_world_cam[4:, None]
    then = slam_map.points.X_world[:, row[shown]] - slam_map.T_world_cam[at[shown], 4:].T
    near, far = np.linalg.norm(now, axis=0), np.linalg.norm(then, axis=0)
    alike = (now * then).sum(axis=0) > _MAX_TURN * near * far
    alike &= (far > _SCALES[0] * near) & (far < _SCALES[1] * near)
    counts = np.bincount(at[shown[alike]], minlength=len(slam_map.ids))
    counts[np.isin(slam_map.ids, list(exclude))] = 0
    order = np.lexsort((slam_map.ids, -counts))[:at_most]
    return [int(slam_map.ids[index]) for index in order if counts[index] >= _MIN_POINTS]


def match_local_map(
    slam_map: Map,
    keyframe_id: int,
    T_keyframe_cam: np.ndarray,
    features: Features,
    params: TrackParams,
    plan: FeaturePlan,
    states: PointStates | None = None,
) -> FeaturePose | None:
    """Where a frame was taken, from the points of the local map that are found in it; `None` if that is not certain.

    Args:
        slam_map: The map.
        keyframe_id: A keyframe in it, near which the frame was taken.
        T_keyframe_cam: `(7,)` about where, in its axes.
        features: Of the frame.
        params: Camera, and the errors of its depth.
        plan: How features were found.
        states: By which points that are OCCLUDED count more.

    Returns:
        The pose in the axes of the keyframe.
    """
    origin, found, T_first = slam_map.pose(keyframe_id), None, T_keyframe_cam
    near, at = local_keyframes(slam_map, keyframe_id), compose(origin, T_keyframe_cam)
    submap = int(slam_map.submap[slam_map.row(keyframe_id)])
    in_view = keyframes_in_view(slam_map, at, submap, set(near.tolist()), _IN_VIEW)
    points = described_points_in(slam_map, np.append(near, np.array(in_view, np.int64)))
    weight = slam_map.points.weight[rows(slam_map.points.ids, points.ids)]
    for radius_px in _RADII_PX:
        expected = compose(origin, T_keyframe_cam)
        index, feature = find_points(slam_map, points, features, expected, plan, radius_px=radius_px)
        X, better_known = to_local(origin, points.X_world[:, index]), np.zeros(len(index))
        counts = weight[index]
        if states is not None:
            counts = counts * states.weights(slam_map, points.ids[index])
        matches = matches_of(X, better_known, features, feature, plan, weight=counts)
        found = fit_pose(T_keyframe_cam, matches, params, min_inliers=_MIN_INLIERS, min_cells=_MIN_CELLS)
        if found is None or not _near(found.T_origin_cam, T_first):
            return None
        T_keyframe_cam = found.T_origin_cam
    return found


def _near(T_a: np.ndarray, T_b: np.ndarray) -> bool:
    apart = between(T_a, T_b)
    return bool(np.linalg.norm(apart[4:]) < _NEAR_M and angle(apart) < _NEAR_RAD)
