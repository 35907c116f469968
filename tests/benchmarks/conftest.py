"""What timings share; XLA computes in one thread, as in all tests."""

from collections.abc import Iterator

import cv2
import pytest


@pytest.fixture
def opencv_in_one_thread() -> Iterator[None]:
    """OpenCV computes in one thread too."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)
