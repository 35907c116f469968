"""Results of a detector for one image."""

from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float32, UInt8


class Detections(NamedTuple):
    """Objects that were found in one image.

    Boxes are measured from the top-left corner of the image, so that pixel column `c` spans `c` to `c + 1`. A box with
    rounded edges covers `mask[top:bottom, left:right]`.

    Attributes:
        boxes: `(k, 4)` left, top, right and bottom edges in pixels, in order of falling scores. Boxes may extend beyond
            the image.
        scores: `(k,)` scores from 0 to 1.
        labels: Name of the class of each box, such as "person".
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
    """Callable that finds objects in an image, such as a function."""

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find objects in an RGB image.

        Raises:
            Exception: Any error; the caller reports it and continues.
        """
        ...


def no_detections() -> Detections:
    """Return the result for an image without objects."""
    return Detections(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), (), None, None)
