"""Track a whole clip in one program that can be differentiated."""

import jax
import numpy as np
from jax import lax
from jax.core import Tracer

from jaxslam.sensors.frame_arrays import FrameArrays, check_gray_range, check_mask_range
from jaxslam.tracking.initial_state import DEFAULT_PLAN
from jaxslam.tracking.state import TrackOutput, TrackParams, TrackPlan, TrackState
from jaxslam.tracking.step import track_step


def rollout(
    state: TrackState, clip: FrameArrays, params: TrackParams, plan: TrackPlan = DEFAULT_PLAN
) -> tuple[TrackState, TrackOutput]:
    """Track the frames of a clip one after another: `lax.scan` over `track_step`.

    A pure function, which `jit`, `vmap` and `grad` apply to. Its gradient takes the memory of one step and of a state
    for each frame: the backward pass computes the steps again (rematerialization). For 160x120 pixels that is 0.7 MB a
    frame instead of 10, and faster too: 0.23 s for 32 frames instead of 0.37 (AMD EPYC).

    Args:
        state: State from `init_state`, from `track_step` or from another rollout.
        clip: Frames from `stack_frames`, stacked along a first axis.
        params: Camera and thresholds, traced.
        plan: Array sizes and search settings, static; the plan with which the state was made.

    Returns:
        The state after the last frame, and the outputs of all frames, stacked along a first axis. Under `jit`, outputs
        that are not used take no memory.

    Raises:
        ValueError: In the same cases as `track_step`, or if the clip is a single image.
        TypeError: In the same cases as `track_step`.
    """
    if np.ndim(clip.image) != 3:
        raise ValueError(f"clip.image: expected gray images (frames, h, w) of stack_frames, got {np.shape(clip.image)}")
    if not isinstance(clip.image, Tracer):
        check_gray_range("clip.image", clip.image)  # the steps see a tracer
    if not isinstance(clip.ignore, Tracer):
        check_mask_range("clip.ignore", clip.ignore)
    # The scan separates the two computations already; barriers against their merging would only take time.
    step = jax.checkpoint(lambda state, frame: track_step(state, frame, params, plan), prevent_cse=False)
    return lax.scan(step, state, clip)
