"""Pictures of what a detector found: masks, boxes and labels, drawn with OpenCV."""

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np

from jaxslam.semantics import Detections

_Area: TypeAlias = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels, the last two exclusive."""

# Wong, "Points of view: Color blindness", Nature Methods 8 (2011): told apart by colour-blind eyes too
_COLORS_RGB = np.array(
    [(230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167)],
    np.uint8,
)
_CLASS_MAP_RGB = np.array((255, 0, 255), np.uint8)
_OPACITY = 0.45
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_detections(image: np.ndarray, detections: Detections) -> np.ndarray:
    """A copy of an image with what was found in it; the surest on top, each in a colour of its own.

    Args:
        image: `(h, w, 3)` uint8 RGB.
        detections: Boxes in its pixels, with labels and scores; masks are tinted, so is the class map.

    Returns:
        `(h, w, 3)` uint8 RGB.
    """
    picture = image.copy()
    if detections.class_mask is not None:
        _tint(picture, detections.class_mask, _CLASS_MAP_RGB)
    order = np.argsort(detections.scores, kind="stable").tolist()
    if detections.masks is not None:
        for k in order:
            _tint(picture, detections.masks[k], _COLORS_RGB[k % len(_COLORS_RGB)])
    colors = [tuple(_COLORS_RGB[k % len(_COLORS_RGB)].tolist()) for k in range(len(order))]
    boxes, line = _outermost_pixels(detections.boxes, picture), 1 + round(max(picture.shape) / 640)
    inset = line - 1  # OpenCV's line is 2 line - 1 wide; it shall end where its box does
    for k in order:
        cv2.rectangle(picture, (boxes[k, :2] + inset).tolist(), (boxes[k, 2:] - inset).tolist(), colors[k], line)
    taken: list[_Area] = []
    for k in reversed(order):
        text = f"{detections.labels[k]} {detections.scores[k]:.2f}"
        taken.append(_write(picture, text, boxes[k, :2].tolist(), colors[k], taken))
    return picture


def _tint(picture: np.ndarray, mask: np.ndarray, color: np.ndarray) -> None:
    """Mix a colour into the pixels of a mask, in place, and draw its outline."""
    picture[mask] = np.round((1 - _OPACITY) * picture[mask] + _OPACITY * color).astype(np.uint8)
    outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(picture, outline, -1, color.tolist(), 1)


def _outermost_pixels(boxes: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """`(k, 4)` left, top, right, bottom pixels of what boxes cover, cut off at the border of the picture."""
    height, width = picture.shape[:2]
    return np.clip(np.round(boxes) - (0, 0, 1, 1), 0, (width - 1, height - 1) * 2).astype(int)


def _write(
    picture: np.ndarray, text: str, corner: tuple[int, int], color: tuple[int, ...], taken: Sequence[_Area]
) -> _Area:
    """Write on a ground of a colour at a corner, wholly inside the picture, and below what is taken if there is room.

    Returns:
        The area it takes.
    """
    height, width = picture.shape[:2]
    size = max(0.4, max(height, width) / 1800)
    stroke = max(1, round(1.5 * size))
    (text_width, text_height), below = cv2.getTextSize(text, _FONT, size, stroke)
    high = text_height + below + 2
    left, top = max(0, min(corner[0], width - text_width)), max(0, corner[1] - high)
    while any(left < r and x < left + text_width and top < b and y < top + high for x, y, r, b in taken):
        top += high
    top = max(0, min(top, height - high))
    cv2.rectangle(picture, (left, top), (left + text_width - 1, top + high - 1), color, cv2.FILLED)
    baseline = (left, top + text_height + 1)
    cv2.putText(picture, text, baseline, _FONT, size, (0, 0, 0), stroke, cv2.LINE_AA)
    return left, top, left + text_width, top + high
