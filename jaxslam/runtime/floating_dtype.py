"""The one floating-point type of the tracker's state, parameters and frames: float32 by default."""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike


def floating_dtype(dtype: DTypeLike) -> jnp.dtype:
    """Convert `dtype`, such as `"float64"` or `np.float64`, to a floating-point type that JAX can currently compute in.

    Raises:
        TypeError: If `dtype` is not a floating-point type, or is float64 while `jax_enable_x64` is off.
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
