"""The mask of an object from its box: what lies about as far away as most of the box, in one piece.

Source: NGD-SLAM (Zhang, Bujanca and Luján 2025), section III-B.2: depth inside the box, connected components, dilation.
The object must fill most of the box.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jaxslam.semantics import Detections
from jaxslam.sensors.downscale import Downscaler

_MIN_SIDE_PX = 4
_MIN_KNOWN = 0.1
"""Least share of the middle of a box that must have depth."""
_MIDDLE = 0.5
"""Share of a box's width and height around its center where the object's own depth is sought."""
_BINS, _NEAREST_M, _FARTHEST_M = 60, 0.3, 8.0
_REACH, _REACH_M = 0.1, 0.25
"""Half the range of depth that an object may take up, as a share of its distance and besides. Against DeepLab's mask of
people in Bonn `crowd`, median IoU 0.80, recall 0.90; with 0.4 m 0.79, 0.91, with half the range 0.80, 0.89."""
_MIN_PART = 0.2
"""Pieces of at least this share of the largest one belong to the object: an arm behind a bag."""


def mask_of_detections(
    detections: Detections, depth: Float[np.ndarray, "h w"], *, dilate_px: int = 2
) -> Bool[np.ndarray, "h w"]:
    """Where detected objects are: the network's own masks where it gives them, else from boxes and depth.

    A box whose mask is empty is one for which the network gave none that it believes in.

    Args:
        detections: Of the image.
        depth: Meters, 0 where missing.
        dilate_px: How far the mask reaches beyond what was found.
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
        add_box(mask, depth, box)
    return dilated(mask, dilate_px)


def reduced_detections(detections: Detections, reduced: Downscaler) -> Detections:
    """What was found, in the pixels of a smaller image."""
    masks, class_mask = (
        None if each is None else reduced.every(each) for each in (detections.masks, detections.class_mask)
    )
    return detections._replace(boxes=detections.boxes / reduced.step, masks=masks, class_mask=class_mask)


def add_box(mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], box: Iterable[float]) -> None:
    """Add the object in a box to a mask, in place; nothing if the box holds too little depth to tell.

    Args:
        mask: To add to.
        depth: Meters, 0 where missing.
        box: Left, top, right and bottom in pixels; it may reach past the image.
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
    distance = object_depth(inside)
    if distance is None:
        return
    near = np.abs(inside - distance) < _REACH_M + _REACH * distance
    mask[rows, columns] |= largest_parts(near)


def object_depth(inside: Float[np.ndarray, "h w"]) -> float | None:
    """The depth that most of the middle of a box has, on a scale of ratios; `None` if little of it is known."""
    rows, columns = (
        slice(int(side * (1 - _MIDDLE) / 2), side - int(side * (1 - _MIDDLE) / 2)) for side in inside.shape
    )
    middle = inside[rows, columns]
    known = middle[np.isfinite(middle) & (middle > 0)]
    if len(known) < _MIN_KNOWN * middle.size:
        return None
    counts, edges = np.histogram(np.log(known), _BINS, (np.log(_NEAREST_M), np.log(_FARTHEST_M)))
    if not counts.any():
        return None
    best = int(np.argmax(np.convolve(counts, [1, 2, 3, 2, 1], "same")))
    return float(np.exp(0.5 * (edges[best] + edges[best + 1])))


def largest_parts(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The largest connected piece of a mask, and those not much smaller."""
    num, piece, measures, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if num < 2:
        return mask
    area = measures[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0  # the background
    return (area >= _MIN_PART * area.max())[piece]


def dilated(mask: Bool[np.ndarray, "h w"], radius_px: int) -> Bool[np.ndarray, "h w"]:
    """A mask that reaches so many pixels further."""
    if radius_px <= 0 or not mask.any():
        return mask
    side = 2 * radius_px + 1
    return cv2.dilate(mask.view(np.uint8), np.ones((side, side), np.uint8)).view(bool)
