"""K-means on the points of a depth image beside OpenCV's, same points and iterations, both on one core."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.clustering.kmeans import kmeans

from jaxslam.benchmark.kernels.point_cases import opencv_kmeans
from jaxslam.benchmark.timing import compare, compile_seconds

pytestmark = pytest.mark.benchmark

CLUSTERS, STEPS, KEYS = 24, 10, 20


def _room(height: int, width: int) -> np.ndarray:
    """Meters along the optical axis: a wall at 4 m with a floor, and six upright ellipses before it, as people are."""
    random = np.random.default_rng(0)
    v, u = np.mgrid[:height, :width] / np.array([height, width]).reshape(2, 1, 1)
    depth = np.minimum(4.0, 1.5 / np.maximum(v - 0.4, 1e-3))
    for _ in range(6):
        middle, z = random.uniform(0.1, 0.9), random.uniform(1.0, 3.5)
        depth = np.where(((u - middle) / 0.07) ** 2 + ((v - 0.6) / 0.35) ** 2 < 1, np.minimum(depth, z), depth)
    return depth * random.normal(1, 0.005, depth.shape)


def _points(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`(3, 19200)` meters, every fourth pixel of every fourth row of 640x480, and which of them were measured."""
    v, u = np.mgrid[: depth.shape[0] : 4, : depth.shape[1] : 4]
    z = depth[::4, ::4]
    points = np.stack([(u - 319.5) / 540 * z, (v - 239.5) / 540 * z, z]).reshape(3, -1).astype(np.float32)
    return points, points[2] > 0


@pytest.fixture(params=["real", "synthetic"])
def points_and_mask(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    if request.param == "synthetic":
        return _points(_room(480, 640))
    folder: Path = request.getfixturevalue("data_dir") / "bonn/rgbd_bonn_crowd/depth"
    image = cv2.imread(str(sorted(folder.glob("*.png"))[100]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return _points(image / 5000)


def _run(key, points, mask, initial=None):
    return kmeans(key, points, mask, num_clusters=CLUSTERS, num_steps=STEPS, initial=initial)


def test_is_faster_than_opencv_from_the_same_centers(points_and_mask, capsys):
    """OpenCV gets the labels of the first centers and moves centers as often; it does not label points at the end."""
    points, mask = (jnp.asarray(array) for array in points_and_mask)
    first = kmeans(jax.random.key(0), points, mask, num_clusters=CLUSTERS, num_steps=0)
    arguments = (jax.random.key(0), points, mask, first.centers)
    rows, label = np.ascontiguousarray(np.asarray(points)[:, mask].T), np.asarray(first.label)[np.asarray(mask)]
    ours = jax.jit(_run)
    costs = float(ours(*arguments).cost), opencv_kmeans(rows, CLUSTERS, STEPS, label)[0]
    comparison = compare(lambda: ours(*arguments), lambda: opencv_kmeans(rows, CLUSTERS, STEPS, label), rounds=30)
    with capsys.disabled():
        print(f"\n{len(rows)} points, {CLUSTERS} clusters, {STEPS} steps, compiled in", end=" ")
        print(f"{compile_seconds(_run, *arguments):.2f} s, cost {costs[0]:.2f} and {costs[1]:.2f}: {comparison}")
    assert costs[0] == pytest.approx(costs[1], rel=0.01)
    assert comparison.processor_ratio < 0.5


def test_is_faster_than_opencv_with_drawn_centers(points_and_mask, capsys):
    """Both by k-means++ of three draws a center, OpenCV in an iteration of its own; mean cost, as each draws others."""
    points, mask = (jnp.asarray(array) for array in points_and_mask)
    rows = np.ascontiguousarray(np.asarray(points)[:, mask].T)
    ours = jax.jit(_run)
    keys = jax.random.split(jax.random.key(0), KEYS)
    our_costs = [float(ours(key, points, mask).cost) for key in keys]
    cv2.setRNGSeed(1)
    their_costs = [opencv_kmeans(rows, CLUSTERS, STEPS + 1)[0] for _ in keys]
    comparison = compare(
        lambda: ours(keys[0], points, mask), lambda: opencv_kmeans(rows, CLUSTERS, STEPS + 1), rounds=30
    )
    with capsys.disabled():
        print(f"\n{len(rows)} points, {CLUSTERS} drawn clusters, {STEPS} steps, mean cost", end=" ")
        print(f"{np.mean(our_costs):.2f} and {np.mean(their_costs):.2f} of {KEYS} draws: {comparison}")
    assert np.mean(our_costs) < 1.01 * np.mean(their_costs)
    assert comparison.processor_ratio < 0.5
