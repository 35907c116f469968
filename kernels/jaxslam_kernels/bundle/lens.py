"""Lens of each camera in bundle adjustment: a focal length and two radial coefficients that are estimated.

With `(x, y)` the point's slopes and `r² = x² + y²`, the camera sees it at `f (1 + k1 r² + k2 r⁴) (x, y)` from the
principal point. So the derivatives by all three lie along `(x, y)`, and the one by `(x, y)` is symmetric.

Source: Agarwal et al., "Bundle Adjustment in the Large", 2010, whose cameras these are, but for the sign of z and y.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from jaxslam_kernels.pose.pose_cost import retract, shifted

Lenses = Float[Array, "k 3"]
"""Focal length, k1 and k2, one row a camera."""
Plane = Float[Array, "k n"]


class Cameras(NamedTuple):
    """Estimated parameters of the cameras: c = 6 numbers each, or 9 with a lens of their own.

    Attributes:
        poses: `(k, 7)` poses, `wxyz_xyz` of T_world_cam.
        lenses: `(k, 3)` lenses; `None` for ideal cameras.
    """

    poses: Float[Array, "k 7"]
    lenses: Lenses | None = None


class Bend(NamedTuple):
    """Effect of a lens on every slope. Planes `(k, n)`.

    Attributes:
        seen: Image position of the point, pixels from the principal point.
        across: Derivatives of that position by the slopes: of u by x, of u by y and of v by x, of v by y.
        by_lens: Derivatives of that position by focal length, k1 and k2, in units of the slopes.
    """

    seen: tuple[Plane, Plane]
    across: tuple[Plane, Plane, Plane]
    by_lens: tuple[Plane, Plane, Plane]


class LensPart(NamedTuple):
    """Parts of the normal equations of the lenses. Planes `(k, n)`.

    Attributes:
        by_lens: Derivatives of the image position by the lens, see `Bend`.
        pull: Derivative of the cost in units of `by_lens`.
        information: Second derivative of the cost in units of `by_lens`.
        cross: Second derivative of the cost by `by_lens` and by the slopes over the depth.
    """

    by_lens: tuple[Plane, Plane, Plane]
    pull: Plane
    information: Plane
    cross: tuple[Plane, Plane]


def bend(lenses: Lenses, x: Plane, y: Plane) -> Bend:
    """Apply the lens of each camera to slopes."""
    f, k1, k2 = (lenses[:, i, None] for i in range(3))
    r2 = x * x + y * y
    factor = 1.0 + r2 * (k1 + r2 * k2)
    growth = 2.0 * f * (k1 + 2.0 * k2 * r2)  # of f times the factor with r² / 2
    straight = f * factor
    return Bend(
        seen=(straight * x, straight * y),
        across=(straight + growth * x * x, growth * x * y, straight + growth * y * y),
        by_lens=(factor, f * r2, f * r2 * r2),
    )


def lens_gradient(part: LensPart) -> Lenses:
    """Gradient of the cost by the lenses."""
    return jnp.stack([jnp.sum(d * part.pull, axis=1) for d in part.by_lens], axis=1)


def lens_hessian(part: LensPart) -> Float[Array, "k 3 3"]:
    """Hessian of the cost by each lens."""
    planes = jnp.stack(part.by_lens, axis=1)
    return jnp.einsum("kan,kbn->kab", planes * part.information[:, None, :], planes)


def shift_cameras(cameras: Cameras, tangents: Float[Array, "k c"]) -> Cameras:
    """Move cameras by steps that are zero but for their derivatives; they stay as they are, to the last bit."""
    poses = jax.vmap(lambda pose, tangent: shifted(SE3(pose), tangent).wxyz_xyz)(cameras.poses, tangents[:, :6])
    return _with_lenses(cameras, poses, tangents)


def move_cameras(cameras: Cameras, tangents: Float[Array, "k c"]) -> Cameras:
    """Move cameras by steps of any size."""
    poses = jax.vmap(lambda pose, tangent: retract(SE3(pose), tangent).wxyz_xyz)(cameras.poses, tangents[:, :6])
    return _with_lenses(cameras, poses, tangents)


def usable_lenses(lenses: Lenses) -> tuple[Lenses, Bool[Array, " k"]]:
    """Replace lenses that are not finite or have no positive focal length by a focal length of one."""
    usable = jnp.isfinite(lenses).all(axis=1) & (lenses[:, 0] > 0)
    return jnp.where(usable[:, None], lenses, jnp.array([1.0, 0.0, 0.0], lenses.dtype)[None, :]), usable


def _with_lenses(cameras: Cameras, poses: Float[Array, "k 7"], tangents: Float[Array, "k c"]) -> Cameras:
    return Cameras(poses, None if cameras.lenses is None else cameras.lenses + tangents[:, 6:])
