"""The floating-point type of state, parameters and frames: one for all three, float32 unless said otherwise."""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike


def floating_dtype(dtype: DTypeLike) -> jnp.dtype:
    """A floating-point type that JAX can compute in now, however it was named: `"float64"`, `np.float64`, ...

    Raises:
        TypeError: If it is no floating-point type, or is float64 while `jax_enable_x64` is off.
    """
    chosen = jnp.dtype(dtype)
    if not jnp.issubdtype(chosen, jnp.floating):
        raise TypeError(f"dtype: expected a floating-point type, got {chosen}")
    if chosen == jnp.float64 and not jax.config.values["jax_enable_x64"]:
        raise TypeError(
            "dtype: expected float32 while jax_enable_x64 is off, got float64;"
            ' turn it on with jax.config.update("jax_enable_x64", True)'
        )
    return chosen
