"""Checks of depth images against what sensors measure: unit, scale, and the depth steps of structured light."""

import numpy as np
from jaxtyping import Float32

_FEWEST, _SAMPLES = 100, 80
"""Fewest valid pixels for a decision, and the approximate number of rows and columns sampled."""
_FARTHEST_M, _NEAREST_M = 200.0, 0.01
"""A median depth outside this range is in another unit, whatever the scene."""
_MIN_COUNT = 100.0
_FACTOR = 5.0
"""Ratio of the usual depth scales, 1000 and 5000 counts per meter."""
_STEP_PER_M = 2.89e-3
"""Depth step of structured light (Kinect v1, Xtion, Astra) at a depth of 1 m, in meters; it grows with depth squared.

It corresponds to a disparity step of an eighth of a pixel at a focal length of 576 pixels and a baseline of 75 mm.
Source: Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data", 2012. Medians measured on images of TUM
fr1 and Bonn: 2.87 to 2.93 mm; on rendered rooms: 2.85 mm."""
_STEP_TOLERANCE, _MAX_SPREAD = 0.06, 0.25
_FEWEST_STEPS, _MIN_RANGE = 40, 1.3
_USUAL_M = (0.9, 4.0)
"""Usual median depths indoors, in meters; the check for a scale off by a factor of 5 runs outside this range only."""


def is_plausible(near: float, median: float, far: float) -> bool:
    """Whether the 2nd, 50th and 98th percentile of depth, in meters, are usual for an RGB-D camera in a room."""
    return near >= 0.25 and 0.2 <= median <= 10 and far <= 12


def contradiction_of_depth(depth_m: Float32[np.ndarray, "h w"]) -> str:
    """Describe the evidence that depth is not in meters, as a part of a sentence; empty if there is none.

    Large and small scenes pass: only values that no sensor measures are reported.

    Args:
        depth_m: `(h, w)` depth in meters; 0 or not finite where missing.
    """
    rows, columns = (max(1, size // _SAMPLES) for size in depth_m.shape)
    measured = _measured(depth_m[::rows, ::columns])
    if measured.size < _FEWEST:
        return ""
    median = float(np.median(measured))
    if median > _MIN_COUNT and bool(np.all(measured == np.rint(measured))):
        return f"whole numbers with a median of {median:.0f} look like millimeters, or counts of the depth image"
    if not _NEAREST_M <= median <= _FARTHEST_M:
        return f"a median of {median:.3g} m looks like another unit, or a depth scale 1000 times off"
    if _USUAL_M[0] <= median <= _USUAL_M[1]:
        return ""
    return _contradiction_of_steps(_measured(depth_m[::rows]), median)


def _measured(depth_m: np.ndarray) -> np.ndarray:
    return depth_m[np.isfinite(depth_m) & (depth_m > 0)]


def _contradiction_of_steps(measured: np.ndarray, median: float) -> str:
    """Describe structured light whose depth steps are five times too coarse or too fine for its depth."""
    levels = np.unique(measured).astype(np.float64)
    if levels.size <= _FEWEST_STEPS or levels[-1] < _MIN_RANGE * levels[0]:
        return ""
    quarter, step, most = np.percentile(np.diff(levels) / (levels[1:] * levels[:-1]), (25, 50, 75))
    if most - quarter > _MAX_SPREAD * step:
        return ""
    for factor, words in ((_FACTOR, "large"), (1 / _FACTOR, "small")):
        if abs(_STEP_PER_M / (step * factor) - 1) < _STEP_TOLERANCE:
            return (
                f"a median of {median:.2g} m, in steps of {1000 * step:.2g} mm at 1 m, looks like depth 5 times too"
                f" {words} (structured light has steps of {1000 * _STEP_PER_M:.2g} mm there)"
            )
    return ""
