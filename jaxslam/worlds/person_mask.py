"""Masks of people with sharp borders: what a network says, decided at its borders by depth and color.

A network's mask is good to about eight pixels. Depth tells what lies behind a person, but is missing in a seam around
people, is out of place by a few pixels where they move fast, and does not tell feet from the floor. So each pixel near
the border has three votes: the network's, that of depth, and that of color against the people and background around.
Lengths in pixels are for images of about 640 x 480.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

_BORDER_PX = 8
"""Distance from the border of the network's mask within which depth and color decide."""
_MIN_PX, _MIN_SHARE = 1000, 0.05
"""Area of the smallest part of a person, and as a share of the largest part."""
_HOLE_PX = 200
"""Area up to which a hole in a person is filled."""
_RIM_PX = 2
"""Width of the rim of people that has the color of what was behind, too."""
_CORE_PX = 1500
"""Smallest area of depth well inside the network's mask that is a person's, and not that of a gap between legs."""
_STRAY_PX = 7
"""Radius up to which pixels of people that seem to be farther than those around are errors of the sensor."""
_STEP, _STEP_M = 0.04, 0.06
"""Difference of depth to the people around that is more than noise: a share of the depth, plus meters."""
_NEAR_PX = 25
"""Width of the window in which colors of people and background are averaged."""
_CLEAR_COLOR = 40.0
"""Difference of RGB distances, 0 to 255, at which color is sure."""
_NETWORK, _COLOR, _DEPTH_OUTSIDE = 0.8, 1.2, 0.6
"""Weights of the votes; that of depth is 1, and less outside the network's mask, where the floor is beside the feet."""
_NO_DEPTH = 0.5
"""Vote of missing depth against people: most of it is background in the shadow of the sensor's light."""
_SMOOTH_PX = 1.2
"""Standard deviation of the blur of the votes."""
_SURE_PX = 12
"""Distance from the border of the network's mask beyond which color has no vote: there are patterns in clothes."""

Mask = Bool[np.ndarray, "h w"]
Plane = Float32[np.ndarray, "h w"]


def refined_mask(mask: Mask, depth_m: Plane, image: UInt8[np.ndarray, "h w 3"]) -> Mask:
    """Return a network's mask of people with sharp borders, without specks.

    The rim of people is left out: it has the color of what was behind, too.

    Args:
        mask: `(h, w)` mask of people.
        depth_m: `(h, w)` depth in meters; 0 where missing.
        image: `(h, w, 3)` RGB.
    """
    mask = _people_only(mask)
    inner, outer = _eroded(mask, _BORDER_PX), _dilated(mask, _BORDER_PX)
    as_people, behind = _compare_depth(inner, depth_m)
    people, background = inner & ~behind, _eroded(~outer | behind, 2)
    distance_px = _inside_px(mask) - _inside_px(~mask)
    votes = (
        np.where(as_people, np.where(mask, 1.0, _DEPTH_OUTSIDE), 0.0)
        - behind
        - np.where(depth_m > 0, 0.0, _NO_DEPTH)
        + _COLOR * _color_vote(image, people, background)
        + _NETWORK * np.clip(distance_px / _BORDER_PX, -1.0, 1.0)
    )
    chosen = cv2.GaussianBlur(votes.astype(np.float32), (0, 0), _SMOOTH_PX) > 0
    chosen |= people & (distance_px > _SURE_PX)
    return _eroded(_people_only(_smoothed(chosen & outer & ~behind)), _RIM_PX)


