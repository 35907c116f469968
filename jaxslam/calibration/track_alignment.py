"""Finds tracked points again in the frames of a block, by the patch around them in one frame of the block.

Optical flow from frame to frame adds up its errors, which then look like a motion of the camera or of the point. The
poses and the camera of a first fit predict where each frame shows the patch, and how turned and stretched, so that all
frames are compared with the same one.

Source: Klein and Murray, "Parallel Tracking and Mapping for Small AR Workspaces", 2007, section 5.2.
"""

import jax.numpy as jnp
import numpy as np
from jaxslam_kernels.flow.lk_search import LevelPlan
from jaxslam_kernels.flow.patch_align import PatchMatch, align_patches
from jaxslam_kernels.image.patches import Window
from jaxslam_kernels.image.pyramid import build_pyramid
from jaxslam_kernels.types import Mask, Pixels
from jaxtyping import Array, Float, Int, UInt8

from jaxslam.calibration.batch_solve import BlockState
from jaxslam.calibration.parameters import CameraVector
from jaxslam.calibration.residuals import predicted_pixels
from jaxslam.calibration.track_block import TrackBlock
from jaxslam.geometry.se3 import inverse, rotate
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.compiler_options import FAST_COMPILE, SINGLE_THREAD

_PLAN = LevelPlan(15, 20, 0.003)
"""Smaller than the patches of depth that tell edges: what moves differently behind an edge stays out of the window."""
_BORDER = Window(_PLAN.window).border
_ARM_PX = 5.0
"""Length of the arms of a cross on the surface whose images tell how a patch is turned and stretched."""
_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))
_NEAREST = 0.3
"""Smallest depth of the end of an arm, in that of the point."""
_MIN_CORRELATION, _FARTHEST_PX = 0.85, 3.0
"""Correlation of patches, and distance from where the point is predicted."""
_AREAS = 0.4, 2.5
"""Smallest and largest factor between the areas of a patch in two frames."""


def aligned(
    block: TrackBlock, state: BlockState, camera: CameraVector, images: UInt8[np.ndarray, "f h w"]
) -> TrackBlock:
    """Return a block whose points are seen where their patches are; where one is not found, its point is not seen.

    Args:
        block: The block as tracked.
        state: Poses and points of a fit, by which a point is predicted to a few pixels.
        camera: Parameters of the camera of that fit.
        images: Images of the frames, gray.
    """
    number = np.arange(block.seen.shape[1])
    anchor = _anchors(block)
    ends = _ends_of_crosses(block, state, camera, anchor)
    places = np.concatenate([state.points[:3], *ends], axis=1)
    predicted = predicted_pixels(block, state.poses, places, camera, height=images.shape[1])
    middle, right, left, below, above = np.moveaxis(predicted.reshape(*predicted.shape[:2], 5, -1), 2, 0)
    # How the arms appear: `[frame, pixel, arm, point]`, and in the frame that has the patch.
    arms = np.stack([right - left, below - above], axis=2)
    own = np.moveaxis(arms[anchor, :, :, number], 0, -1)
    area, own_area = _determinant(arms), _determinant(own)
    sought = block.seen & np.isfinite(predicted.reshape(len(predicted), 10, -1)).all(axis=1)
    # In products: a point behind a camera may have no area. The signs are the same unless it is seen from behind.
    sought &= (area * own_area > _AREAS[0] * own_area**2) & (area * own_area < _AREAS[1] * own_area**2)
    center = block.uv[anchor, :, number].T
    uv, seen = block.uv.copy(), np.zeros_like(block.seen)
    pictures = jnp.asarray(images)  # once, not for every frame
    for frame, image in enumerate(images):
        warp = np.einsum("ijn,jkn->ikn", own, _inverse(arms[frame]))
        arrays = (np.asarray(array, np.float32) for array in (center, warp, middle[frame]))
        match = _look_up(pictures, anchor, *arrays, sought[frame], image)
        found = np.asarray(match.points, np.float64)
        good = np.asarray(match.converged) & (np.asarray(match.correlation) > _MIN_CORRELATION)
        seen[frame] = sought[frame] & good & (np.hypot(*(found - middle[frame])) < _FARTHEST_PX)
        uv[frame] = np.where(seen[frame], found, uv[frame])
    return block._replace(uv=uv, seen=seen)


def _anchors(block: TrackBlock) -> Int[np.ndarray, " p"]:
    """Return the frame whose patch is looked for: the middle one of those that see a point, if possible with depth."""
    good = np.where(block.measured.any(axis=0), block.measured, block.seen)
    rank = np.cumsum(good, axis=0)
    return np.argmax(rank >= np.maximum((rank[-1] + 1) // 2, 1), axis=0).astype(np.int32)


def _ends_of_crosses(
    block: TrackBlock, state: BlockState, camera: CameraVector, anchor: Int[np.ndarray, " p"]
) -> list[Float[np.ndarray, "3 p"]]:
    """Return the ends of arms to the right, left, below and above of each point, on the plane of its measured depth.

    Where no depth is measured the plane faces the camera.
    """
    number = np.arange(len(anchor))
    poses = state.poses[anchor]
    X_cam = rotate(inverse(poses), state.points[:3].T - poses[:, 4:])
    slope = np.where(block.depth.measured[anchor, number], block.depth.plane[anchor, 1:, number].T, 0.0)
    ends = []
    for du, dv in _DIRECTIONS:
        # On a plane the inverse depth is linear in the pixel.
        share = 1 / np.maximum(1 + _ARM_PX * X_cam[:, 2] * (du * slope[0] + dv * slope[1]), _NEAREST)
        aside = _ARM_PX * np.array([du / camera[0], dv / camera[1], 0.0])
        end = share[:, None] * (X_cam + X_cam[:, 2:] * aside)
        ends.append((rotate(poses, end) + poses[:, 4:]).T)
    return ends


def _determinant(matrices: Float[np.ndarray, "... 2 2 n"]) -> Float[np.ndarray, "... n"]:
    return matrices[..., 0, 0, :] * matrices[..., 1, 1, :] - matrices[..., 0, 1, :] * matrices[..., 1, 0, :]


def _inverse(matrices: Float[np.ndarray, "2 2 n"]) -> Float[np.ndarray, "2 2 n"]:
    """Return inverses; finite ones of singular matrices, which belong to points that are not looked for."""
    (a, b), (c, d) = matrices
    determinant = _determinant(matrices)
    return np.array([[d, -b], [-c, a]]) / np.where(np.abs(determinant) > 0, determinant, 1.0)


@compiled(when="first use", options=FAST_COMPILE | SINGLE_THREAD)
def _look_up(
    images: UInt8[Array, "f h w"],
    anchor: Int[Array, " p"],
    center: Pixels,
    warp: Float[Array, "2 2 p"],
    guess: Pixels,
    mask: Mask,
    image: UInt8[Array, "h w"],
) -> PatchMatch:
    pyramid = build_pyramid(image, num_levels=1, border=_BORDER)
    return align_patches(images, anchor, center, warp, pyramid, guess, mask, plan=_PLAN)
