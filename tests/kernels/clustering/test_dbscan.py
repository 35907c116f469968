"""Clusters by density against scikit-learn, borders and order against their definitions."""

from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxslam_kernels.clustering.dbscan as kernel
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from jaxslam_kernels.clustering.dbscan import Clusters, dbscan
from quick_compile import quick_compile
from sklearn.cluster import DBSCAN

N = 40
SEEDS = st.integers(0, 2**32 - 1)

_dbscan = quick_compile(lambda points, mask, radius, q: dbscan(points, mask, radius=radius, min_points=q))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _clusters(points, radius, min_points, mask=None) -> Clusters:
    mask = np.ones(np.shape(points)[1], bool) if mask is None else mask
    return jax.tree.map(np.asarray, _dbscan(points, mask, np.asarray(radius, points.dtype), min_points))


def _blobs(seed=0, n=N, d=2, dtype: Any = np.float64):
    """Three blobs of unit deviation, noise between them, in random order."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-8, 8, (d, 3))
    points = centers[:, rng.integers(0, 3, n)] + rng.normal(size=(d, n))
    noise = rng.uniform(size=n) < 0.25
    return np.where(noise, rng.uniform(-10, 10, (d, n)), points).astype(dtype)


def _rings(seed=0, n=100):
    """Three around one center, 4 apart; 1.5 from point to point of one, in random order."""
    rng = np.random.default_rng(seed)
    place = rng.permutation(n) * 6 / n
    ring = np.searchsorted([1, 3], place, side="right") + 1
    angle = 2 * np.pi * place / ring
    return 4 * ring * np.stack([np.cos(angle), np.sin(angle)]) + 0.05 * rng.normal(size=(2, n))


def _chain(seed=0, n=500):
    return np.random.default_rng(seed).permutation(n)[None, :].astype(float)


def _distances(points):
    return np.linalg.norm(points[:, :, None] - points[:, None, :], axis=0)


def _in_order(label):
    """Labels renamed in the order of first appearance, noise left alone: equal for equal partitions."""
    names = {name: k for k, name in enumerate(dict.fromkeys(label[label >= 0].tolist()))}
    return np.array([names.get(name, -1) for name in label.tolist()], int)


def _assert_by_definition(points, clusters, radius):
    """Each border point has its nearest core point's label; the rest is noise; labels count up as they appear."""
    label, core = clusters.label, clusters.core
    distance = np.where(core[None, :], _distances(points), np.inf)
    nearest, reached = np.argmin(distance, axis=1), distance.min(axis=1, initial=np.inf) <= radius
    np.testing.assert_array_equal(label, np.where(reached, label[nearest], -1))
    np.testing.assert_array_equal(label, _in_order(label))
    assert clusters.num == label.max(initial=-1) + 1


