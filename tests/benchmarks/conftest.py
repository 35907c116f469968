"""What timings share: XLA computes in one thread, as it does by itself in a process that starts on one core."""

from collections.abc import Iterator

import cv2
import pytest

from jaxslam.xla import prefer_one_thread

prefer_one_thread()  # before the first array, which tests make when they are imported


@pytest.fixture
def opencv_in_one_thread() -> Iterator[None]:
    """OpenCV computes in one thread too."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)
