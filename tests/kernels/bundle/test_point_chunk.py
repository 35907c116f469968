"""Chunks of points against the equations of the whole grid."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.bundle.cost import BundleProblem, Observations, bundle_cost, bundle_problem, bundle_views
from jaxslam_kernels.bundle.equations import normal_equations
from jaxslam_kernels.bundle.lens import Cameras
from jaxslam_kernels.bundle.point_chunk import EliminatedChunk, chunk_cost, eliminate_chunk
from jaxslam_kernels.bundle.schur import eliminate, solve_reduced
from quick_compile import quick_compile
from small_problems import BundleInputs, bundle_inputs

K, N, DAMPING, SCALE = 3, 8, 1e-3, 2.0

pytestmark = pytest.mark.usefixtures("float64")


def make_inputs() -> BundleInputs:
    """Depths for half of the observations, an outlier, one behind the camera, and slots that hold nothing."""
    poses, X_world, seen = bundle_inputs(N)
    weights = jnp.linspace(0.2, 1.0, seen.weights.size)
    depth = jnp.where(jnp.arange(seen.depth.size) % 2 == 0, 4.0, 0.0)
    xy = seen.xy.at[:, 5].add(0.1)
    seen = seen._replace(weights=weights, depth=depth, xy=xy)
    spare = lambda values: jnp.concatenate([values, jnp.full_like(values[..., :2], 10)], axis=-1)
    seen = Observations(*map(spare, seen))._replace(valid=jnp.arange(K * N + 2) < K * N)
    return BundleInputs(poses, X_world.at[2, 3].set(-1.0), seen)


def poses_from_points(inputs: BundleInputs) -> jax.Array:
    camera, point = jnp.minimum(inputs.observations.camera, K - 1), jnp.minimum(inputs.observations.point, N - 1)
    return inputs.poses[camera].at[:, 4:].add(-inputs.X_world.T[point])


@partial(quick_compile, static_argnames="num_points")
def eliminated(inputs: BundleInputs, num_points: int = N) -> EliminatedChunk:
    scale, damping = jnp.array([SCALE, DAMPING], inputs.poses.dtype)
    return eliminate_chunk(poses_from_points(inputs), inputs.observations, scale, damping, "cauchy", num_points)


def whole_problem(inputs: BundleInputs) -> BundleProblem:
    free = jnp.ones(K, bool).at[0].set(False)
    return bundle_problem(inputs.observations, jnp.ones(N), jnp.array(SCALE), free, jnp.ones(N, bool))[0]


@quick_compile
def whole_step(inputs: BundleInputs) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The step of the cameras and of the points from the grid, and the gradient of the cameras."""
    problem = whole_problem(inputs)
    equations = normal_equations(bundle_views(Cameras(inputs.poses), inputs.X_world, problem, "cauchy"))
    reduced = eliminate(equations, problem, jnp.array(DAMPING))
    return *solve_reduced(reduced, equations.camera_gradient, equations.point_gradient), equations.camera_gradient


def test_is_what_the_grid_gives():
    """The Hessian of the cameras, their step, and the shifts of the points."""
    inputs = make_inputs()
    step, shifts, gradient = whole_step(inputs)
    part, m = eliminated(inputs), K * N
    camera, point = (np.asarray(index)[:m] for index in (inputs.observations.camera, inputs.observations.point))
    B = np.zeros((6 * K, 3 * N))
    H, g = np.zeros((K, 6, 6)), np.zeros((K, 6))
    for row in range(m):
        i, j = camera[row], point[row]
        B[6 * i : 6 * i + 6, 3 * j : 3 * j + 3] = part.coupling[row]
        H[i] += part.hessian[row]
        g[i] += part.gradient[row]
    H[:, range(6), range(6)] *= 1 + DAMPING
    whole = -B @ B.T
    for i in range(K):
        whole[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += H[i]
    along = np.asarray(part.along).T.ravel()
    right = (B @ along - g.ravel())[6:]
    found = np.concatenate([np.zeros(6), np.linalg.solve(whole[6:, 6:], right)])
    np.testing.assert_allclose(found.reshape(K, 6), step, rtol=1e-8, atol=1e-12)
    moved = -np.einsum("ijn,in->jn", part.root, (along + B.T @ found).reshape(N, 3).T)
    np.testing.assert_allclose(moved, shifts, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(g, gradient, rtol=1e-9)


def test_cost_is_that_of_the_grid():
    inputs = make_inputs()

    @quick_compile
    def costs(inputs: BundleInputs) -> tuple[jax.Array, jax.Array]:
        cost = chunk_cost(poses_from_points(inputs), inputs.observations, jnp.array(SCALE), "cauchy")
        problem = whole_problem(inputs)
        views = bundle_views(Cameras(inputs.poses), inputs.X_world, problem, "cauchy")
        return cost, bundle_cost(views, problem, "cauchy")

    cost, whole = costs(inputs)
    np.testing.assert_allclose(cost, whole, rtol=1e-12)


def test_more_room_than_points_changes_nothing():
    inputs = make_inputs()
    some, more = eliminated(inputs), eliminated(inputs, N + 3)
    for name in ("gradient", "hessian", "coupling"):
        np.testing.assert_array_equal(getattr(some, name), getattr(more, name))
    np.testing.assert_array_equal(more.along[:, :N], some.along)
    assert not np.asarray(more.root[:, :, N:]).any()


def test_finite_in_single_precision_where_nothing_is_seen():
    """All slots empty, NaN in them, and a point at the camera."""
    inputs = make_inputs()
    nothing = inputs.observations._replace(
        valid=jnp.zeros(K * N + 2, bool), xy=jnp.full_like(inputs.observations.xy, jnp.nan)
    )
    for seen in (nothing, inputs.observations):
        at = inputs._replace(X_world=inputs.X_world.at[:, 0].set(inputs.poses[0, 4:]), observations=seen)
        single = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, at)
        part = eliminated(single)
        assert all(np.isfinite(each).all() for each in part)
