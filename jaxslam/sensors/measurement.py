"""From pixels to geometry and back: distortion, the rolling shutter, and depth taken at another time."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.camera import distort, normalize, to_pixels
from jaxslam_kernels.depth.sampling import lacks_depth, sample_depth, valid_depth
from jaxslam_kernels.flow.disparity import ROW_PLAN, row_disparities
from jaxslam_kernels.flow.lk_flow import FlowPlan
from jaxslam_kernels.image.pyramid import Pyramid, build_pyramid
from jaxslam_kernels.program_parts import apart
from jaxslam_kernels.rolling_shutter import as_if_at_once, image_velocity, row_time
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import DepthImage, Flag, Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float

from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import SensorModel

_SPARSE_PX = 8
"""Spacing of the pixels that tell whether a frame has depth at all."""
RIGHT_LEVELS = 2
"""Of the pyramid of the right image: where matching begins is known to a few pixels."""
_EXPECTED_PX = 1.0
"""A match so close to where the map has a point is that point."""
_SURFACE_PX = 2
"""Radius around a pixel in which `surface_depth` needs all depth to be of one surface: at an edge, a pose error of
pixels would become an error of depth."""
_MAX_BENT = 0.5
"""Largest shift of a point by the lens, as a share of the image: farther out, its polynomial may fold back inside."""


class PreparedFrame(NamedTuple):
    """The current frame, prepared.

    Attributes:
        frame: Arrays of the frame.
        pyramid: Pyramid of its image.
        elapsed_s: Seconds since the last good frame.
        right: Finest levels of the right image of a pair; `None` where depth is measured.
    """

    frame: FrameArrays
    pyramid: Pyramid
    elapsed_s: Scalar
    right: Pyramid | None = None

    def has_depth(self, sensor: SensorModel) -> Flag:
        """Return whether the frame has depth at all that `sensor` believes; it may have none for some frames."""
        some = self.frame.depth[::_SPARSE_PX, ::_SPARSE_PX]
        return jnp.any(valid_depth(some, sensor.min_depth_m, sensor.max_depth_m) > 0)

    def depth_at(self, uv: Pixels, sensor: SensorModel, *, reach: int = 1, max_step: float = 0.05) -> Weights:
        """Return the `(n,)` depth at pixels, meters; 0 where none is to be believed. See `believed_depth`."""
        return believed_depth(self.frame.depth, uv, sensor, reach=reach, max_step=max_step)

    def lacks_depth(self, uv: Pixels, sensor: SensorModel, *, reach: int) -> Mask:
        """Return the `(n,)` mask of the pixels around which no depth is to be believed. See `lacks_depth`."""
        limits = {"nearest": sensor.min_depth_m, "farthest": sensor.max_depth_m}
        return lacks_depth(self.frame.depth, uv, reach=reach, **limits)

    def with_right(self) -> "PreparedFrame":
        """The same frame with the right image of its pair, if it is one."""
        if self.frame.right is None:
            return self
        dtype, border = self.pyramid.levels[0].dtype, self.pyramid.border
        return self._replace(right=build_pyramid(self.frame.right, num_levels=RIGHT_LEVELS, border=border, dtype=dtype))

    def is_softly_masked(self) -> bool:
        """Return whether the mask of ignored pixels is floating point, from 0 to 1; static."""
        return self.frame.ignore.dtype != jnp.bool_

    def without(self, pixels: Bool[Array, "h w"] | Float[Array, "h w"]) -> "PreparedFrame":
        """The same frame with these pixels to be ignored too; by a soft mask, as far as they are above it."""
        ignore = self.frame.ignore
        both = jnp.maximum(ignore, pixels.astype(ignore.dtype)) if self.is_softly_masked() else ignore | pixels
        return self._replace(frame=self.frame._replace(ignore=both))

    def without_mask(self) -> "PreparedFrame":
        """The same frame with no pixel to be ignored."""
        return self._replace(frame=self.frame._replace(ignore=jnp.zeros_like(self.frame.ignore)))

    def ignored(self, uv: Pixels) -> Mask:
        """Return the `(n,)` mask of the pixels that count for nothing; those outside the image do not either."""
        ignore = self._ignore_at(uv)
        return ignore >= 1 if self.is_softly_masked() else ignore

    def weighed(self, uv: Pixels, weights: Weights) -> Weights:
        """Multiply the `(n,)` weights of points by those of their pixels: one minus a soft mask.

        The nearest pixel counts, a constant of derivatives; those by the mask are exact. Under a mask of `bool`, points
        are left out by `ignored`, and weights stay as they are.
        """
        return weights * (1 - self._ignore_at(uv)) if self.is_softly_masked() else weights

    def may_hold_corners(self) -> Bool[Array, "h w"]:
        """Return the mask of the pixels at which new points may be detected: those that are rather trusted."""
        return self.frame.ignore <= 0.5 if self.is_softly_masked() else ~self.frame.ignore

    def _ignore_at(self, uv: Pixels) -> Mask | Weights:
        """Return the `(n,)` mask at the nearest pixels, of its own type; true or 1 outside the image."""
        column, row = jnp.round(lax.stop_gradient(uv)).astype(jnp.int32)
        return apart(lambda: self.frame.ignore.at[row, column].get(mode="fill", fill_value=True))


class Measurements(NamedTuple):
    """Points as a global-shutter camera without distortion would have seen them at the time of the frame.

    Attributes:
        xy: `(2, n)` normalized coordinates.
        depth: `(n,)` measured depth, meters; 0 where there is none to believe.
        sigma: `(n,)` standard deviation of the depth, meters.
    """

    xy: Pixels
    depth: Weights
    sigma: Weights

    def in_camera(self) -> Points:
        """`(3, n)` where the points are in the axes of the camera; at its center without depth."""
        return jnp.concatenate([self.xy, jnp.ones_like(self.xy[:1])]) * self.depth[None, :]

    def followed_by(self, others: "Measurements") -> "Measurements":
        """Return these measurements and others after them."""
        return Measurements(*(jnp.concatenate(pair, axis=-1) for pair in zip(self, others, strict=True)))


class PixelRays(NamedTuple):
    """Pixels of a frame with their rays, which are the same for every pose.

    Attributes:
        uv: `(2, n)` pixels as seen.
        xy: `(2, n)` normalized coordinates as seen, without distortion.
        matched: `(n,)` depths from `match_depth`, meters; `None` where depth is measured.
    """

    uv: Pixels
    xy: Pixels
    matched: Weights | None

    def measured(
        self,
        expected_depth: Weights,
        twist: Float[Array, "6"],
        depth: DepthImage,
        depth_delay_s: Scalar,
        sensor: SensorModel,
        *,
        reach: int = 1,
    ) -> Measurements:
        """Remove the rolling shutter, and read the depth where the pixels are by the time the depth image is taken.

        Args:
            expected_depth: `(n,)` approximate depths, meters, which scale the image motion that translation causes.
            twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
            depth: `(h, w)` depth image as measured, meters; 0 or NaN where missing.
            depth_delay_s: Seconds from the time of the image to that of the depth.
            sensor: Camera with its depth noise, and the depths to be believed.
            reach: Reach of `sample_depth`, pixels, static.
        """
        velocity = image_velocity(self.xy, expected_depth, twist)
        at_once = as_if_at_once(self.xy, velocity, self.uv[1], depth.shape[0], sensor.readout_s)
        measured = self.matched
        if measured is None:
            focal = jnp.stack([sensor.intrinsics.fx, sensor.intrinsics.fy])[:, None]
            there = self.uv + focal * velocity * depth_delay_s
            measured = believed_depth(depth, there, sensor, reach=reach)
        return Measurements(at_once, measured, depth_sigma(measured, sensor))

    def from_pose(
        self, X_world: Points, pose: SE3, twist: Float[Array, "6"], view: PreparedFrame, sensor: SensorModel
    ) -> Measurements:
        """Measure map points `(3, n)`, in meters, that are seen along the rays from about `pose`.

        The depth is read anew for each pose. Read once, at the predicted one, the error on Bonn `crowd` (start) grows
        by 13 to 18 % with the presets `ngd`, `usd`, `rts` and `static`: its depth comes later than its images.
        """
        expected = _depth_from(X_world, pose, sensor)
        return self.measured(expected, twist, view.frame.depth, view.frame.depth_delay_s, sensor)


def believed_depth(
    depth: DepthImage, uv: Pixels, sensor: SensorModel, *, reach: int = 1, max_step: float = 0.05
) -> Weights:
    """Return the `(n,)` depth at pixels, meters, as `sample_depth`; 0 where there is none that a sensor believes.

    Args:
        depth: `(h, w)` depth image as measured, meters; 0 or NaN where missing.
        uv: `(2, n)` pixel coordinates.
        sensor: Camera with its depth noise, and the depths to be believed.
        reach: Reach of `sample_depth`, pixels, static.
        max_step: Largest difference of depth around a pixel, as a share of its depth; that of noise comes on top.
    """
    limits = {"nearest": sensor.min_depth_m, "farthest": sensor.max_depth_m}
    return sample_depth(depth, uv, reach=reach, max_step=max_step, noise=sensor.depth_step_m(), **limits)


def pixel_rays(uv: Pixels, sensor: SensorModel, matched: Weights | None = None) -> PixelRays:
    """Make the rays of pixels `(2, n)` as seen; `matched` are their depths from `match_depth`, if any."""
    return PixelRays(uv, normalize(sensor.intrinsics, uv), matched)


def _depth_from(X_world: Points, pose: SE3, sensor: SensorModel) -> Weights:
    """Return the depth of map points `(3, n)` as seen from a pose, meters, but at least the smallest valid one."""
    return jnp.maximum(to_camera(pose, X_world)[2], sensor.min_depth_m)


def match_depth(
    view: PreparedFrame,
    uv: Pixels,
    expected_depth: Weights,
    mask: Mask,
    sensor: SensorModel,
    *,
    known_point: bool = True,
    plan: FlowPlan = ROW_PLAN,
) -> Weights | None:
    """Depth of pixels of the left image of a pair by matching them in the right one; `None` without a pair.

    Args:
        view: The frame.
        uv: `(2, n)` pixels as seen.
        expected_depth: `(n,)` meters, where matching begins; where it is not positive, the frame's own rough depth.
        mask: `(n,)` which to match.
        sensor: Camera, and the depths to be believed.
        known_point: Whether `expected_depth` is that of points of the map, static: where it is confirmed, a match needs
            no way back. Else it is rough depth of this very pair, which may be wrong in the same way.
        plan: Settings of the search along rows, static.

    Returns:
        `(n,)` meters, 0 where there is no match.
    """
    if view.right is None:
        return None
    if not uv.shape[1]:  # a plan that looks nothing up
        return jnp.zeros(0, expected_depth.dtype)
    focal_baseline = sensor.intrinsics.fx * sensor.baseline_m
    rough = jnp.where(expected_depth > 0, expected_depth, view.depth_at(uv, sensor, reach=0))
    known = mask & (rough > 0)
    left = Pyramid(view.pyramid.levels[: len(view.right.levels)], view.pyramid.border)
    guess = focal_baseline / jnp.where(known, rough, 1)
    expected_px = _EXPECTED_PX if known_point else 0.0
    match = row_disparities(left, view.right, uv, guess, known, expected_px=expected_px, plan=plan)
    depth = focal_baseline / jnp.where(match.found, match.disparity, 1)
    return valid_depth(jnp.where(match.found, depth, 0), sensor.min_depth_m, sensor.max_depth_m)


def predict_pixels(X_cam: Points, twist: Float[Array, "6"], height: int, sensor: SensorModel) -> Pixels:
    """Project points into a frame of a rolling shutter, while the camera moves with `twist`."""
    depth = jnp.maximum(X_cam[2], sensor.min_depth_m / 2)
    xy = X_cam[:2] / depth[None, :]
    v = to_pixels(sensor.intrinsics, distort(sensor.intrinsics, xy))[1]
    late = xy + image_velocity(xy, depth, twist) * row_time(v, height, sensor.readout_s)[None, :]
    return to_pixels(sensor.intrinsics, distort(sensor.intrinsics, late))


class ExpectedPixels(NamedTuple):
    """Pixels at which points are expected in a frame.

    Attributes:
        uv: `(2, n)` pixels of the distorted image, whether or not they are inside.
        inside: `(n,)` mask of the points that are in the image.
        ignored: `(n,)` whether the frame ignores the pixel; of any pixel where a point is not inside.
    """

    uv: Pixels
    inside: Mask
    ignored: Mask


def expected_pixels(
    X_cam: Points, twist: Float[Array, "6"], ignore: Bool[Array, "h w"], sensor: SensorModel
) -> ExpectedPixels:
    """Look up where points are expected in a frame.

    Args:
        X_cam: `(3, n)` positions in the camera frame, meters.
        twist: Velocity of the camera in its own axes.
        ignore: Mask of the pixels that the frame ignores.
        sensor: Camera and its readout time.
    """
    height, width = ignore.shape
    uv = predict_pixels(X_cam, twist, height, sensor)
    size = jnp.array([[width], [height]], uv.dtype)
    pixel = jnp.round(uv)
    inside = _before_the_lens(X_cam, size, sensor) & ((pixel >= 0) & (pixel < size)).all(axis=0)
    column, row = jnp.clip(pixel, 0, size - 1).astype(jnp.int32)
    return ExpectedPixels(uv, inside, ignore[row, column])


def _before_the_lens(X_cam: Points, size: Float[Array, "2 1"], sensor: SensorModel) -> Mask:
    """Return which points are in front of the camera, and not so far aside that only distortion folds them inside."""
    nearest = sensor.min_depth_m / 2
    straight = to_pixels(sensor.intrinsics, X_cam[:2] / jnp.maximum(X_cam[2:], nearest))
    near = (straight > -_MAX_BENT * size) & (straight < (1 + _MAX_BENT) * size)
    return (X_cam[2] > nearest) & near.all(axis=0)


def surface_depth(
    expected_depth: Weights,
    uv: Pixels,
    twist: Float[Array, "6"],
    depth: DepthImage,
    depth_delay_s: Scalar,
    sensor: SensorModel,
) -> tuple[Weights, Mask]:
    """Measure the depth of the surface at each pixel, to compare it with that of a point expected there.

    Args:
        expected_depth: `(n,)` expected depths, meters.
        uv: `(2, n)` expected pixels.
        twist: Velocity of the camera in its own axes.
        depth: Raw depth image, meters.
        depth_delay_s: Time from the image to its depth, seconds.
        sensor: Camera and the error model of its depth.

    Returns:
        Depths `(n,)` in meters, and a mask of the pixels around which all depth is of one surface within range.
    """
    rays = pixel_rays(uv, sensor)
    measured = rays.measured(expected_depth, twist, depth, depth_delay_s, sensor, reach=_SURFACE_PX).depth
    return measured, measured > 0


def depth_sigma(depth: Weights, sensor: SensorModel) -> Weights:
    """Standard deviation of measured depth, meters."""
    return sensor.depth_sigma_m + sensor.depth_sigma_per_m2 * jnp.square(depth)
