"""Draw the masks, boxes and labels of detections with OpenCV."""

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np

from jaxslam.semantics import Detections
from jaxslam.visualization.overlay import BLUE, GREEN, ORANGE, PURPLE, SKY_BLUE, VERMILION, YELLOW, Rgb, tint

_Area: TypeAlias = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels, the last two exclusive."""

_COLORS: tuple[Rgb, ...] = (ORANGE, SKY_BLUE, GREEN, YELLOW, BLUE, VERMILION, PURPLE)
_CLASS_MAP: Rgb = (255, 0, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_detections(image: np.ndarray, detections: Detections) -> np.ndarray:
    """Draw detections on a copy of an image, each in its own color, with the highest score on top.

    Args:
        image: `(h, w, 3)` uint8 RGB image.
        detections: Detections in the image. Masks and the class map tint the pixels.

    Returns:
        `(h, w, 3)` uint8 RGB.
    """
    picture = image.copy()
    colors = [_COLORS[k % len(_COLORS)] for k in range(len(detections.scores))]
    if detections.class_mask is not None:
        tint(picture, detections.class_mask, _CLASS_MAP)
    order = np.argsort(detections.scores, kind="stable").tolist()
    if detections.masks is not None:
        for k in order:
            tint(picture, detections.masks[k], colors[k])
    boxes, line = _outermost_pixels(detections.boxes, picture), 1 + round(max(picture.shape) / 640)
    inset = line - 1  # OpenCV's line is 2 line - 1 wide; it shall end where its box does
    for k in order:
        cv2.rectangle(picture, (boxes[k, :2] + inset).tolist(), (boxes[k, 2:] - inset).tolist(), colors[k], line)
    taken: list[_Area] = []
    for k in reversed(order):
        text = f"{detections.labels[k]} {detections.scores[k]:.2f}"
        taken.append(_write(picture, text, boxes[k, :2].tolist(), colors[k], taken))
    return picture


def _outermost_pixels(boxes: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """`(k, 4)` left, top, right, bottom pixels of what boxes cover, cut off at the border of the picture."""
    height, width = picture.shape[:2]
    return np.clip(np.round(boxes) - (0, 0, 1, 1), 0, (width - 1, height - 1) * 2).astype(int)


def _write(
    picture: np.ndarray, text: str, corner: tuple[int, int], color: tuple[int, ...], taken: Sequence[_Area]
) -> _Area:
    """Write on a ground of a color at a corner, wholly inside the picture, and below what is taken if there is room.

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
