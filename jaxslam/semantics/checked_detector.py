"""A detector whose results are checked, and that notices swapped color channels."""

import numpy as np
from jaxtyping import UInt8

from jaxslam.semantics.color_order import ColorOrder
from jaxslam.semantics.detection_checks import check_answer
from jaxslam.semantics.detections import Detections, Detector
from jaxslam.semantics.detector import OnnxDetector


class CheckedDetector:
    """Detector that checks the results of another detector.

    Attributes:
        color_suspicion: Warning that red and blue look swapped; empty if they do not.
    """

    def __init__(self, detector: Detector) -> None:
        """Wrap a detector. Colors are only checked for an `OnnxDetector`, which then runs twice on a few images."""
        self._detector = detector
        self.begin()

    def begin(self) -> None:
        """Forget the images of the previous run."""
        self.color_suspicion = ""
        self._color_order = ColorOrder(self._detector) if isinstance(self._detector, OnnxDetector) else None

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], /) -> Detections:
        """Find objects in an RGB image.

        Raises:
            ModelError: If the result is not `Detections` of this image.
            Exception: Any error of the detector.
        """
        found = self._detector(image)
        check_answer(found, *image.shape[:2])
        if self._color_order is not None and self._color_order.look(image, found):
            self.color_suspicion = (
                "image: expected RGB, got colors of skin and scores of people that fit BGR better; it looks as if red"
                " and blue are swapped (image[..., ::-1])"
            )
        return found
