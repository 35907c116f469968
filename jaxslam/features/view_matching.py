"""Relative pose of two views from their features alone, wherever the two were taken."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.pose.pnp import PnpResult, ransac_pnp
from jaxslam_kernels.pose.pose_refine import PoseStatus
from jaxtyping import Array, Float64, Int64, Key

from jaxslam.features.matching import hamming_pairs, match_by_projection, match_descriptors, predicted_octave, same_turn
from jaxslam.features.orb import DEFAULT_PLAN, FeaturePlan, Features, no_features
from jaxslam.features.pose_from_matches import (
    PLACE_GATES,
    Matches,
    PoseGates,
    compile_pose_fit,
    fit_pose,
    matches_depth_sigma,
    matches_of,
    pinhole,
)
from jaxslam.geometry.se3 import to_local
from jaxslam.geometry.types import Pose
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE
from jaxslam.sensors.sensor_model import SensorModel

MIN_AGREEING = 12
"""Minimum number of matches from descriptors alone that agree on a pose."""
_MAX_MATCHES = 512
_HYPOTHESES = 256
_GATE_SIGMAS = 3.0
_GUIDED_PX = 8.0
_GUIDED_BITS = 64
_GUIDED_RATIO = 0.9


class ViewPose(NamedTuple):
    """The pose of one view relative to another.

    Attributes:
        T_source_cam: `wxyz_xyz` pose of the camera in the axes of the source.
        covariance: Covariance of the pose in the tangent space at the camera: translation (m), then rotation (rad). It
            does not include errors that the features have in common.
        inlier_share: Share of the features matched at the predicted positions that agree with the pose.
        pairs: `(2, k)` index of each inlier among the features of the source, and among those of the view.
        is_place: Whether the pose meets `PLACE_GATES` too, so that it is certain by itself.
    """

    T_source_cam: Float64[np.ndarray, "7"]
    covariance: Float64[np.ndarray, "6 6"]
    inlier_share: float
    pairs: Int64[np.ndarray, "2 k"]
    is_place: bool


def match_views(
    source: Features,
    features: Features,
    sensor: SensorModel,
    key: Key[Array, ""],
    *,
    plan: FeaturePlan = DEFAULT_PLAN,
    gates: PoseGates = PLACE_GATES,
) -> ViewPose | None:
    """Estimate the pose of a view relative to another one; `None` unless enough features agree with one.

    Features are matched by descriptor, wherever they are; RANSAC finds the pose that most of them agree with; then
    they are matched again where that pose predicts them.

    Args:
        source: Features of the other view; those with depth are used.
        features: Features of the view.
        sensor: Camera, of which ideal pixels leave the pinhole, and the error model of its depth.
        key: Random key of RANSAC.
        plan: Settings of feature extraction.
        gates: What the pose must meet.
    """
    pairs = _by_descriptor(source, features)
    if pairs.shape[1] < MIN_AGREEING:
        return None
    coarse: PnpResult = jax.device_get(
        _agreed(key, _matches(source, features, pairs, _MAX_MATCHES, sensor, plan), sensor)
    )
    if coarse.status > PoseStatus.NOT_CONVERGED:
        return None
    T_coarse = np.asarray(coarse.T_world_cam.wxyz_xyz, np.float64)
    return match_views_near(source, features, T_coarse, sensor, (_GUIDED_PX,), plan=plan, gates=gates)


def match_views_near(
    source: Features,
    features: Features,
    T_source_cam: Pose,
    sensor: SensorModel,
    radii_px: tuple[float, ...],
    *,
    plan: FeaturePlan = DEFAULT_PLAN,
    gates: PoseGates = PLACE_GATES,
) -> ViewPose | None:
    """Estimate the pose of a view relative to another one from an approximate pose; `None` unless enough agree.

    Args:
        source: Features of the other view; those with depth are used.
        features: Features of the view.
        T_source_cam: `(7,)` approximate pose of the camera in the axes of the source.
        sensor: Camera, of which ideal pixels leave the pinhole, and the error model of its depth.
        radii_px: Search radius of each pass around the predicted pixels at octave 0.
        plan: Settings of feature extraction.
        gates: What the pose must meet in each pass.
    """
    found = None
    for radius_px in radii_px:
        pairs = _where_expected(source, features, T_source_cam, sensor, plan, radius_px)
        matches = _matches(source, features, pairs, plan.num_features, sensor, plan)
        fit = fit_pose(T_source_cam, matches, sensor, gates)
        if fit is None:
            return None
        T_source_cam = fit.T_origin_cam
        found = ViewPose(T_source_cam, fit.covariance, fit.share, pairs[:, fit.agree], fit.meets(PLACE_GATES))
    return found


def pixels_apart(source: Features, first: Pose, second: Pose, sensor: SensorModel) -> float:
    """Return how far apart two motions take the features of a view, median of pixels; infinite without depth.

    Args:
        source: Features of the view; those with depth count, as far as they stay in front of the camera.
        first: `(7,)` pose of the camera after a motion, in the axes of the view.
        second: The same after another one.
        sensor: Camera, of which ideal pixels leave the pinhole.
    """
    X_source = _in_camera(source, sensor)[:, source.depth > 0]
    X_first, X_second = (to_local(motion, X_source) for motion in (first, second))
    in_front = (X_first[2] > 0) & (X_second[2] > 0)
    if not in_front.any():
        return np.inf
    focal, _ = pinhole(sensor)
    slopes = [X[:2, in_front] / X[2, in_front] for X in (X_first, X_second)]
    return float(np.median(np.linalg.norm((slopes[0] - slopes[1]) * focal, axis=0)))


def _by_descriptor(source: Features, features: Features) -> Int64[np.ndarray, "2 k"]:
    """Match features by descriptor, most similar first, where that of the source has depth."""
    pairs = match_descriptors(source, features)
    pairs = pairs[:, source.depth[pairs[0]] > 0]
    distance = hamming_pairs(source.descriptor[pairs[0]], features.descriptor[pairs[1]])
    return pairs[:, np.argsort(distance, kind="stable")[:_MAX_MATCHES]]


def _where_expected(
    source: Features,
    features: Features,
    T_source_cam: Pose,
    sensor: SensorModel,
    plan: FeaturePlan,
    radius_px: float,
) -> Int64[np.ndarray, "2 k"]:
    """Match features near the pixels at which a pose predicts those of the source."""
    known = np.flatnonzero(source.depth > 0)
    X_cam = to_local(T_source_cam, _in_camera(source, sensor)[:, known])
    in_front = X_cam[2] > float(sensor.min_depth_m)
    known, X_cam = known[in_front], X_cam[:, in_front]
    focal, center = pinhole(sensor)
    pairs = match_by_projection(
        X_cam[:2] / X_cam[2] * focal + center,
        predicted_octave(source.octave[known], source.depth[known], X_cam[2], plan),
        source.descriptor[known],
        features,
        radius_px=radius_px,
        max_distance=_GUIDED_BITS,
        ratio=_GUIDED_RATIO,
        plan=plan,
    )
    pairs[0] = known[pairs[0]]
    return pairs[:, same_turn(features.angle[pairs[1]] - source.angle[pairs[0]])]


def _in_camera(features: Features, sensor: SensorModel) -> Float64[np.ndarray, "3 n"]:
    """Back-project features into camera axes; those without depth are put at the camera center."""
    focal, center = pinhole(sensor)
    return np.concatenate([(features.uv - center) / focal, np.ones((1, len(features.depth)))]) * features.depth


def _matches(
    source: Features, features: Features, pairs: np.ndarray, capacity: int, sensor: SensorModel, plan: FeaturePlan
) -> Matches:
    then, now = pairs
    X = _in_camera(source, sensor)[:, then]
    return matches_of(X, source.depth[then], features, now, plan, capacity=capacity)


@compiled(when="warm-up", options=FAST_COMPILE)
def _agreed(key: Key[Array, ""], matches: Matches, sensor: SensorModel) -> PnpResult:
    return ransac_pnp(
        key,
        matches.X,
        matches.uv,
        without_distortion(sensor.intrinsics),
        weights=matches.weight,
        depth=matches.depth,
        threshold_px=_GATE_SIGMAS * matches.sigma_px,
        threshold_depth=_GATE_SIGMAS * matches_depth_sigma(matches, sensor),
        min_inliers=MIN_AGREEING,
        num_hypotheses=_HYPOTHESES,
    )


def compile_view_matching(sensor: SensorModel, plan: FeaturePlan = DEFAULT_PLAN) -> None:
    """Compile everything that `match_views` needs, so that nothing is compiled while frames arrive."""
    nothing: Any = np.zeros((2, 0), np.int64)
    empty = no_features()
    key = jax.random.fold_in(jax.random.key(0), 0)
    jax.block_until_ready(_agreed(key, _matches(empty, empty, nothing, _MAX_MATCHES, sensor, plan), sensor))
    compile_pose_fit(sensor, plan)
