"""Recognising a place: where an image was taken, relative to a keyframe that shows the same place."""

from collections.abc import Set
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import without_distortion
from jaxslam_kernels.pnp import PnpResult, ransac_pnp
from jaxslam_kernels.pose_refine import PoseRefinement, PoseStatus, refine_pose
from jaxslam_kernels.types import Pixels, Points, Weights
from jaxtyping import Array, Float64, Int64, Key

from jaxslam.features import DEFAULT_PLAN, FeaturePlan, Features, no_features
from jaxslam.map import Keyframe, Map, has
from jaxslam.matching import hamming_pairs, match_by_projection, match_descriptors, predicted_octave, same_turn
from jaxslam.observe import depth_sigma
from jaxslam.padding import padded
from jaxslam.place_index import PlaceIndex
from jaxslam.pose import to_local
from jaxslam.state import TrackParams

MIN_AGREEING = 12
"""Fewest matches of descriptors alone that agree on a pose."""
MIN_INLIERS = 30
"""Fewest features that agree in the end."""
MIN_SHARE = 0.5
"""Their least share of the features that were matched where the pose puts them."""
MIN_CELLS = 12
"""Fewest cells of the image they must lie in. With 8, one of 900 pairs of images of one room came out 0.5 m wrong:
what is seen in a small part of the image may be a thing that is there twice."""
_CELL = 0.15
"""Side of such a cell in focal lengths, 9 degrees: 48 of them in an image of 640 x 480 pixels and 525 focal length."""
MAX_SIGMA_M = 0.03
"""Largest standard deviation of the position in any direction, metres."""
_MOST_MATCHES = 512
_HYPOTHESES = 256
_SIGMA_PX = 1.0
"""Standard deviation of a feature of octave 0, each coordinate."""
_GATE_SIGMAS = 3.0
_CHI2_GATES = (9.21, 11.34)
"""99 % quantiles of chi squared with two degrees of freedom and, where depth was measured, three."""
_GUIDED_PX = 8.0
_GUIDED_BITS = 64
_GUIDED_RATIO = 0.9


class _Seen(NamedTuple):
    """Points of a keyframe, in its axes, found in an image; padded with weight 0 to a fixed size."""

    X: Points
    depth_then: Weights
    uv: Pixels
    depth: Weights
    scale: Weights
    weight: Weights


class Recognition(NamedTuple):
    """A place recognised.

    Attributes:
        keyframe: Id of the keyframe it was recognised in.
        T_keyframe_cam: `wxyz_xyz`, the pose of the camera in the axes of the keyframe.
        covariance: Of the pose in the tangent space at the camera: translation (m), then rotation (rad). Errors that
            features have in common are not in it.
        num_inliers: Features that agree with the pose.
        inlier_share: Their share of the features matched where the pose puts them.
        pairs: Index of each of them among the features of the keyframe, and among those of the image.
    """

    keyframe: int
    T_keyframe_cam: Float64[np.ndarray, "7"]
    covariance: Float64[np.ndarray, "6 6"]
    num_inliers: int
    inlier_share: float
    pairs: Int64[np.ndarray, "2 k"]


def recognise(
    map: Map,
    index: PlaceIndex,
    features: Features,
    params: TrackParams,
    *,
    exclude: Set[int] = frozenset(),
    limit: int = 5,
    seed: int = 0,
    plan: FeaturePlan = DEFAULT_PLAN,
) -> Recognition | None:
    """Where an image was taken, relative to a keyframe that shows the same place; `None` if that is not certain.

    A wrong place is worse than none: enough features, spread over the image, must agree with one pose.

    Args:
        map: Holds the keyframes. Those of the index that are not in it are passed over.
        index: Of its keyframes.
        features: Of the image.
        params: Camera, of which ideal pixels leave the pinhole, and the errors of its depth.
        exclude: Keyframes not to be recognised, such as the latest ones.
        limit: Most keyframes looked at, the most alike first.
        seed: Of random choices.
        plan: How features were found.
    """
    for keyframe_id, _ in index.query(features, exclude, limit):
        if has(map.ids, np.array([keyframe_id]))[0]:
            found = verify(map.keyframe(keyframe_id), features, params, seed=seed, plan=plan)
            if found is not None:
                return found
    return None


def verify(
    keyframe: Keyframe, features: Features, params: TrackParams, *, seed: int = 0, plan: FeaturePlan = DEFAULT_PLAN
) -> Recognition | None:
    """Where an image was taken, relative to one keyframe, if it certainly shows the same place; as in `recognise`."""
    source = keyframe.features
    pairs = _by_descriptor(source, features)
    if pairs.shape[1] < MIN_AGREEING:
        return None
    key = jax.random.fold_in(jax.random.key(seed), keyframe.id)
    coarse: PnpResult = jax.device_get(
        _agreed(key, _seen(source, features, pairs, _MOST_MATCHES, params, plan), params)
    )
    if coarse.status > PoseStatus.NOT_CONVERGED:
        return None
    pairs = _where_expected(source, features, np.asarray(coarse.T_world_cam.wxyz_xyz, np.float64), params, plan)
    seen = _seen(source, features, pairs, plan.num_features, params, plan)
    refined: PoseRefinement = jax.device_get(_refined(coarse.T_world_cam, seen, params))
    agree = _agree(refined, seen)[: pairs.shape[1]]
    return _accepted(keyframe.id, refined, pairs[:, agree], agree.mean() if len(agree) else 0.0, features, params)


