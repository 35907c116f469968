"""ORB features of an image, which can be recognized later and from other places."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxslam_kernels.camera import to_pixels
from jaxslam_kernels.image.pyramid import build_pyramid
from jaxslam_kernels.types import Pixels, Weights
from jaxtyping import Array, Bool, Float, Float32, Int64, Integer, UInt8

from jaxslam.config.schema import MappingConfig
from jaxslam.features.sorting import sorted_together
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.padding import padded
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import RIGHT_LEVELS, PreparedFrame, believed_depth, match_depth, pixel_rays
from jaxslam.sensors.sensor_model import SensorModel

DESCRIPTOR_BYTES = 32
_PATCH_PX = 31
_BORDER_PX = 19
"""Margin that a rotated patch and its blur need, in pixels of its level (`EDGE_THRESHOLD` of ORB-SLAM)."""
_CLEARANCE_PX = 8
"""Minimum distance of a patch center from ignored pixels, in pixels of its level: most comparisons of a descriptor lie
within it."""
_MAX_CANDIDATES = 12
"""Corners considered per level for every feature wanted; it bounds the time spent on noise and gravel."""


class Features(NamedTuple):
    """ORB features of one image, `n` of them.

    Attributes:
        uv_raw: Positions in the distorted image, in pixels.
        uv: Positions as an ideal pinhole camera without distortion and rolling shutter would see them, in pixels.
        depth: Depths in meters; 0 where no valid depth was measured.
        octave: Level of the scale pyramid; 0 is the finest.
        angle: Direction of the patch in radians, from u towards v.
        descriptor: Descriptors of 256 bits each.
    """

    uv_raw: Float32[np.ndarray, "2 n"]
    uv: Float32[np.ndarray, "2 n"]
    depth: Float32[np.ndarray, " n"]
    octave: UInt8[np.ndarray, " n"]
    angle: Float32[np.ndarray, " n"]
    descriptor: UInt8[np.ndarray, "n 32"]


_SETTINGS = MappingConfig()  # the only place of defaults


class FeaturePlan(NamedTuple):
    """Settings of feature extraction.

    Attributes:
        num_features: Maximum number of features.
        num_levels: Number of levels of the scale pyramid.
        scale_factor: Scale from one level to the next.
        fast_threshold: Minimum contrast of a corner, in gray values.
        min_fast_threshold: Minimum contrast in cells without a corner at `fast_threshold`, in gray values.
    """

    num_features: int = _SETTINGS.num_features
    num_levels: int = _SETTINGS.num_levels
    scale_factor: float = _SETTINGS.scale_factor
    fast_threshold: int = _SETTINGS.fast_threshold
    min_fast_threshold: int = _SETTINGS.min_fast_threshold

    def quotas(self) -> Int64[np.ndarray, " num_levels"]:
        """Return `(num_levels,)` features per level, in proportion to its scale (Mur-Artal et al. 2015)."""
        shares = self.scale_factor ** -np.arange(self.num_levels, dtype=np.float64)
        ends = np.round(np.cumsum(shares) / shares.sum() * self.num_features).astype(np.int64)
        return np.diff(ends, prepend=0)

    def scale(self, octave: Integer[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
        """Return the size of features of these octaves in the image, relative to octave 0."""
        return np.float32(self.scale_factor) ** octave.astype(np.float32)


class Patches(NamedTuple):
    """Features as detected in the image, without geometry; fields as in `Features`."""

    uv_raw: Float32[np.ndarray, "2 n"]
    octave: UInt8[np.ndarray, " n"]
    angle: Float32[np.ndarray, " n"]
    descriptor: UInt8[np.ndarray, "n 32"]

    def without(self, ignore: Bool[np.ndarray, "h w"]) -> "Patches":
        """Return the features that do not lie at ignored pixels of their image `(h, w)`."""
        column, row = np.rint(self.uv_raw).astype(np.int32)
        kept = ~ignore[row, column]
        return Patches(self.uv_raw[:, kept], self.octave[kept], self.angle[kept], self.descriptor[kept])


DEFAULT_PLAN = FeaturePlan()


def features_of(
    frame: FrameArrays,
    twist: Float[np.ndarray, "6"],
    sensor: SensorModel,
    plan: FeaturePlan = DEFAULT_PLAN,
    patches: Patches | None = None,
) -> Features:
    """Extract the features of a frame, remove distortion and rolling shutter, and read their depth.

    Args:
        frame: Frame with a uint8 image; no feature is taken where it says `ignore`.
        twist: `(6,)` velocity of the camera in its own axes, in meters per second, then radians per second.
        sensor: Camera, readout time, and the range of valid depths.
        plan: Settings of feature extraction.
        patches: Result of `patches_of` for the frame, if it is known already.
    """
    patches = patches_of(frame, plan) if patches is None else patches
    num = len(patches.octave)
    fixed_size = padded(patches.uv_raw, plan.num_features, axis=1)  # so that it is compiled once
    uv, depth = jax.device_get(_ideal(fixed_size, twist.astype(np.float32), frame, sensor))
    return Features(patches.uv_raw, uv[:, :num], depth[:num], *patches[1:])


def patches_of(frame: FrameArrays, plan: FeaturePlan = DEFAULT_PLAN) -> Patches:
    """Extract the features of a frame without geometry, which is most of the time of `features_of`."""
    return extract(np.asarray(frame.image), np.asarray(frame.ignore), plan)


def extract(
    gray: UInt8[np.ndarray, "h w"], ignore: Bool[np.ndarray, "h w"] | None = None, plan: FeaturePlan = DEFAULT_PLAN
) -> Patches:
    """Extract ORB features that are well spread over the image.

    Every level of the pyramid has its quota and a grid of as many cells. The best corner of every cell comes first,
    then the second best, and so on until the quota is filled, so that the available texture fills it.

    Source: Rublee et al., ORB: an efficient alternative to SIFT or SURF, 2011; the two thresholds and the quotas are
    ORB-SLAM's (Mur-Artal et al. 2015).

    Args:
        gray: `(h, w)` uint8 image.
        ignore: `(h, w)` bool, true where no feature may be taken.
        plan: Settings of feature extraction.
    """
    clearance = None if ignore is None or not ignore.any() else _distance_to(ignore)
    levels = zip(_pyramid(gray, plan), plan.quotas(), strict=True)
    found = [_extract_level(gray, picture, clearance, int(quota), plan) for picture, quota in levels]
    found = [patches._replace(octave=patches.octave + np.uint8(level)) for level, patches in enumerate(found)]
    uv_raw, octave, angle, descriptor = zip(*found, strict=True)
    return Patches(
        np.concatenate(uv_raw, axis=1), np.concatenate(octave), np.concatenate(angle), np.concatenate(descriptor)
    )


def _distance_to(ignore: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Compute the distance of every pixel from the nearest ignored one."""
    return cv2.distanceTransform((~ignore).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)