CASES = {
    "blobs": (_blobs(0, 100), 0.7, 4),
    "blobs in space": (_blobs(1, 100, d=3), 1.2, 5),
    "many dimensions": (_blobs(3, 100, d=7), 3.0, 4),
    "rings": (_rings(), 2.0, 3),
    "chain": (_chain(), 1.0, 2),
    "pairs": (_blobs(4, 100), 0.4, 2),
    "sparse": (_blobs(5, 100), 0.05, 3),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(dtype == np.float64):
        clusters = _clusters(_blobs(dtype=dtype), 1.0, 3)
    assert clusters.label.shape == clusters.core.shape == (N,)
    assert clusters.num.shape == ()
    assert clusters.label.dtype == clusters.num.dtype == np.int32


@pytest.mark.parametrize("case", CASES)
def test_matches_reference(x64, case):
    points, radius, min_points = CASES[case]
    clusters = _clusters(points, radius, min_points)
    reference = DBSCAN(eps=radius, min_samples=min_points).fit(points.T)
    core = clusters.core
    np.testing.assert_array_equal(np.flatnonzero(core), reference.core_sample_indices_)
    np.testing.assert_array_equal(_in_order(clusters.label[core]), _in_order(reference.labels_[core]))
    np.testing.assert_array_equal(clusters.label < 0, reference.labels_ < 0)
    assert clusters.num == reference.labels_.max() + 1
    _assert_by_definition(points, clusters, radius)


def test_cases_are_not_trivial(x64):
    """Together they hold many clusters, one long one, borders, noise, and nothing but noise."""
    found = {case: _clusters(*CASES[case]) for case in CASES}
    assert found["rings"].num == 3
    assert found["chain"].num == 1
    assert found["pairs"].num > 10
    assert found["sparse"].num == 0
    border = lambda clusters: (clusters.label >= 0) & ~clusters.core
    assert border(found["blobs"]).sum() > 10
    assert (found["blobs in space"].label < 0).sum() > 10


@pytest.mark.parametrize("seed", range(3))
def test_single_precision(seed):
    points = _blobs(seed, dtype=np.float32)
    radius = np.float32(_radius_in_gap(points.astype(float), 1.2))
    clusters = _clusters(points, radius, 4)
    reference = DBSCAN(eps=float(radius), min_samples=4).fit(points.T)
    assert clusters.num > 1
    np.testing.assert_array_equal(np.flatnonzero(clusters.core), reference.core_sample_indices_)
    np.testing.assert_array_equal(clusters.label < 0, reference.labels_ < 0)
    _assert_by_definition(points.astype(float), clusters, radius)


@pytest.mark.parametrize(("place", "expected"), [(5.1, 1), (4.9, 0), (5.0, 0)])
def test_a_border_point_goes_to_the_nearest_core_point(place, expected):
    """Not to the cluster visited first, as with scikit-learn; if two are equally near, to the first of them."""
    points = np.array([[0, 1, 2, place, 8, 9, 10]], np.float32)
    clusters = _clusters(points, 3.2, 4)
    np.testing.assert_array_equal(np.flatnonzero(clusters.core), [2, 4])
    np.testing.assert_array_equal(clusters.label, [0, 0, 0, expected, 1, 1, 1])


def test_a_border_point_in_reach_of_two_clusters_does_not_join_them():
    clusters = _clusters(np.array([[5, 8, 9, 10, 0, 1, 2]], np.float32), 3.2, 4)
    assert clusters.num == 2
    np.testing.assert_array_equal(clusters.label, [0, 0, 0, 0, 1, 1, 1])


def test_the_radius_itself_is_within():
    """Exactly, also far from the origin; the next number below is not enough."""
    for offset in (0.0, 4096.0):
        points = np.array([[0, 3, 6], [0, 4, 8]], np.float32) + np.float32(offset)
        assert _clusters(points, 5.0, 2).num == 1
        assert _clusters(points, np.nextafter(np.float32(5), np.float32(0)), 2).num == 0


def test_a_long_chain_takes_few_steps(monkeypatch):
    """Its 500 points in any order are one cluster, after steps with the logarithm of their number."""
    steps = []

    def count_steps(condition, body, state):
        step = lambda counted: (body(counted[0]), counted[1] + 1)
        state, count = lax.while_loop(lambda counted: condition(counted[0]), step, (state, 0))
        steps.append(count)
        return state

    @quick_compile
    def compute(points):
        return dbscan(points, jnp.ones(500, bool), radius=1.0, min_points=3), steps

    monkeypatch.setattr(kernel, "lax", SimpleNamespace(stop_gradient=lax.stop_gradient, while_loop=count_steps))
    clusters, counts = compute(jnp.asarray(_chain(1), jnp.float32))
    np.testing.assert_array_equal(clusters.label, 0)
    assert clusters.core.sum() == 498
    assert [2 < count <= 12 for count in counts] == [True]


def _spread(points, mask, clusters: Clusters):
    """Squared distances to the cluster's mean, all clusters together, with the labels as constant weights."""
    weights = (clusters.label[None, :] == jnp.arange(N, dtype=jnp.int32)[:, None]).astype(points.dtype)
    clean = jnp.where(mask[None, :] & jnp.isfinite(points), points, 0)
    means = clean @ weights.T / jnp.maximum(weights.sum(axis=1), 1)[None, :]
    return (weights[None] * jnp.square(clean[:, None, :] - means[:, :, None])).sum()


def _loss(points, mask, radius, min_points):
    return _spread(points, mask, dbscan(points, mask, radius=radius, min_points=min_points))


_gradient_at_labels = quick_compile(jax.grad(_spread))
_value_and_gradient = quick_compile(jax.value_and_grad(_loss, argnums=(0, 2)))
_jvp = quick_compile(lambda points, direction, *rest: jax.jvp(lambda p: _loss(p, *rest), (points,), (direction,)))


@pytest.mark.parametrize(
    ("points", "radius", "min_points"),
    [(_blobs(), 1.5, 3), (np.zeros((2, N)), 0.5, 1), (_blobs(1), 1e-9, 3), (_blobs(2), np.inf, 3)],
    ids=["blobs", "one place", "noise", "one cluster"],
)
def test_gradient(x64, points, radius, min_points):
    """Forward, reverse, finite differences and the gradient at given labels agree; the radius has none."""
    mask = np.arange(N) % 7 > 0
    direction = np.random.default_rng(9).normal(size=points.shape)
    _, (gradient, by_radius) = _value_and_gradient(points, mask, radius, min_points)
    (_, forward) = _jvp(points, direction, mask, radius, min_points)
    ahead, behind = (_value_and_gradient(points + h * direction, mask, radius, min_points)[0] for h in (1e-6, -1e-6))
    expected = _gradient_at_labels(points, mask, _clusters(points, radius, min_points, mask))
    np.testing.assert_allclose(gradient, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(forward, (gradient * direction).sum(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-6)
    assert by_radius == 0
    assert (abs(forward) > 0.1) == (radius > 1)


def test_vmap_equals_loop():
    points = np.stack([_blobs(seed, dtype=np.float32) for seed in range(3)])
    masks = np.random.default_rng(0).uniform(size=(3, N)) < 0.9
    radii, least = np.array([0.7, 1.5, np.inf], np.float32), np.array([2, 4, 3], np.int32)
    batched = quick_compile(jax.vmap(lambda p, m, r, q: dbscan(p, m, radius=r, min_points=q)))(
        points, masks, radii, least
    )
    for k in range(3):
        one = _clusters(points[k], radii[k], least[k], masks[k])
        assert one.num > 0
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), batched, one)


def test_single_trace():
    compute = lambda points, mask, radius, q: dbscan(points, mask, radius=radius, min_points=q)
    traced = quick_compile(eqx.debug.assert_max_traces(compute, max_traces=1))
    for seed in range(3):
        mask = np.arange(N) > seed
        traced(_blobs(seed, dtype=np.float32), mask, 0.5 + seed, seed)


DEGENERATE = {  # points, mask, radius, min_points, and the expected labels
    "all masked": (_blobs(), np.zeros(N, bool), 1.0, 1, np.full(N, -1)),
    "all NaN": (np.full((2, N), np.nan), np.ones(N, bool), 1.0, 1, np.full(N, -1)),
    "one coordinate NaN": (np.array([[np.nan], [1.0]]) * np.ones(N), np.ones(N, bool), np.inf, 1, np.full(N, -1)),
    "infinite": (np.full((2, N), np.inf), np.ones(N, bool), np.inf, 1, np.full(N, -1)),
    "all in one place": (np.full((2, N), 3.7), np.ones(N, bool), 1.0, N, np.zeros(N, int)),
    "one place, radius 0": (np.full((2, N), 3.7), np.ones(N, bool), 0.0, N, np.zeros(N, int)),
    "one place, too few": (np.full((2, N), 3.7), np.ones(N, bool), 1.0, N + 1, np.full(N, -1)),
    "radius 0": (_blobs(), np.ones(N, bool), 0.0, 2, np.full(N, -1)),
    "radius 0, min_points 1": (_blobs(), np.ones(N, bool), 0.0, 1, np.arange(N)),
    "min_points 0": (_blobs(), np.ones(N, bool), 0.0, 0, np.arange(N)),
    "radius infinite": (_blobs(), np.ones(N, bool), np.inf, N, np.zeros(N, int)),
    "radius infinite, too few": (_blobs(), np.ones(N, bool), np.inf, N + 1, np.full(N, -1)),
    "radius infinite, far apart": (1e38 * np.sign(_blobs()), np.ones(N, bool), np.inf, 3, np.zeros(N, int)),
    "radius NaN": (_blobs(), np.ones(N, bool), np.nan, 0, np.full(N, -1)),
    "radius negative": (_blobs(), np.ones(N, bool), -1.0, 0, np.full(N, -1)),
}


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_degenerate(case, dtype):
    points, mask, radius, min_points, expected = DEGENERATE[case]
    points, radius = points.astype(dtype), dtype(radius)
    with jax.enable_x64(dtype == np.float64):
        clusters = _clusters(points, radius, min_points, mask)
        value, gradients = _value_and_gradient(np.clip(points, -1e3, 1e3), mask, radius, min_points)
    np.testing.assert_array_equal(clusters.label, expected)
    np.testing.assert_array_equal(clusters.core, expected >= 0)
    assert clusters.num == expected.max() + 1
    assert np.isfinite(value)
    assert all(np.isfinite(gradient).all() for gradient in gradients)


@pytest.mark.parametrize("n", [0, 1])
def test_hardly_any_points(n):
    for min_points in (1, 2):
        clusters = _clusters(np.ones((3, n), np.float32), 1.0, min_points)
        np.testing.assert_array_equal(clusters.label, np.full(n, 0 if min_points == 1 else -1))
        assert clusters.core.shape == (n,)
        assert clusters.num == (n if min_points == 1 else 0)


def _radius_in_gap(points, radius):
    """A radius near the given one, in the middle between two distances: rounding moves no pair across it."""
    distances = np.sort(_distances(points), axis=None)
    near = distances[(distances > 0.9 * radius) & (distances < 1.1 * radius)]
    widest = int(np.argmax(np.diff(near)))
    assert near[widest + 1] - near[widest] > 1e-4 * radius
    return near[widest : widest + 2].mean()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, min_points=st.integers(1, 6))
