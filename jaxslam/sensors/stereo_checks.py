"""Checks of stereo pairs without depth: matching rows, swapped sides, and the range of disparities."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame, to_gray

_FEATURES, _MIN_MATCHES, _RATIO = 600, 30, 0.7
_QUICK_FEATURES, _QUICK_LEVELS, _QUICK_RATIO = 500, 4, 0.8
_MAX_OFF_ROW_PX = 1.0
_MAX_BRIGHTER = 0.25
_NEAR_ZERO_PX = 0.5
_SURELY_OFF_ROW_PX = 2.0
"""Median row error in pixels that no rectified pair reaches; quick matches give 0.6 in KITTI 06 and 0 in rooms."""
_SURELY_NEGATIVE_PX, _NEARLY_ALL, _ENOUGH_MATCHES = -1.0, 0.8, 60


class PairFinding(NamedTuple):
    """The result of one check on stereo pairs.

    Attributes:
        topic: The topic in a word.
        odd: Whether the result is unusual.
        text: Result of the check.
        consequence: Effect of an unusual result on tracking.
    """

    topic: str
    odd: bool
    text: str
    consequence: str


def look_over(frames: Sequence[Frame], camera: Camera) -> Iterator[PairFinding]:
    """Check the stereo pairs among some frames of a camera; yields nothing if there are none."""
    pairs = [(to_gray(frame.image), to_gray(frame.right)) for frame in frames if frame.right is not None]
    if not pairs or camera.baseline_m is None:
        return
    ratio = float(np.median([left.mean() / max(right.mean(), 1) for left, right in pairs]))
    yield PairFinding(
        "brightness",
        abs(ratio - 1) > _MAX_BRIGHTER,
        f"the left images are {ratio:.2f} times as bright as the right ones",
        "points are matched badly; is each camera exposed on its own?",
    )
    shifts = np.concatenate([matched_shifts(*pair) for pair in pairs])
    if len(shifts) < _MIN_MATCHES:
        yield PairFinding("rows", True, f"{len(shifts)} matches between left and right", "hardly any point has depth")
        return
    off, on_row = _rows(shifts)
    yield PairFinding(
        "rows",
        off > _MAX_OFF_ROW_PX,
        f"matches lie {off:.2f} pixels from their rows, the median of {len(shifts)}",
        "the pair is not rectified, or not of this calibration; depth is found for few points, and wrong",
    )
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


def contradiction_of_pairs(shifts: Float[np.ndarray, "n 2"]) -> tuple[str, str]:
    """Describe what is certainly wrong with stereo pairs, as a topic and a sentence; both empty if nothing is.

    Args:
        shifts: `(n, 2)` shifts of matches in one or more pairs, as `matched_shifts` returns them. Too few matches give
            no result.
    """
    if len(shifts) < _ENOUGH_MATCHES:
        return "", ""
    if not shifts.any():
        return "pair sides", "right: expected what the right camera saw, got the left image twice"
    off, on_row = _rows(shifts)
    if off > _SURELY_OFF_ROW_PX:
        return (
            "pair rows",
            f"right: expected the rows of the left image, got matches {off:.1f} pixels off their rows, the median of"
            f" {len(shifts)}; it looks as if the pair is not rectified (jaxslam.RectifiedPair does it)",
        )
    negative = float(np.mean(on_row < -_NEAR_ZERO_PX))
    if np.median(on_row) < _SURELY_NEGATIVE_PX and negative > _NEARLY_ALL:
        return (
            "pair sides",
            f"right: expected what the right camera saw, got {negative:.0%} of {len(on_row)} matches further right than"
            " in image; it looks as if left and right are swapped",
        )
    return "", ""


def _rows(shifts: Float[np.ndarray, "n 2"]) -> tuple[float, Float[np.ndarray, " m"]]:
    """Return the median row error of matches, and the disparities of those near their rows, both in pixels."""
    off = float(np.median(np.abs(shifts[:, 1])))
    return off, shifts[np.abs(shifts[:, 1]) < max(3 * off, _MAX_OFF_ROW_PX), 0]


def matched_shifts(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], *, quick: bool = False
) -> Float[np.ndarray, "n 2"]:
    """Return `(n, 2)` shifts of matches: how far right and down features are in the left image from the right one.

    Shifts are in pixels.

    Args:
        left: The gray left image.
        right: The gray right image.
        quick: Whether to match ORB features, accurate to a pixel, instead of SIFT features, accurate to a tenth.
    """
    finder = cv2.ORB.create(_QUICK_FEATURES, nlevels=_QUICK_LEVELS) if quick else cv2.SIFT.create(_FEATURES)
    (at_left, of_left), (at_right, of_right) = (finder.detectAndCompute(image, None) for image in (left, right))
    if len(at_left) < 2 or len(at_right) < 2:
        return np.zeros((0, 2))
    ratio = _QUICK_RATIO if quick else _RATIO
    nearest = cv2.BFMatcher(finder.defaultNorm()).knnMatch(of_left, of_right, k=2)
    good = [first for first, second in nearest if first.distance < ratio * second.distance]
    pairs = [(at_left[match.queryIdx].pt, at_right[match.trainIdx].pt) for match in good]
    return np.array([np.subtract(a, b) for a, b in pairs]).reshape(-1, 2)
