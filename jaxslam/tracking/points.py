"""Points in the tracker's state: tracked from frame to frame, kept in keyframes, and matched with keyframes."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxslam_kernels.types import Code, Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Float, Int, Num

from jaxslam.runtime.filled_arrays import filled


class TrackedPoints(NamedTuple):
    """Points tracked from frame to frame; slots that are not `valid` are free.

    Attributes:
        uv: `(2, n)` positions in the last good frame, pixels of the distorted image.
        xy: `(2, n)` the same positions in normalized coordinates of an ideal camera.
        depth: `(n,)` depths measured there, meters; 0 where depth is missing.
        X_world: `(3, n)` positions in the world, fused over the last few frames, meters.
        X_anchor: `(3, n)` positions in the world measured `anchor_age` frames ago, meters; a slowly moving point drifts
            away from its anchor. For a point of unknown depth, the position of the camera that detected it.
        information: `(n,)` inverse variances of the depths, 1 / m^2; 0 for a point of unknown depth, whose `X_world` is
            only somewhere on the ray along which it was detected.
        weight: `(n,)` weights of the points, 0 to 1; the caller may change them between steps.
        age: `(n,)` number of frames since each point was detected.
        anchor_age: `(n,)` number of frames since `X_anchor` was measured.
        id: `(n,)` ids of the points; an id is never reused.
        valid: `(n,)` mask of the slots that hold a point.
    """

    uv: Pixels
    xy: Pixels
    depth: Weights
    X_world: Points
    X_anchor: Points
    information: Weights
    weight: Weights
    age: Int[Array, " n"]
    anchor_age: Int[Array, " n"]
    id: Int[Array, " n"]
    valid: Mask

    def has_position(self) -> Mask:
        """Return the `(n,)` mask of the points whose depth is known, measured or from parallax."""
        return self.valid & (self.information > 0)


def empty_points(num_points: int, dtype: DTypeLike) -> TrackedPoints:
    """Make slots without points; no two arrays share memory, so that a program may take all of them over."""
    n = num_points
    return TrackedPoints(
        uv=filled((2, n), dtype),
        xy=filled((2, n), dtype),
        depth=filled(n, dtype),
        X_world=filled((3, n), dtype),
        X_anchor=filled((3, n), dtype),
        information=filled(n, dtype),
        weight=filled(n, dtype, 1),
        age=filled(n, jnp.int32),
        anchor_age=filled(n, jnp.int32),
        id=filled(n, jnp.int32),
        valid=filled(n, bool),
    )


class KeyframeRing(NamedTuple):
    """Keyframes whose points are matched again: a ring of the latest ones, followed by those loaded from the map.

    Attributes:
        images: `(k, h, w)` images, in the type of the frames.
        T_world_cam: `(k, 7)` poses, `wxyz_xyz`.
        uv: `(k, 2, n)` positions of the points in the images, pixels.
        X_world: `(k, 3, n)` positions of the points in the world, meters.
        weight: `(k, n)` weights of the points when the keyframe was made; 0 for a slot without a point.
        id: `(k, n)` ids of the points.
        made: Number of keyframes made so far; the next one takes slot `made` modulo the size of the ring.
    """

    images: Num[Array, "k h w"]
    T_world_cam: Float[Array, "k 7"]
    uv: Float[Array, "k 2 n"]
    X_world: Float[Array, "k 3 n"]
    weight: Float[Array, "k n"]
    id: Int[Array, "k n"]
    made: Code


class KeyframeMatches(NamedTuple):
    """Keyframe points matched in a frame.

    Attributes:
        X_world: `(3, n)` positions in the world, meters.
        uv: `(2, n)` positions in the frame, pixels.
        weight: `(n,)` weights of the matches; 0 for a point without a match.
        id: `(n,)` ids of the points.
        overlap: `(k,)` share of each keyframe's points that are in view.
        num_sought: Number of keyframe points that were looked for in the frame.
    """

    X_world: Points
    uv: Pixels
    weight: Weights
    id: Int[Array, " n"]
    overlap: Float[Array, " k"]
    num_sought: Scalar
