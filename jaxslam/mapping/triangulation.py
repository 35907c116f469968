"""Triangulate features without depth: match two keyframes along epipolar lines, and intersect the rays.

Source: Mur-Artal et al., "ORB-SLAM", 2015, section VI-C, for the checks.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from jaxslam.features.matching import NEAR, hamming
from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.geometry.se3 import between, inverse, transform
from jaxslam.geometry.so3 import matrices
from jaxslam.geometry.types import Pose
from jaxslam.sensors.camera import Camera

_RATIO = 0.8
"""Largest ratio of the Hamming distances of the best and the second best match near the epipolar line."""
_CHI2_LINE, _CHI2_POINT = 3.84, 5.99
"""95 % quantiles of chi squared with one and with two degrees of freedom."""
_MIN_PARALLAX = np.deg2rad(2.0)
"""Smallest angle between the two rays, radians: with a focal length of 525 pixels, depth is then known to 10 %."""
_SCALE_FACTOR = 1.5
"""Largest factor between the ratio of distances and the ratio of feature sizes, besides one pyramid level."""


class Triangulated(NamedTuple):
    """The `m` triangulated points of two keyframes.

    Attributes:
        first: `(m,)` index of the feature in the first keyframe.
        second: `(m,)` index of the feature in the second keyframe.
        X_first: `(3, m)` positions in the camera frame of the first keyframe, meters.
    """

    first: Int64[np.ndarray, " m"]
    second: Int64[np.ndarray, " m"]
    X_first: Float64[np.ndarray, "3 m"]


def triangulate(
    camera: Camera, first: Features, second: Features, T_first_second: Pose, plan: FeaturePlan
) -> Triangulated:
    """Triangulate the features of two keyframes whose relative pose is known.

    The features of a match are each other's best near the epipolar line. The point lies in front of both cameras, has a
    parallax of at least two degrees, reprojects onto both features, and is at distances that agree with their octaves.

    Args:
        camera: Camera of both keyframes.
        first: Features of the first keyframe.
        second: Features of the second keyframe.
        T_first_second: `(7,)` pose of the second keyframe relative to the first.
        plan: Settings of feature extraction.
    """
    rays = [_rays(camera, features) for features in (first, second)]
    sigmas = [plan.scale(features.octave) / np.sqrt(camera.fx * camera.fy) for features in (first, second)]
    pairs = _matched(first, second, _near_lines(rays[0], rays[1], sigmas, T_first_second))
    a, b = (ray[:, index] for ray, index in zip(rays, pairs, strict=True))
    X = _intersections(a, b, T_first_second)
    X_second = transform(inverse(T_first_second), X)
    good = np.isfinite(X).all(axis=0) & (X[2] > 0) & (X_second[2] > 0)
    X, X_second = np.where(good, X, 1.0), np.where(good, X_second, 1.0)
    near, far = np.linalg.norm(X, axis=0), np.linalg.norm(X_second, axis=0)
    turned = matrices(T_first_second[:4]) @ X_second
    good &= (X * turned).sum(axis=0) < np.cos(_MIN_PARALLAX) * near * far
    for local, ray, sigma, index in zip((X, X_second), (a, b), sigmas, pairs, strict=True):
        error = local[:2] / local[2] - ray[:2]
        good &= (error**2).sum(axis=0) < _CHI2_POINT * sigma[index] ** 2
    size = plan.scale(first.octave[pairs[0]]) / plan.scale(second.octave[pairs[1]])
    good &= np.abs(np.log(size * near / far)) < np.log(_SCALE_FACTOR * plan.scale_factor)
    return Triangulated(pairs[0][good], pairs[1][good], X[:, good])


def _rays(camera: Camera, features: Features) -> Float64[np.ndarray, "3 n"]:
    """Return the `(3, n)` rays of the features in the camera frame, with z = 1."""
    return camera.back_project(features.uv.astype(np.float64), np.ones(features.uv.shape[1]))


def _near_lines(
    first: Float64[np.ndarray, "3 n"], second: Float64[np.ndarray, "3 m"], sigmas: list[np.ndarray], T: Pose
) -> Bool[np.ndarray, "n m"]:
    """Return the `(n, m)` mask of feature pairs that satisfy the epipolar constraint."""
    x, y, z = T[4:]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ matrices(T[:4])
    error = first.T @ essential @ second
    of_first, of_second = (essential @ second)[:2], (essential.T @ first)[:2]
    # The Sampson distance: the errors of both features count.
    variance = (sigmas[0] ** 2)[:, None] * (of_first**2).sum(axis=0) + (sigmas[1] ** 2) * (of_second**2).sum(axis=0)[
        :, None
    ]
    return error**2 < _CHI2_LINE * variance


def _matched(first: Features, second: Features, allowed: Bool[np.ndarray, "n m"]) -> Int64[np.ndarray, "2 k"]:
    """Return the `(2, k)` allowed pairs of features that are each other's best match and pass the ratio test."""
    if not allowed.any():
        return np.zeros((2, 0), np.int64)
    distance = np.where(allowed, hamming(first.descriptor, second.descriptor), np.iinfo(np.uint16).max)
    best = distance.argmin(axis=1)
    least = np.partition(distance, min(1, distance.shape[1] - 1), axis=1)[:, :2].astype(np.float64)
    index = np.arange(len(best))
    good = (distance.argmin(axis=0)[best] == index) & (least[:, 0] <= NEAR)
    good &= (least[:, 0] < _RATIO * least[:, -1]) | (distance.shape[1] == 1)
    return np.stack([index[good], best[good]])


def _intersections(
    first: Float64[np.ndarray, "3 k"], second: Float64[np.ndarray, "3 k"], T_first_second: Pose
) -> Float64[np.ndarray, "3 k"]:
    """Triangulate `(3, k)` points from pairs of rays; not finite where the rays are parallel."""
    if not first.shape[1]:
        return np.zeros((3, 0))
    T_second_first = inverse(T_first_second)
    projections = np.eye(3, 4), np.column_stack([matrices(T_second_first[:4]), T_second_first[4:]])
    X = cv2.triangulatePoints(*projections, np.ascontiguousarray(first[:2]), np.ascontiguousarray(second[:2]))
    with np.errstate(divide="ignore", invalid="ignore"):
        return X[:3] / X[3]


def at_baseline(T_world_first: Pose, T_world_second: Pose, depth: Float[np.ndarray, " n"]) -> bool:
    """Return whether the baseline of two keyframes is long enough for the depths seen.

    Args:
        T_world_first: `(7,)` pose of the first keyframe.
        T_world_second: `(7,)` pose of the second keyframe.
        depth: `(n,)` depths of features, meters; 0 where depth is missing.
    """
    seen = depth[depth > 0]
    apart = np.linalg.norm(between(T_world_first, T_world_second)[4:])
    return bool(len(seen) and apart > _MIN_PARALLAX * np.median(seen))
