"""Measured depth around tracked points, kept so that it can be looked up where a better camera says that they are.

Around a pixel the depth is taken as that of a plane, whose inverse depth is linear in the pixel. Value and slope of a
plane are fitted to a window centered on where the point is expected. It must be: the slope is noisy, and a value that
is extrapolated by it would draw the estimated delay of depth towards the center of the window.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from jaxslam.sensors.sensor_model import DepthNoise

_REACH, _WINDOW = 8, 4
"""Samples of depth to each side of a point that are kept, and of which a plane is fitted to."""
_SAMPLED_WIDTH = 320
"""Width of an image of which each pixel is a sample; of twice the width, each second pixel of each second row."""
_MIN_SHARE = 0.7
"""Share of the window that must be measured."""
_FLAT = 1.0
"""Largest deviation from the plane, root mean square, in standard deviations of depth: at an edge it is more."""
_BENT, _LEAST_BENT = 3.0, 0.1
"""Second difference of the inverse depth from which on a patch lies at an edge: in those of the median patch, and at
least in standard deviations of the inverse depth."""
_BENT_PERCENTILE, _HALF = 90, 4
"""Percentile of the second differences of a patch, over that many samples to each side."""
_MOST_MISSING = 0.15
"""Share of the samples of a patch that may be missing: depth ends at edges."""
_COUNTS = 65535
_OFFSETS = np.stack(np.meshgrid(*2 * [np.arange(-_REACH, _REACH + 1)])).reshape(2, -1)


class DepthSettings(NamedTuple):
    """Noise and range of a depth sensor.

    Attributes:
        noise: Standard deviation of its depth.
        min_m: Smallest valid depth, meters.
        max_m: Largest valid depth, meters.
        stride: Pixels from one sample to the next.
    """

    noise: DepthNoise
    min_m: float
    max_m: float
    stride: int

    @classmethod
    def of(cls, noise: DepthNoise, limits_m: tuple[float, float], width: int) -> "DepthSettings":
        """Return the settings for images of a width."""
        return cls(noise, *limits_m, max(1, round(width / _SAMPLED_WIDTH)))


class DepthPatches(NamedTuple):
    """Depth around `n` points, any leading axes.

    Attributes:
        counts: `(... n s)` depth in shares of the largest valid one, 0 where there is none.
        origin: `(... 2 n)` pixel in the middle.
    """

    counts: UInt16[np.ndarray, "*batch n s"]
    origin: Int[np.ndarray, "*batch 2 n"]


class DepthPlanes(NamedTuple):
    """Planes of inverse depth around `n` pixels, any leading axes.

    Attributes:
        plane: `(... 3 n)` inverse depth at the pixel, 1/m, and its slope along u and v, 1/m per pixel.
        uv: `(... 2 n)` the pixels.
        sigma: `(... n)` standard deviation of the inverse depth, 1/m.
        measured: `(... n)` whether there is a plane.
    """

    plane: Float[np.ndarray, "*batch 3 n"]
    uv: Float[np.ndarray, "*batch 2 n"]
    sigma: Float[np.ndarray, "*batch n"]
    measured: Bool[np.ndarray, "*batch n"]


def cut_patches(
    depth_m: Float[np.ndarray, "h w"], uv: Float[np.ndarray, "2 n"], settings: DepthSettings
) -> DepthPatches:
    """Keep the depth around pixels.

    Args:
        depth_m: Depth image in meters; 0 or NaN where missing.
        uv: Pixels, in the image or not.
        settings: What is known of the sensor.
    """
    height, width = depth_m.shape
    origin = np.round(np.clip(np.nan_to_num(uv, nan=-1e6), -1e6, 1e6)).astype(np.int64)
    u, v = origin[:, :, None] + settings.stride * _OFFSETS[:, None]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = depth_m[np.where(inside, v, 0), np.where(inside, u, 0)]
    with np.errstate(invalid="ignore"):
        valid = inside & (depth >= settings.min_m) & (depth <= settings.max_m)
    counts = np.where(valid, np.round(_COUNTS / settings.max_m * np.where(valid, depth, 0.0)), 0)
    return DepthPatches(counts.astype(np.uint16), origin)


def planes_at(patches: DepthPatches, uv: Float[np.ndarray, "*batch 2 n"], settings: DepthSettings) -> DepthPlanes:
    """Fit planes to the depth around pixels near those of the patches; there is none where a patch does not reach.

    Args:
        patches: The patches.
        uv: `(... 2 n)` pixels.
        settings: What is known of the sensor.
    """
    near = np.nan_to_num(uv - patches.origin, nan=1e6) / settings.stride
    du, dv = (_OFFSETS[k] - near[..., k, :, None] for k in range(2))
    reached = np.asarray((np.abs(near) <= _REACH - _WINDOW).all(axis=-2))
    window = (np.abs(du) <= _WINDOW + 0.5) & (np.abs(dv) <= _WINDOW + 0.5) & reached[..., None]
    weights = (window & (patches.counts > 0)).astype(np.float64)
    inverse = _COUNTS / settings.max_m / np.maximum(patches.counts, 1)
    rows = np.stack([np.ones_like(du), du, dv], axis=-1)
    products = np.swapaxes(rows * weights[..., None], -1, -2) @ rows
    enough = weights.sum(axis=-1) >= _MIN_SHARE * (2 * _WINDOW + 1) ** 2
    products[~enough] = np.eye(3)
    sums = np.swapaxes(rows, -1, -2) @ (weights * inverse)[..., None]
    fitted = np.linalg.solve(products, sums)
    spread = np.sqrt((weights * (inverse - (rows @ fitted)[..., 0]) ** 2).sum(axis=-1) / np.maximum(weights.sum(-1), 1))
    plane = np.moveaxis(fitted[..., 0], -1, -2) / np.array([1, settings.stride, settings.stride])[:, None]
    least = 1 / settings.max_m
    sigma = settings.noise.sigma_m * np.maximum(plane[..., 0, :], least) ** 2 + settings.noise.sigma_per_m2
    measured = enough & (spread < _FLAT * sigma) & (plane[..., 0, :] > least)
    return DepthPlanes(plane, uv, sigma, measured)


def near_edges(
    patches: DepthPatches, settings: DepthSettings, used: Bool[np.ndarray, "*batch n"]
) -> Bool[np.ndarray, "*batch n"]:
    """Tell which patches hold an edge in depth, where optical flow is drawn aside by what moves differently behind it.

    On a plane second differences of the inverse depth are noise only. At an edge many are much larger, or depth is
    missing.

    Args:
        patches: The patches.
        settings: What is known of the sensor.
        used: Which patches count for the median, by which the noise is known.
    """
    side = 2 * _REACH + 1
    counts = patches.counts.reshape(*patches.counts.shape[:-1], side, side)
    inverse = np.where(counts > 0, _COUNTS / settings.max_m / np.maximum(counts, 1), np.nan)
    missing = np.isnan(inverse).mean(axis=(-2, -1))
    whole = used & (missing <= _MOST_MISSING)
    patch = inverse[whole]
    middle = slice(_HALF, -_HALF)
    along = patch[..., 2 * _HALF :] - 2 * patch[..., middle] + patch[..., : -2 * _HALF]
    down = patch[..., 2 * _HALF :, :] - 2 * patch[..., middle, :] + patch[..., : -2 * _HALF, :]
    edges = np.ones(used.shape, bool)
    if whole.any():
        flat = [np.abs(each).reshape(len(patch), -1) for each in (along, down)]
        bent = np.max([np.nanpercentile(each, _BENT_PERCENTILE, axis=-1) for each in flat], axis=0)
        edges[whole] = bent > max(_BENT * float(np.median(bent)), _LEAST_BENT * settings.noise.sigma_per_m2)
    return edges
