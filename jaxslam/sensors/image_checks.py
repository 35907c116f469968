"""Checks of gray images: too dark, too bright, blurred, or scaled to another range."""

import cv2
import numpy as np
from jaxtyping import UInt8

_MIN_ONES = 0.02
_MIN_AGREEMENT = 0.5


def image_fault(gray: UInt8[np.ndarray, "h w"]) -> str | None:
    """Describe why the tracker would find few points or none; `None` if the image is sharp and well lit."""
    if scaled_to_one(gray):
        return "with values of 0 and 1 only (an image scaled to 0 to 1?)"
    if gray.mean() < 25:
        return "dark"
    if gray.mean() > 230:
        return "overexposed"
    return "blurred or blank" if cv2.Laplacian(gray, cv2.CV_32F).var() < 25 else None


def scaled_to_one(gray: UInt8[np.ndarray, "h w"]) -> bool:
    """Whether an image was scaled to 0 to 1 before it became uint8.

    The noise of a covered lens may have values of 0 and 1 too, but there one pixel says nothing about the next; in an
    image of a scene, neighboring pixels agree.
    """
    if gray.max() != 1:
        return False
    ones = float(gray.mean())
    by_chance = ones**2 + (1 - ones) ** 2
    agree = float(np.mean(gray[:, 1:] == gray[:, :-1]))
    return ones > _MIN_ONES and agree - by_chance > _MIN_AGREEMENT * (1 - by_chance)
