"""Motion beyond that of the camera: against NumPy, and in scenes where what moves is known."""

from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from jaxlie import SE3
from jaxslam_kernels.scene_flow import GroupMotion, flow_length, group_motion, scene_flow, upper_limit
from quick_compile import quick_compile_nested
from scipy.spatial.transform import Rotation

SEEDS = st.integers(0, 2**32 - 1)
N, K = 40, 4


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _scene(seed=0, dtype: Any = np.float64):
    """Points in the world, where they are now in the axes of a camera, its pose; those of the last group have moved."""
    rng = np.random.default_rng(seed)
    X_world = rng.uniform([-2, -1, 2], [2, 1, 5], (N, 3)).T
    rotation = Rotation.from_rotvec(rng.normal(0, 0.1, 3))
    position = rng.normal(0, 0.2, 3)
    group = np.arange(N) % K
    there = X_world + np.where(group == K - 1, 0.3, 0.0) * np.array([[1.0], [0.5], [0.0]])
    X_cam = rotation.inv().apply(there.T - position).T + rng.normal(0, 1e-3, (3, N))
    pose = np.concatenate([rotation.as_quat(scalar_first=True), position])
    return X_world.astype(dtype), X_cam.astype(dtype), pose.astype(dtype), group.astype(np.int32)


@partial(quick_compile_nested, static_argnames="robust")
def _state(X_world, X_cam, pose, group, robust=True) -> tuple[jax.Array, GroupMotion]:
    """The limit of the points of the first groups, and how all groups move by it."""
    flow = scene_flow(jnp.asarray(X_world), jnp.asarray(X_cam), SE3(jnp.asarray(pose)))
    length = flow_length(flow)
    limit = upper_limit(length, (jnp.asarray(group) < K - 1).astype(flow.dtype), 3.0, robust=robust)
    moves = (length > limit).astype(flow.dtype)
    return limit, group_motion(flow, moves, jnp.ones(N, bool), jnp.asarray(group), K)


def test_shapes():
    limit, state = _state(*_scene(dtype=np.float32))
    assert limit.shape == ()
    assert limit.dtype == jnp.float32
    assert all(part.shape == (K,) and part.dtype == jnp.float32 for part in state)