def _extract_level(
    gray: UInt8[np.ndarray, "h w"],
    picture: UInt8[np.ndarray, "_h _w"],
    clearance: Float32[np.ndarray, "h w"] | None,
    quota: int,
    plan: FeaturePlan,
) -> Patches:
    """Extract the features of one pyramid level; their octave is 0."""
    if min(picture.shape) <= 2 * _BORDER_PX or quota == 0:
        return _no_patches()
    orb = cv2.ORB.create(
        nfeatures=_MAX_CANDIDATES * quota,
        nlevels=1,
        edgeThreshold=_BORDER_PX,
        scoreType=cv2.ORB_FAST_SCORE,
        patchSize=_PATCH_PX,
        fastThreshold=plan.min_fast_threshold,
    )
    corners = orb.detect(picture, None)
    uv = _positions(corners)
    response = np.array([corner.response for corner in corners], np.float32)
    clear = np.arange(len(corners))
    if clearance is not None:
        column, row = np.round(_in_image(uv, picture, gray)).astype(np.int64)
        clear = np.flatnonzero(clearance[row, column] > _CLEARANCE_PX * gray.shape[0] / picture.shape[0])
    chosen = clear[_spread(uv[:, clear], response[clear], picture.shape, quota, plan.fast_threshold)]
    if not len(chosen):
        return _no_patches()
    kept, descriptor = orb.compute(picture, [corners[index] for index in chosen])
    angle = np.radians(np.array([corner.angle for corner in kept], np.float32))
    uv_raw = _in_image(_positions(kept), picture, gray)
    return Patches(uv_raw, np.zeros(len(kept), np.uint8), angle, descriptor)


