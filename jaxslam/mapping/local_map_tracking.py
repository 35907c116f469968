"""Localize a frame against the local map by matching descriptors, where optical flow is weak or lost.

Source: Mur-Artal and Tardos, "ORB-SLAM2", 2017, section III, "tracking against the local map".
"""

from collections.abc import Set

import numpy as np

from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.features.pose_from_matches import FeaturePose, PoseGates, fit_pose, matches_of
from jaxslam.geometry.se3 import angle, between, compose, displacement, retract, to_local
from jaxslam.geometry.types import Ids, Pose
from jaxslam.map.point_records import has, observations_at, rows
from jaxslam.map.types import Map, covisible
from jaxslam.mapping.map_point_matching import described_points_in, find_points
from jaxslam.mapping.occlusion_states import PointStates
from jaxslam.mapping.view_coverage import in_view, seen_alike
from jaxslam.sensors.sensor_model import SensorModel

LOCAL_KEYFRAMES = 15
"""Number of most covisible keyframes whose points form the local map."""
_IN_VIEW = 5
"""Number of further keyframes that show most of what is in view, whatever their age."""
_NEAR_REACH, _NEAR_RAD = 1 / 40, 0.15
"""Maximum distance of the result from the approximate pose, as a share of the largest valid depth, and in radians.
15 cm for a sensor that measures up to 6 m."""
_GATES = PoseGates(min_inliers=15, min_cells=2, max_sigma=np.inf)
"""Place recognition needs more, because an object may exist twice; here the camera pose is known approximately, and a
person may leave little of the view. In Bonn's `crowd`, 15 of 15 points agree in two cells beside someone: alone they
tell a position to 0.28 m."""
RADII_PX = (15.0, 5.0)
"""Search radii around the predicted pixels at octave 0: the first one, and the one once the pose is better known."""
WIDE_RADII_PX = (45.0, *RADII_PX)
"""The same where the motion model may be violated: a camera that is shaken changes its velocity within a frame."""

_NEAREST = 64
"""Number of keyframes, the nearest ones, whose points are looked at: the cost does not grow with the map."""
_MIN_POINTS = 60
"""Minimum number of its points in view for a keyframe to be used."""


def local_keyframes(slam_map: Map, keyframe_id: int) -> Ids:
    """Return the ids of a keyframe and of those most covisible with it."""
    near, _ = covisible(slam_map, keyframe_id, at_least=1)
    return np.append(np.int64(keyframe_id), near[:LOCAL_KEYFRAMES])


def nearest_keyframes(slam_map: Map, T_world_cam: Pose, submap: int, exclude: Set[int] = frozenset()) -> Ids:
    """Return the ids of the keyframes nearest to a camera, at most 64, in order.

    Args:
        slam_map: The map.
        T_world_cam: `(7,)` pose of the camera.
        submap: Number of the submap the camera is in.
        exclude: Ids of keyframes to leave out.
    """
    others = np.flatnonzero((slam_map.submap == submap) & ~np.isin(slam_map.ids, list(exclude)))
    apart = np.linalg.norm(slam_map.T_world_cam[others, 4:] - T_world_cam[4:], axis=1)
    return slam_map.ids[np.sort(others[np.argsort(apart, kind="stable")[:_NEAREST]])]


def keyframes_in_view(slam_map: Map, T_world_cam: Pose, submap: int, exclude: Set[int], at_most: int) -> list[int]:
    """Return the keyframes that observe the most points in view, best first.

    Args:
        slam_map: The map.
        T_world_cam: `(7,)` pose of the camera.
        submap: Number of the submap the camera is in.
        exclude: Ids of keyframes to leave out.
        at_most: Maximum number of keyframes.
    """
    near = nearest_keyframes(slam_map, T_world_cam, submap, exclude)
    slam_map = slam_map.around(near)
    of_near = has(near, slam_map.observations.keyframe)
    seen = observations_at(slam_map.observations, np.flatnonzero(of_near))
    X_world = slam_map.points.X_world[:, rows(slam_map.points.ids, seen.point)]
    at, positions = rows(near, seen.keyframe), slam_map.T_world_cam[rows(slam_map.ids, near), 4:].T
    shown = in_view(slam_map.camera, T_world_cam, X_world)
    shown &= seen_alike(X_world, positions[:, at], T_world_cam[4:, None])
    counts = np.bincount(at[shown], minlength=len(near))
    order = np.lexsort((near, -counts))[:at_most]
    return [int(near[index]) for index in order if counts[index] >= _MIN_POINTS]


def match_local_map(
    slam_map: Map,
    keyframe_id: int,
    T_keyframe_cam: Pose,
    features: Features,
    sensor: SensorModel,
    plan: FeaturePlan,
    states: PointStates | None = None,
    radii_px: tuple[float, ...] = RADII_PX,
) -> FeaturePose | None:
    """Localize a frame against the local map from an approximate pose; `None` if too few points agree.

    Args:
        slam_map: The map.
        keyframe_id: Id of a keyframe near the camera.
        T_keyframe_cam: `(7,)` approximate pose of the camera in the axes of the keyframe.
        features: Features of the frame.
        sensor: Camera, and the error model of its depth.
        plan: Settings of feature extraction.
        states: Current point states, by which OCCLUDED points get more weight.
        radii_px: Search radius of each pass around the predicted pixels at octave 0.

    Returns:
        The pose in the axes of the keyframe, combined with the approximate one.
    """
    origin, found, T_first = slam_map.pose(keyframe_id), None, T_keyframe_cam
    near_m = _NEAR_REACH * float(sensor.max_depth_m)
    near, at = local_keyframes(slam_map, keyframe_id), compose(origin, T_keyframe_cam)
    submap = int(slam_map.submap[slam_map.row(keyframe_id)])
    in_view = keyframes_in_view(slam_map, at, submap, set(near.tolist()), _IN_VIEW)
    local = np.append(near, np.array(in_view, np.int64))
    slam_map = slam_map.around(local)
    points = described_points_in(slam_map, local, plan)
    weight = slam_map.points.weight[rows(slam_map.points.ids, points.ids)]
    for radius_px in radii_px:
        expected = compose(origin, T_keyframe_cam)
        index, feature = find_points(slam_map, points, features, expected, plan, radius_px=radius_px)
        X, better_known = to_local(origin, points.X_world[:, index]), np.zeros(len(index))
        counts = weight[index]
        if states is not None:
            counts = counts * states.weights(slam_map, points.ids[index])
        matches = matches_of(X, better_known, features, feature, plan, weight=counts)
        found = fit_pose(T_keyframe_cam, matches, sensor, _GATES)
        if found is None:
            return None
        found = _with_prior(found, T_first, near_m)
        T_keyframe_cam = found.T_origin_cam
        apart = between(T_keyframe_cam, T_first)
        if np.linalg.norm(apart[4:]) >= near_m or angle(apart) >= _NEAR_RAD:
            return None
    return found


def _with_prior(found: FeaturePose, T_prior: Pose, near_m: float) -> FeaturePose:
    """Combine a pose with the approximate one that it was looked for at: few matches leave some directions open.

    Three standard deviations of the approximate pose are the farthest that the result may be off.
    """
    information = np.linalg.inv(found.covariance)
    prior = np.diag(np.repeat([near_m / 3, _NEAR_RAD / 3], 3) ** -2.0)
    both = information + prior
    step = np.linalg.solve(both, prior @ displacement(found.T_origin_cam, T_prior))
    return found._replace(T_origin_cam=retract(found.T_origin_cam, step), covariance=np.linalg.inv(both))
