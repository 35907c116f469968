"""K-means against scikit-learn from the same centers; drawing of centers, empty ones and order by their definitions."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.clustering.kmeans import KMeans, _draw, kmeans
from quick_compile import quick_compile
from scipy.spatial.transform import Rotation
from sklearn.cluster import KMeans as Reference

N, K = 60, 4
SEEDS = st.integers(0, 2**32 - 1)

_kmeans = quick_compile(kmeans, static_argnames=("num_clusters", "num_steps"))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _clusters(points, mask=None, key=0, steps=5, initial=None, num=K, usable=None) -> KMeans:
    mask = np.ones(np.shape(points)[1], bool) if mask is None else mask
    found = _kmeans(
        jax.random.key(key), points, mask, num_clusters=num, num_steps=steps, initial=initial, usable=usable
    )
    return jax.tree.map(np.asarray, found)


def _blobs(seed=0, n=N, d=3, num=K, apart=3.0, dtype: Any = np.float64):
    """As many blobs of unit deviation as there are clusters, in random order."""
    rng = np.random.default_rng(seed)
    middles = apart * rng.uniform(-1, 1, (d, num))
    return (middles[:, rng.integers(0, num, n)] + rng.normal(size=(d, n))).astype(dtype)


def _begin(points, num=K, seed=0):
    """Points themselves, so that no center is without any at first."""
    return points[:, np.random.default_rng(seed).choice(points.shape[1], num, replace=False)]


def _distances(points, centers):
    return np.linalg.norm(points[:, None, :] - centers[:, :, None], axis=0)


def _lloyd(points, centers, steps):
    """Labels before the last step, labels at the end, and centers, by the definition, in double precision."""
    before = label = np.full(points.shape[1], -1)
    for step in range(steps + 1):
        if step > 0:
            means = [points[:, label == k].mean(axis=1) if (label == k).any() else c for k, c in enumerate(centers.T)]
            centers = np.stack(means, axis=1)
        before, label = label, np.argmin(_distances(points, centers), axis=0)
    return before, label, centers


_TO_THE_END: Any = {"n_init": 1, "tol": 0, "algorithm": "lloyd"}
CASES = {  # points, number of clusters, steps
    "blobs": (_blobs(), K, 5),
    "one step": (_blobs(1), K, 1),
    "to the end": (_blobs(2), K, 50),
    "one cluster": (_blobs(3), 1, 2),
    "line": (_blobs(4, d=1), 3, 4),
    "many dimensions": (_blobs(5, d=7), 5, 6),
    "far away": (_blobs(6) + 1e4, K, 5),
    "many points": (_blobs(7, n=2000, num=24, apart=5), 24, 10),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("steps", [0, 3])
def test_shapes(dtype, steps):
    with jax.enable_x64(dtype == np.float64):
        found = _clusters(_blobs(dtype=dtype), steps=steps)
    assert found.label.shape == (N,)
    assert found.centers.shape == (3, K)
    assert found.cost.shape == ()
    assert found.counts.shape == (K,)
    assert found.label.dtype == found.counts.dtype == np.int32
    assert found.centers.dtype == found.cost.dtype == dtype
    assert found.counts.sum() == N


@pytest.mark.parametrize("case", CASES)
def test_matches_reference(x64, case):
    """The same labels, and costs and centers within 1e-9."""
    points, num, steps = CASES[case]
    begin = _begin(points, num)
    found = _clusters(points, initial=begin, num=num, steps=steps)
    reference: Any = Reference(num, init=begin.T, max_iter=steps, **_TO_THE_END).fit(points.T)
    np.testing.assert_array_equal(found.label, reference.labels_)
    np.testing.assert_allclose(found.centers, reference.cluster_centers_.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.cost, reference.inertia_, rtol=1e-9)
    np.testing.assert_array_equal(found.counts, np.bincount(reference.labels_, minlength=num))
    assert found.cost < np.square(_distances(points, begin).min(axis=0)).sum()
    if case in ("to the end", "many points"):  # one that does not move any more before the last step, one that does
        assert (reference.n_iter_ < steps) == (case == "to the end")


@pytest.mark.parametrize("seed", range(3))
def test_single_precision(seed):
    points = _blobs(seed, n=2000, num=24, apart=20, dtype=np.float32)
    found = _clusters(points, key=seed, num=24, steps=10)
    assert all(np.isfinite(leaf).all() for leaf in found)
    distances = _distances(points.astype(float), found.centers.astype(float))
    chosen = distances[found.label, np.arange(points.shape[1])]
    np.testing.assert_allclose(chosen, distances.min(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found.cost, np.square(chosen).sum(), rtol=1e-4)


def test_a_center_without_points_stays(x64):
    """Where it was, until points come near it; it is told by its count, and may be drawn anew in the next call."""
    points = _blobs()
    begin = np.concatenate([_begin(points, K - 1), np.full((3, 1), 1e3)], axis=1)
    found = _clusters(points, initial=begin)
    np.testing.assert_allclose(found.centers[:, -1], 1e3, rtol=1e-12)
    assert found.counts[-1] == 0
    _, label, centers = _lloyd(points, begin, 5)
    np.testing.assert_array_equal(found.label, label)
    np.testing.assert_allclose(found.centers, centers, rtol=1e-12, atol=1e-12)
    again = _clusters(points, initial=found.centers, usable=found.counts > 0)
    assert (again.counts > 0).all()
    assert again.cost < found.cost


def test_equally_near_centers():
    """The first of them has the points."""
    points = np.array([[-1, 0, 1]], np.float32)
    found = _clusters(points, initial=np.array([[-1, 1]], np.float32), num=2, steps=0)
    np.testing.assert_array_equal(found.label, [0, 0, 1])
    found = _clusters(points, initial=np.zeros((1, 3), np.float32), num=3)
    np.testing.assert_array_equal(found.counts, [3, 0, 0])


@pytest.mark.parametrize("key", range(10))
def test_drawn_centers_are_far_apart(key):
    """One in each of the blobs, which are small and far apart; each at a point that counts."""
    points = np.concatenate([_blobs(k, 15, num=1, apart=0) * 1e-3 + 10 * k for k in range(K)], axis=1)
    points, mask = points.astype(np.float32), np.arange(N) % 3 > 0
    found = _clusters(points, mask, key, steps=0)
    nearest = _distances(points[:, mask], found.centers).min(axis=1)
    np.testing.assert_allclose(nearest, 0, atol=1e-5)
    np.testing.assert_array_equal(np.sort(np.round(found.centers[0] / 10)), np.arange(K))


@pytest.mark.parametrize("key", range(3))
def test_centers_that_are_not_usable_are_drawn(key):
    """Away from the usable ones, which stay; what was there instead does not matter."""
    points = np.concatenate([_blobs(k, 15, num=1, apart=0) * 1e-3 + 10 * k for k in range(K)], axis=1)
    begin, usable = np.array([[7.0, 20, 7, 0]] * 3), np.array([False, True, True, True])
    for wrong in (7.0, np.nan, np.inf):
        begin[:, [0, 2]] = [7.0, wrong]
        usable[2] = wrong != 7
        found = _clusters(points.astype(np.float32), None, key, 0, begin.astype(np.float32), usable=usable)
        np.testing.assert_allclose(found.centers[:, [1, 3]], begin[:, [1, 3]], atol=1e-5)
        assert set(np.round(found.centers[0, [0, 2]] / 10)) == {1, 3}


@pytest.mark.parametrize("unknown", [False, True])
def test_a_draw_is_in_proportion_to_squared_distance(unknown):
    """Over numbers evenly from 0 to 1, each point comes as often as its share; all alike if there is no center yet."""
    squared = np.random.default_rng(0).integers(0, 4, (5, 6)).astype(np.float32)
    squared[2] = 0
    inside = squared > 0 if unknown else np.ones((5, 6), bool)
    known = np.where(inside, np.inf, 0).astype(np.float32) if unknown else squared
    share = inside.astype(float) if unknown else squared
    num = int(share.sum()) * 10
    uniform = (np.arange(num, dtype=np.float32) + np.float32(0.5)) / np.float32(num)
    row, column = jax.jit(jax.vmap(_draw, (0, None, None)))(uniform, known, inside)
    times = np.zeros((5, 6))
    np.add.at(times, (np.asarray(row), np.asarray(column)), 1)
    np.testing.assert_array_equal(times, 10 * share)


def test_better_than_centers_at_random():
    """Drawn centers cost less than as many points by chance, over keys."""
    points = _blobs(n=500, num=8, apart=20, dtype=np.float32)
    drawn = [_clusters(points, key=key, num=8).cost for key in range(10)]
    chance = [_clusters(points, initial=_begin(points, 8, key), num=8).cost for key in range(10)]
    assert np.mean(drawn) < 0.9 * np.mean(chance)


@pytest.mark.parametrize(("num", "steps", "shape"), [(0, 1, (3, 0)), (K, -1, (3, K)), (K, 1, (3, 3))])
def test_what_cannot_be_is_refused(num, steps, shape):
    with pytest.raises(ValueError, match="expected"):
        kmeans(jax.random.key(0), jnp.ones((3, N)), jnp.ones(N, bool), num_clusters=num, num_steps=steps,
               initial=jnp.ones(shape))  # fmt: skip


def _weighted(found: KMeans):
    """One number that depends on all that has a gradient."""
    weights = np.cos(np.arange(found.centers.size)).reshape(found.centers.shape)
    return found.cost + (found.centers * weights.astype(found.centers.dtype)).sum()


def _loss(points, key, mask, initial, steps):
    return _weighted(kmeans(key, points, mask, num_clusters=K, num_steps=steps, initial=initial))


def _loss_at_labels(points, mask, before, label, kept):
    """The same with labels given, of which those before the last step make the centers."""
    weights = (before[None, :] == np.arange(K)[:, None]).astype(points.dtype)
    means = jnp.where(mask[None, :], points, 0) @ weights.T / jnp.maximum(weights.sum(axis=1), 1)[None, :]
    centers = jnp.where((weights.sum(axis=1) > 0)[None, :], means, kept)
    cost = (jnp.square(points - centers[:, label]) * mask[None, :].astype(points.dtype)).sum()
    return _weighted(KMeans(label, centers, cost, label))


_value_and_gradient: Any = quick_compile(jax.value_and_grad(_loss), static_argnums=4)
_jvp: Any = quick_compile(
    lambda points, direction, key, mask, initial, steps: jax.jvp(
        lambda p: _loss(p, key, mask, initial, steps), (points,), (direction,)
    ),
    static_argnums=5,
)
_SPARSE = np.concatenate([_begin(_blobs(), K - 1), np.full((3, 1), 50.0)], axis=1)


@pytest.mark.parametrize(
    ("points", "initial", "steps"),
    [
        (_blobs(), _begin(_blobs()), 0),
        (_blobs(), _begin(_blobs()), 1),
        (_blobs(1), _begin(_blobs(1)), 3),
        (_blobs(2), None, 3),
        (_blobs(), _SPARSE, 3),
        (np.zeros((3, N)), _begin(_blobs()), 3),
    ],
    ids=["no step", "one step", "steps", "drawn", "an empty one", "one place"],
)
def test_gradient(x64, points, initial, steps):
    """Forward, reverse, finite differences and the gradient at given labels agree."""
    mask, key = np.arange(N) % 7 > 0, jax.random.key(3)
    direction = np.random.default_rng(9).normal(size=points.shape)
    rest = (key, mask, initial)
    value, gradient = _value_and_gradient(points, *rest, steps)
    _, forward = _jvp(points, direction, *rest, steps)
    ahead, behind = (_value_and_gradient(points + h * direction, *rest, steps)[0] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(forward, (gradient * direction).sum(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-6)
    begin = _clusters(points, mask, 3, 0, None).centers if initial is None else initial
    before, label = np.full(N, -1), np.zeros(N, int)
    before[mask], label[mask], centers = _lloyd(points[:, mask], begin, steps)
    expected, at_labels = jax.value_and_grad(_loss_at_labels)(points, mask, before, label, centers)
    np.testing.assert_allclose(value, expected, rtol=1e-9)
    np.testing.assert_allclose(gradient, at_labels, rtol=1e-9, atol=1e-9)
    assert (np.asarray(gradient)[:, ~mask] == 0).all()
    assert np.linalg.norm(gradient) > 0.1


def test_initial_centers_have_no_gradient(x64):
    points, initial = jnp.asarray(_blobs()), jnp.asarray(_SPARSE)
    by_initial = jax.grad(_loss, argnums=3)(points, jax.random.key(0), jnp.ones(N, bool), initial, 2)
    np.testing.assert_array_equal(by_initial, 0)


@pytest.mark.parametrize("warm", [False, True])
def test_vmap_equals_loop(warm):
    points = np.stack([_blobs(seed, dtype=np.float32) for seed in range(3)])
    masks = np.random.default_rng(0).uniform(size=(3, N)) < 0.9
    keys, usable = jax.random.split(jax.random.key(0), 3), np.array([[True] * K, [True, False] * 2, [False] * K])
    initial = np.stack([_begin(one) for one in points])
    start = {"initial": initial, "usable": usable} if warm else {}
    run = lambda key, points, mask, start: kmeans(key, points, mask, num_clusters=K, num_steps=3, **start)
    batched = quick_compile(jax.vmap(run))(keys, points, masks, start)
    for k in range(3):
        one = quick_compile(run)(keys[k], points[k], masks[k], jax.tree.map(lambda a, k=k: a[k], start))
        np.testing.assert_array_equal(batched.label[k], one.label)
        np.testing.assert_array_equal(batched.counts[k], one.counts)
        np.testing.assert_allclose(batched.centers[k], one.centers, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(batched.cost[k], one.cost, rtol=1e-5)


def test_single_trace():
    compute = lambda key, points, mask, initial, usable: kmeans(
        key, points, mask, num_clusters=K, num_steps=2, initial=initial, usable=usable
    )
    traced = jax.jit(eqx.debug.assert_max_traces(compute, max_traces=1))
    for seed in range(3):
        points = _blobs(seed, dtype=np.float32)
        traced(jax.random.key(seed), points, np.arange(N) > seed, _begin(points), np.arange(K) > seed)


ALL, NONE = np.ones(N, bool), np.zeros(N, bool)
DEGENERATE = {  # points, mask, how many count, the cost
    "all masked": (_blobs(), NONE, 0, 0),
    "all NaN": (np.full((3, N), np.nan), ALL, 0, 0),
    "one coordinate NaN": (np.array([[np.nan], [1], [2]]) * np.ones(N), ALL, 0, 0),
    "infinite": (np.full((3, N), np.inf), ALL, 0, 0),
    "squares overflow": (np.full((3, N), 1e300), ALL, 0, 0),
    "all in one place": (np.full((3, N), 3.75), ALL, N, 0),
    "fewer points than centers": (_blobs(), np.arange(N) < 2, 2, 0),
    "some NaN": (np.where(np.arange(N) < N - 3, np.nan, _blobs()), ALL, 3, 0),
    "two places": (np.sign(_blobs(1)[:1]) * np.ones((3, N)), ALL, N, 0),
}


@pytest.mark.parametrize("begin", ["drawn", "given", "NaN"])
@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_degenerate(case, dtype, begin):
    points, mask, num, cost = DEGENERATE[case]
    with np.errstate(over="ignore"):
        points = points.astype(dtype)
    initial = {"drawn": None, "given": _begin(points[:, ::-1], K), "NaN": np.full((3, K), np.nan, dtype)}[begin]
    with jax.enable_x64(dtype == np.float64):
        found = _clusters(points, mask, initial=initial)
        value, gradient = _value_and_gradient(points, jax.random.key(0), mask, initial, 5)
    assert found.counts.sum() == (found.label >= 0).sum() == num
    assert (found.label[~mask] == -1).all()
    assert all(np.isfinite(leaf).all() for leaf in (*found, value, gradient))
    if begin != "given":
        np.testing.assert_allclose(found.cost, cost, atol=1e-9)


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("steps", [0, 2])
def test_hardly_any_points(n, steps):
    found = _clusters(np.full((3, n), 2, np.float32), steps=steps)
    np.testing.assert_array_equal(found.label, np.zeros(n))
    np.testing.assert_array_equal(found.counts, [n, 0, 0, 0])
    np.testing.assert_array_equal(found.centers, 2 * n)
    assert found.cost == 0


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_order_does_not_matter(seed):
    """From the same centers, points in another order have the same labels, and the same cost."""
    points, order = _blobs(seed), np.random.default_rng(seed).permutation(N)
    begin = _begin(points, seed=seed)
    with jax.enable_x64(True):
        before, after = _clusters(points, initial=begin), _clusters(points[:, order], initial=begin)
    np.testing.assert_array_equal(after.label, before.label[order])
    np.testing.assert_allclose(after.cost, before.cost, rtol=1e-12)
    np.testing.assert_allclose(after.centers, before.centers, rtol=1e-12, atol=1e-12)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, shift=st.floats(-100, 100), warm=st.booleans())
def test_rigid_motion_does_not_matter(seed, shift, warm):
    """Centers move with the points, also those that are drawn."""
    points = _blobs(seed)
    begin = _begin(points, seed=seed) if warm else None
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    move: Any = lambda X: None if X is None else rotation @ X + shift * np.array([[1.0], [-2], [3]])
    with jax.enable_x64(True):
        before, after = _clusters(points, initial=begin), _clusters(move(points), initial=move(begin))
    np.testing.assert_array_equal(after.label, before.label)
    np.testing.assert_allclose(after.cost, before.cost, rtol=1e-9)
    np.testing.assert_allclose(after.centers, move(before.centers), rtol=1e-9, atol=1e-9)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=SEEDS, filling=st.sampled_from([0.0, 1.0, 1e6, np.nan, np.inf]))
def test_masked_points_do_not_matter(seed, filling):
    """Slots that are masked out, anywhere between the others, change nothing, whatever they hold."""
    rng = np.random.default_rng(seed)
    points, places = _blobs(seed), np.sort(rng.permutation(80)[:N])
    mask = np.isin(np.arange(80), places)
    padded, zeros = filling * _blobs(seed + 1, 80), np.zeros((3, 80))
    padded[:, places] = zeros[:, places] = points
    begin = _begin(points, seed=seed)
    with jax.enable_x64(True):
        before, after = _clusters(points, initial=begin), _clusters(padded, mask, initial=begin)
        drawn, drawn_without = _clusters(padded, mask), _clusters(zeros, mask)
    np.testing.assert_array_equal(after.label[places], before.label)
    np.testing.assert_allclose(after.cost, before.cost, rtol=1e-12)
    np.testing.assert_allclose(after.centers, before.centers, rtol=1e-12, atol=1e-12)
    assert (after.label[~mask] == -1).all()
    jax.tree.map(np.testing.assert_array_equal, drawn, drawn_without)
