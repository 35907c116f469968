"""Where an image lies in a network's input, and the way back."""

from typing import Literal, NamedTuple, TypeAlias

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

Fit: TypeAlias = Literal["corner", "center", "stretch"]
"""Keep the aspect and pad at the right and the bottom, or on both sides; or stretch to the whole input."""


class Placement(NamedTuple):
    """`input = image * scale + offset` in pixels from the top left corner, x before y.

    Attributes:
        size: The image's width and height.
        scale: Pixels of the input for one of the image.
        offset: Where the image begins in the input.
    """

    size: tuple[int, int]
    scale: tuple[float, float]
    offset: tuple[int, int]


def place(
    image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], fit: Fit, pad: int
) -> tuple[UInt8[np.ndarray, "hi wi 3"], Placement]:
    """An image as a network's input.

    Args:
        image: Any size.
        size: `(width, height)` of the input.
        fit: How the one is made the other.
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
    """Boxes in the input as boxes in the image; they are not cut at its edges."""
    offset, scale = (np.tile(np.asarray(pair, np.float32), 2) for pair in (placement.offset, placement.scale))
    return (boxes - offset) / scale


def plane_to_image(
    plane: Float32[np.ndarray, "hp wp"],
    input_size: tuple[int, int],
    placement: Placement,
    window: tuple[int, int, int, int] | None = None,
) -> Float32[np.ndarray, "h w"]:
    """A plane over the whole input, of any resolution, at the image's resolution (bilinear).

    Args:
        plane: Values over the input.
        input_size: `(width, height)` of the input.
        placement: Where the image lies in it.
        window: The part wanted: left, top, right, bottom pixels of the image; `None` for all of it.
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
