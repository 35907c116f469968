"""What depth images confirm and see past, against a loop over points in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox.debug import assert_max_traces
from flow_cases import all_finite
from jaxlie import SE3
from jaxslam_kernels.camera import make_intrinsics
from jaxslam_kernels.depth.free_space import classify_visibility
from quick_compile import quick_compile

HEIGHT, WIDTH, N = 40, 60, 900
INTRINSICS = make_intrinsics(50.0, 50.0, 30.0, 20.0)
POSE = np.array([0.99, 0.05, -0.1, 0.02, 0.3, -0.2, 0.1], np.float32)
POSE[:4] /= np.linalg.norm(POSE[:4])


def _run(X, pose, depth, least):
    return classify_visibility(
        X, SE3(pose), depth, least, INTRINSICS, same_share=jnp.float32(0.03), same_m=jnp.float32(0.03)
    )


_see = quick_compile(assert_max_traces(_run, max_traces=1))


def _case(seed=0):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 4, (HEIGHT, WIDTH)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0
    X_cam = rng.uniform((-2, -1.5, -1), (2, 1.5, 5), (N, 3)).T
    R = np.asarray(SE3(jnp.asarray(POSE)).rotation().as_matrix(), np.float64)
    return (R @ X_cam + POSE[4:, None]).astype(np.float32), POSE, depth, depth, X_cam


def test_shapes():
    seen = jax.eval_shape(_run, *(jnp.asarray(array) for array in _case()[:4]))
    assert seen.there.shape == seen.past.shape == (N,)
    assert seen.there.dtype == seen.past.dtype == bool


def test_matches_reference():
    X, pose, depth, least, X_cam = _case()
    seen = _see(X, pose, depth, least)
    counts = {"there": 0, "past": 0}
    for index, (x, y, z) in enumerate(X_cam.T):
        there = past = False
        if z > 0.01:
            u, v = round(50 * x / z + 30), round(50 * y / z + 20)
            if 0 <= u < WIDTH and 0 <= v < HEIGHT and depth[v, u] > 0:
                there = abs(depth[v, u] - z) <= 0.03 * z + 0.03
                past = depth[v, u] - z > 2 * (0.03 * z + 0.03)
        assert (bool(seen.there[index]), bool(seen.past[index])) == (there, past)
        counts["there"] += there
        counts["past"] += past
    assert min(counts.values()) > 5


def test_outlines_see_nothing_past():
    X, pose, depth, least, _ = _case()
    assert np.any(_see(X, pose, depth, least).past)
    assert not np.any(_see(X, pose, depth, np.zeros_like(least)).past)


def test_gradient():
    """All that comes out is yes or no: nothing flows back, and that is finite."""
    X, pose, depth, least, _ = _case()
    total = lambda *inputs: jnp.sum(jnp.where(_run(*inputs).past, 1.0, 0.0))
    gradients = quick_compile(jax.grad(total, (0, 1, 2, 3)))(X, pose, depth, least)
    assert all_finite(gradients)
    assert not any(np.any(gradient) for gradient in gradients)


def test_vmap_equals_loop():
    cases = [_case(seed)[:4] for seed in range(3)]
    batched = quick_compile(jax.vmap(_run))(*(np.stack(arrays) for arrays in zip(*cases, strict=True)))
    for index, case in enumerate(cases):
        for one, expected in zip(batched, _see(*case), strict=True):
            np.testing.assert_array_equal(one[index], expected)


def test_single_trace():
    """`_see` refuses a second trace."""
    found = [np.asarray(_see(*_case(seed)[:4]).past) for seed in range(3)]
    assert not np.array_equal(found[0], found[1])


@pytest.mark.parametrize("which", range(4))
def test_degenerate(which):
    inputs = [array.copy() for array in _case()[:4]]
    inputs[which][:] = np.nan
    seen = _see(*inputs)
    assert not np.any(seen.past & (which != 2))
    assert not np.any(seen.there & (which != 3))
    total = lambda X, *rest: jnp.sum(jnp.where(_run(X, *rest).there, 1.0, 0.0))
    assert all_finite(quick_compile(jax.grad(total))(*inputs))