def _by_descriptor(source: Features, features: Features) -> Int64[np.ndarray, "2 k"]:
    """The matches that are most alike, of features whose place in the keyframe is known."""
    pairs = match_descriptors(source, features)
    pairs = pairs[:, source.depth[pairs[0]] > 0]
    distance = hamming_pairs(source.descriptor[pairs[0]], features.descriptor[pairs[1]])
    return pairs[:, np.argsort(distance, kind="stable")[:_MOST_MATCHES]]


def _where_expected(
    source: Features, features: Features, T_keyframe_cam: np.ndarray, params: TrackParams, plan: FeaturePlan
) -> Int64[np.ndarray, "2 k"]:
    """Matches near where a pose puts the features of the keyframe."""
    known = np.flatnonzero(source.depth > 0)
    X_cam = to_local(T_keyframe_cam, _in_camera(source, params)[:, known])
    in_front = X_cam[2] > float(params.min_depth_m)
    known, X_cam = known[in_front], X_cam[:, in_front]
    focal, centre = _pinhole(params)
    pairs = match_by_projection(
        X_cam[:2] / X_cam[2] * focal + centre,
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


def _accepted(
    keyframe_id: int,
    refined: PoseRefinement,
    pairs: np.ndarray,
    share: float,
    features: Features,
    params: TrackParams,
) -> Recognition | None:
    num_inliers = pairs.shape[1]
    if refined.status != PoseStatus.OK or num_inliers < MIN_INLIERS or share < MIN_SHARE:
        return None
    T_keyframe_cam = np.asarray(refined.T_world_cam.wxyz_xyz, np.float64)
    T_keyframe_cam[:4] /= np.linalg.norm(T_keyframe_cam[:4])
    # Residuals larger than expected make the pose less certain, smaller ones no more certain.
    covariance = np.asarray(refined.covariance, np.float64) * max(float(refined.residual_scale), 1.0) ** 2
    covariance = 0.5 * (covariance + covariance.T)
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    if _cells(features.uv[:, pairs[1]], params) < MIN_CELLS or sigma_m > MAX_SIGMA_M:
        return None
    return Recognition(keyframe_id, T_keyframe_cam, covariance, num_inliers, float(share), pairs)


def _cells(uv: np.ndarray, params: TrackParams) -> int:
    """How many cells of the image hold one of the pixels."""
    focal, centre = _pinhole(params)
    return np.unique(np.floor((uv - centre) / (_CELL * focal)), axis=1).shape[1]


def _agree(refined: PoseRefinement, seen: _Seen) -> np.ndarray:
    gate = np.where(np.asarray(seen.depth) > 0, _CHI2_GATES[1], _CHI2_GATES[0])
    return (np.asarray(refined.chi2) < gate) & (np.asarray(seen.weight) > 0)


def _pinhole(params: TrackParams) -> tuple[np.ndarray, np.ndarray]:
    """Focal length and principal point, `(2, 1)` each."""
    fx, fy, cx, cy = (float(value) for value in params.intrinsics[:4])
    return np.array([[fx], [fy]]), np.array([[cx], [cy]])


def _in_camera(features: Features, params: TrackParams) -> Float64[np.ndarray, "3 n"]:
    """Where features are in the axes of their camera; at its centre without depth."""
    focal, centre = _pinhole(params)
    return np.concatenate([(features.uv - centre) / focal, np.ones((1, len(features.depth)))]) * features.depth


def _seen(
    source: Features, features: Features, pairs: np.ndarray, capacity: int, params: TrackParams, plan: FeaturePlan
) -> _Seen:
    then, now = pairs
    columns = (
        _in_camera(source, params)[:, then],
        source.depth[then],
        features.uv[:, now],
        features.depth[now],
        plan.scale(features.octave[now]),
        np.ones(len(now)),
    )
    filled: Any = (padded(column.astype(np.float32), capacity, axis=-1) for column in columns)
    return _Seen(*filled)


@jax.jit
def _agreed(key: Key[Array, ""], seen: _Seen, params: TrackParams) -> PnpResult:
    return ransac_pnp(
        key,
        seen.X,
        seen.uv,
        without_distortion(params.intrinsics),
        weights=seen.weight,
        depth=seen.depth,
        threshold_px=_GATE_SIGMAS * _SIGMA_PX * seen.scale,
        threshold_depth=_GATE_SIGMAS * _depth_sigma(seen, params),
        min_inliers=MIN_AGREEING,
        num_hypotheses=_HYPOTHESES,
    )


@jax.jit
def _refined(T_keyframe_cam: SE3, seen: _Seen, params: TrackParams) -> PoseRefinement:
    return refine_pose(
        T_keyframe_cam,
        seen.X,
        seen.uv,
        without_distortion(params.intrinsics),
        weights=seen.weight,
        depth=seen.depth,
        sigma_px=_SIGMA_PX * seen.scale,
        sigma_depth=_depth_sigma(seen, params),
    )


def _depth_sigma(seen: _Seen, params: TrackParams) -> Weights:
    """Of the difference of depth measured in the keyframe and in the image."""
    return jnp.hypot(depth_sigma(seen.depth_then, params), depth_sigma(seen.depth, params))


def compile_recognition(params: TrackParams, plan: FeaturePlan = DEFAULT_PLAN) -> None:
    """Compile all that `recognise` needs, so that nothing is compiled while frames come."""
    nothing: Any = np.zeros((2, 0), np.int64)
    empty = no_features()
    identity = SE3(jnp.asarray([1.0, 0, 0, 0, 0, 0, 0], jnp.float32))
    key = jax.random.fold_in(jax.random.key(0), 0)
    jax.block_until_ready(_agreed(key, _seen(empty, empty, nothing, _MOST_MATCHES, params, plan), params))
    jax.block_until_ready(_refined(identity, _seen(empty, empty, nothing, plan.num_features, params, plan), params))