def _pyramid(gray: UInt8[np.ndarray, "h w"], plan: FeaturePlan) -> list[UInt8[np.ndarray, "_h _w"]]:
    """Build the scale pyramid, each level from the previous one, so that fine texture is smoothed and not aliased."""
    pictures = [np.ascontiguousarray(gray)]
    for scale in plan.scale(np.arange(1, plan.num_levels)):
        height, width = (max(round(side / float(scale)), 1) for side in gray.shape)
        pictures.append(cv2.resize(pictures[-1], (width, height)))
    return pictures


def _positions(corners: Sequence[cv2.KeyPoint]) -> Float32[np.ndarray, "2 n"]:
    return np.asarray(cv2.KeyPoint.convert(corners), np.float32).reshape(-1, 2).T


def _in_image(
    uv: Float32[np.ndarray, "2 n"], picture: UInt8[np.ndarray, "_h _w"], gray: UInt8[np.ndarray, "h w"]
) -> Float32[np.ndarray, "2 n"]:
    """Map pixels of a pyramid level to the image: the outer edges of both coincide, not their first pixels."""
    ratio = np.array([[gray.shape[1] / picture.shape[1]], [gray.shape[0] / picture.shape[0]]], np.float32)
    return (uv + np.float32(0.5)) * ratio - np.float32(0.5)


def _spread(
    uv: Float32[np.ndarray, "2 n"],
    response: Float32[np.ndarray, " n"],
    shape: tuple[int, ...],
    quota: int,
    fast_threshold: int,
) -> Int64[np.ndarray, " k"]:
    """Return the indices of at most `quota` corners: in each round, the best remaining one of every cell.

    The response of a corner is the highest threshold at which it is detected. A cell with a corner at `fast_threshold`
    contributes no weaker ones.
    """
    side = np.sqrt(shape[0] * shape[1] / quota)
    column, row = (uv / side).astype(np.int64)
    cell = row * (int(shape[1] / side) + 1) + column
    weakness = 255 - response.astype(np.int64)
    cell, weakness, order = sorted_together(cell, weakness, np.arange(len(cell)))
    first = np.flatnonzero(np.diff(cell, prepend=-1))
    size = np.diff(first, append=len(order))
    rank = np.arange(len(order)) - np.repeat(first, size)
    strongest = np.repeat(weakness[first], size)
    least = 255 - fast_threshold
    allowed = np.flatnonzero((weakness <= least) | (strongest > least))
    return order[allowed[sorted_together(rank[allowed], weakness[allowed], np.arange(len(allowed)))[2][:quota]]]


def no_features() -> Features:
    """Return an empty set of features."""
    uv_raw, *rest = _no_patches()
    return Features(uv_raw, uv_raw, np.zeros(0, np.float32), *rest)


def _no_patches() -> Patches:
    return Patches(
        np.zeros((2, 0), np.float32),
        np.zeros(0, np.uint8),
        np.zeros(0, np.float32),
        np.zeros((0, DESCRIPTOR_BYTES), np.uint8),
    )


@compiled(when="warm-up")
def _ideal(uv_raw: Pixels, twist: Float[Array, "6"], frame: FrameArrays, sensor: SensorModel) -> tuple[Pixels, Weights]:
    """Convert pixels to those of the ideal camera and read depth; of a stereo pair by matching."""
    sensor = sensor.for_readout(frame.readout_sign)
    rough, matched = believed_depth(frame.depth, uv_raw, sensor), None
    if frame.right is not None:
        pyramid = build_pyramid(frame.image, num_levels=RIGHT_LEVELS, dtype=uv_raw.dtype)
        view = PreparedFrame(frame, pyramid, frame.dt_s).with_right()
        matched = match_depth(view, uv_raw, rough, rough > 0, sensor, known_point=False)
    seen = pixel_rays(uv_raw, sensor, matched).measured(rough, twist, frame.depth, frame.depth_delay_s, sensor)
    return to_pixels(sensor.intrinsics, seen.xy), seen.depth