def filled_depth(mask: Mask, depth_m: Plane) -> Plane:
    """Return the depth of people with that of the nearest pixel where it is missing; 0 outside of the mask.

    Pixels that are farther than those around are corrected: depth is out of place there. A person without any depth
    is too near for the sensor: nearer than everything, and has depth 0.

    Args:
        mask: `(h, w)` mask of people.
        depth_m: `(h, w)` depth in meters; 0 where missing.
    """
    known = mask & (depth_m > 0)
    if not known.any():
        return np.zeros_like(depth_m)
    _, labels = cv2.distanceTransformWithLabels(_bytes(~known), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.asarray(labels, np.int32)
    depths_m = np.zeros(int(nearest.max()) + 1, np.float32)
    depths_m[nearest[known]] = depth_m[known]
    part, areas_px = _parts(mask)
    has_depth = np.bincount(part[known], minlength=len(areas_px)) > 0
    filled_m = np.where(has_depth[part], depths_m[nearest], np.float32(0))
    opened_m = cv2.morphologyEx(np.where(mask, filled_m, np.float32(np.inf)), cv2.MORPH_OPEN, _disk(_STRAY_PX))
    return np.where(mask, opened_m, np.float32(0))


def _compare_depth(inner: Mask, depth_m: Plane) -> tuple[Mask, Mask]:
    """Tell which pixels have a depth as the people around, and which have another."""
    core = _without_specks(inner & (depth_m > 0) & ~_at_step(depth_m), _CORE_PX)
    window = np.ones((2 * _BORDER_PX + 9,) * 2, np.uint8)
    nearest_m = cv2.erode(np.where(core, depth_m, np.float32(np.inf)), window)
    farthest_m = cv2.dilate(np.where(core, depth_m, np.float32(0)), window)
    apart_m = _STEP_M + _STEP * depth_m
    comparable = (depth_m > 0) & (farthest_m > 0)
    fits = (depth_m > nearest_m - apart_m) & (depth_m < farthest_m + apart_m)
    return comparable & fits, comparable & ~fits


def _color_vote(image: np.ndarray, people: Mask, background: Mask) -> Plane:
    """Compare each pixel's color with those of sure people and background around: 1 for people, -1 for background."""
    colors = image.astype(np.float32)
    (own, has_own), (other, has_other) = (_color_around(colors, where) for where in (people, background))
    difference = np.linalg.norm(colors - other, axis=2) - np.linalg.norm(colors - own, axis=2)
    return np.where(has_own & has_other, np.clip(difference / _CLEAR_COLOR, -1.0, 1.0), np.float32(0))


def _color_around(colors: np.ndarray, where: Mask) -> tuple[np.ndarray, Mask]:
    """Average the color of chosen pixels in a window, and tell where there are some."""
    window, chosen = (_NEAR_PX, _NEAR_PX), where.astype(np.float32)
    share, total = cv2.blur(chosen, window), cv2.blur(colors * chosen[..., None], window)
    return total / np.maximum(share, 1e-6)[..., None], share > 1e-4


def _at_step(depth_m: Plane) -> Mask:
    """Tell which pixels have a right or lower neighbor across a step of depth."""
    steps = np.zeros(depth_m.shape, bool)
    apart = 0.5 * _STEP_M + _STEP * depth_m
    steps[:-1] |= np.abs(np.diff(depth_m, axis=0)) > apart[:-1]
    steps[:, :-1] |= np.abs(np.diff(depth_m, axis=1)) > apart[:, :-1]
    return steps


def _inside_px(mask: Mask) -> Plane:
    return np.asarray(cv2.distanceTransform(_bytes(mask), cv2.DIST_L2, 5), np.float32)


def _without_specks(mask: Mask, at_least_px: float) -> Mask:
    """Keep the connected parts of a mask that have an area."""
    part, areas_px = _parts(mask)
    large = areas_px >= at_least_px
    large[0] = False  # what is not in the mask
    return large[part]


def _parts(mask: Mask) -> tuple[np.ndarray, np.ndarray]:
    """Number the connected parts of a mask from 1, and return their areas; number 0 is the rest."""
    _, part, measures, _ = cv2.connectedComponentsWithStats(_bytes(mask), connectivity=4)
    return np.asarray(part, np.int32), measures[:, cv2.CC_STAT_AREA]


def _people_only(mask: Mask) -> Mask:
    """Take away parts that are too small for people, and fill small holes."""
    largest_px = _parts(mask)[1][1:].max(initial=0)
    kept = _without_specks(mask, max(_MIN_PX, _MIN_SHARE * largest_px))
    return ~_without_specks(~kept, _HOLE_PX)


def _smoothed(mask: Mask) -> Mask:
    """Close cracks, and take away what is thinner than fingers."""
    closed = cv2.morphologyEx(_bytes(mask), cv2.MORPH_CLOSE, _disk(2))
    return cv2.morphologyEx(closed, cv2.MORPH_OPEN, _disk(3)).view(bool)


def _eroded(mask: Mask, radius_px: int) -> Mask:
    return cv2.erode(_bytes(mask), _disk(radius_px)).view(bool)


def _dilated(mask: Mask, radius_px: int) -> Mask:
    return cv2.dilate(_bytes(mask), _disk(radius_px)).view(bool)


def _disk(radius_px: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2)


def _bytes(mask: Mask) -> np.ndarray:
    return np.ascontiguousarray(mask).view(np.uint8)
