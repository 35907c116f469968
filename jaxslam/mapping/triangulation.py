"""Points where no depth was measured: features of two keyframes, matched along epipolar lines and triangulated.

Source: Mur-Artal et al., "ORB-SLAM", 2015, section VI-C, for the checks.
"""

from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.features.matching import NEAR, hamming
from jaxslam.features.orb import FeaturePlan, Features
from jaxslam.geometry.se3 import between, inverse, transform
from jaxslam.geometry.so3 import matrices
from jaxslam.sensors.camera import Camera

_RATIO = 0.8
"""The best match must differ in less than this share of the bits of the second best along the line."""
_CHI2_LINE, _CHI2_POINT = 3.84, 5.99
"""95 % quantiles of chi squared with one and with two degrees of freedom."""
_MIN_PARALLAX = np.deg2rad(2.0)
"""Smallest angle between the two rays: with a focal length of 525 pixels, depth is then known to a tenth."""
_SCALE_FACTOR = 1.5
"""How far the ratio of distances may be from that of the features' sizes, besides a level of the pyramid."""
_NEAREST_M = 0.1


class Triangulated(NamedTuple):
    """Points seen by two keyframes; `(m,)`.

    Attributes:
        first: Index of the feature in the first one.
        second: Index of the feature in the second one.
        X_first: `(3, m)` meters, in the axes of the first.
    """

    first: np.ndarray
    second: np.ndarray
    X_first: np.ndarray


def triangulate(
    camera: Camera, first: Features, second: Features, T_first_second: np.ndarray, plan: FeaturePlan
) -> Triangulated:
    """Points seen as features of two keyframes whose relative pose is known.

    Every match is the other's best along the epipolar line, and the point lies in front of both cameras, is seen from
    directions that differ by a degree at least, projects onto both features, and is as far away as their sizes say.

    Args:
        camera: Of both.
        first: Features to match.
        second: Features to match them with.
        T_first_second: `(7,)` pose of the second keyframe in the axes of the first.
        plan: How features are found.
    """
    rays = [_rays(camera, features) for features in (first, second)]
    sigmas = [plan.scale(features.octave) / np.sqrt(camera.fx * camera.fy) for features in (first, second)]
    pairs = _matched(first, second, _near_lines(rays[0], rays[1], sigmas, T_first_second))
    a, b = (ray[:, index] for ray, index in zip(rays, pairs, strict=True))
    X = _intersections(a, b, T_first_second)
    X_second = transform(inverse(T_first_second), X)
    good = np.isfinite(X).all(axis=0) & (X[2] > _NEAREST_M) & (X_second[2] > _NEAREST_M)
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


def _rays(camera: Camera, features: Features) -> np.ndarray:
    """`(3, n)` directions, third coordinate 1."""
    return camera.back_project(features.uv.astype(np.float64), np.ones(features.uv.shape[1]))


def _near_lines(first: np.ndarray, second: np.ndarray, sigmas: list[np.ndarray], T: np.ndarray) -> np.ndarray:
    """`(n, m)` which features of the second lie near the epipolar line of which feature of the first."""
    x, y, z = T[4:]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ matrices(T[:4])
    error = first.T @ essential @ second
    of_first, of_second = (essential @ second)[:2], (essential.T @ first)[:2]
    # Each line moves with the feature it is of, as the other feature does by itself: Sampson's distance.
    variance = (sigmas[0] ** 2)[:, None] * (of_first**2).sum(axis=0) + (sigmas[1] ** 2) * (of_second**2).sum(axis=0)[
        :, None
    ]
    return error**2 < _CHI2_LINE * variance


def _matched(first: Features, second: Features, allowed: np.ndarray) -> np.ndarray:
    """`(2, k)` pairs of features that are each other's best among those allowed, and clearly so."""
    if not allowed.any():
        return np.zeros((2, 0), np.int64)
    distance = np.where(allowed, hamming(first.descriptor, second.descriptor), np.iinfo(np.uint16).max)
    best = distance.argmin(axis=1)
    least = np.partition(distance, min(1, distance.shape[1] - 1), axis=1)[:, :2].astype(np.float64)
    index = np.arange(len(best))
    good = (distance.argmin(axis=0)[best] == index) & (least[:, 0] <= NEAR)
    good &= (least[:, 0] < _RATIO * least[:, -1]) | (distance.shape[1] == 1)
    return np.stack([index[good], best[good]])


def _intersections(first: np.ndarray, second: np.ndarray, T_first_second: np.ndarray) -> np.ndarray:
    """`(3, k)` where pairs of rays meet best; not finite where they are parallel."""
    if not first.shape[1]:
        return np.zeros((3, 0))
    T_second_first = inverse(T_first_second)
    projections = np.eye(3, 4), np.column_stack([matrices(T_second_first[:4]), T_second_first[4:]])
    X = cv2.triangulatePoints(*projections, np.ascontiguousarray(first[:2]), np.ascontiguousarray(second[:2]))
    with np.errstate(divide="ignore", invalid="ignore"):
        return X[:3] / X[3]


def at_baseline(T_world_first: np.ndarray, T_world_second: np.ndarray, depth: np.ndarray) -> bool:
    """Whether two keyframes are far enough apart for points as far away as those seen (meters, 0 for none)."""
    seen = depth[depth > 0]
    apart = np.linalg.norm(between(T_world_first, T_world_second)[4:])
    return bool(len(seen) and apart > _MIN_PARALLAX * np.median(seen))
