"""Compare a depth image with earlier ones: find new surfaces, and the static background inside a propagated mask.

Only depth and camera poses are used. A surface in front of the one seen there before is new: a person, a door, or a
carried chair, whether a detector knows it or not. A surface that was there before does not belong to a passing object.
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
from jaxslam.runtime.compiled import compiled
from jaxslam.sensors.downscale import Downscaler, ImageGrid

_COARSE_WIDTH = 160
"""Approximate number of columns of the reduced images that are compared."""
_AGO_S = (0.27, 0.5)
"""Ages of the frames against which new surfaces and static surfaces are found, seconds: a walker has moved by half his
width, and by more than a step. With 0.33 s for the latter, masks without detections for a second are worse, because
people who pause drop out of them (Bonn `crowd`, against DeepLab, without new surfaces: median IoU 0.35 instead of
0.39)."""
_LONG_AGO_S = (1.0, 2.0, 3.5)
"""Ages of further frames, seconds: what they see through has appeared since, also if it stands still by now."""
_KEPT_S, _DENSE_S, _SPARSE_S = 4.5, 1.0, 0.2
"""Time for which frames are kept, seconds; of those older than the second time, only such as are the third apart."""
_NEW_SHARE = 0.003
"""Smallest share of the image that a new surface covers."""
_NEW_RANGE = 0.12
"""Margin of the depth range of an object beyond that of its new surface, as a share of its depth."""
_TIMING_S = 0.0125
"""Uncertainty of the time of a row of a depth image, seconds: half the readout time of a rolling shutter. A rotating
camera displaces edges by that: on TUM `fr1_rpy`, at 2 rad/s, desks got false new surfaces of 20 pixels along their
edges."""
_PERCENTILES = (5, 95)
"""Percentiles that bound the depth range of a new surface."""
_MIN_HELD = 0.2
"""Smallest share of an appeared surface that the mask must hold to get all of it back."""
_MIN_OVERLAP = 0.1
"""Smallest share of the new surface that a connected component of its object holds."""


class BackgroundSurfaces(NamedTuple):
    """Comparison of a frame's depth with earlier frames, at the reduced size.

    Attributes:
        depth: `(h, w)` depth of the frame, meters; 0 where it is missing.
        outside: `(h, w)` mask of the surfaces that were there, outside the mask, in the frame from which the mask is
            propagated.
        still: `(h, w)` mask of the surfaces that were there in the older of the two earlier frames.
        unmoved: `(h, w)` mask of the surfaces that were there, outside the mask, in the newer of these frames.
        new: `(h, w)` mask of the surfaces that are in front of those of the newer of the two earlier frames.
        appeared: `(h, w)` mask of the surfaces that are in front of those of the older one, or of a frame up to four
            seconds old.
        displaced_px: Largest displacement of edges against the newer of the two earlier frames, reduced pixels.
    """

    depth: np.ndarray
    outside: np.ndarray
    still: np.ndarray
    unmoved: np.ndarray
    new: np.ndarray
    appeared: np.ndarray
    displaced_px: float


class _Remembered(NamedTuple):
    """A tracked frame at the reduced size; fields as in the arguments of `SurfaceMemory.remember`."""

    time_s: float
    T_world_cam: np.ndarray
    turn_rad_per_s: float
    depth: np.ndarray
    mask: np.ndarray


class SurfaceMemory:
    """The depth images, masks and poses of the last seconds, with which new frames are compared."""

    def __init__(self, raster: ImageGrid, farthest_m: float = math.inf) -> None:
        """Start without frames.

        Args:
            raster: Pixel grid of the images. Distortion is ignored: between frames so close it makes no difference.
            farthest_m: Largest valid depth, meters; some sensors report missing depth as far away.
        """
        self._farthest_m = farthest_m
        self._reduced = Downscaler(raster, _COARSE_WIDTH)
        self._intrinsics, shape = self._reduced.raster.intrinsics, self._reduced.raster.shape
        num = 1 + len(_AGO_S) + len(_LONG_AGO_S)
        self._depth = aligned_array(shape, np.float32)
        self._depths_then = aligned_array((num, *shape), np.float32)
        self._masks_then = aligned_array((num, *shape), np.bool_)
        self._seen: dict[int, _Remembered] = {}

    def compile(self) -> None:
        """Compile the comparison."""
        self._compared(np.tile(np.eye(1, 7), (len(self._depths_then), 1)))

    def compare(
        self,
        time_s: float,
        T_world_cam: Float[np.ndarray, "7"],
        turn_rad_per_s: float,
        depth: Float[np.ndarray, "h w"],
        since: tuple[int, Bool[np.ndarray, "h w"]] | None = None,
    ) -> BackgroundSurfaces:
        """Compare a frame with earlier frames.

        Args:
            time_s: Time of the frame, seconds.
            T_world_cam: `(7,)` pose of the camera at the time of the depth.
            turn_rad_per_s: Angular speed of the camera.
            depth: `(h, w)` depth image, meters; 0 where depth is missing.
            since: Number and `(h, w)` mask of the frame from which the mask is propagated; `None` without one.
        """
        coarse = self._reduced.every(depth)
        np.copyto(self._depth, np.where(coarse < self._farthest_m, coarse, 0))
        poses = np.tile(np.eye(1, 7), (len(self._depths_then), 1))
        self._depths_then[:] = 0  # missing depth gives no evidence
        first = None if since is None else self._seen.get(since[0])
        if since is not None and first is not None:
            first = first._replace(mask=self._reduced.every(since[1]))
        before = [first, *(self._about(time_s - ago_s, ago_s / 2) for ago_s in _AGO_S)]
        before += [self._about(time_s - ago_s, ago_s / 4) for ago_s in _LONG_AGO_S]
        for slot, then in enumerate(before):
            if then is not None:
                self._depths_then[slot], self._masks_then[slot] = then.depth, then.mask
                poses[slot] = between(then.T_world_cam, T_world_cam)
        turns = turn_rad_per_s + (0.0 if before[1] is None else before[1].turn_rad_per_s)
        displaced_px = float(self._intrinsics.fx) * turns * _TIMING_S
        outside, still, unmoved, new, appeared = self._compared(poses)
        return BackgroundSurfaces(self._depth, outside, still, unmoved, new, appeared, displaced_px)

    def remember(
        self,
        frame: int,
        time_s: float,
        T_world_cam: Float[np.ndarray, "7"],
        turn_rad_per_s: float,
        mask: Bool[np.ndarray, "h w"],
    ) -> None:
        """Store the frame compared last, now that its pose and mask are final.

        Args:
            frame: Number of the frame.
            time_s: Time of the frame, seconds.
            T_world_cam: `(7,)` pose of the camera at the time of the depth.
            turn_rad_per_s: Angular speed of the camera.
            mask: `(h, w)` mask of the movable objects.
        """
        coarse = self._depth.copy(), self._reduced.every(mask).copy()
        self._seen[frame] = _Remembered(time_s, T_world_cam, turn_rad_per_s, *coarse)
        last_s = -math.inf
        for number, then_s in sorted((number, seen.time_s) for number, seen in self._seen.items()):
            age_s = time_s - then_s
            if not 0 <= age_s <= _KEPT_S or (age_s > _DENSE_S and then_s < last_s + _SPARSE_S):
                del self._seen[number]
            else:
                last_s = then_s

    def correct(self, T_new_old: Float[np.ndarray, "7"]) -> None:
        """Apply a correction of the world frame to the stored poses."""
        for frame, seen in self._seen.items():
            self._seen[frame] = seen._replace(T_world_cam=compose(T_new_old, seen.T_world_cam))

    def forget(self) -> None:
        """Drop all stored frames."""
        self._seen.clear()

    def without(self, mask: Bool[np.ndarray, "h w"], drop: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Remove the pixels of a reduced mask `drop` from a mask, except isolated ones."""
        smooth = cv2.medianBlur(drop.view(np.uint8), 3)
        return mask & ~self._reduced.whole(smooth.view(bool)) if smooth.any() else mask

    def with_lost_parts(self, mask: Bool[np.ndarray, "h w"], seen: BackgroundSurfaces) -> Bool[np.ndarray, "h w"]:
        """Add appeared surfaces to a mask that holds a part of each: what propagation has lost of an object."""
        appeared = _opened(seen.appeared, seen.displaced_px)
        num, labels = cv2.connectedComponents(appeared.view(np.uint8), connectivity=4)
        piece = np.asarray(labels, np.int32)
        area = np.bincount(piece.ravel(), minlength=num)
        held = np.bincount(piece[self._reduced.every(mask)], minlength=num)
        back = held > _MIN_HELD * area
        back[0] = False  # what has not appeared
        return mask | self._reduced.whole(back[piece]) if back.any() else mask

    def with_new_surfaces(self, mask: Bool[np.ndarray, "h w"], seen: BackgroundSurfaces) -> Bool[np.ndarray, "h w"]:
        """Add the objects with new surfaces to a mask."""
        coming = new_surfaces(seen, self._reduced.every(mask))
        return mask | self._reduced.whole(coming) if coming.any() else mask

    def _about(self, time_s: float, within_s: float) -> _Remembered | None:
        """Return the stored frame nearest to a time; `None` if none is within `within_s` seconds."""
        nearest = min(self._seen.values(), key=lambda seen: abs(seen.time_s - time_s), default=None)
        return None if nearest is None or abs(nearest.time_s - time_s) > within_s else nearest

    def _compared(self, T_then_now: np.ndarray) -> Sequence[np.ndarray]:
        poses = T_then_now.astype(np.float32)
        compared = _compared(self._depth, self._depths_then, self._masks_then, poses, self._intrinsics)
        return [np.asarray(each) for each in compared]


