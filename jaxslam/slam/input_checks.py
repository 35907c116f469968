"""Looks at the input of a run for what is wrong but shows only in the pictures: units, sides, rows, color order."""

import numpy as np

from jaxslam.semantics.checked_detector import CheckedDetector
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.depth_checks import contradiction_of_depth
from jaxslam.sensors.frame import Frame, to_gray
from jaxslam.sensors.image_checks import scaled_to_one
from jaxslam.sensors.stereo_checks import contradiction_of_pairs, matched_shifts
from jaxslam.slam.input_warnings import InputWarnings

_FIRST, _RARELY = 10, 100
_PAIR_EVERY = 3
"""Of the first frames, those whose pair is matched: it takes longest."""


class InputChecks:
    """Looks at the first ten frames, then at every hundredth, and warns of what contradicts the camera."""

    def __init__(
        self, camera: Camera, warnings: InputWarnings, detector: CheckedDetector | None, *, has_imu: bool = False
    ) -> None:
        """Begin before the first frame.

        Args:
            camera: Camera that takes the frames.
            warnings: Collector of warnings.
            detector: The detector that looks at the same frames, which notices swapped colors.
            has_imu: Whether the data sheet of an IMU was given.
        """
        self._camera, self._warnings, self._detector, self._has_imu = camera, warnings, detector, has_imu
        self._frames = self._without_depth = 0
        self._shifts = np.zeros((0, 2))

    def look(self, frame: Frame) -> None:
        """Look at the next frame, if it is one of those looked at."""
        number, self._frames = self._frames, self._frames + 1
        if self._detector is not None and self._detector.color_suspicion:
            self._warnings.warn("color order", self._detector.color_suspicion)
        if number >= _FIRST and number % _RARELY:
            return
        self._look_at_samples(frame)
        if scaled_to_one(to_gray(frame.image)):
            text = "image: expected values from 0 to 255, got 0 and 1 only; it looks like an image scaled to 0 to 1"
            self._warnings.warn("image range", text)
        if self._camera.is_stereo:
            self._look_at_pair(frame, number)
        elif frame.depth_m is None:
            self._without_depth += number < _FIRST
            if self._without_depth == _FIRST:
                self._warnings.warn("no depth", "depth_m: expected depth now and then to start with, got none so far")
        elif contradiction := contradiction_of_depth(frame.depth_m):
            self._warnings.warn("depth scale", f"depth_m: expected meters along the optical axis, got {contradiction}")

    def _look_at_samples(self, frame: Frame) -> None:
        """Warn of samples of an IMU without its data sheet, and of a data sheet without samples."""
        if frame.imu is not None and not self._has_imu:
            text = (
                "imu: expected the data sheet of the IMU with its samples, Slam(imu=...), got none: they are not used"
            )
            self._warnings.warn("IMU", text)
        if frame.imu is None and self._has_imu:
            self._warnings.warn("IMU", "imu: expected samples of the IMU with each frame, as its data sheet was given")

    def _look_at_pair(self, frame: Frame, number: int) -> None:
        if frame.right is None or (number < _FIRST and number % _PAIR_EVERY):
            return
        new = matched_shifts(to_gray(frame.image), to_gray(frame.right), quick=True)
        self._shifts = new if number >= _FIRST else np.concatenate([self._shifts, new])
        topic, text = contradiction_of_pairs(self._shifts)
        if text:
            self._warnings.warn(topic, text)
