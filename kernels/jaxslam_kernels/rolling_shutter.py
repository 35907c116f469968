"""Image motion of static points while the camera moves, and the rolling shutter it corrects.

A rolling shutter exposes one row after the other. A row `v` of an image of height `h` is taken at
`t + readout_s * (v / (h - 1) - 1 / 2)`, where `t`, the time of the frame, is that of its middle row.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam_kernels.types import Pixels, Scalar, Weights


def image_velocity(xy: Pixels, depth: Weights, twist: Float[Array, "6"]) -> Pixels:
    """Velocity in normalised coordinates of static points seen from a moving camera.

    Source: Longuet-Higgins and Prazdny, The Interpretation of a Moving Retinal Image, 1980.

    Args:
        xy: `(2, n)` normalised coordinates.
        depth: `(n,)` depth in metres; only rotation acts on a point of depth 0 (unknown).
        twist: Velocity of the camera in its own axes, metres a second then radians a second.

    Returns:
        `(2, n)` velocity a second.
    """
    x, y = xy
    vx, vy, vz, wx, wy, wz = twist
    known = depth > 0
    inverse = jnp.where(known, 1 / jnp.where(known, depth, 1), 0)
    dx = (x * vz - vx) * inverse + x * y * wx - (1 + x * x) * wy + y * wz
    dy = (y * vz - vy) * inverse + (1 + y * y) * wx - x * y * wy - x * wz
    return jnp.stack([dx, dy])


def row_time(v: Float[Array, " n"], height: int, readout_s: Scalar) -> Float[Array, " n"]:
    """When row `v` is taken, in seconds after the middle row."""
    return (v / (height - 1) - 0.5) * readout_s


def as_if_at_once(
    xy: Pixels, v: Float[Array, " n"], depth: Weights, twist: Float[Array, "6"], height: int, readout_s: Scalar
) -> Pixels:
    """Where points would have been seen had the whole image been taken at the time of its middle row.

    First order in the readout time: at 140 degrees a second and 20 ms the row furthest from the middle moves 1.4
    degrees, and the second-order term is a hundredth of that.

    Args:
        xy: `(2, n)` normalised coordinates of the points as seen.
        v: `(n,)` rows they were seen in.
        depth: `(n,)` depth in metres, 0 if unknown.
        twist: As for `image_velocity`.
        height: Rows of the image, static.
        readout_s: Seconds from the first row to the last; 0 for a global shutter.
    """
    return xy - image_velocity(xy, depth, twist) * row_time(v, height, readout_s)[None, :]
