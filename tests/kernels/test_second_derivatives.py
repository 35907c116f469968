"""Second derivatives: right, or an error that says that there are none. Never a wrong number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.camera import make_intrinsics, normalize
from jaxslam_kernels.first_order import first_order
from jaxslam_kernels.flow.lk_flow import FlowPlan, lk_flow
from jaxslam_kernels.flow.lk_search import LevelPlan
from jaxslam_kernels.flow.patch_align import align_patches
from jaxslam_kernels.image.pyramid import build_pyramid
from quick_compile import quick_compile
from small_problems import (
    adjust,
    bundle_inputs,
    graph_inputs,
    match,
    match_inputs,
    optimize,
    pose_inputs,
    ransac,
    refine,
)

SOLVERS = {
    "refine_pose": (lambda w: refine(pose_inputs(), w).T_world_cam.wxyz_xyz.sum(), 12),
    "refine_pose cost": (lambda w: refine(pose_inputs(), w).cost, 12),
    "ransac_pnp": (lambda w: ransac(pose_inputs(), w).T_world_cam.wxyz_xyz.sum(), 12),
    "bundle_adjust": (lambda w: adjust(bundle_inputs(), w).X_world.sum(), 8),
    "optimize_pose_graph": (lambda w: optimize(graph_inputs(), w).T_world_cam.wxyz_xyz.sum(), 6),
    "ransac_fundamental": (lambda w: match(match_inputs(), w).F.sum(), 20),
}
ORDERS = {
    "hessian": jax.hessian,
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "change of a gradient": lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (x,)),
    "compiled": lambda f: jax.hessian(jax.jit(f)),
    "of compiled": lambda f: jax.jacfwd(jax.jit(jax.grad(f))),
    "of a checkpoint": lambda f: jax.hessian(jax.checkpoint(f)),
    "batch": lambda f: lambda x: jax.vmap(jax.hessian(f))(jnp.stack([x, x])),
    "scan": lambda f: jax.hessian(lambda x: jax.lax.scan(lambda c, _: (c + f(x), None), 0.0 * x, length=2)[0]),
}


pytestmark = pytest.mark.usefixtures("float64")


@jax.custom_jvp
def _guarded_cube(x):
    return x**3


@_guarded_cube.defjvp
def _guarded_cube_jvp(primals, tangents):
    (x,) = first_order(primals, "cube")
    return _guarded_cube(x), 3 * x**2 * tangents[0]


@pytest.mark.parametrize("solver", SOLVERS)
def test_raises(solver):
    f, n = SOLVERS[solver]
    name = solver.split()[0].replace("ransac_pnp", "refine_pose")  # it is the refinement that has none
    with pytest.raises(NotImplementedError, match=f"second derivatives of {name} are not implemented.*finite differ"):
        jax.eval_shape(jax.hessian(f), jnp.ones(n))


@pytest.mark.parametrize("order", ORDERS)
def test_raises_in_any_order(order):
    with pytest.raises(NotImplementedError, match="second derivatives of cube"):
        jax.eval_shape(ORDERS[order](_guarded_cube), jnp.ones(()))


def test_of_what_the_solver_does_not_see():
    """A second derivative by something else, or a first one by each of two, goes through."""
    inputs = pose_inputs()
    pose = lambda w: refine(inputs, w).T_world_cam.wxyz_xyz.sum()
    loss = lambda x, w: jnp.sum(jnp.square(x)) * pose(w)
    jax.eval_shape(jax.hessian(loss), jnp.ones(2), jnp.ones(12))
    jax.eval_shape(jax.jacfwd(jax.grad(loss), argnums=1), jnp.ones(2), jnp.ones(12))
    with pytest.raises(NotImplementedError):
        jax.eval_shape(jax.jacfwd(jax.grad(loss, argnums=1), argnums=1), jnp.ones(2), jnp.ones(12))


FIRST_ORDERS = {
    "reverse": jax.grad,
    "forward": jax.jacfwd,
    "compiled": lambda f: jax.jit(jax.grad(jax.jit(f))),
    "checkpoint": lambda f: jax.grad(jax.checkpoint(f)),
    "linearize": lambda f: lambda x: jax.linearize(f, x)[1](jnp.ones_like(x)),
    "vmap": lambda f: lambda x: jax.vmap(jax.grad(f))(x[None])[0],
    "scan": lambda f: jax.grad(lambda x: jax.lax.scan(lambda c, x: (c + f(x), None), jnp.zeros(()), x[None])[0]),
    "cond": lambda f: jax.grad(lambda x: jax.lax.cond(x > 0, f, lambda x: 2 * x, x)),
    "while": lambda f: jax.jacfwd(
        lambda x: jax.lax.while_loop(lambda c: c[0] < 1, lambda c: (c[0] + 1, f(x)), (0, x))[1]
    ),
}


@pytest.mark.parametrize("order", FIRST_ORDERS)
def test_first_derivatives_go_through(order):
    assert FIRST_ORDERS[order](_guarded_cube)(jnp.asarray(3.0)) == 27.0


def _texture(shift):
    v, u = np.mgrid[:40, :40].astype(float)
    return jnp.asarray(128 + 40 * np.sin(0.35 * (u + shift)) + 30 * np.cos(0.29 * v) + 20 * np.sin(0.2 * u + 0.31 * v))


POINTS = np.array([[17.3, 22.6], [20.7, 18.2]])
LEVEL = LevelPlan(9, 60, 1e-9)


def _flow(t):
    moved = jnp.asarray(np.random.default_rng(0).normal(size=(2, 40, 40)))
    previous, current = (build_pyramid(_texture(s) + t * m, num_levels=1) for s, m in zip((0, 0.7), moved, strict=True))
    flow = lk_flow(previous, current, POINTS + 0.1 * t, plan=FlowPlan(LEVEL, LEVEL, LEVEL))
    return jnp.concatenate([flow.points.ravel(), flow.residual, flow.texture])


def _patches(t):
    moved = jnp.asarray(np.random.default_rng(1).normal(size=(2, 40, 40)))
    pictures = (_texture(0) + t * moved[0])[None]
    current = build_pyramid(_texture(0.7) + t * moved[1], num_levels=1)
    warp = jnp.broadcast_to(jnp.eye(2)[:, :, None], (2, 2, 2)) * (1 + 0.01 * t)
    match = align_patches(
        pictures,
        jnp.zeros(2, jnp.int32),
        POINTS + 0.1 * t,
        warp,
        current,
        jnp.asarray(POINTS),
        jnp.ones(2, bool),
        plan=LEVEL,
    )
    return jnp.concatenate([match.points.ravel(), match.correlation])


def _directions(t):
    camera = make_intrinsics(200.0, 210.0, 80.0, 60.0, (0.2, -0.1, 0.002, -0.003, 0.03), dtype=jnp.float64)
    moved = camera._replace(fx=camera.fx + 10 * t, distortion=camera.distortion * (1 + t))
    return normalize(moved, jnp.array([[20.0, 150, 80], [30.0, 100, 61]]) + 10 * t).ravel()


@pytest.mark.parametrize("kernel", [_flow, _patches, _directions])
def test_right(kernel):
    """Those that are found by iteration and have a second derivative: equal to differences of the first."""
    along = lambda f, t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]
    first = lambda t: along(kernel, t)
    both = quick_compile(lambda t: (first(t), along(first, t)))
    h = 1e-4
    here, before, after = (both(jnp.asarray(t)) for t in (0.0, -h, h))
    expected = (after[0] - before[0]) / (2 * h)
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(here[1], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    probe = jnp.asarray(np.random.default_rng(2).normal(size=expected.shape))
    reverse = quick_compile(jax.grad(jax.grad(lambda t: kernel(t) @ probe)))
    np.testing.assert_allclose(reverse(jnp.zeros(())), here[1] @ probe, rtol=1e-8)
