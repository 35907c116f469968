"""OpenCV's optical flow of 1000 corners: the unit in which times are given, the same on every machine."""

import itertools
import time

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from jaxslam.datasets import Dataset
from jaxslam.errors import DatasetError, FrameError
from jaxslam.sensors.frame import to_gray

NUM_CORNERS, WINDOW_PX, LEVELS = 1000, 21, 4
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
"""Ten steps, or until one is shorter than 0.03 pixels."""
_PAIRS, _CALLS = 8, 3

Gray = UInt8[np.ndarray, "h w"]
Corners = Float32[np.ndarray, "n 1 2"] | Float32[np.ndarray, "n 2"]


def corners_of(image: np.ndarray, seed: int = 0) -> Corners:
    """A thousand corners at most of a color or gray image, pixels; points anywhere in one that has none.

    Args:
        image: `(h, w, 3)` RGB or `(h, w)`.
        seed: Seed of random points.
    """
    gray = to_gray(image)
    corners: Corners | None = cv2.goodFeaturesToTrack(gray, NUM_CORNERS, 0.001, 7)
    if corners is None:
        places = np.random.default_rng(seed).uniform(0, min(gray.shape), (NUM_CORNERS, 1, 2))
        return places.astype(np.float32)
    return corners


def opencv_flow(before: Gray, after: Gray, corners: Corners) -> Corners:
    """Track the corners into the next image, building both pyramids."""
    found, _, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        corners,
        corners.copy(),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=LEVELS - 1,
        criteria=CRITERIA,
    )
    return found


def flow_ms(before: Gray, after: Gray, corners: Corners) -> float:
    """Milliseconds that it takes, once."""
    began = time.perf_counter()
    opencv_flow(before, after, corners)
    return 1e3 * (time.perf_counter() - began)


def flow_time_ms(dataset: Dataset) -> float | None:
    """Cost of a frame on this machine, whatever is done with it.

    The median over pairs of frames all over the recording, in one thread. Frames that cannot be read are passed over.

    Returns:
        Milliseconds; `None` if no two frames in a row can be read.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        starts = np.unique(np.linspace(0, max(len(dataset) - 2, 0), _PAIRS).astype(int)).tolist()
        parts = [range(*ends) for ends in itertools.pairwise([*starts, max(len(dataset) - 1, 1)])]
        found = [time_ms for part in parts if (time_ms := _of_part_ms(dataset, part)) is not None]
        return float(np.median(found)) if found else None
    finally:
        cv2.setNumThreads(before)


def _of_part_ms(dataset: Dataset, part: range) -> float | None:
    """The time of the first pair, of those that begin in a part of the recording, that can be read."""
    for index in part:
        try:
            return _of_pair_ms(dataset, index)
        except (DatasetError, FrameError):  # as `Slam.run` does: the tracker passes over it too
            continue
    return None


def _of_pair_ms(dataset: Dataset, index: int) -> float:
    a, b = (to_gray(dataset[min(i, len(dataset) - 1)].image) for i in (index, index + 1))
    corners = corners_of(a, index)
    return float(np.median([flow_ms(a, b, corners) for _ in range(_CALLS)]))
