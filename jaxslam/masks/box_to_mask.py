"""Segment the object in a bounding box by depth: the largest connected component at the depth of most of the box.

Source: NGD-SLAM (Zhang, Bujanca and Luján 2025), section III-C.2: depth inside the box, connected components, dilation.
The object must fill most of the box.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxslam.dynamics.object_motion import INERT
from jaxslam.semantics import Detections
from jaxslam.semantics.class_names import moves_by_itself
from jaxslam.sensors.downscale import Downscaler

_MIN_SIDE_PX = 4
_MIN_KNOWN = 0.1
"""Smallest share of the middle of a box with depth."""
_MIDDLE = 0.5
"""Share of a box's width and height, around its center, from which the object's depth is taken."""
_BIN = 0.0547236
"""Width of a bin of log depth: 5.6 % of the depth, whether that of a hand before the lens or of a car down the road."""
_REACH, _REACH_PER_WIDTH = 0.1, 0.5
"""Half the depth range of an object: a share of its distance, plus a share of the width of its box.

Against DeepLab's masks of people in Bonn `crowd`, mean IoU 0.767, recall 0.91; with 0.3 of the width 0.766, 0.88;
with 0.2 of the distance alone 0.760, 0.88; with 0.1 of the distance and 0.25 m for every object 0.769, 0.90."""
_MIN_PART = 0.2
"""Smallest size of a component of the object, as a share of the largest one: an arm behind a bag is separate."""


def mask_of_detections(
    detections: Detections, depth: Float[np.ndarray, "h w"], focal_px: float, *, dilate_px: int = 2
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of all detected objects: the detector's own masks or, for a box without one, from depth.

    A box whose mask is empty counts as a box without a mask.

    Args:
        detections: Detections in the image.
        depth: `(h, w)` depth image, meters; 0 where depth is missing.
        focal_px: Horizontal focal length of the depth image, pixels.
        dilate_px: Radius of the dilation, pixels.
    """
    mask = np.zeros(depth.shape, bool)
    if detections.class_mask is not None:
        mask |= detections.class_mask
    if detections.masks is None:
        boxes = detections.boxes
    else:
        mask |= detections.masks.any(axis=0)
        boxes = detections.boxes[~detections.masks.any(axis=(1, 2))]
    for box in boxes:
        add_box(mask, depth, box, focal_px)
    return dilated(mask, dilate_px)


def instance_labels(
    detections: Detections, depth: Float[np.ndarray, "h w"], focal_px: float
) -> UInt8[np.ndarray, "h w"]:
    """Return the number of the detected object at each pixel, from 1; 0 where there is none.

    Where objects overlap, the one with the higher score is numbered. `INERT` is added to the number of an object that
    does not move by itself. Pixels of a class map have no number, because it does not tell objects.

    Args:
        detections: Detections in the image; only the first 126 are numbered.
        depth: `(h, w)` depth image, meters; 0 where depth is missing.
        focal_px: Horizontal focal length of the depth image, pixels.
    """
    labels = np.zeros(depth.shape, np.uint8)
    for row in reversed(range(min(len(detections.labels), INERT - 2))):
        one = slice(row, row + 1)
        mask = None if detections.masks is None else detections.masks[one]
        alone = detections._replace(boxes=detections.boxes[one], masks=mask, class_mask=None)
        flag = 0 if moves_by_itself(detections.labels[row]) else INERT
        labels[mask_of_detections(alone, depth, focal_px, dilate_px=0)] = row + 1 + flag
    return labels


def reduced_detections(detections: Detections, reduced: Downscaler) -> Detections:
    """Convert detections to the pixels of a reduced image."""
    masks, class_mask = (
        None if each is None else reduced.every(each) for each in (detections.masks, detections.class_mask)
    )
    return detections._replace(boxes=detections.boxes / reduced.step, masks=masks, class_mask=class_mask)


def add_box(
    mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], box: Iterable[float], focal_px: float
) -> None:
    """Add the object in a box to a mask, in place; add nothing if too little of the box has depth.

    Args:
        mask: `(h, w)` mask to add to.
        depth: `(h, w)` depth image, meters; 0 where depth is missing. Where it is missing everywhere, the whole box is
            added.
        box: Left, top, right and bottom of the box, pixels; it may extend beyond the image.
        focal_px: Horizontal focal length of the depth image, pixels.
    """
    height, width = depth.shape
    left, top, right, bottom = (float(side) for side in box)
    if not np.isfinite([left, top, right, bottom]).all():
        return
    columns = slice(max(int(left), 0), int(np.clip(np.ceil(right), 0, width)))
    rows = slice(max(int(top), 0), int(np.clip(np.ceil(bottom), 0, height)))
    inside = depth[rows, columns]
    if min(inside.shape) < _MIN_SIDE_PX:
        return
    if not (depth > 0).any():
        mask[rows, columns] = True
        return
    distance = object_depth(inside)
    if distance is None:
        return
    reach = _REACH + _REACH_PER_WIDTH * inside.shape[1] / focal_px
    near = np.abs(inside - distance) < reach * distance
    mask[rows, columns] |= largest_parts(near)


def object_depth(inside: Float[np.ndarray, "h w"]) -> float | None:
    """Return the mode of log depth in the middle of a box, as a depth in meters; `None` with too little depth."""
    rows, columns = (
        slice(int(side * (1 - _MIDDLE) / 2), side - int(side * (1 - _MIDDLE) / 2)) for side in inside.shape
    )
    middle = inside[rows, columns]
    known = middle[np.isfinite(middle) & (middle > 0)]
    if len(known) < _MIN_KNOWN * middle.size:
        return None
    bins = np.floor(np.log(known) / _BIN).astype(np.int64)
    first = int(bins.min())
    smooth = np.convolve(np.pad(np.bincount(bins - first), 2), [1, 2, 3, 2, 1], "valid")
    return float(np.exp(_BIN * (first + int(np.argmax(smooth)) + 0.5)))


def largest_parts(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Keep the largest connected component of a mask and those not much smaller."""
    num, piece, measures, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if num < 2:
        return mask
    area = measures[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0  # the background
    return (area >= _MIN_PART * area.max())[piece]


def dilated(mask: Bool[np.ndarray, "h w"], radius_px: int) -> Bool[np.ndarray, "h w"]:
    """Dilate a mask by a radius in pixels."""
    if radius_px <= 0 or not mask.any():
        return mask
    side = 2 * radius_px + 1
    return cv2.dilate(mask.view(np.uint8), np.ones((side, side), np.uint8)).view(bool)
