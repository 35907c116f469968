"""The network that scores points in groups: against NumPy, and for what must not matter to it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxslam_kernels.point_network import PointNetwork, PointScores, network_shapes, score_points
from quick_compile import quick_compile

N, F, C, K, H = 30, 5, 3, 4, 6
SEEDS = st.integers(0, 2**32 - 1)
_score = quick_compile(score_points)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _network(seed: int = 0, dtype: Any = np.float64) -> PointNetwork:
    rng = np.random.default_rng(seed)
    return PointNetwork(
        **{name: jnp.asarray(rng.normal(size=shape), dtype) for name, shape in network_shapes(F, C, H).items()}
    )


def _points(seed: int = 0, n: int = N, dtype: Any = np.float64) -> tuple[np.ndarray, ...]:
    """Features of points and groups, the group of each point, -1 for some, and which count."""
    rng = np.random.default_rng(seed)
    features, of_groups = rng.normal(size=(F, n)).astype(dtype), rng.normal(size=(C, K)).astype(dtype)
    return features, of_groups, rng.integers(-1, K, n).astype(np.int32), rng.random(n) < 0.8


def _scored(network: PointNetwork, *points: Any) -> PointScores:
    return jax.tree.map(np.asarray, _score(jax.tree.map(jnp.asarray, network), *points))


def _by_definition(network: PointNetwork, features, of_groups, group_of, mask) -> tuple[np.ndarray, np.ndarray]:
    """Scores of points and groups, one after the other."""
    network = jax.tree.map(np.asarray, network)
    embedded = {i: np.tanh(network.embed @ features[:, i] + network.embed_bias) for i in np.flatnonzero(mask)}
    mean = lambda chosen: np.mean([embedded[i] for i in chosen], axis=0) if chosen else np.zeros(H)
    of_all = mean(list(embedded))
    joined, groups = [], []
    for k in range(K):
        own = mean([i for i in embedded if group_of[i] == k])
        joined.append(np.tanh(network.join @ np.concatenate([own, of_all, of_groups[:, k]]) + network.join_bias))
        groups.append(network.group @ joined[-1] + network.group_bias)
    points = np.zeros(features.shape[1])
    for i, own in embedded.items():
        group = group_of[i]
        layer, start = (joined[group], groups[group]) if group >= 0 else (np.zeros(H), 0.0)
        refined = np.tanh(network.refine @ np.concatenate([own, layer, of_all]) + network.refine_bias)
        points[i] = start + network.point @ refined + network.point_bias
    return points, np.array(groups)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(dtype == np.float64):
        found = _scored(_network(dtype=dtype), *_points(dtype=dtype))
    assert (found.point.shape, found.group.shape, found.number.shape) == ((N,), (K,), (K,))
    assert {part.dtype for part in found} == {np.dtype(dtype)}


@pytest.mark.parametrize("seed", range(3))
def test_matches_reference(x64, seed):
    network, points = _network(seed), _points(seed)
    found, (by_point, by_group) = _scored(network, *points), _by_definition(network, *points)
    np.testing.assert_allclose(found.point, by_point, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(found.group, by_group, rtol=1e-10, atol=1e-10)
    _, _, group_of, mask = points
    np.testing.assert_array_equal(found.number, [np.count_nonzero(mask & (group_of == k)) for k in range(K)])


@pytest.mark.parametrize("seed", range(3))
def test_single_precision(seed):
    single = _scored(_network(seed, np.float32), *_points(seed, n=1000, dtype=np.float32))
    with jax.enable_x64(True):
        double = _scored(_network(seed), *_points(seed, n=1000))
    np.testing.assert_allclose(single.point, double.point, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(single.group, double.group, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_gradient_where_no_point_counts(x64):
    """By all weights and features, forward and reverse, to second order."""
    features, of_groups, group_of, mask = _points()
    fixed = jnp.asarray(group_of), jnp.zeros(mask.shape, bool)

    def made(network, features, of_groups):  # NumPy's where they are differences
        network = jax.tree.map(jnp.asarray, network)
        return score_points(network, jnp.asarray(features), jnp.asarray(of_groups), *fixed)[:2]

    check_grads(made, (_network(), jnp.asarray(features), jnp.asarray(of_groups)), order=2)


def test_vmap_equals_loop(x64):
    network = _network()
    several = [_points(seed) for seed in range(3)]
    together = quick_compile(jax.vmap(score_points, (None, 0, 0, 0, 0)))(
        network, *map(np.stack, zip(*several, strict=True))
    )
    for index, points in enumerate(several):
        alone = _scored(network, *points)
        for part, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(part[index], one, rtol=1e-12, atol=1e-12)


def test_single_trace(x64):
    traced = []

    @quick_compile
    def counted(*arguments):
        traced.append(1)
        return score_points(*arguments)

    for seed in range(3):
        counted(_network(seed), *_points(seed))
    assert len(traced) == 1


@given(SEEDS)
@settings(deadline=None, max_examples=20)
def test_order_of_points_does_not_matter(seed):
    with jax.enable_x64(True):
        network, (features, of_groups, group_of, mask) = _network(seed), _points(seed)
        order = np.random.default_rng(seed).permutation(N)
        plain = _scored(network, features, of_groups, group_of, mask)
        mixed = _scored(network, features[:, order], of_groups, group_of[order], mask[order])
        np.testing.assert_allclose(mixed.point, plain.point[order], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(mixed.group, plain.group, rtol=1e-9, atol=1e-9)


class TestDegenerate:
    def test_points_that_do_not_count_are_not_read(self, x64):
        features, of_groups, group_of, mask = _points()
        wild = np.where(mask, features, np.nan)
        for part, plain in zip(
            _scored(_network(), wild, of_groups, group_of, mask),
            _scored(_network(), features, of_groups, group_of, mask),
            strict=True,
        ):
            np.testing.assert_array_equal(part, plain)

    def test_features_that_are_not_finite(self, x64):
        """Such a point does not count; such a feature of a group is zero."""
        features, of_groups, group_of, mask = _points()
        broken = features.copy()
        broken[1, 3] = np.nan
        found = _scored(_network(), broken, of_groups, group_of, np.ones_like(mask))
        without = _scored(_network(), features, of_groups, group_of, np.arange(N) != 3)
        np.testing.assert_array_equal(found.point, without.point)
        assert found.point[3] == 0
        of_groups = np.where(np.arange(K) == 2, np.inf, of_groups)
        zeroed = np.where(np.arange(K) == 2, 0, of_groups)
        np.testing.assert_array_equal(
            _scored(_network(), features, of_groups, group_of, mask).group,
            _scored(_network(), features, zeroed, group_of, mask).group,
        )

    @pytest.mark.parametrize("group", [-1, K, 10**6])
    def test_no_such_group(self, x64, group):
        features, of_groups, _, mask = _points()
        found = _scored(_network(), features, of_groups, np.full(N, group, np.int32), mask)
        assert not found.number.any()
        assert np.isfinite(found.point).all()
        assert (found.point[mask] != 0).all()

    def test_nothing_counts(self, x64):
        features, of_groups, group_of, mask = map(jnp.asarray, _points())

        def total(network):
            scores = score_points(network, features, of_groups, group_of, jnp.zeros_like(mask))
            return sum(jnp.sum(jnp.square(part)) for part in scores)

        assert not _scored(_network(), features, of_groups, group_of, jnp.zeros_like(mask)).point.any()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(quick_compile(jax.grad(total))(_network())))

    def test_a_network_that_does_not_fit(self):
        network, points = _network(dtype=np.float32), [*map(jnp.asarray, _points(dtype=np.float32))]
        with pytest.raises(ValueError, match=r"network.join: expected \(6, 15\) for 5 features of points, 3 of groups"):
            score_points(network._replace(join=jnp.zeros((H, 2))), *points)
        with pytest.raises(ValueError, match=r"features: expected float \(5, n\), got float32 \(4, 30\)"):
            score_points(network, points[0][:4], *points[1:])
