"""The Schur complement of bundle adjustment: points eliminated, poses solved for, points found again.

No two points share a residual, so their part of the Hessian is a 3 x 3 block each. What is left is dense, six numbers
a camera, or nine with its lens: right for a window of up to some 64 of them.

Source: Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6.1.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from jaxslam_kernels.bundle.cost import BundleProblem, free_cameras
from jaxslam_kernels.bundle.equations import BundleEquations
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.types import Flag, Mask, Points, Scalar, Weights


class Reduced(NamedTuple):
    """The equations after the points are eliminated, in units that give cameras and points a unit diagonal.

    Attributes:
        units: Units of the camera parameters; 0 for those that are fixed or not observed.
        root: Lower triangular C of each point with `Cᵀ C = V⁻¹`; rows of 0 for directions that nothing determines.
        coupling: `B = units W Cᵀ` as a matrix, so that the Schur complement is `H - B Bᵀ`.
        factor: Cholesky factor of the Schur complement; not finite if that is not positive definite.
    """

    units: Float[Array, "k c"]
    root: Float[Array, "3 3 n"]
    coupling: Float[Array, "kc n3"]
    factor: Float[Array, "kc kc"]


def eliminate(equations: BundleEquations, problem: BundleProblem, damping: Scalar) -> Reduced:
    """Eliminates the points from equations whose diagonal is raised by the fraction `damping`."""
    (k, c, _), n = equations.camera_hessian.shape, equations.point_hessian.shape[2]
    units = _units(apart(equations.camera_diagonal), free_cameras(problem)[:k])
    root = apart(lambda: inverse_root(equations.point_hessian, problem.free_point, damping))
    # Row by row, and only below the diagonal: as sums over whole columns of the root, 0.5 ms instead of 0.07. So too if
    # they were put together as an axis of their own, 0.19 ms.
    along = lambda i: sum(equations.cross[:, :, j] * root[i, j][None, None] for j in range(i + 1))
    rows = [(units[:, :, None] * along(i)).reshape(c * k, n) for i in range(3)]
    coupling = jnp.concatenate(rows, axis=1)
    cameras = equations.camera_hessian * units[:, :, None] * units[:, None, :]
    diagonal = jnp.where(units > 0, damping, 1.0)  # and 1 for what does not move
    cameras = cameras + np.eye(c, dtype=units.dtype)[None] * diagonal[:, :, None]
    blocks = np.eye(k, dtype=units.dtype)[:, None, :, None] * cameras[:, :, None, :]
    if equations.edges is not None:
        blocks = blocks + equations.edges * units[:, :, None, None] * units[None, None]
    return Reduced(
        units, root, coupling, cho_factor(blocks.reshape(c * k, c * k) - coupling @ coupling.T, lower=True)[0]
    )


def solve_reduced(
    reduced: Reduced, camera_gradient: Float[Array, "k c"], point_gradient: Points
) -> tuple[Float[Array, "k c"], Points]:
    """The step that cancels the gradients, linear in them."""
    n = point_gradient.shape[1]
    along = jnp.einsum("ijn,jn->in", reduced.root, point_gradient)
    right = reduced.units.reshape(-1) * camera_gradient.reshape(-1) - reduced.coupling @ along.reshape(-1)
    step = -cho_solve((reduced.factor, True), right)
    along = along + (step @ reduced.coupling).reshape(3, n)
    return reduced.units * step.reshape(reduced.units.shape), -jnp.einsum("ijn,in->jn", reduced.root, along)


def points_determined(hessian: Float[Array, "3 3 n"], free: Mask) -> Mask:
    """Points whose Hessian is positive definite to working precision."""
    return (jnp.diagonal(inverse_root(hessian, free, jnp.zeros((), hessian.dtype))) > 0).all(axis=1)


def is_determined(reduced: Reduced) -> Flag:
    """Whether no direction is free: the pivots of the Schur complement stand clear of rounding.

    Where points have little parallax their elimination loses digits; 400 eps were seen for a free scale.
    """
    pivots = jnp.square(jnp.diagonal(reduced.factor))
    return jnp.isfinite(pivots).all() & (pivots.min() > 1000.0 * float(jnp.finfo(pivots.dtype).eps))


def _units(diagonal: Array, free: Array) -> Array:
    """Units in which the diagonal is one, or 0 for what is fixed or has nothing to go by."""
    counts = free & (diagonal > 1e-20)
    return jnp.where(counts, lax.rsqrt(jnp.where(counts, diagonal, 1.0)), 0.0)


def inverse_root(hessian: Float[Array, "3 3 n"], free: Mask, damping: Scalar | Weights) -> Float[Array, "3 3 n"]:
    """Lower triangular C with `Cᵀ C = V⁻¹`, from the Cholesky factor in units of the diagonal.

    A pivot within rounding of zero is a direction that nothing determines (along the ray of a single view): it is
    left out, which costs the poses nothing, since the cross terms have no part in it.
    """
    units = _units(jnp.stack([hessian[i, i] for i in range(3)]), free[None, :])  # `diagonal` would be a gather
    v = [[hessian[i, j] * units[i] * units[j] for j in range(3)] for i in range(3)]
    invert = lambda pivot: jnp.where(pivot > floor, lax.rsqrt(jnp.where(pivot > floor, pivot, 1.0)), 0.0)
    floor, raised = 16.0 * float(jnp.finfo(hessian.dtype).eps), 1.0 + damping
    r0 = invert(v[0][0] * raised)
    l10, l20 = v[1][0] * r0, v[2][0] * r0
    r1 = invert(v[1][1] * raised - l10 * l10)
    l21 = (v[2][1] - l20 * l10) * r1
    r2 = invert(v[2][2] * raised - l20 * l20 - l21 * l21)
    c10, c21, zero = -l10 * r0 * r1, -l21 * r1 * r2, jnp.zeros_like(r0)
    c20 = -(l20 * r0 + l21 * c10) * r2
    rows = [[r0, zero, zero], [c10, r1, zero], [c20, c21, r2]]
    return jnp.stack([jnp.stack(row) for row in rows]) * units[None]
