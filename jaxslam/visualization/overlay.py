"""Draw masks over images, in colors that color-blind people can distinguish."""

from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

Rgb: TypeAlias = tuple[int, int, int]

# Wong, "Points of view: Color blindness", Nature Methods 8 (2011)
ORANGE, SKY_BLUE, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILION, PURPLE = (0, 114, 178), (213, 94, 0), (204, 121, 167)
_OPACITY = 0.5


def tint(picture: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], color: Rgb) -> None:
    """Mix a color into the pixels of a mask, in place, and draw its outlines."""
    picture[mask] = np.round((1 - _OPACITY) * picture[mask] + _OPACITY * np.array(color)).astype(np.uint8)
    outlines, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, color, 1)
