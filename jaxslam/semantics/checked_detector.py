"""A detector whose answers are checked, and that notices swapped colors."""

import numpy as np
from jaxtyping import UInt8

from jaxslam.semantics.color_order import ColorOrder
from jaxslam.semantics.detection_checks import check_answer
from jaxslam.semantics.detections import Detections, Detector
from jaxslam.semantics.detector import OnnxDetector


class CheckedDetector:
    """Calls a detector and checks its answers.

    Attributes:
        color_suspicion: A sentence that says that red and blue look swapped; empty if they do not.
    """

    def __init__(self, detector: Detector) -> None:
        """Begin with no image; only a network of jaxslam's own is asked twice about an image, to compare colors."""
        self._detector = detector
        self.begin()

    def begin(self) -> None:
        """Forget the images of the run before."""
        self.color_suspicion = ""
        self._color_order = ColorOrder(self._detector) if isinstance(self._detector, OnnxDetector) else None

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """What the detector finds in an RGB image.

        Raises:
            ModelError: If the answer is not `Detections` of this image.
            Exception: Whatever goes wrong in the detector.
        """
        found = self._detector(image)
        check_answer(found, *image.shape[:2])
        if self._color_order is not None and self._color_order.look(image, found):
            self.color_suspicion = (
                "image: expected RGB, got colors of skin and scores of people that fit BGR better; it looks as if red"
                " and blue are swapped (image[..., ::-1])"
            )
        return found
