"""Checks of grey images: too dark, too bright, blurred, or scaled to another range."""

import cv2
import numpy as np
from jaxtyping import UInt8

_LEAST_ONES = 0.02
_LEAST_AGREEMENT = 0.5


def image_fault(grey: UInt8[np.ndarray, "h w"]) -> str | None:
    """What gives the tracker few points or none, in words; `None` if the image is sharp and well lit."""
    if scaled_to_one(grey):
        return "with values of 0 and 1 only (an image scaled to 0 to 1?)"
    if grey.mean() < 25:
        return "dark"
    if grey.mean() > 230:
        return "overexposed"
    return "blurred or blank" if cv2.Laplacian(grey, cv2.CV_32F).var() < 25 else None


def scaled_to_one(grey: UInt8[np.ndarray, "h w"]) -> bool:
    """Whether a picture was scaled to 0 to 1 before it became uint8.

    In the noise of a covered lens, which may have values of 0 and 1 too, one pixel says nothing of the next; in a
    picture neighbors agree.
    """
    if grey.max() != 1:
        return False
    ones = float(grey.mean())
    by_chance = ones**2 + (1 - ones) ** 2
    agree = float(np.mean(grey[:, 1:] == grey[:, :-1]))
    return ones > _LEAST_ONES and agree - by_chance > _LEAST_AGREEMENT * (1 - by_chance)
