"""How far a camera has turned between two images, from the shift of the whole picture."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from jaxslam.features.pose_from_matches import pinhole
from jaxslam.geometry.se3 import IDENTITY, retract
from jaxslam.geometry.types import Pose
from jaxslam.sensors.sensor_model import SensorModel

_SIDE_PX = 60
"""Shorter side of the images that are compared: 0.2 ms, and 0.8 ms to make both from 640 x 480 pixels."""
_LEAST_PX = 16
"""Shortest side of an image that has a shift to tell."""
_BLUR_PX = 1.0
_MIN_RESPONSE = 0.3
"""Smallest share of the spectral energy in the peak of the correlation. Of pairs of every 6th, 8th and 12th image of
fr1_rpy, all 50 beyond it tell the shift to 2 to 28 pixels, of 16 to 230, and one of seven below it."""


def turn_between(last: UInt8[np.ndarray, "h w"], image: UInt8[np.ndarray, "h w"], sensor: SensorModel) -> Pose | None:
    """Estimate how a camera turned from one image to the next, without roll; `None` if the images do not tell.

    The translation is 0: the shift of the picture by a sideways motion is told as a turn. The shift comes from phase
    correlation of small, blurred images, as a first guess of the motion for optical flow.

    Source: Kuglin and Hines, The Phase Correlation Image Alignment Method, 1975; small blurry images that tell how a
    lost camera turned are from Klein and Murray, Improving the Agility of Keyframe-Based SLAM, 2008.

    Args:
        last: The first image.
        image: The second image, of the same size.
        sensor: Camera, of which the focal lengths are used.

    Returns:
        `(7,)` pose of the second camera in the axes of the first one.
    """
    if min(image.shape) < _LEAST_PX:
        return None
    before, now = _small(last), _small(image)
    window = cv2.createHanningWindow((now.shape[1], now.shape[0]), cv2.CV_32F)
    shift, response = cv2.phaseCorrelate(before, now, window)
    if not response >= _MIN_RESPONSE:
        return None
    scale = np.array([image.shape[1] / now.shape[1], image.shape[0] / now.shape[0]])
    right, down = np.arctan(np.array(shift) * scale / pinhole(sensor)[0][:, 0])
    return retract(IDENTITY, np.array([0, 0, 0, down, -right, 0]))


def _small(image: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "_h _w"]:
    """Return the image in the size to compare, less its mean, which would correlate at no shift."""
    ratio = max(min(image.shape) / _SIDE_PX, 1.0)
    size = round(image.shape[1] / ratio), round(image.shape[0] / ratio)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(small - small.mean(), (0, 0), _BLUR_PX)
