"""Parts of a program that are computed once: fewer instructions, and the same values and derivatives."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.program_parts import apart
from quick_compile import quick_compile


def _many_uses(x: jax.Array, keep: Callable[[Callable[[], jax.Array]], jax.Array]) -> jax.Array:
    y = keep(lambda: jnp.sin(x) * jnp.cos(x) + jnp.square(x) / (1 + jnp.square(x)))
    return jnp.stack([jnp.roll(y, shift) * y for shift in range(12)])


def test_computed_once() -> None:
    x = jnp.linspace(0, 1, 512)
    count = lambda keep: str(jax.jit(lambda x: _many_uses(x, keep)).lower(x).compile().as_text()).count("cosine(")
    assert count(apart) == 1
    assert count(lambda compute: compute()) > 4


def test_same_values_and_derivatives() -> None:
    x = jnp.linspace(0, 1, 16)
    weights = jnp.cos(jnp.arange(12 * 16.0)).reshape(12, 16)
    for function in (
        lambda keep: _many_uses(x, keep),
        lambda keep: jax.grad(lambda x: jnp.sum(weights * _many_uses(x, keep)))(x),
        lambda keep: jax.jvp(lambda x: _many_uses(x, keep), (x,), (x,))[1],
        lambda keep: jax.vmap(lambda x: _many_uses(x, keep))(jnp.stack([x, 2 * x])),
        lambda keep: jax.hessian(lambda x: jnp.sum(weights * _many_uses(x, keep)))(x),
    ):
        found, expected = (quick_compile(partial(function, keep))() for keep in (apart, lambda compute: compute()))
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)
