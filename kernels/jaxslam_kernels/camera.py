"""The pinhole camera with Brown-Conrady distortion, as in OpenCV: project, back-project, distort, undistort.

Everything is differentiable with respect to the points and to the intrinsics. Values that mean nothing (a point
behind the camera, a pixel that is NaN, a depth of 0) give a finite placeholder with zero gradient; `in_front`
and the depth itself say which they are.

Source: the OpenCV calibration manual; Brown, "Decentering Distortion of Lenses", 1966.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxslam_kernels.checks import checked
from jaxslam_kernels.derivative_rules import custom_jvp
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights

MIN_DEPTH = 0.01
"""Meters. Nothing nearer than this is imaged: such a point counts as behind the camera."""

_NEWTON_STEPS = 5  # 4 reach float64 accuracy for the cameras of TUM and Bonn, 5 for KITTI's raw wide one
_MAX_SLOPE = 10.0  # normalized coordinates, 84 degrees off the axis: keeps a diverging iteration finite

_Planes: TypeAlias = tuple[Array, Array]
_Coefficients: TypeAlias = Float[Array, "5"]


class Intrinsics(NamedTuple):
    """One camera: a pytree, so it can be traced, batched and differentiated.

    Attributes:
        fx: Focal length along u, pixels.
        fy: Focal length along v, pixels.
        cx: Principal point u, pixels.
        cy: Principal point v, pixels.
        distortion: `(5,)` coefficients `k1 k2 p1 p2 k3`, OpenCV's order; `None` for an ideal camera. With zeros, the
            distortion is computed and inverted all the same.
    """

    fx: Scalar
    fy: Scalar
    cx: Scalar
    cy: Scalar
    distortion: Float[Array, "5"] | None


@checked
def make_intrinsics(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    dtype: DTypeLike = jnp.float32,
) -> Intrinsics:
    """Intrinsics from plain numbers in pixels; distortion `k1 k2 p1 p2 [k3]`, missing ones are zero."""
    coefficients = (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    scalars = (jnp.asarray(value, dtype) for value in (fx, fy, cx, cy))
    return Intrinsics(*scalars, distortion=jnp.asarray(coefficients, dtype))


@checked
def without_distortion(intrinsics: Intrinsics) -> Intrinsics:
    """Return the ideal pinhole camera of the same focal lengths and principal point."""
    return intrinsics._replace(distortion=None)


@checked
def in_front(X_cam: Points) -> Mask:
    """True for finite points at least `MIN_DEPTH` in front of the camera."""
    return jnp.isfinite(X_cam).all(axis=0) & (X_cam[2] > MIN_DEPTH)


@checked
def project(intrinsics: Intrinsics, X_cam: Points) -> Pixels:
    """Pixels of points in camera coordinates (meters), distortion included.

    A point that is not `in_front` lands on the principal point.
    """
    visible = in_front(X_cam)
    z = jnp.where(visible, X_cam[2], 1.0)
    xy = jnp.where(visible[None, :], X_cam[:2], 0.0) / z[None, :]
    return to_pixels(intrinsics, distort(intrinsics, xy))


@checked
def back_project(intrinsics: Intrinsics, uv: Pixels, depth: Weights) -> Points:
    """Points in camera coordinates (meters) seen at distorted pixels `uv` with `depth` along the optical axis.

    The origin where the pixel or the depth is not finite, or the depth not positive.
    """
    known = jnp.isfinite(depth) & (depth > 0) & jnp.isfinite(uv).all(axis=0)
    z = jnp.where(known, depth, 0.0)
    return jnp.concatenate([normalize(intrinsics, uv) * z[None, :], z[None, :]])


@checked
def to_pixels(intrinsics: Intrinsics, xy: Pixels) -> Pixels:
    """Normalized coordinates to pixels by the camera matrix alone, without distortion."""
    return jnp.stack([intrinsics.fx * xy[0] + intrinsics.cx, intrinsics.fy * xy[1] + intrinsics.cy])


@checked
def distort(intrinsics: Intrinsics, xy: Pixels) -> Pixels:
    """Distorted normalized coordinates of undistorted ones."""
    if intrinsics.distortion is None:
        return xy
    return jnp.stack(_distort(intrinsics.distortion, xy[0], xy[1]))


@checked
def normalize(intrinsics: Intrinsics, uv: Pixels) -> Pixels:
    """Undistorted normalized coordinates `(x / z, y / z)` of distorted pixels; 0 where `uv` is not finite.

    Newton's method on `distort`, a fixed number of steps. Its derivatives are those of the implicit function theorem,
    forward and reverse, of any order. Meant for pixels where the distortion can be
    inverted: far outside the image of a strong lens the result is finite and nothing more.
    """
    known = jnp.isfinite(uv).all(axis=0)
    u, v = jnp.where(known[None, :], uv, 0.0)
    target = (
        jnp.where(known, (u - intrinsics.cx) / intrinsics.fx, 0.0),
        jnp.where(known, (v - intrinsics.cy) / intrinsics.fy, 0.0),
    )
    x, y = target if intrinsics.distortion is None else _undistort(intrinsics.distortion, target)
    return jnp.stack([jnp.where(known, x, 0.0), jnp.where(known, y, 0.0)])


@checked
def undistort_pixels(intrinsics: Intrinsics, uv: Pixels) -> Pixels:
    """Pixels where an ideal camera with the same matrix and no distortion would have seen the same rays."""
    return to_pixels(intrinsics, normalize(intrinsics, uv))


@checked
def depth_from_disparity(disparity: Weights, fx: Scalar, baseline: Scalar | float) -> Weights:
    """Depth in meters of rectified disparities in pixels, `fx * baseline / d`; 0 where there is none."""
    return _reciprocal(disparity, fx, baseline)


@checked
def disparity_from_depth(depth: Weights, fx: Scalar, baseline: Scalar | float) -> Weights:
    """Rectified disparities in pixels of depths in meters, `fx * baseline / z`; 0 where there is none."""
    return _reciprocal(depth, fx, baseline)


def _reciprocal(values: Weights, fx: Scalar, baseline: Scalar | float) -> Weights:
    known = jnp.isfinite(values) & (values > 0)
    return jnp.where(known, fx * baseline / jnp.where(known, values, 1.0), 0.0)


def _distort(coefficients: _Coefficients, x: Array, y: Array) -> _Planes:
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@custom_jvp
def _undistort(coefficients: _Coefficients, target: _Planes) -> _Planes:
    """The inverse of `_distort`."""
    return _newton(coefficients, target, _NEWTON_STEPS)


@_undistort.defjvp
def _undistort_jvp(primals: tuple, tangents: tuple) -> tuple[_Planes, _Planes]:
    coefficients, target = primals
    held = _nearly_undistorted(coefficients, target)
    return jax.jvp(partial(_last_step, coefficients, held), primals, tangents)


def _last_step(held: _Coefficients, at: _Planes, coefficients: _Coefficients, target: _Planes) -> _Planes:
    """The Newton step from `at`, whose derivative with the first two held is that of the solution."""
    return _newton_step(held, *at, _distort(coefficients, *at), target)


@custom_jvp
def _nearly_undistorted(coefficients: _Coefficients, target: _Planes) -> _Planes:
    """The solution but for the last step, with the derivative of the solution: for second derivatives."""
    return _newton(coefficients, target, _NEWTON_STEPS - 1)


@_nearly_undistorted.defjvp
def _nearly_undistorted_jvp(primals: tuple, tangents: tuple) -> tuple[_Planes, _Planes]:
    return _nearly_undistorted(*primals), jax.jvp(_undistort, primals, tangents)[1]


def _newton(coefficients: _Coefficients, target: _Planes, num_steps: int) -> _Planes:
    """Newton's method on `_distort` from the target."""

    def step(_: Array, xy: _Planes) -> _Planes:
        # Apart: XLA would take slices and products of coefficients out of the loop, a dozen small kernels.
        return apart(lambda: _newton_step(coefficients, *xy, _distort(coefficients, *xy), target))

    # A loop, not unrolled: XLA's CPU backend fuses unrolled steps into one kernel and evaluates an earlier step
    # again for each of its uses, 4^steps times in all (200 ms for 500 points instead of 10 us). No step stands behind
    # the loop either: it would be evaluated again in every kernel that uses the result.
    return lax.fori_loop(0, num_steps, step, target)


def _newton_step(coefficients: _Coefficients, x: Array, y: Array, value: _Planes, target: _Planes) -> _Planes:
    """`(x, y) - J⁻¹ (value - target)` with J the Jacobian of `_distort` at `(x, y)`, which is symmetric."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    a = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    b = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    d = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    scale = 1.0 / jnp.maximum(a * d - b * b, 1e-3)
    error_x, error_y = value[0] - target[0], value[1] - target[1]
    return (
        jnp.clip(x - (d * error_x - b * error_y) * scale, -_MAX_SLOPE, _MAX_SLOPE),
        jnp.clip(y - (a * error_y - b * error_x) * scale, -_MAX_SLOPE, _MAX_SLOPE),
    )
