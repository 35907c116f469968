"""What a detector says about one image."""

from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float32, UInt8


class Detections(NamedTuple):
    """What was found in one image.

    Boxes are measured from the image's top left corner, so that pixel column `c` reaches from `c` to `c + 1`:
    `mask[top:bottom, left:right]` of rounded edges is what a box covers.

    Attributes:
        boxes: `(k, 4)` left, top, right, bottom in pixels of the image; may reach past it. Best score first.
        scores: `(k,)` 0 to 1.
        labels: The name of each, such as "person".
        masks: `(k, h, w)` instance masks at the image's size; `None` where the network gives none.
        class_mask: `(h, w)` pixels of any wanted class, where the network labels pixels (then there are no boxes);
            `None` where it does not.
    """

    boxes: Float32[np.ndarray, "k 4"]
    scores: Float32[np.ndarray, " k"]
    labels: tuple[str, ...]
    masks: Bool[np.ndarray, "k h w"] | None
    class_mask: Bool[np.ndarray, "h w"] | None


class Detector(Protocol):
    """Any callable that finds things in an image, be it a function."""

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find things in an RGB image.

        Raises:
            Exception: Whatever goes wrong; the caller reports it and goes on.
        """
        ...


def no_detections() -> Detections:
    """Nothing found."""
    return Detections(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), (), None, None)
