"""Quadratic models of the cost of `bundle.cost`: normal equations for a step, and the exact Hessian at an optimum."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam_kernels.bundle.cost import BundleProblem, Plane, Views, bundle_views
from jaxslam_kernels.bundle.edges import EdgeHessian
from jaxslam_kernels.bundle.lens import Cameras, LensPart, lens_gradient, lens_hessian, shift_cameras
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.robust import Loss
from jaxslam_kernels.types import Points


class BundleEquations(NamedTuple):
    """A quadratic model of the cost: gradients, and the blocks of a Hessian that no two points share.

    The cameras are all of the problem, or the first ones of it if the others cannot move.

    Attributes:
        camera_gradient: Gradient along the right tangents of the poses, then by the lenses.
        camera_hessian: Hessian block of each camera.
        point_gradient: Gradient by the points.
        point_hessian: Hessian block of each point.
        cross: Second derivatives by camera and point.
        edges: Second derivatives of the edges' cost by every two cameras; `None` without edges.
    """

    camera_gradient: Float[Array, "k c"]
    camera_hessian: Float[Array, "k c c"]
    point_gradient: Points
    point_hessian: Float[Array, "3 3 n"]
    cross: Float[Array, "k c 3 n"]
    edges: EdgeHessian | None = None

    def camera_diagonal(self) -> Float[Array, "k c"]:
        """Return the second derivative of the cost by each parameter of the cameras."""
        diagonal = jnp.diagonal(self.camera_hessian, axis1=1, axis2=2)
        if self.edges is None:
            return diagonal
        return diagonal + jnp.einsum("kckc->kc", self.edges)


def normal_equations(views: Views, num_movable: int | None = None) -> BundleEquations:
    """The exact gradient, and the Hessian of iteratively reweighted least squares.

    Args:
        views: Every point seen from every camera.
        num_movable: Number of cameras in the equations, the first ones; the others only hold the points. `None` for
            all.
    """
    R, (x, y), (mu, mv, md) = views.R, views.slope, views.information
    k, n = x.shape
    m = k if num_movable is None else num_movable
    column = lambda i, j: R[:, j, i, None]  # Rᵀ, spread over the points

    def weighted_rotation() -> tuple[Array, ...]:
        """The rows of M Rᵀ, element by element."""
        first = [mu * (column(0, j) - x * column(2, j)) for j in range(3)]
        second = [mv * (column(1, j) - y * column(2, j)) for j in range(3)]
        if views.skew is not None:
            first, second = (
                [a + views.skew * (column(1, j) - y * column(2, j)) for j, a in enumerate(first)],
                [a + views.skew * (column(0, j) - x * column(2, j)) for j, a in enumerate(second)],
            )
        third = [md * column(2, j) - x * first[j] - y * second[j] for j in range(3)]
        return (*first, *second, *third)

    by_row = apart(weighted_rotation)
    (X, Y, Z), pull = ([plane[:m] for plane in planes] for planes in (views.X_cam, views.pull))

    def turned() -> Float[Array, "m 9 n"]:
        """The rows of (M Rᵀ) × X, element by element."""
        columns = [[plane[:m] for plane in by_row[j::3]] for j in range(3)]
        by_column = [(Z * b - Y * c, X * c - Z * a, Y * a - X * b) for a, b, c in columns]
        return jnp.stack([v for row in zip(*by_column, strict=True) for v in row], axis=1)

    information = apart(lambda: jnp.stack(by_row, axis=1))
    parts = [-information[:m], apart(turned)]  # nine planes each: of more, see `apart`
    if views.lens is not None:
        parts.append(jnp.stack([v for row in _lens_rows(views, views.lens) for v in row], axis=1)[:m])
    cross = jnp.concatenate(parts, axis=1)
    num_rows = cross.shape[1] // 3
    moments = jnp.einsum("kan,kbn->kab", cross, jnp.stack([X, Y, Z, jnp.ones_like(X)], axis=1))
    cross = cross.reshape(m, num_rows, 3, n)
    point_hessian = jnp.einsum("kia,kajn->ijn", R, information.reshape(k, 3, 3, n))
    along_pose = [-sum_ for sum_ in map(partial(jnp.sum, axis=1), pull)]
    turning = (pull[1] * Z - pull[2] * Y, pull[2] * X - pull[0] * Z, pull[0] * Y - pull[1] * X)
    gradient = jnp.stack([*along_pose, *(jnp.sum(t, axis=1) for t in turning)], axis=1)
    columns = _pose_columns(moments.reshape(m, num_rows, 3, 4), R[:m])
    hessian = 0.5 * (columns[:, :6] + jnp.swapaxes(columns[:, :6], 1, 2))
    if views.lens is not None:
        gradient = jnp.concatenate([gradient, lens_gradient(views.lens)[:m]], axis=1)
        hessian = _with_lens_blocks(hessian, columns[:, 6:], lens_hessian(views.lens)[:m])
    return BundleEquations(
        camera_gradient=gradient,
        camera_hessian=hessian,
        point_gradient=jnp.einsum("kia,kan->in", R, jnp.stack(views.pull, axis=1)),
        point_hessian=point_hessian,
        cross=cross,
    )


def _with_lens_blocks(
    hessian: Float[Array, "k 6 6"], mixed: Float[Array, "k 3 6"], of_lens: Float[Array, "k 3 3"]
) -> Float[Array, "k 9 9"]:
    """Extend each pose's Hessian by the lens: the mixed second derivatives, and those by the lens alone."""
    return jnp.concatenate(
        [
            jnp.concatenate([hessian, jnp.swapaxes(mixed, 1, 2)], axis=2),
            jnp.concatenate([mixed, of_lens], axis=2),
        ],
        axis=1,
    )


