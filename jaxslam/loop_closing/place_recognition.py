"""Place recognition: estimate the camera pose of an image relative to a keyframe that shows the same place."""

from collections.abc import Set
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.pose.pnp import PnpResult, ransac_pnp
from jaxslam_kernels.pose.pose_refine import PoseStatus
from jaxtyping import Array, Float64, Int64, Key

from jaxslam.features.matching import hamming_pairs, match_by_projection, match_descriptors, predicted_octave, same_turn
from jaxslam.features.orb import DEFAULT_PLAN, FeaturePlan, Features, no_features
from jaxslam.features.pose_from_matches import Matches, fit_pose, matches_depth_sigma, matches_of, pinhole
from jaxslam.geometry.se3 import IDENTITY, to_local
from jaxslam.geometry.types import Pose
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.map.point_records import has
from jaxslam.map.types import Keyframe, Map
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


class Recognition(NamedTuple):
    """A recognized place.

    Attributes:
        keyframe: Id of the recognized keyframe.
        T_keyframe_cam: `wxyz_xyz` pose of the camera in the axes of the keyframe.
        covariance: Covariance of the pose in the tangent space at the camera: translation (m), then rotation (rad). It
            does not include errors that the features have in common.
        num_inliers: Number of features that agree with the pose.
        inlier_share: Their share of the features matched at the predicted positions.
        pairs: `(2, k)` index of each inlier among the features of the keyframe, and among those of the image.
    """

    keyframe: int
    T_keyframe_cam: Float64[np.ndarray, "7"]
    covariance: Float64[np.ndarray, "6 6"]
    num_inliers: int
    inlier_share: float
    pairs: Int64[np.ndarray, "2 k"]


def recognize(
    slam_map: Map,
    index: PlaceIndex,
    features: Features,
    sensor: SensorModel,
    *,
    exclude: Set[int] = frozenset(),
    limit: int = 5,
    seed: int = 0,
    plan: FeaturePlan = DEFAULT_PLAN,
) -> Recognition | None:
    """Estimate the pose of an image relative to a keyframe of the same place; `None` unless it is certain.

    A wrong place is worse than none: enough features, spread over the image, must agree with one pose.

    Args:
        slam_map: Map that holds the keyframes. Indexed keyframes that are not in it are skipped.
        index: Place index of its keyframes.
        features: Features of the image.
        sensor: Camera, of which ideal pixels leave the pinhole, and the error model of its depth.
        exclude: Ids of keyframes that must not be recognized, such as the latest ones.
        limit: Maximum number of keyframes to verify, the most similar first.
        seed: Seed of the random choices.
        plan: Settings of feature extraction.
    """
    for keyframe_id, _ in index.query(features, exclude, limit):
        if has(slam_map.ids, np.array([keyframe_id]))[0]:
            found = verify(slam_map.keyframe(keyframe_id), features, sensor, seed=seed, plan=plan)
            if found is not None:
                return found
    return None


def verify(
    keyframe: Keyframe, features: Features, sensor: SensorModel, *, seed: int = 0, plan: FeaturePlan = DEFAULT_PLAN
) -> Recognition | None:
    """Estimate the pose of an image relative to one keyframe, if it certainly shows the same place; see `recognize`."""
    source = keyframe.features
    pairs = _by_descriptor(source, features)
    if pairs.shape[1] < MIN_AGREEING:
        return None
    key = jax.random.fold_in(jax.random.key(seed), keyframe.id)
    coarse: PnpResult = jax.device_get(
        _agreed(key, _matches(source, features, pairs, _MAX_MATCHES, sensor, plan), sensor)
    )
    if coarse.status > PoseStatus.NOT_CONVERGED:
        return None
    T_coarse = np.asarray(coarse.T_world_cam.wxyz_xyz, np.float64)
    pairs = _where_expected(source, features, T_coarse, sensor, plan)
    fit = fit_pose(T_coarse, _matches(source, features, pairs, plan.num_features, sensor, plan), sensor)
    if fit is None:
        return None
    return Recognition(keyframe.id, fit.T_origin_cam, fit.covariance, len(fit.agree), fit.share, pairs[:, fit.agree])


def _by_descriptor(source: Features, features: Features) -> Int64[np.ndarray, "2 k"]:
    """Match features by descriptor, most similar first, where the keyframe's feature has depth."""
    pairs = match_descriptors(source, features)
    pairs = pairs[:, source.depth[pairs[0]] > 0]
    distance = hamming_pairs(source.descriptor[pairs[0]], features.descriptor[pairs[1]])
    return pairs[:, np.argsort(distance, kind="stable")[:_MAX_MATCHES]]


def _where_expected(
    source: Features, features: Features, T_keyframe_cam: Pose, sensor: SensorModel, plan: FeaturePlan
) -> Int64[np.ndarray, "2 k"]:
    """Match features near the pixels at which a pose predicts those of the keyframe."""
    known = np.flatnonzero(source.depth > 0)
    X_cam = to_local(T_keyframe_cam, _in_camera(source, sensor)[:, known])
    in_front = X_cam[2] > float(sensor.min_depth_m)
    known, X_cam = known[in_front], X_cam[:, in_front]
    focal, center = pinhole(sensor)
    pairs = match_by_projection(
        X_cam[:2] / X_cam[2] * focal + center,
        predicted_octave(source.octave[known], source.depth[known], X_cam[2], plan),
        source.descriptor[known],
        features,
        radius_px=_GUIDED_PX,
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


def compile_recognition(sensor: SensorModel, plan: FeaturePlan = DEFAULT_PLAN) -> None:
    """Compile everything that `recognize` needs, so that nothing is compiled while frames arrive."""
    nothing: Any = np.zeros((2, 0), np.int64)
    empty = no_features()
    key = jax.random.fold_in(jax.random.key(0), 0)
    jax.block_until_ready(_agreed(key, _matches(empty, empty, nothing, _MAX_MATCHES, sensor, plan), sensor))
    fit_pose(IDENTITY, _matches(empty, empty, nothing, plan.num_features, sensor, plan), sensor)
