"""What the camera has seen before at the places it sees now: what has come since, and what stands still.

Depth alone tells, with the pose of the camera: a surface in front of what was seen there before has come since, a
person, a door or a chair that is carried, known to a network or not. One that was there already is no part of what
moves by.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import Intrinsics
from jaxslam_kernels.depth.depth_change import depth_change
from jaxtyping import Array, Bool, Float

from jaxslam.geometry.se3 import between, compose
from jaxslam.runtime.aligned_memory import aligned_array
from jaxslam.runtime.compile_cache import SINGLE_THREAD
from jaxslam.runtime.compiled import compiled
from jaxslam.sensors.downscale import Downscaler, ImageGrid

_COARSE_WIDTH = 160
"""Images are compared at about so many columns."""
_AGO_S = (0.27, 0.5)
"""How long ago the frames were taken that tell what is new and what stands still: a walker has moved by half his width,
and more than a step. With 0.33 s for the latter, masks without detections for a second are worse (Bonn `crowd`, against
DeepLab, new_surfaces not added: median IoU 0.35 instead of 0.39): people who pause leave them."""
_KEPT_S = 1.0
_NEW_SHARE = 0.003
"""Least share of the image that a new surface covers."""
_NEW_RANGE_M = 0.2
"""How much nearer and farther than the surface that is new the rest of it may be."""
_TIMING_S = 0.0125
"""How well it is known when a row of a depth image was taken: half the readout of a rolling shutter. A camera that
turns shows edges displaced by that: on TUM `fr1_rpy`, at 2 rad/s, desks had new_surfaces of 20 pixels along them."""
_PERCENTILES = (5, 95)
_MIN_OVERLAP = 0.1
"""A piece of a new surface holds at least this share of the surface that is new."""


class BackgroundSurfaces(NamedTuple):
    """What is known of the pixels of a frame, at the coarse size.

    Attributes:
        depth: `(h, w)` meters, 0 where missing.
        outside: `(h, w)` the surface was there, and outside the mask, in the frame the mask is carried on from.
        still: `(h, w)` it has been there for a while.
        unmoved: `(h, w)` it was there a little ago, and outside the mask.
        new: `(h, w)` it was not.
        displaced_px: How far edges may be displaced against that frame, coarse pixels.
    """

    depth: np.ndarray
    outside: np.ndarray
    still: np.ndarray
    unmoved: np.ndarray
    new: np.ndarray
    displaced_px: float


class _Remembered(NamedTuple):
    """A frame that was tracked."""

    time_s: float
    T_world_cam: np.ndarray
    turn_rad_per_s: float
    depth: np.ndarray
    mask: np.ndarray


class SurfaceMemory:
    """Keeps the depth, masks and poses of the last second, and compares new frames with them."""

    def __init__(self, raster: ImageGrid, farthest_m: float = math.inf) -> None:
        """Begin with nothing seen.

        Args:
            raster: Of the images. Distortion is left out: between frames so close it makes no difference.
            farthest_m: Depth beyond is as good as missing: sensors that see nothing may say that it is far away.
        """
        self._farthest_m = farthest_m
        self._reduced = Downscaler(raster, _COARSE_WIDTH)
        self._intrinsics, shape = self._reduced.raster.intrinsics, self._reduced.raster.shape
        num = 1 + len(_AGO_S)
        self._depth = aligned_array(shape, np.float32)
        self._depths_then = aligned_array((num, *shape), np.float32)
        self._masks_then = aligned_array((num, *shape), np.bool_)
        self._seen: dict[int, _Remembered] = {}

    def compile(self) -> None:
        """Compile all that is needed."""
        self._compared(np.tile(np.eye(1, 7), (len(self._depths_then), 1)))

    def compare(
        self,
        time_s: float,
        T_world_cam: Float[np.ndarray, "7"],
        turn_rad_per_s: float,
        depth: Float[np.ndarray, "h w"],
        since: tuple[int, Bool[np.ndarray, "h w"]] | None = None,
    ) -> BackgroundSurfaces:
        """Compare a frame with those before.

        Args:
            time_s: Of the frame.
            T_world_cam: Where the camera was when the depth was taken.
            turn_rad_per_s: How fast it turns.
            depth: Meters, 0 where missing.
            since: Number and mask of the frame that the mask is carried on from.
        """
        coarse = self._reduced.every(depth)
        np.copyto(self._depth, np.where(coarse < self._farthest_m, coarse, 0))
        poses = np.tile(np.eye(1, 7), (len(self._depths_then), 1))
        self._depths_then[:] = 0  # says nothing
        first = None if since is None else self._seen.get(since[0])
        if since is not None and first is not None:
            first = first._replace(mask=self._reduced.every(since[1]))
        before = [first, *(self._about(time_s - ago_s, ago_s / 2) for ago_s in _AGO_S)]
        for slot, then in enumerate(before):
            if then is not None:
                self._depths_then[slot], self._masks_then[slot] = then.depth, then.mask
                poses[slot] = between(then.T_world_cam, T_world_cam)
        turns = turn_rad_per_s + (0.0 if before[1] is None else before[1].turn_rad_per_s)
        displaced_px = float(self._intrinsics.fx) * turns * _TIMING_S
        outside, still, unmoved, new = self._compared(poses)
        return BackgroundSurfaces(self._depth, outside, still, unmoved, new, displaced_px)

    def remember(
        self,
        frame: int,
        time_s: float,
        T_world_cam: Float[np.ndarray, "7"],
        turn_rad_per_s: float,
        mask: Bool[np.ndarray, "h w"],
    ) -> None:
        """Keep the frame compared last, now that it is known where it was taken."""
        coarse = self._depth.copy(), self._reduced.every(mask).copy()
        self._seen[frame] = _Remembered(time_s, T_world_cam, turn_rad_per_s, *coarse)
        for old in [number for number, seen in self._seen.items() if not 0 <= time_s - seen.time_s <= _KEPT_S]:
            del self._seen[old]

    def correct(self, T_new_old: Float[np.ndarray, "7"]) -> None:
        """The world has moved: poses as they are now were others before."""
        for frame, seen in self._seen.items():
            self._seen[frame] = seen._replace(T_world_cam=compose(T_new_old, seen.T_world_cam))

    def forget(self) -> None:
        """Nothing that was seen says anything of what comes."""
        self._seen.clear()

    def without(self, mask: Bool[np.ndarray, "h w"], drop: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """A mask without pixels of the coarse size; single ones of those stay."""
        smooth = cv2.medianBlur(drop.view(np.uint8), 3)
        return mask & ~self._reduced.whole(smooth.view(bool)) if smooth.any() else mask

    def with_new_surfaces(self, mask: Bool[np.ndarray, "h w"], seen: BackgroundSurfaces) -> Bool[np.ndarray, "h w"]:
        """A mask with what has come into the picture: what is new, and what hangs together with it."""
        coming = new_surfaces(seen, self._reduced.every(mask))
        return mask | self._reduced.whole(coming) if coming.any() else mask

    def _about(self, time_s: float, within_s: float) -> _Remembered | None:
        """The frame taken nearest to a time; `None` if there is none within so many seconds."""
        nearest = min(self._seen.values(), key=lambda seen: abs(seen.time_s - time_s), default=None)
        return None if nearest is None or abs(nearest.time_s - time_s) > within_s else nearest

    def _compared(self, T_then_now: np.ndarray) -> Sequence[np.ndarray]:
        poses = T_then_now.astype(np.float32)
        compared = _compared(self._depth, self._depths_then, self._masks_then, poses, self._intrinsics)
        return [np.asarray(each) for each in compared]


def new_surfaces(seen: BackgroundSurfaces, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of what has come into the picture and is not in the mask: new surfaces, and the rest of their objects.

    The rest has the depth of the new surface, hangs together with it, and is not known to stand where it is.
    """
    side = max(3, 1 + math.ceil(seen.displaced_px)) | 1  # edges of depth are ragged; an even side would shift the rest
    fresh = cv2.morphologyEx((seen.new & ~mask).view(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    num, piece, measures, _ = cv2.connectedComponentsWithStats(fresh, connectivity=4)
    coming = np.zeros(mask.shape, bool)
    for index in range(1, num):
        area = measures[index, cv2.CC_STAT_AREA]
        if area < _NEW_SHARE * mask.size:
            continue
        core = piece == index
        nearest, farthest = np.percentile(seen.depth[core], _PERCENTILES)
        alike = (seen.depth > nearest - _NEW_RANGE_M) & (seen.depth < farthest + _NEW_RANGE_M) & ~seen.unmoved
        num_parts, part = cv2.connectedComponents(alike.view(np.uint8), connectivity=4)
        held = np.bincount(part[core], minlength=num_parts)
        held[0] = 0  # the background
        coming |= (held > _MIN_OVERLAP * area)[part]
    return coming


@compiled(when="warm-up", options=SINGLE_THREAD)
def _compared(
    depth: Float[Array, "h w"],
    depths_then: Float[Array, "k h w"],
    masks_then: Bool[Array, "k h w"],
    T_then_now: Float[Array, "k 7"],
    intrinsics: Intrinsics,
) -> tuple[Bool[Array, "h w"], ...]:
    """`outside`, `still`, `unmoved` and `new`, from the frame the mask comes from, one a little ago, one long ago."""
    change = jax.vmap(lambda then, pose: depth_change(depth, then, SE3(pose), intrinsics))(depths_then, T_then_now)
    masked = jax.vmap(lambda mask, then: mask.reshape(-1)[then])(masks_then, change.then)
    outside = change.same & ~masked
    return outside[0], change.same[2], outside[1], change.new[1]