def _lens_rows(views: Views, lens: LensPart) -> list[list[Plane]]:
    """Second derivatives by lens and point."""
    R, (x, y), (by_x, by_y) = views.R, views.slope, lens.cross
    column = lambda i, j: R[:, j, i, None]
    base = [by_x * (column(0, j) - x * column(2, j)) + by_y * (column(1, j) - y * column(2, j)) for j in range(3)]
    return [[d * b for b in base] for d in lens.by_lens]


class ExactBlocks(NamedTuple):
    """Blocks of the Hessian that every slot adds to, the curvature of projection and loss included.

    Attributes:
        camera: Block of the slot's camera.
        cross: Block that couples its camera and its point.
        point: Block of its point.
    """

    camera: Float[Array, "k c c n"]
    cross: Float[Array, "k c 3 n"]
    point: Float[Array, "3 3 k n"]


def exact_blocks(cameras: Cameras, X_world: Points, problem: BundleProblem, loss: Loss) -> ExactBlocks:
    """The exact Hessian, at an optimum: elsewhere the turning of the tangents would add to it.

    A slot depends on one camera and one point, so moving all of them at once along one axis gives a column of each.
    """
    k, c = cameras.poses.shape[0], 6 if cameras.lenses is None else 9

    def gradient(tangent: Float[Array, " d"]) -> Float[Array, "d k n"]:
        shifted = shift_cameras(cameras, jnp.broadcast_to(tangent[None, :c], (k, c)))
        views = bundle_views(shifted, X_world + tangent[c:, None], problem, loss)
        (X, Y, Z), (a, b, d), R, lens = views.X_cam, views.pull, views.R, views.lens
        world = [R[:, j, 0, None] * a + R[:, j, 1, None] * b + R[:, j, 2, None] * d for j in range(3)]
        by_lens = [] if lens is None else [plane * lens.pull for plane in lens.by_lens]
        return jnp.stack([-a, -b, -d, b * Z - d * Y, d * X - a * Z, a * Y - b * X, *by_lens, *world])

    hessian = jax.jacfwd(gradient)(jnp.zeros(c + 3, X_world.dtype))  # (c + 3, k, n, c + 3)
    camera = jnp.transpose(hessian[:c, :, :, :c], (1, 0, 3, 2))
    return ExactBlocks(
        camera=0.5 * (camera + jnp.swapaxes(camera, 1, 2)),
        cross=jnp.transpose(hessian[:c, :, :, c:], (1, 0, 3, 2)),
        point=jnp.transpose(hessian[c:, :, :, c:], (0, 3, 1, 2)),
    )


def _pose_columns(moments: Float[Array, "k c 3 4"], R: Float[Array, "k 3 3"]) -> Float[Array, "k c 6"]:
    """`Σ A M D` with `D = (-I, [X]×)`, from the sums of `A M Rᵀ` times (X, Y, Z, 1) over the points."""
    by_axis = jnp.einsum("kajb,kji->kaib", moments, R)  # A M: the Rᵀ taken off again
    across = lambda i, j: by_axis[:, :, i, j] - by_axis[:, :, j, i]
    columns = [
        -by_axis[:, :, 0, 3],
        -by_axis[:, :, 1, 3],
        -by_axis[:, :, 2, 3],
        across(1, 2),
        across(2, 0),
        across(0, 1),
    ]
    return jnp.stack(columns, axis=2)
