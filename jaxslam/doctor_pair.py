"""What can be told of stereo pairs without depth: whether rows match, which side is which, how far things are."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.camera import Camera
from jaxslam.frame import Frame, to_grey

_FEATURES, _LEAST_MATCHES, _RATIO = 600, 30, 0.7
_MOST_OFF_ROW_PX = 1.0
_MOST_BRIGHTER = 0.25
_NEAR_ZERO_PX = 0.5


class PairFinding(NamedTuple):
    """One thing looked at: its topic, whether it is odd, what was found, and what that would do."""

    topic: str
    odd: bool
    text: str
    consequence: str


def look_over(frames: Sequence[Frame], camera: Camera) -> Iterator[PairFinding]:
    """Findings about the pairs among some frames of a camera; nothing if there is none."""
    pairs = [(to_grey(frame.image), to_grey(frame.right)) for frame in frames if frame.right is not None]
    if not pairs or camera.baseline_m is None:
        return
    ratio = float(np.median([left.mean() / max(right.mean(), 1) for left, right in pairs]))
    yield PairFinding(
        "brightness",
        abs(ratio - 1) > _MOST_BRIGHTER,
        f"the left images are {ratio:.2f} times as bright as the right ones",
        "points are matched badly; is each camera exposed on its own?",
    )
    shifts = np.concatenate([_shifts(*pair) for pair in pairs])
    if len(shifts) < _LEAST_MATCHES:
        yield PairFinding("rows", True, f"{len(shifts)} matches between left and right", "hardly any point has depth")
        return
    off = float(np.median(np.abs(shifts[:, 1])))
    yield PairFinding(
        "rows",
        off > _MOST_OFF_ROW_PX,
        f"matches lie {off:.2f} pixels from their rows, the median of {len(shifts)}",
        "the pair is not rectified, or not of this calibration; depth is found for few points, and wrong",
    )
    on_row = shifts[np.abs(shifts[:, 1]) < max(3 * off, _MOST_OFF_ROW_PX), 0]
    near, median, far = np.percentile(on_row, (98, 50, 2))
    if median < -_NEAR_ZERO_PX:
        what = "what is in the left images lies further right in the right ones"
        yield PairFinding("sides", True, what, "left and right are swapped: nothing has depth")
        return
    depth_m = camera.fx * camera.baseline_m / max(float(median), _NEAR_ZERO_PX)
    yield PairFinding(
        "disparity",
        bool(far < -1 or median < 1),
        f"median {median:.1f} pixels ({depth_m:.1f} m at a baseline of {camera.baseline_m:.3f} m), 96 % between"
        f" {far:.1f} and {near:.1f}",
        "too far away for this baseline, or the two cameras do not look the same way",
    )


def _shifts(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """`(n, 2)` how much further right and down a feature lies in the left image than in the right one, pixels."""
    sift = cv2.SIFT.create(_FEATURES)
    (at_left, of_left), (at_right, of_right) = (sift.detectAndCompute(image, None) for image in (left, right))
    if len(at_left) < 2 or len(at_right) < 2:
        return np.zeros((0, 2))
    nearest = cv2.BFMatcher().knnMatch(of_left, of_right, k=2)
    good = [first for first, second in nearest if first.distance < _RATIO * second.distance]
    pairs = [(at_left[match.queryIdx].pt, at_right[match.trainIdx].pt) for match in good]
    return np.array([np.subtract(a, b) for a, b in pairs]).reshape(-1, 2)
