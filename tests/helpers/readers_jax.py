"""JAX as it comes, for Python that readers write: README and notebooks. Tests themselves run with its strict rules,
and in one thread."""

ENVIRONMENT = {"JAX_NUMPY_DTYPE_PROMOTION": "standard", "JAX_NUMPY_RANK_PROMOTION": "allow", "NPROC": ""}
