"""Kernels on sets of points beside SciPy, scikit-learn and OpenCV: alignment of paths, clusters of two kinds."""

import math
from functools import cache
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.clustering.dbscan import dbscan
from jaxslam_kernels.clustering.kmeans import kmeans
from jaxslam_kernels.trajectory.alignment import ate
from scipy.spatial.transform import Rotation

from jaxslam.benchmark.kernels.case import Case, Problem

_MIN_POINTS, _RADIUS_OF_512_PX = 5, 20.0
_CENTERS, _STEPS = 24, 10


def scipy_ate(estimate: np.ndarray, reference: np.ndarray) -> float:
    """Root of the mean squared distance of `(3, n)` positions after alignment, as a user of SciPy would write it."""
    x, y = estimate.T - estimate.mean(axis=1), reference.T - reference.mean(axis=1)
    rotation = Rotation.align_vectors(y, x)[0]
    return float(np.sqrt(np.square(rotation.apply(x) - y).sum(axis=1).mean()))


def paths(n: int) -> tuple[np.ndarray, np.ndarray]:
    """`(3, n)` estimated and true positions of a walk, the estimate off by 0.1 m and in a frame of its own."""
    random = np.random.default_rng(0)
    reference = np.cumsum(random.normal(size=(3, n)), axis=1)
    estimate = Rotation.random(rng=random).apply((reference + 0.1 * random.normal(size=(3, n))).T).T + 5.0
    return estimate, reference


def movers(n: int) -> np.ndarray:
    """`(2, n)` pixels: six groups on people, and a quarter of outliers."""
    random = np.random.default_rng(0)
    centers = random.uniform([[50], [50]], [[590], [430]], (2, 6))
    points = centers[:, random.integers(0, 6, n)] + 20 * random.normal(size=(2, n))
    return np.where(random.uniform(size=n) < 0.25, random.uniform([[0], [0]], [[640], [480]], (2, n)), points)


def opencv_kmeans(
    rows: np.ndarray, num: int, steps: int, labels: np.ndarray | None = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, labels and centers of `(n, d)` points; from labels, or from centers drawn by k-means++ in a first step."""
    flags = cv2.KMEANS_PP_CENTERS if labels is None else cv2.KMEANS_USE_INITIAL_LABELS
    first = np.zeros((len(rows), 1), np.int32) if labels is None else labels.reshape(-1, 1).copy()
    return cv2.kmeans(rows, num, first, (cv2.TERM_CRITERIA_COUNT, steps, 0), 1, flags)


def _alignment(num_poses: int) -> Problem:
    estimate, reference = paths(num_poses)
    x, y = (jnp.asarray(positions, jnp.float32) for positions in (estimate, reference))
    return Problem(
        lambda x, y, weights: ate(x, y, weights).statistics.rmse,
        (x, y, jnp.ones(num_poses, jnp.float32)),
        lambda: scipy_ate(estimate, reference),
        lambda ours, theirs: abs(float(ours) / theirs - 1),
    )


def _dbscan(num_points: int) -> Problem:
    points = movers(num_points).astype(np.float32)
    columns = np.ascontiguousarray(points.T)
    radius = _RADIUS_OF_512_PX * math.sqrt(512 / num_points)

    def ours(points: Any, mask: Any, radius: Any, min_points: Any) -> Any:
        return dbscan(points, mask, radius=radius, min_points=min_points).label

    @cache
    def prepare() -> tuple[Any, ...]:
        from sklearn.cluster import DBSCAN  # noqa: PLC0415

        return (DBSCAN(eps=radius, min_samples=_MIN_POINTS),)

    return Problem(
        ours,
        (jnp.asarray(points), jnp.ones(num_points, bool), jnp.float32(radius), jnp.int32(_MIN_POINTS)),
        lambda method: method.fit(columns).labels_,
        lambda ours, theirs: float(np.mean(_in_order(np.asarray(ours)) != _in_order(theirs))),
        prepare,
    )


def _kmeans(num_points: int) -> Problem:
    points = paths(num_points)[0].astype(np.float32)
    rows, arguments = np.ascontiguousarray(points.T), (jax.random.key(0), jnp.asarray(points))
    mask = jnp.ones(num_points, bool)
    first = kmeans(*arguments, mask, num_clusters=_CENTERS, num_steps=0)
    label = np.asarray(first.label)

    def ours(key: Any, points: Any, mask: Any, initial: Any) -> Any:
        return kmeans(key, points, mask, num_clusters=_CENTERS, num_steps=_STEPS, initial=initial).cost

    return Problem(
        ours,
        (*arguments, mask, first.centers),
        lambda: opencv_kmeans(rows, _CENTERS, _STEPS, label)[0],
        lambda ours, theirs: abs(float(ours) / theirs - 1),
    )


def _in_order(labels: np.ndarray) -> np.ndarray:
    """The clusters numbered by their first points; noise stays -1."""
    found, first = np.unique(labels[labels >= 0], return_index=True)
    number = np.full(len(labels) + 1, -1)  # its last is that of noise
    number[found[np.argsort(first)]] = np.arange(len(found))
    return number[labels]


POINT_CASES = (
    Case(
        name="alignment",
        axis="poses",
        sizes=(100, 1000, 10_000, 100_000),
        reference="scipy Rotation.align_vectors",
        compared="rigid alignment of two paths and the root of the mean squared distance; SciPy in double precision",
        difference="relative difference of the error",
        limit=1e-3,
        problem=_alignment,
    ),
    Case(
        name="dbscan",
        axis="points",
        sizes=(32, 128, 512, 2048),
        reference="sklearn.cluster.DBSCAN",
        compared=f"six groups of pixels and a quarter of outliers, {_MIN_POINTS} points within a radius that shrinks as"
        " points grow in number; ours looks at all pairs",
        difference="share of points in another cluster",
        limit=0.01,
        problem=_dbscan,
        packages=("scikit-learn",),
    ),
    Case(
        name="kmeans",
        axis="points",
        sizes=(300, 1200, 4800, 19_200),
        reference="cv2.kmeans",
        compared=f"{_CENTERS} clusters of the positions of a walk, {_STEPS} steps from the same centers; OpenCV does"
        " not label the points after the last of them",
        difference="relative difference of the sum of squared distances",
        limit=0.01,
        problem=_kmeans,
    ),
)