def new_surfaces(seen: BackgroundSurfaces, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Find the objects that have come into view outside a mask: new surfaces, and the rest of their objects.

    The rest of an object is at the depth of its new surface, connected to it, and not known to be unmoved.
    """
    fresh = _opened(seen.new & ~mask, seen.displaced_px)
    num, piece, measures, _ = cv2.connectedComponentsWithStats(fresh.view(np.uint8), connectivity=4)
    coming = np.zeros(mask.shape, bool)
    for index in range(1, num):
        area = measures[index, cv2.CC_STAT_AREA]
        if area < _NEW_SHARE * mask.size:
            continue
        core = piece == index
        nearest, farthest = np.percentile(seen.depth[core], _PERCENTILES)
        nearest, farthest = (1 - _NEW_RANGE) * nearest, (1 + _NEW_RANGE) * farthest
        alike = (seen.depth > nearest) & (seen.depth < farthest) & ~seen.unmoved
        num_parts, part = cv2.connectedComponents(alike.view(np.uint8), connectivity=4)
        held = np.bincount(part[core], minlength=num_parts)
        held[0] = 0  # the background
        coming |= (held > _MIN_OVERLAP * area)[part]
    return coming


def _opened(surfaces: Bool[np.ndarray, "h w"], displaced_px: float) -> Bool[np.ndarray, "h w"]:
    """Remove what is no wider than edges are displaced from a mask of surfaces."""
    side = max(3, 1 + math.ceil(displaced_px)) | 1  # depth edges are ragged; an even side would shift the mask
    return cv2.morphologyEx(surfaces.view(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)).view(bool)


@compiled(when="warm-up")
def _compared(
    depth: Float[Array, "h w"],
    depths_then: Float[Array, "k h w"],
    masks_then: Bool[Array, "k h w"],
    T_then_now: Float[Array, "k 7"],
    intrinsics: Intrinsics,
) -> tuple[Bool[Array, "h w"], ...]:
    """Compute the masks of `BackgroundSurfaces` from the frame of the mask, the newer one, the older one and others."""
    change = jax.vmap(lambda then, pose: depth_change(depth, then, SE3(pose), intrinsics))(depths_then, T_then_now)
    masked = jax.vmap(lambda mask, then: mask.reshape(-1)[then])(masks_then, change.then)
    outside = change.same & ~masked
    return outside[0], change.same[2], outside[1], change.new[1], change.new[2:].any(axis=0)