@pytest.mark.parametrize("robust", [True, False])
def test_matches_reference(x64, robust):
    X_world, X_cam, pose, group = _scene(3)
    limit, state = _state(X_world, X_cam, pose, group, robust)
    rotation = Rotation.from_quat(pose[:4], scalar_first=True)
    flow = X_cam - rotation.inv().apply(X_world.T - pose[4:]).T
    length = np.linalg.norm(flow, axis=0)
    rest = length[group < K - 1]
    if robust:
        middle = np.sort(rest)[(len(rest) - 1) // 2]
        deviations = np.sort(np.abs(rest - middle))
        expected = middle + 3 * 1.4826 * deviations[(len(rest) - 1) // 2]
        np.testing.assert_allclose(limit, expected, rtol=1e-4)
    else:
        np.testing.assert_allclose(limit, rest.mean() + 3 * rest.std(ddof=1), rtol=1e-12)
    for number in range(K):
        there = group == number
        np.testing.assert_allclose(state.share[number], np.mean(length[there] > limit), rtol=1e-12)
        np.testing.assert_allclose(state.mean[number], np.linalg.norm(flow[:, there].mean(axis=1)), rtol=1e-9)
    assert state.share[K - 1] == 1
    assert (state.share[: K - 1] < 0.3).all()


@pytest.mark.parametrize("robust", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_gradient(x64, robust):
    X_world, X_cam, pose, group = _scene(1)

    def loss(X_cam, weight):
        flow = scene_flow(jnp.asarray(X_world), X_cam, SE3(jnp.asarray(pose)))
        length = flow_length(flow)
        limit = upper_limit(length, jnp.where(jnp.asarray(group) < K - 1, weight, 0), 3.0, robust=robust)
        soft = jax.nn.sigmoid((length - limit) / limit)
        state = group_motion(flow, soft, jnp.ones(N, bool), jnp.asarray(group), K)
        return jnp.sum(state.share * jnp.arange(1.0, K + 1)) + 10 * jnp.sum(state.mean)

    at = jnp.asarray(X_cam), jnp.ones(N)
    check_grads(jax.jit(lambda X: loss(X, at[1])), at[:1], order=1, modes=("fwd", "rev"), eps=1e-7, rtol=1e-4)
    if not robust:  # a median does not depend on weights, but where it jumps
        check_grads(jax.jit(loss), at, order=1, modes=("fwd", "rev"), eps=1e-7, rtol=1e-4)


@pytest.mark.slow
def test_gradient_without_motion(x64):
    X_world, _, _pose, group = _scene(1)

    def loss(X_cam):
        flow = X_cam - jnp.asarray(X_world)
        state = group_motion(flow, flow_length(flow), jnp.ones(N, bool), jnp.asarray(group), K)
        return jnp.sum(state.mean) + upper_limit(flow_length(flow), jnp.ones(N), 3.0, robust=False)

    assert np.isfinite(jax.grad(loss)(jnp.asarray(X_world))).all()


def test_vmap_equals_loop():
    scenes = [_scene(seed, np.float32) for seed in range(3)]
    a, b, c, d = (np.stack(part) for part in zip(*scenes, strict=True))
    together = jax.vmap(_state)(a, b, c, d)
    for number, scene in enumerate(scenes):
        alone = _state(*scene)
        one = jax.tree.map(itemgetter(number), together)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), one, alone)


def test_single_trace():
    traces = []

    def counted(*scene):
        traces.append(1)
        return _state(*scene)

    compiled = jax.jit(counted)
    for seed in range(3):
        compiled(*_scene(seed, np.float32))
    assert len(traces) == 1


@pytest.mark.parametrize("bad", ["nothing counts", "one point", "not a number", "no group"])
@pytest.mark.parametrize("robust", [True, False])
def test_degenerate(bad, robust):
    X_world, X_cam, pose, group = _scene(2, np.float32)
    weights = np.ones(N, np.float32)
    counts = np.ones(N, bool)
    if bad == "nothing counts":
        weights[:], counts[:] = 0, False
    elif bad == "one point":
        weights[1:], counts[1:] = 0, False
    elif bad == "not a number":
        X_cam[:, ::5] = np.nan
    else:
        group[:] = -1

    def loss(X_cam):
        flow = scene_flow(jnp.asarray(X_world), X_cam, SE3(jnp.asarray(pose)))
        known = jnp.isfinite(flow).all(axis=0)
        flow = jnp.where(known[None, :], flow, 0)
        length = flow_length(flow)
        limit = upper_limit(length, jnp.where(known, weights, 0), 3.0, robust=robust)
        state = group_motion(flow, length, jnp.asarray(counts), jnp.asarray(group), K)
        return limit + jnp.sum(state.mean) + jnp.sum(state.share), (limit, state)

    (_, (limit, state)), gradient = jax.value_and_grad(loss, has_aux=True)(jnp.asarray(X_cam))
    assert all(np.isfinite(part).all() for part in (limit, *state))
    assert np.isfinite(gradient).all()
    if bad == "nothing counts":
        assert limit == 0
        assert not state.number.any()
    if bad == "no group":
        assert not state.number.any()


def test_bad_points_are_in_no_group():
    flow = jnp.asarray(np.array([[1.0, np.nan, 1.0], [0, 0, 0], [0, 0, 0]], np.float32))
    state = group_motion(flow, jnp.ones(3), jnp.ones(3, bool), jnp.zeros(3, jnp.int32), 1)
    assert state.number[0] == 2
    assert state.mean[0] == 1
    length = jnp.array([0.1, np.nan, 0.1, np.inf], jnp.float32)
    assert upper_limit(length, jnp.ones(4), 3.0, robust=False) == pytest.approx(0.1)
    assert upper_limit(length, jnp.ones(4), 3.0) == pytest.approx(0.1)


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_camera_motion_makes_none(seed):
    """Points at rest do not move, however the camera does, in any order."""
    X_world, X_cam, pose, group = _scene(seed, np.float32)
    rotation = Rotation.from_quat(pose[:4], scalar_first=True)
    at_rest = rotation.inv().apply(X_world.T - pose[4:]).T.astype(np.float32)
    flow = scene_flow(jnp.asarray(X_world), jnp.asarray(at_rest), SE3(jnp.asarray(pose)))
    assert np.abs(flow).max() < 1e-5
    order = np.random.default_rng(seed).permutation(N)
    limit, state = _state(X_world, X_cam, pose, group)
    again, shuffled = _state(X_world[:, order], X_cam[:, order], pose, group[order])
    np.testing.assert_allclose(limit, again, rtol=1e-5)
    np.testing.assert_allclose(state.mean, shuffled.mean, rtol=1e-4, atol=1e-6)
