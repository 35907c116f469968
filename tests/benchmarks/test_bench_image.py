"""The image pyramid beside `cv2.buildOpticalFlowPyramid`, as Lucas-Kanade flow needs it."""

import cv2
import jax
import pytest
from jaxslam_kernels.image.pyramid import build_pyramid

from jaxslam.benchmark.kernels.scenes.image_warps import picture
from jaxslam.benchmark.timing import compare

pytestmark = pytest.mark.benchmark


def test_pyramid_against_opencv(capsys):
    """Four levels of 640x480. Ours are floating point, four times the bytes of OpenCV's."""
    image = picture(640, 480)
    ours = jax.jit(lambda image: build_pyramid(image, num_levels=4).levels)
    comparison = compare(
        lambda: ours(image), lambda: cv2.buildOpticalFlowPyramid(image, (21, 21), 3, withDerivatives=False)
    )
    with capsys.disabled():
        print(f"\nbuild_pyramid, 640x480, 4 levels, against cv2.buildOpticalFlowPyramid: {comparison}")
    assert comparison.processor_ratio < 3.0
