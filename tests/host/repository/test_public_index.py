"""What users import from `jaxslam`, used as they use it: pyright reads this file too."""

import jax.numpy as jnp
import numpy as np

import jaxslam
from jaxslam import (
    FlowPlan,
    FlowResult,
    Intrinsics,
    KeyframeReason,
    LevelPlan,
    PoseStatus,
    TrackedPoints,
    TrackOutput,
    TrackPlan,
    TrackReason,
    TrackState,
    TrackStatus,
    enable_compile_cache,
    init_state,
    track_params,
)
from jaxslam.config.schema import TrackConfig

FLOW = FlowPlan(finest=LevelPlan(9, 6, 0.03))
SMALL = TrackPlan(num_points=4, num_levels=2, num_keyframes=1, num_reloaded=0, num_sources=1, flow=FLOW)


def told(output: TrackOutput) -> tuple[str, str, str, str]:
    """An output in words."""
    status, reason = TrackStatus(int(output.status)).name, TrackReason(int(output.reason)).text
    return status, reason, KeyframeReason(int(output.keyframe)).name, PoseStatus(int(output.pose_status)).name


def halved(state: TrackState) -> TrackState:
    """A state whose points count half."""
    points: TrackedPoints = state.points
    return state._replace(points=points._replace(weight=0.5 * points.weight))


def predicted_m(followed: FlowResult) -> float:
    """How far from the origin the camera should be."""
    return float(jnp.linalg.norm(followed.predicted.translation()))


def test_types_may_be_named_as_in_numpy() -> None:
    camera = jaxslam.Camera.load("tum_fr1")
    for dtype in ("float32", np.float32, jnp.float32, np.dtype(np.float32)):
        state = init_state(24, 32, SMALL, image_dtype="uint8", dtype=dtype)
        intrinsics: Intrinsics = track_params(camera, TrackConfig(), dtype).sensor.intrinsics
        assert state.twist.dtype == intrinsics.fx.dtype == np.float32
    assert halved(state).points.weight.tolist() == [0.5] * 4


def test_words_for_every_code() -> None:
    assert all(TrackReason(code).text for code in range(1, len(TrackReason)))
    assert [TrackReason.NO_DEPTH, TrackReason.BAD_TIME, TrackReason.NO_CORNERS] == [5, 6, 7]


def test_index_is_whole() -> None:
    """Each name is the one of its module, and no submodule hides it."""
    assert callable(enable_compile_cache)
    for name in ("follow_points", "track_followed", "track_step", "init_state"):
        assert getattr(jaxslam, name).__module__ == "jaxslam.tracking.step"
