"""Image motion of static points while the camera moves, and the rolling shutter it corrects.

A rolling shutter exposes one row after the other. A row `v` of an image of height `h` is taken at
`t + readout_s * (v / (h - 1) - 1 / 2)`, where `t`, the time of the frame, is that of its middle row.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam_kernels.camera import MIN_DEPTH
from jaxslam_kernels.checks import checked
from jaxslam_kernels.types import Pixels, Scalar, Weights


@checked
def image_velocity(xy: Pixels, depth: Weights, twist: Float[Array, "6"]) -> Pixels:
    """Velocity in normalized coordinates of static points seen from a moving camera.

    Source: Longuet-Higgins and Prazdny, The Interpretation of a Moving Retinal Image, 1980.

    Args:
        xy: `(2, n)` normalized coordinates.
        depth: `(n,)` depth in meters; only rotation acts on a point whose depth is unknown (0, not a number, or less
            than `camera.MIN_DEPTH`).
        twist: Velocity of the camera in its own axes, meters a second then radians a second: after a time `s` its
            pose is `T_world_cam @ exp(s * twist)`.

    Returns:
        `(2, n)` velocity a second; 0 where `xy` or `twist` is not finite.
    """
    moving = jnp.isfinite(twist).all()
    seen = (jnp.isfinite(xy).all(axis=0) & moving)[None, :]
    x, y = jnp.where(seen, xy, 0)
    vx, vy, vz, wx, wy, wz = jnp.where(moving, twist, 0)
    known = depth > MIN_DEPTH
    inverse = jnp.where(known, 1 / jnp.where(known, depth, 1), 0)
    dx = (x * vz - vx) * inverse + x * y * wx - (1 + x * x) * wy + y * wz
    dy = (y * vz - vy) * inverse + (1 + y * y) * wx - x * y * wy - x * wz
    return jnp.where(seen, jnp.stack([dx, dy]), 0)


@checked
def row_time(v: Float[Array, " n"], height: int, readout_s: Scalar) -> Float[Array, " n"]:
    """Return the time at which rows are taken, in seconds after the middle row; 0 for a row that is not a number.

    Args:
        v: `(n,)` rows, pixel coordinates in the image as taken, distortion included.
        height: Rows of the image, static, at least 2.
        readout_s: Seconds from the first row to the last; 0 for a global shutter.
    """
    after = v / (height - 1) - 0.5
    return jnp.where(jnp.isfinite(v), after, 0) * readout_s


@checked
def as_if_at_once(xy: Pixels, velocity: Pixels, v: Float[Array, " n"], height: int, readout_s: Scalar) -> Pixels:
    """Correct points to where a global shutter at the time of the middle row would have seen them.

    First order in the readout time. A camera of 640x480 pixels and 517 pixels focal length that turns at 140 degrees a
    second and reads out in 20 ms moves points by up to 19 pixels; a third of a pixel of that remains, and the error
    grows with the square of speed and readout time.

    Args:
        xy: `(2, n)` normalized coordinates of the points as seen.
        velocity: `(2, n)` velocity of the points from `image_velocity`, normalized coordinates per second.
        v: `(n,)` rows, pixel coordinates in the image as taken, distortion included.
        height: Rows of the image, static, at least 2.
        readout_s: Seconds from the first row to the last; 0 for a global shutter.

    Returns:
        `(2, n)` normalized coordinates; 0 where `xy` is not finite.
    """
    seen = jnp.isfinite(xy).all(axis=0)[None, :]
    return jnp.where(seen, xy, 0) - velocity * row_time(v, height, readout_s)[None, :]
