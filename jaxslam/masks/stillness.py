"""What stands still leaves a mask that has not been confirmed for a while: it may never have been part of an object."""

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.camera import Camera
from jaxslam.masks.propagation import Followed, depth_at
from jaxslam.masks.sampling import CELL_PX
from jaxslam.pose import between, transform

_STILL_PX = 2.0
"""A point this near to where the camera's motion alone would have it stands still."""


def without_still_parts(
    mask: Bool[np.ndarray, "h w"],
    followed: Followed,
    depth: Float[np.ndarray, "h w"],
    before: np.ndarray,
    now: np.ndarray,
    camera: Camera,
) -> Bool[np.ndarray, "h w"]:
    """The mask without the cells of 15 x 15 pixels in which more points stand still than move.

    Args:
        mask: Of the present frame.
        followed: Points of the mask, from the frame before to this one.
        depth: Of this frame, metres, 0 where missing.
        before: `(7,)` pose of the camera at the frame before.
        now: `(7,)` pose of the camera at this frame.
        camera: Its lens is taken to be without distortion, which such small motions do not tell.
    """
    still, known = _still(followed, depth, between(before, now), camera)
    rows, columns = (-(-side // CELL_PX) for side in mask.shape)
    column, row = (followed.now[:, known] // CELL_PX).astype(np.int64)
    votes = np.zeros((rows, columns), np.int64)
    np.add.at(votes, (row, column), np.where(still[known], 1, -1))
    cells = np.repeat(np.repeat(votes > 0, CELL_PX, axis=0), CELL_PX, axis=1)
    return mask & ~cells[: mask.shape[0], : mask.shape[1]]


def _still(
    followed: Followed, depth: np.ndarray, T_before_now: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Which points stand still, and for which that is known."""
    known, measured = depth_at(depth, followed)
    z = measured.astype(np.float64)
    u, v = followed.now.astype(np.float64)
    X_now = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    x, y, ahead = transform(T_before_now, X_now)
    known &= ahead > 0.05
    ahead = np.where(known, ahead, 1.0)
    expected = np.stack([camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy])
    return known & (np.linalg.norm(expected - followed.before, axis=0) < _STILL_PX), known
