"""A function with a rule: the rule holds in every transformation, and to every order."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.derivative_rules import custom_jvp

SHIFT, X = 0.3, jnp.array([0.7, 1.1])


@partial(custom_jvp, nondiff_argnums=(0,))
def sine(shift, inputs, count):
    """A sine whose own derivative is zero, and how many there are."""
    return jax.lax.stop_gradient(jnp.sin(inputs["x"] + shift)), count + 1


@sine.defjvp
def _sine_jvp(shift, primals, tangents):
    inputs, count = primals
    value = sine(shift, inputs, count)
    slope = sine(shift + jnp.pi / 2, inputs, count)[0]
    return value, (slope * tangents[0]["x"], np.zeros(jnp.shape(value[1]), jax.dtypes.float0))


def of_rule(x):
    return sine(SHIFT, {"x": x}, jnp.int32(3))[0]


def plain(x):
    return jnp.sin(x + SHIFT)


def scanned(f):
    return lambda x: jax.lax.scan(lambda c, _: (c + f(c * x), c), x, length=3)[0]


TRANSFORMATIONS = {
    "third": lambda f: jax.grad(jax.grad(jax.grad(f))),
    "compiled": lambda f: jax.jit(jax.jacfwd(jax.grad(jax.jit(f)))),
    "forward over reverse through a scan": lambda f: jax.jacfwd(jax.grad(scanned(f))),
    "reverse over reverse through a scan": lambda f: jax.grad(jax.grad(scanned(f))),
    "third through a scan": lambda f: jax.jacfwd(jax.jacfwd(jax.grad(scanned(f)))),
    "of a scan of a batch": lambda f: lambda x: jax.hessian(lambda v: scanned(jax.vmap(f))(v).sum())(jnp.stack([x, x])),
    "through a checkpoint in a scan": lambda f: jax.jacfwd(jax.grad(scanned(jax.checkpoint(f)))),
    "batch": lambda f: lambda x: jax.vmap(jax.hessian(f))(jnp.stack([x, 2 * x])),
    "linearized": lambda f: lambda x: jax.linearize(jax.grad(f), x)[1](jnp.ones_like(x)),
}


@pytest.mark.parametrize("name", TRANSFORMATIONS)
def test_derivatives(name):
    transform = TRANSFORMATIONS[name]
    with jax.enable_x64(True):
        x = jnp.asarray(0.7)
        np.testing.assert_allclose(transform(of_rule)(x), transform(plain)(x), rtol=1e-12)


def test_values_along_other_axes():
    """A batch of some of the arguments, along any of their axes."""
    x = jnp.arange(6.0).reshape(2, 3)
    value, count = jax.vmap(lambda x, n: sine(SHIFT, {"x": x}, n), in_axes=(1, None))(x, jnp.int32(3))
    np.testing.assert_allclose(value, jnp.sin(x + SHIFT).T, rtol=1e-6)
    np.testing.assert_array_equal(count, 4)
    slope = jax.vmap(jax.grad(lambda x, n: sine(SHIFT, {"x": x}, n)[0].sum()), in_axes=(None, 0))(x, jnp.arange(2))
    np.testing.assert_allclose(slope[1], jnp.cos(x + SHIFT), rtol=1e-5)


def test_arrays_of_numpy():
    value, count = sine(SHIFT, {"x": np.float32(0.7)}, np.int32(3))
    assert (float(value), int(count)) == (pytest.approx(np.sin(1.0)), 4)


class TestBadInput:
    def test_arguments_by_name(self):
        with pytest.raises(TypeError, match="sine: expected arguments by position, got count by name"):
            sine(SHIFT, {"x": X}, count=3)

    def test_no_rule(self):
        with pytest.raises(TypeError, match="rule given by `defjvp`, which is missing"):
            custom_jvp(_nothing)(X)


def _nothing(x):
    return x
