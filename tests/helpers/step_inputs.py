"""By what the tracker is differentiated in tests; `docs/make_tables.py` makes a table of it."""

from typing import NamedTuple


class StepInput(NamedTuple):
    """An input of `track_step`, by which the pose has a derivative.

    Attributes:
        words: What it is, for the table in `docs/derivatives.md`.
        first: Length of the difference that the first derivative is compared with. It changes the loss by 2e-7 or more:
            the tolerances of searches and solvers change it by up to 2e-11.
        second: Length for the second derivative; `None` where that is not compared. It is short, so that no point
            crosses a pixel on the way.
    """

    words: str
    first: float
    second: float | None


STEP_INPUTS = {
    "camera": StepInput("focal lengths and center of the camera", 1e-4, 1e-5),
    "weight": StepInput("weights of `state.points`", 1e-2, 1e-4),
    "X_world": StepInput("positions of `state.points`", 1e-5, 1e-6),
    "loss_scale": StepInput("`loss_scale`", 3e-3, 1e-3),
    "pixel_sigma": StepInput("`pixel_sigma`", 1e-3, 1e-4),
    "readout_s": StepInput("`sensor.readout_s`", 1e-4, None),
    "image": StepInput("images", 1e-2, None),
    "ignore": StepInput("`ignore` as floating point", 1e-2, None),
    "distortion": StepInput("distortion of the camera", 1e-5, None),
    "depth_sigma_per_m2": StepInput("`sensor.depth_sigma_per_m2`", 1e-5, None),
}
CONSTANT_PARAMS = (
    "outlier_px",
    "min_correlation",
    "min_inliers",
    "weak_inliers",
    "min_share",
    "detect_below",
    "keyframe_below",
    "keyframe_followed_below",
    "keyframe_views",
    "map_views",
    "map_changed",
    "keyframe_points_below",
    "keyframe_weak_after_s",
    "keyframe_min_s",
    "keyframe_motion",
    "keyframe_movable_below",
    "keyframe_patience_s",
    "anchor_frames",
    "restart_after",
    "max_speed_m_per_s",
    "max_turn_rad_per_s",
)
"""Fields of `TrackParams` that only compare: poses have no derivative by them."""
STEPS, STEPS_TWICE = 10, 3
"""Frames through which first and second derivatives are compared. Between pixels, interpolation bends, and a gradient
has a step there: few frames for the second ones."""
