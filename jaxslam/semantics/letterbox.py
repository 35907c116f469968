"""Fit images into the input of a network, and map results back to the image."""

from typing import Literal, NamedTuple, TypeAlias

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

Fit: TypeAlias = Literal["corner", "center", "stretch"]
"""How an image fits the input: keep the aspect and pad right and below (`corner`) or on both sides (`center`), or
stretch."""


class Placement(NamedTuple):
    """Transform from the image to the input, `input = image * scale + offset`, in pixels from the top-left corner.

    Attributes:
        size: Width and height of the image in pixels.
        scale: Scale along x and y.
        offset: Column and row of the image's top-left corner in the input.
    """

    size: tuple[int, int]
    scale: tuple[float, float]
    offset: tuple[int, int]


def place(
    image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], fit: Fit, pad: int
) -> tuple[UInt8[np.ndarray, "hi wi 3"], Placement]:
    """Resize and pad an image to the input of a network.

    Args:
        image: `(h, w, 3)` image of any size.
        size: Size `(width, height)` of the input in pixels.
        fit: Way in which the image is fitted to the input.
        pad: Value of the pixels beside the image.
    """
    (height, width), (full_width, full_height) = image.shape[:2], size
    if fit == "stretch":
        inner = size
    else:
        scale = min(full_width / width, full_height / height)
        inner = (min(max(round(width * scale), 1), full_width), min(max(round(height * scale), 1), full_height))
    resized = cv2.resize(image, inner, interpolation=cv2.INTER_LINEAR)
    centered = fit == "center"
    left, top = ((full_width - inner[0]) // 2, (full_height - inner[1]) // 2) if centered else (0, 0)
    placement = Placement((width, height), (inner[0] / width, inner[1] / height), (left, top))
    if inner == size:
        return resized, placement
    canvas = np.full((full_height, full_width, 3), pad, np.uint8)
    canvas[top : top + inner[1], left : left + inner[0]] = resized
    return canvas, placement


def boxes_to_image(boxes: Float32[np.ndarray, "k 4"], placement: Placement) -> Float32[np.ndarray, "k 4"]:
    """Map boxes `(k, 4)` from the input to the image, without clipping."""
    offset, scale = (np.tile(np.asarray(pair, np.float32), 2) for pair in (placement.offset, placement.scale))
    return (boxes - offset) / scale


def plane_to_image(
    plane: Float32[np.ndarray, "hp wp"],
    input_size: tuple[int, int],
    placement: Placement,
    window: tuple[int, int, int, int] | None = None,
) -> Float32[np.ndarray, "h w"]:
    """Resample a plane over the whole input, of any resolution, at the pixels of the image (bilinear).

    Args:
        plane: `(hp, wp)` values over the input.
        input_size: Size `(width, height)` of the input in pixels.
        placement: Transform from the image to the input.
        window: Left, top, right and bottom of the wanted part of the image in pixels; `None` for the whole image.
    """
    left, top, right, bottom = window or (0, 0, *placement.size)
    per_input = (plane.shape[1] / input_size[0], plane.shape[0] / input_size[1])
    scale = [a * b for a, b in zip(placement.scale, per_input, strict=True)]
    # cell centers lie half a cell from the corner that coordinates are measured from
    shift = [
        (start + 0.5) * s + offset * per - 0.5
        for start, s, offset, per in zip((left, top), scale, placement.offset, per_input, strict=True)
    ]
    to_plane = np.array([[scale[0], 0, shift[0]], [0, scale[1], shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(plane, to_plane, (right - left, bottom - top), flags=flags, borderMode=cv2.BORDER_REPLICATE)
