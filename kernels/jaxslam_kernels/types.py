"""Conventions every kernel keeps: axes, frames, units, layout. Stated once, here.

Layout: struct of arrays with the long axis last. `n` points in the image are `(2, n)`, in space `(3, n)`;
XLA vectorizes the last axis on a CPU. Fixed shapes with boolean masks; nothing is ever dropped from an array.

Frames: `T_world_cam` carries camera coordinates into the world, `X_world = T_world_cam @ X_cam`. Every transform
names both frames that way. Camera axes as in OpenCV: x right, y down, z forward. Transforms are `jaxlie.SE3`
(parameters `wxyz_xyz`, tangent = translation first, then rotation). A pose is updated on the right in its own
frame, `T_world_cam @ exp(tangent)`, unless a docstring says otherwise; covariances live in that tangent space.

Units: meters, radians, seconds, pixels. A pixel `(u, v)` counts from the center of the top-left pixel, which
is (0, 0): `u` along a row, `v` down a column. An image is `image[v, u]`.

Failure: nothing raises inside compiled code. Results are finite, and a status code says what they are worth; that goes
for no points at all too. While tracing, an argument of another type (`TypeError`) or another shape (`ValueError`) than
annotated raises, see `checks`.

Derivatives: by a weight of exactly 0 the derivative is the one-sided limit from above. Those of what a solver finds are
right to any order where it has converged to a strict minimum, see `derivative_rules`.

Precision: float32 in the real-time path; every kernel follows the type of its inputs, so float64 works too.
"""

from typing import TypeAlias

from jaxtyping import Array, Bool, Float, Int

Scalar: TypeAlias = Float[Array, ""]
Flag: TypeAlias = Bool[Array, ""]
Code: TypeAlias = Int[Array, ""]

Pixels: TypeAlias = Float[Array, "2 n"]
"""Pixel coordinates `(u, v)`, one column a point."""
Points: TypeAlias = Float[Array, "3 n"]
"""Points in space in meters, one column a point."""
Weights: TypeAlias = Float[Array, " n"]
"""One non-negative number a point; zero means that the point does not count."""
Mask: TypeAlias = Bool[Array, " n"]

Image: TypeAlias = Float[Array, "h w"]
"""A gray image, intensities 0 to 255."""
DepthImage: TypeAlias = Float[Array, "h w"]
"""Depth along the optical axis in meters; 0 where missing."""
