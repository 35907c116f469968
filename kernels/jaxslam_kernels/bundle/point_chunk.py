"""Bundle adjustment in chunks of points, for problems of any size: the part of the reduced equations that a chunk adds.

A point and its observations share nothing with other points. So the points of a large problem can be eliminated chunk
by chunk, and what remains are sums over the chunks: the Hessian of the cameras, which couples only cameras that observe
common points. The grid of `cost`, every camera against every point, would be nearly empty. Here each observation is a
row of its own in a grid of one column, whose point is the origin: the world is moved there for it.

Source: Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6.1.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxslam_kernels.bundle.cost import BundleProblem, Observations, Views, bundle_cost, bundle_problem, bundle_views
from jaxslam_kernels.bundle.equations import normal_equations
from jaxslam_kernels.bundle.lens import Cameras
from jaxslam_kernels.bundle.schur import inverse_root
from jaxslam_kernels.robust import Loss
from jaxslam_kernels.types import Points, Scalar


class EliminatedChunk(NamedTuple):
    """Contribution of m observations of n points to the equations of the cameras, with the points eliminated.

    With `B` the couplings of all observations and `y` of all points, the Hessian of the cameras is the sum of
    `hessian` by cameras, minus `B Bᵀ`; their gradient is the sum of `gradient`, minus `B y`. A step x of the cameras
    moves the points by `-rootᵀ (y + Bᵀ x)`.

    Attributes:
        gradient: Gradient along the right tangent of the observation's camera.
        hessian: Hessian block of that camera, of iteratively reweighted least squares.
        coupling: Coupling of that camera with its point, in units in which the point's damped Hessian is the identity.
        along: y, the gradient by each point in these units.
        root: Lower triangular C of each point with `Cᵀ C = V⁻¹`; rows of 0 for directions that nothing determines.
    """

    gradient: Float[Array, "m 6"]
    hessian: Float[Array, "m 6 6"]
    coupling: Float[Array, "m 6 3"]
    along: Points
    root: Float[Array, "3 3 n"]


def chunk_cost(poses: Float[Array, "m 7"], observations: Observations, scale: Scalar, loss: Loss) -> Scalar:
    """The cost of a chunk.

    Args:
        poses: Pose of each observation's camera, `wxyz_xyz` of T_world_cam, with the world's origin at its point.
        observations: The observations; `camera` is not used.
        scale: Scale of the robust loss, in standard deviations.
        loss: The robust loss, static.
    """
    problem = _problem(observations, scale)
    return bundle_cost(_views(poses, problem, loss), problem, loss)


def eliminate_chunk(
    poses: Float[Array, "m 7"],
    observations: Observations,
    scale: Scalar,
    damping: Scalar,
    loss: Loss,
    num_points: int,
) -> EliminatedChunk:
    """Eliminate the points of a chunk, whose Hessians have their diagonal raised by the fraction `damping`.

    Args:
        poses: As in `chunk_cost`.
        observations: The observations, with `point` the column of the point; `camera` is not used.
        scale: Scale of the robust loss, in standard deviations.
        damping: Damping of Levenberg-Marquardt.
        loss: The robust loss, static.
        num_points: Number n of points, static.
    """
    views = _views(poses, _problem(observations, scale), loss)
    equations = normal_equations(views)
    cross, R = equations.cross[..., 0], views.R
    # A point moves against its camera: its rows are those of the camera's translation, turned into the world.
    pull = -jnp.einsum("mij,mj->mi", R, equations.camera_gradient[:, :3])
    information = -jnp.einsum("mij,mjl->mil", R, cross[:, :3])
    column = observations.point
    by_point = lambda values: _by_point(values, column, num_points)
    root = inverse_root(by_point(information), jnp.ones(num_points, bool), damping)
    along = jnp.einsum("ijn,jn->in", root, by_point(pull))
    coupling = jnp.einsum("mcj,ijm->mci", cross, jnp.take(root, column, axis=2, mode="fill", fill_value=0))
    return EliminatedChunk(equations.camera_gradient, equations.camera_hessian, coupling, along, root)


def _problem(observations: Observations, scale: Scalar) -> BundleProblem:
    """The observations as a grid of one column, every observation in a row of its own."""
    every = jnp.arange(observations.weights.shape[0], dtype=jnp.int32)
    alone = observations._replace(camera=every, point=jnp.zeros_like(every))
    free, one = jnp.ones(every.shape, bool), jnp.ones(1, observations.weights.dtype)
    return bundle_problem(alone, one, scale, free, free[:1])[0]


def _views(poses: Float[Array, "m 7"], problem: BundleProblem, loss: Loss) -> Views:
    return bundle_views(Cameras(poses), jnp.zeros((3, 1), poses.dtype), problem, loss)


def _by_point(values: Float[Array, "m ..."], column: Int[Array, " m"], num_points: int) -> Float[Array, "... n"]:
    """Sum values of observations by their points, which go to the last axis."""
    sums = jnp.zeros((num_points, *values.shape[1:]), values.dtype).at[column].add(values, mode="drop")
    return jnp.moveaxis(sums, 0, -1)
