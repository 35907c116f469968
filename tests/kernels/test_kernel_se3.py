"""Transforms against NumPy's 4x4 matrices, under strict promotion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.se3 import between, cross_matrix, displacement, retract, rotation_matrix, to_camera, to_world
from scipy.linalg import expm


def random_pose(seed, dtype: type = np.float64):
    values = np.random.default_rng(seed).normal(size=7)
    values[:4] /= np.linalg.norm(values[:4])
    return SE3(jnp.asarray(values, dtype))


def hat(tangent):
    x, y, z = tangent[3:]
    return np.block([[np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), tangent[:3, None]], [np.zeros((1, 4))]])


pytestmark = pytest.mark.usefixtures("float64")


class TestTransform:
    def test_shapes(self):
        X = jnp.ones((3, 5), jnp.float32)
        T = random_pose(0, np.float32)
        assert to_camera(T, X).shape == to_world(T, X).shape == (3, 5)
        assert displacement(T, T).shape == (6,)
        assert displacement(T, T).dtype == to_world(T, X).dtype == jnp.float32

    @pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
    def test_matches_reference(self, size):
        A, B = random_pose(1), random_pose(2)
        tangent = size * np.random.default_rng(3).normal(size=6)
        np.testing.assert_allclose(
            between(A, B).as_matrix(), np.linalg.inv(A.as_matrix()) @ np.asarray(B.as_matrix()), atol=1e-12
        )
        there = retract(A, jnp.asarray(tangent))
        np.testing.assert_allclose(there.as_matrix(), np.asarray(A.as_matrix()) @ expm(hat(tangent)), atol=1e-12)
        np.testing.assert_allclose(displacement(A, there), tangent, atol=1e-12)

    @pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.4, 0.6, 3.0])
    def test_derivatives_of_retraction(self, angle):
        """Both orders against differences of the matrix exponential, with a long translation."""
        A, rng = random_pose(1), np.random.default_rng(3)
        at, direction = np.concatenate([[3.0, -2.0, 5.0], angle * np.array([0.6, 0.0, 0.8])]), rng.normal(size=6)
        moved = lambda t: retract(A, jnp.asarray(at) + t * direction).as_matrix()
        along = lambda f: lambda t: jax.jvp(f, (t,), (jnp.ones_like(t),))[1]
        h, here = 1e-3, jnp.zeros(())
        known = {k: np.asarray(A.as_matrix()) @ expm(hat(at + k * h * direction)) for k in (-2, -1, 0, 1, 2)}
        first = (8 * (known[1] - known[-1]) - (known[2] - known[-2])) / (12 * h)
        second = (16 * (known[1] + known[-1]) - (known[2] + known[-2]) - 30 * known[0]) / (12 * h**2)
        np.testing.assert_allclose(moved(here), known[0], atol=1e-12)
        np.testing.assert_allclose(along(moved)(here), first, atol=1e-9)
        np.testing.assert_allclose(along(along(moved))(here), second, atol=1e-7)

    def test_rotation_matrix(self):
        """Equal to jaxlie's, also in its derivatives and for a quaternion that is not of unit length."""
        for factor in (1.0, 0.5):
            T = random_pose(6)
            parameters = T.wxyz_xyz.at[:4].multiply(factor)
            ours, theirs = (lambda p: rotation_matrix(SE3(p))), (lambda p: SE3(p).rotation().as_matrix())
            np.testing.assert_allclose(ours(parameters), theirs(parameters), atol=1e-14)
            np.testing.assert_allclose(jax.jacrev(ours)(parameters), jax.jacfwd(theirs)(parameters), atol=1e-13)

    def test_points_return(self):
        A, X = random_pose(4), jnp.asarray(np.random.default_rng(5).normal(size=(3, 20)))
        world = np.asarray(A.as_matrix()) @ np.vstack([X, np.ones((1, 20))])
        np.testing.assert_allclose(to_world(A, X), world[:3], atol=1e-12)
        np.testing.assert_allclose(to_camera(A, to_world(A, X)), X, atol=1e-12)

    @pytest.mark.parametrize("size", [0.0, 1e-7, 0.7])
    def test_gradient(self, size):
        A, direction = random_pose(6), np.random.default_rng(7).normal(size=6)
        loss = lambda tangent: jnp.sum(displacement(A, retract(A, tangent)) * direction)
        at = jnp.asarray(size * np.random.default_rng(8).normal(size=6))
        # The displacement undoes the move: the gradient is the direction itself, also where nothing moves.
        # (jaxlie cancels digits just above its switch to a series, 3e-8 at 1e-7.)
        np.testing.assert_allclose(jax.grad(loss)(at), direction, atol=1e-7)
        np.testing.assert_allclose(jax.jacfwd(loss)(at), direction, atol=1e-7)

    def test_vmap_equals_loop(self):
        tangents = jnp.asarray(np.random.default_rng(9).normal(size=(4, 6)))
        A = random_pose(10)
        batched = jax.vmap(lambda t: retract(A, t).wxyz_xyz)(tangents)
        np.testing.assert_allclose(batched, [retract(A, t).wxyz_xyz for t in tangents], atol=1e-14)

    def test_single_trace(self):
        step = eqx.filter_jit(eqx.debug.assert_max_traces(displacement, max_traces=1))
        for seed in range(3):
            step(random_pose(seed), random_pose(seed + 1))

    def test_degenerate(self):
        nothing = displacement(random_pose(11), random_pose(11))
        np.testing.assert_allclose(nothing, 0, atol=1e-15)
        half_turn = retract(SE3.identity(), jnp.asarray([0, 0, 0, np.pi, 0, 0]))
        assert np.isfinite(displacement(SE3.identity(), half_turn)).all()

    def test_cross_matrix(self):
        u, v = jnp.asarray(np.random.default_rng(3).normal(size=(2, 3)))
        np.testing.assert_allclose(cross_matrix(u) @ v, np.cross(u, v), atol=1e-15)
        assert cross_matrix(u.astype(jnp.float32)).dtype == jnp.float32
