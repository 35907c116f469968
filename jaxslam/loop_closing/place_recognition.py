"""Place recognition: estimate the camera pose of an image relative to a keyframe that shows the same place."""

from collections.abc import Set
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float64, Int64

from jaxslam.features.orb import DEFAULT_PLAN, FeaturePlan, Features
from jaxslam.features.view_matching import match_views
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.map.types import Keyframe, Map
from jaxslam.sensors.sensor_model import SensorModel


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
        if slam_map.has_keyframe(keyframe_id):
            found = verify(slam_map.keyframe(keyframe_id), features, sensor, seed=seed, plan=plan)
            if found is not None:
                return found
    return None


def verify(
    keyframe: Keyframe, features: Features, sensor: SensorModel, *, seed: int = 0, plan: FeaturePlan = DEFAULT_PLAN
) -> Recognition | None:
    """Estimate the pose of an image relative to one keyframe, if it certainly shows the same place; see `recognize`."""
    key = jax.random.fold_in(jax.random.key(seed), keyframe.id)
    found = match_views(keyframe.features, features, sensor, key, plan=plan)
    if found is None:
        return None
    num_inliers = found.pairs.shape[1]
    return Recognition(keyframe.id, found.T_source_cam, found.covariance, num_inliers, found.inlier_share, found.pairs)
