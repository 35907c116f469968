"""Blocks of frames with the tracks of points through them, as arrays of one size."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.calibration.depth_patches import DepthPatches, DepthPlanes


class TrackBlock(NamedTuple):
    """Some frames in a row, and the tracks of `p` points through them. No track is part of two blocks.

    Attributes:
        times_s: `(f,)` times of the frames since the first one, seconds.
        poses: `(f, 7)` initial poses, wxyz_xyz of T_world_cam.
        X_world: `(3, p)` initial positions of the points, meters.
        uv: `(f, 2, p)` pixels at which the points are seen, in the image as taken.
        seen: `(f, p)` whether a point is seen in a frame.
        depth: Planes of inverse depth around the points, with the axes `(f, ..., p)`.
        patches: Depth from which they are fitted; `None` where they stay as they are.
        delay_s: `(f,)` times from the images to their depth images by their timestamps, seconds.
        time_sign: `(f,)` 1, or -1 of a recording that is played backward.
        origin: `(7,)` pose of the first frame in the world of the whole recording, in which blocks see the same places.
        timestamps_ns: `(f,)` times of the frames as the recording says them, nanoseconds.
    """

    times_s: Float[np.ndarray, " f"]
    poses: Float[np.ndarray, "f 7"]
    X_world: Float[np.ndarray, "3 p"]
    uv: Float[np.ndarray, "f 2 p"]
    seen: Bool[np.ndarray, "f p"]
    depth: DepthPlanes
    patches: DepthPatches | None
    delay_s: Float[np.ndarray, " f"]
    time_sign: Float[np.ndarray, " f"]
    origin: Float[np.ndarray, "7"]
    timestamps_ns: Int[np.ndarray, " f"]

    @property
    def measured(self) -> Bool[np.ndarray, "f p"]:
        """Whether a point is seen and its depth measured."""
        return self.seen & self.depth.measured

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.times_s)

    def motion_weights(self) -> Float[np.ndarray, "f 4"]:
        """Return the weights by which the displacements to the frames before and after give the motion at a time.

        `(f, 4)`: of the displacement to the frame before, times the time since the frame and times its square, and the
        same of the frame after: the parabola through all three. At an end of the block there is only one of them, and
        the motion is even.
        """
        weights = np.zeros((self.num_frames, 4))
        steps = np.diff(self.times_s)
        weights[0, 2], weights[-1, 0] = 1 / steps[0], -1 / steps[-1]
        before, after = steps[:-1], steps[1:]
        whole = before + after
        inner = (-after / (before * whole), 1 / (before * whole), before / (after * whole), 1 / (after * whole))
        weights[1:-1] = np.stack(inner, axis=1)
        return weights
