"""Voxels of clouds and grids against NumPy's groups in float64, and what a grid must do as points come and go."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox.debug import assert_max_traces
from flow_cases import all_finite
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxslam_kernels.depth.voxel_grid import (
    MAX_LOG_ODDS,
    MIN_LOG_ODDS,
    Voxels,
    centroids,
    changed,
    empty_grid,
    reduced_cloud,
    weighed,
    with_cloud,
)
from jaxslam_kernels.depth.voxel_hash import NO_ROW, empty_table, find_rows, key_corners, voxel_keys
from quick_compile import quick_compile, quick_compile_nested

N, CAPACITY = 600, 512
VOXEL_M = np.float32(0.1)

_reduce = quick_compile(assert_max_traces(partial(reduced_cloud, capacity=CAPACITY), max_traces=1))
_add = quick_compile(with_cloud)
_change = quick_compile(changed)
_all = quick_compile(partial(centroids, size=CAPACITY))


def _cloud(seed=0, dtype: type = np.float32):
    rng = np.random.default_rng(seed)
    X = (rng.uniform(-0.4, 0.4, (3, N)) + np.array([[0.0], [-3.0], [2.0]])).astype(dtype)
    return X, rng.uniform(0, 255, (3, N)).astype(dtype), np.ones(N, bool)


def _groups(X, color, mask, voxel_m=VOXEL_M):
    """`{voxel: (centroid, color, count)}` by a dictionary."""
    found: dict[tuple[int, ...], list[int]] = {}
    for index in np.flatnonzero(mask).tolist():
        found.setdefault(tuple(np.floor(X[:, index] / voxel_m).astype(int).tolist()), []).append(index)
    return {
        key: (X[:, rows].astype(np.float64).mean(axis=1), color[:, rows].mean(axis=1), len(rows))
        for key, rows in found.items()
    }


def _as_groups(voxels: Voxels, voxel_m=VOXEL_M):
    X, color, count = (np.asarray(array) for array in voxels[:3])
    rows = np.flatnonzero(count)
    keys = np.floor(X[:, rows] / voxel_m).astype(int)
    return {tuple(key.tolist()): (X[:, row], color[:, row], count[row]) for key, row in zip(keys.T, rows, strict=True)}


def _assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key, (X, color, count) in theirs.items():
        np.testing.assert_allclose(ours[key][0], X, atol=2e-6)
        np.testing.assert_allclose(ours[key][1], color, atol=2e-3)
        np.testing.assert_allclose(ours[key][2], count, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes(dtype):
    with jax.enable_x64(True):
        voxels = jax.eval_shape(partial(reduced_cloud, capacity=CAPACITY), *_cloud(dtype=dtype), dtype(0.1))
        grid = jax.eval_shape(partial(empty_grid, CAPACITY, dtype))
    assert voxels.X.shape == voxels.color.shape == (3, CAPACITY)
    assert voxels.counts.shape == (CAPACITY,)
    assert voxels.X.dtype == voxels.counts.dtype == grid.sums.dtype == dtype
    assert grid.sums.shape == (CAPACITY, 8)


class TestMatchesReference:
    def test_matches_reference(self):
        X, color, mask = _cloud()
        mask[::7] = False
        voxels = _reduce(X, color, mask, VOXEL_M)
        theirs = _groups(X, color, mask)
        assert 100 < len(theirs) < CAPACITY
        assert int(voxels.num) == len(theirs)
        _assert_same(_as_groups(voxels), theirs)

    def test_grid_of_two_clouds(self):
        first, second = _cloud(1), _cloud(2)
        grid, one = empty_grid(CAPACITY), np.ones(N, np.float32)
        for X, color, _ in (first, second):
            grid, rows = _add(grid, X, color, one, one, VOXEL_M)
            assert np.all(np.asarray(rows) != NO_ROW)
        X, color, mask = (np.concatenate(arrays, axis=-1) for arrays in zip(first, second, strict=True))
        _assert_same(_as_groups(_all(grid, np.int32(0), VOXEL_M)), _groups(X, color, mask))

    def test_keys_are_octomaps(self):
        """Voxel `i` reaches from `i` times its side on, and counts from 32,768."""
        X = np.array([[0.05, -0.05], [-0.25, 0.25], [0.0, -6.4]], np.float32)
        keys, inside = voxel_keys(jnp.asarray(X), jnp.float32(0.1))
        assert np.all(inside)
        np.testing.assert_array_equal(np.asarray(keys[0]) >> 16, [32768, 32767])
        np.testing.assert_array_equal(np.asarray(keys[0]) & 0xFFFF, [32765, 32770])
        np.testing.assert_array_equal(keys[1], [32768, 32704])
        np.testing.assert_allclose(key_corners(keys, jnp.float32(0.1))[1], [-0.3, 0.2], atol=1e-6)


class TestGrid:
    def test_what_is_taken_out_was_never_there(self):
        """The grid is linear: with one cloud added and taken out again it is that of the other."""
        stays, goes = _cloud(3), _cloud(4)
        grid, one = empty_grid(CAPACITY), np.ones(N, np.float32)
        grid, _ = _add(grid, *stays[:2], one, one, VOXEL_M)
        grid, rows = _add(grid, *goes[:2], one, one, VOXEL_M)
        grid = _change(grid, rows, *goes[:2], -one, -one, VOXEL_M)
        _assert_same(_as_groups(_all(grid, np.int32(0), VOXEL_M)), _groups(*stays))

    def test_rows_stay(self):
        X, color, _ = _cloud(5)
        one = np.ones(N, np.float32)
        grid, rows = _add(empty_grid(CAPACITY), X, color, one, one, VOXEL_M)
        again, same = _add(grid, X[:, ::-1], color, one, one, VOXEL_M)
        np.testing.assert_array_equal(rows, same[::-1])
        assert int(again.table.num) == int(grid.table.num)

    def test_log_odds_are_bounded(self):
        X, color, _ = _cloud(6)
        one = np.ones(N, np.float32)
        grid, rows = _add(empty_grid(CAPACITY), X, color, one, 10 * one, VOXEL_M)
        assert np.all(grid.log_odds[np.asarray(rows)] == MAX_LOG_ODDS)
        less = weighed(grid, jnp.int32(0), jnp.full(CAPACITY, -10, jnp.float32))
        assert np.all(less.log_odds == MIN_LOG_ODDS)

    def test_full(self):
        """What there is no room for is left out, and what is in stays as it is."""
        X, color, _ = _cloud(7)
        one = np.ones(N, np.float32)
        grid, rows = _add(empty_grid(50), X, color, one, one, VOXEL_M)
        assert int(grid.table.num) == 50
        assert 50 <= np.count_nonzero(np.asarray(rows) != NO_ROW) < N
        again, same = _add(grid, X, color, one, one, VOXEL_M)
        np.testing.assert_array_equal(rows, same)
        np.testing.assert_allclose(again.sums[:, 6], 2 * grid.sums[:, 6])
        voxels = quick_compile(partial(reduced_cloud, capacity=50))(X, color, np.ones(N, bool), VOXEL_M)
        assert int(voxels.num) == len(_groups(X, color, np.ones(N, bool)))

    def test_rows_by_a_dictionary(self):
        """Keys that come in many turns, most of them again: each has one row, and no two share one."""
        rng, table, known = np.random.default_rng(0), empty_table(4000), {}
        look = quick_compile(find_rows)
        for _ in range(12):
            keys = rng.integers(0, 60, (2, N)).astype(np.uint32)
            table, rows, left_out = look(table, keys, np.ones(N, bool))
            assert int(left_out) == 0
            for key, row in zip(keys.T.tolist(), np.asarray(rows).tolist(), strict=True):
                assert known.setdefault(tuple(key), row) == row
        assert sorted(known.values()) == list(range(len(known)))
        assert int(table.num) == len(known)


def test_gradient():
    """Forward, reverse and central differences agree while no point changes its voxel."""
    with jax.enable_x64(True):
        X, color, mask = _cloud(dtype=np.float64)
        X[0, :3] = X[0, 0]  # alone or together, on the border or not
        rng = np.random.default_rng(1)
        weights = rng.normal(size=(2, 3, CAPACITY))

        @quick_compile_nested
        def loss(X, color):
            voxels = reduced_cloud(X, color, jnp.asarray(mask), jnp.float64(0.1), capacity=CAPACITY)
            return jnp.sum(weights[0] * voxels.X) + jnp.sum(weights[1] * voxels.color)

        reverse = quick_compile(jax.grad(loss, (0, 1)))(X, color)
        for which in range(2):
            direction = [np.zeros_like(X), np.zeros_like(X)]
            direction[which] = rng.normal(size=X.shape)
            ahead, behind = ([a + s * 1e-7 * d for a, d in zip((X, color), direction, strict=True)] for s in (1, -1))
            numeric = (loss(*ahead) - loss(*behind)) / 2e-7
            forward = jax.jvp(loss, (X, color), tuple(direction))[1]
            np.testing.assert_allclose(np.sum(reverse[which] * direction[which]), forward, rtol=1e-9)
            np.testing.assert_allclose(forward, numeric, rtol=1e-5)


def test_vmap_equals_loop():
    clouds = [_cloud(seed) for seed in range(3)]
    stacked = [np.stack(arrays) for arrays in zip(*clouds, strict=True)]
    batched = quick_compile(jax.vmap(partial(reduced_cloud, capacity=CAPACITY), (0, 0, 0, None)))(*stacked, VOXEL_M)
    for index, cloud in enumerate(clouds):
        alone = _reduce(*cloud, VOXEL_M)
        for one, expected in zip(batched, alone, strict=True):
            np.testing.assert_allclose(one[index], expected, atol=1e-4)


def test_single_trace():
    """`_reduce` refuses a second trace; points, mask and side of the voxels change without one."""
    nums = [int(_reduce(*_cloud(seed), np.float32(side)).num) for seed, side in ((0, 0.1), (1, 0.2), (2, 1.0))]
    assert nums[0] > nums[1] > nums[2] > 0


class TestDegenerate:
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
    def test_degenerate(self, value):
        """No points; points that are none, or too far away: no voxel, and finite gradients."""
        X, color, mask = _cloud()
        for points, wanted in ((X, ~mask), (np.full_like(X, value), mask)):
            voxels = _reduce(points, color, wanted, VOXEL_M)
            assert int(voxels.num) == 0
            assert not np.any(voxels.counts)
            assert all_finite(voxels)
            total = lambda *inputs: jnp.sum(reduced_cloud(*inputs, capacity=CAPACITY).X)
            assert all_finite(quick_compile(jax.grad(total))(points, color, wanted, VOXEL_M))

    def test_grid_of_nothing(self):
        X, color, _ = _cloud()
        none = np.zeros(N, np.float32)
        grid, rows = _add(empty_grid(CAPACITY), np.full_like(X, np.nan), color, none + 1, none, VOXEL_M)
        assert np.all(rows == NO_ROW)
        grid, rows = _add(grid, X, color, none, none, VOXEL_M)
        assert np.all(rows == NO_ROW)
        assert int(grid.table.num) == 0
        assert all_finite(_all(grid, np.int32(0), VOXEL_M))

    def test_all_in_one(self):
        _, color, mask = _cloud()
        voxels = _reduce(np.full((3, N), 0.05, np.float32), color, mask, VOXEL_M)
        assert int(voxels.num) == 1
        np.testing.assert_allclose(voxels.counts[0], N)
        np.testing.assert_allclose(voxels.color[:, 0], color.mean(axis=1), rtol=1e-5)


class TestInvariances:
    @settings(max_examples=10, deadline=None)
    @given(seed=st.integers(0, 2**16))
    def test_order_of_points(self, seed):
        X, color, mask = _cloud(seed)
        order = np.random.default_rng(seed).permutation(N)
        alone, other = _reduce(X, color, mask, VOXEL_M), _reduce(X[:, order], color[:, order], mask, VOXEL_M)
        _assert_same(_as_groups(other), _as_groups(alone))

    @settings(max_examples=10, deadline=None)
    @given(steps=st.tuples(*[st.integers(-50, 50)] * 3))
    def test_whole_voxels_further(self, steps):
        X, color, mask = _cloud()
        shift = (np.array(steps, np.float32) * np.float32(0.125))[:, None]
        size = np.float32(0.125)  # exact
        alone, other = _reduce(X, color, mask, size), _reduce(X + shift, color, mask, size)
        assert abs(int(other.num) - int(alone.num)) <= 2  # a point on a border may be rounded beyond it
        np.testing.assert_allclose(np.sum(other.counts), N)
