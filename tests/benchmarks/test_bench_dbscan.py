"""Clusters by density beside scikit-learn's DBSCAN, same points, both on one core."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.clustering.dbscan import dbscan
from sklearn.cluster import DBSCAN

from jaxslam.benchmark.kernels.point_cases import movers
from jaxslam.benchmark.timing import compare, compile_seconds

pytestmark = pytest.mark.benchmark


def _scattered(n: int) -> np.ndarray:
    """`(3, n)` meters: as many small groups as chance makes."""
    return np.random.default_rng(1).uniform(-2, 2, (3, n))


def _chain(n: int) -> np.ndarray:
    """`(2, n)` points on one line in random order: as many steps as a cluster of n points can take."""
    return np.stack([np.random.default_rng(2).permutation(n), np.zeros(n)])


@pytest.mark.parametrize("n", [256, 512])
@pytest.mark.parametrize(
    ("make", "radius", "min_points"),
    [(movers, 20.0, 5), (_scattered, 0.5, 4), (_chain, 1.0, 2)],
    ids=["movers", "scattered", "chain"],
)
def test_is_faster_than_scikit_learn(make, radius, min_points, n, capsys):
    points = make(n).astype(np.float32)
    arguments = (jnp.asarray(points), jnp.ones(n, bool), jnp.float32(radius), jnp.int32(min_points))
    run = lambda points, mask, radius, least: dbscan(points, mask, radius=radius, min_points=least)
    ours, theirs = jax.jit(run), DBSCAN(eps=radius, min_samples=min_points)
    columns = np.ascontiguousarray(points.T)
    num = int(ours(*arguments).num)
    assert num == theirs.fit(columns).labels_.max() + 1
    comparison = compare(lambda: ours(*arguments), lambda: theirs.fit(columns))
    with capsys.disabled():
        print(f"\n{n} points, {num} clusters, compiled in {compile_seconds(run, *arguments):.2f} s: {comparison}")
    assert comparison.processor_ratio < 1.0
