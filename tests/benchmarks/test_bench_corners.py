"""The best corner of every grid cell beside `cv2.goodFeaturesToTrack` asked for as many."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.image.corners import corner_score, grid_corners

from jaxslam.benchmark.kernels.scenes.image_warps import picture
from jaxslam.benchmark.timing import compare

pytestmark = pytest.mark.benchmark


@pytest.mark.parametrize(("width", "height", "cell"), [(320, 240, 10), (640, 480, 20)])
def test_is_not_slower_than_opencv(width, height, cell, capsys):
    """At half the size too, where the tracker looks for them."""
    image, everywhere = picture(width, height), np.ones((height, width), bool)
    count = (width // cell) * (height // cell)
    ours = jax.jit(lambda image, allowed: grid_corners(corner_score(image.astype(jnp.float32)), allowed, cell=cell))
    theirs = lambda: cv2.goodFeaturesToTrack(image, count, qualityLevel=0.01, minDistance=cell / 2, blockSize=5)
    assert ours(image, everywhere).points.shape == (2, count)
    comparison = compare(lambda: ours(image, everywhere), theirs)
    with capsys.disabled():
        print(f"\n{width}x{height}, {count} cells, OpenCV finds {len(theirs())}: {comparison}")
    assert comparison.ratio <= 1.0
