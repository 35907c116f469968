"""Small symmetric matrices of normal equations: scaling, solving, and whether they determine every unknown."""

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jaxtyping import Array, Float

from jaxslam_kernels.types import Flag

_MIN_DIAGONAL = 1e-12  # an unknown with less information than this keeps its unit


def unit_diagonal(hessian: Float[Array, "d d"]) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """Scale a Hessian to a diagonal of ones.

    Args:
        hessian: Symmetric positive semi-definite matrix.

    Returns:
        `(d, d)` the scaled matrix, and `(d,)` the units `u` of the unknowns, `scaled = hessian * u uᵀ`.
    """
    diagonal = jnp.diagonal(hessian)
    unit = lax.rsqrt(jnp.where(diagonal > _MIN_DIAGONAL, diagonal, 1.0))
    return hessian * unit[:, None] * unit[None, :], unit


def is_determined(hessian: Float[Array, "d d"]) -> Flag:
    """Tell whether a Hessian determines every unknown, clear of rounding; false if it is not finite or not definite.

    Compares the variance of every unknown with the variance it would have if all others were known (the variance
    inflation factor: the diagonal of the inverse of the scaled matrix). The smallest pivot of a Cholesky
    decomposition is no substitute: it depends on the order of the unknowns, and for points on a line, in float32, an
    eigenvalue of 2e-8 left a pivot of 7e-6.
    """
    scaled, _ = unit_diagonal(lax.stop_gradient(hessian))
    root, _ = cho_factor(scaled)
    inverse_root = solve_triangular(root, jnp.eye(root.shape[0], dtype=root.dtype), trans="T")
    inflation = jnp.square(inverse_root).sum(axis=0)
    return (inflation < float(jnp.finfo(root.dtype).eps) ** -0.75).all()  # NaN compares false


def solve_exact(exact: Float[Array, "d d"], reweighted: Float[Array, "d d"], right: Float[Array, " d"]) -> Array:
    """Solve `H x = right` with the exact Hessian of a cost at its minimum.

    Args:
        exact: Exact Hessian, of which the symmetric part counts. It is positive definite at a strict minimum.
        reweighted: Hessian that stands in where a solver stopped short of one.
        right: Right-hand side.

    Returns:
        `(d,)` the solution; zero where neither determines every unknown.
    """
    exact = 0.5 * (exact + exact.T)
    hessian = jnp.where(is_determined(exact), exact, reweighted)
    determined = is_determined(hessian)
    return solve_determined(hessian, determined, jnp.where(determined, right, 0.0))


def solve_determined(hessian: Float[Array, "d d"], determined: Flag, right: Array) -> Array:
    """Solve `H x = right` for a positive definite H.

    Args:
        hessian: Symmetric matrix H.
        determined: Result of `is_determined` for it; where false, the solution is meaningless but finite.
        right: `(d,)` right-hand side, or `(d, k)` several.

    Returns:
        The solution, of the shape of `right`.
    """
    scaled, unit = unit_diagonal(jnp.where(determined, hessian, jnp.eye(hessian.shape[0], dtype=hessian.dtype)))
    unit = unit.reshape(-1, *(1,) * (right.ndim - 1))
    return unit * cho_solve(cho_factor(scaled), unit * right)