def test_order_does_not_matter(seed, min_points):
    """Points in another order have the same clusters, numbered in the new order."""
    points, order = _blobs(seed), np.random.default_rng(seed).permutation(N)
    with jax.enable_x64(True):
        before, after = _clusters(points, 1.2, min_points), _clusters(points[:, order], 1.2, min_points)
    np.testing.assert_array_equal(after.core, before.core[order])
    np.testing.assert_array_equal(after.label, _in_order(before.label[order]))
    assert after.num == before.num


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, angle=st.floats(-np.pi, np.pi), u=st.floats(-100, 100), v=st.floats(-100, 100), flip=st.booleans())
def test_rigid_motion_does_not_matter(seed, angle, u, v, flip):
    points = _blobs(seed)
    radius = _radius_in_gap(points, 1.2)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = rotation @ (points[::-1] if flip else points) + np.array([[u], [v]])
    with jax.enable_x64(True):
        jax.tree.map(np.testing.assert_array_equal, _clusters(moved, radius, 3), _clusters(points, radius, 3))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, filling=st.sampled_from([0.0, 1.0, np.nan, np.inf]))
def test_masked_points_do_not_matter(seed, filling):
    """Slots that are masked out, anywhere between the others, change nothing, whatever they hold."""
    rng = np.random.default_rng(seed)
    points, places = _blobs(seed), np.sort(rng.permutation(60)[:N])
    padded, mask = filling * _blobs(seed + 1, 60), np.zeros(60, bool)
    padded[:, places], mask[places] = points, True
    with jax.enable_x64(True):
        before, after = _clusters(points, 1.2, 3), _clusters(padded, 1.2, 3, mask)
    np.testing.assert_array_equal(after.label[places], before.label)
    np.testing.assert_array_equal(after.core[places], before.core)
    assert after.num == before.num
    assert (after.label[~mask] == -1).all()
    assert not after.core[~mask].any()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, radius=st.sampled_from([1, 2, 3]), min_points=st.integers(1, 6))
def test_points_on_a_grid(seed, radius, min_points):
    """Whole pixels, many in one place and many at exactly the radius: ties everywhere, and scikit-learn's cores."""
    points = np.random.default_rng(seed).integers(0, 16, (2, N)).astype(np.float32)
    clusters = _clusters(points, radius, min_points)
    reference = DBSCAN(eps=radius, min_samples=min_points).fit(points.T)
    np.testing.assert_array_equal(np.flatnonzero(clusters.core), reference.core_sample_indices_)
    _assert_by_definition(points.astype(float), clusters, radius)
    core = clusters.core
    np.testing.assert_array_equal(_in_order(clusters.label[core]), _in_order(reference.labels_[core]))
