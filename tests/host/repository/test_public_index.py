"""What users import from `jaxslam`, used as they use it: pyright reads this file too."""

import inspect
from collections.abc import Iterator
from typing import Any, get_args, get_type_hints

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
    assert jaxslam.init_state.__module__ == "jaxslam.tracking.initial_state"
    for name in ("follow_points", "track_followed", "track_step"):
        assert getattr(jaxslam, name).__module__ == "jaxslam.tracking.step"


def classes_in(hint: Any) -> Iterator[type]:
    """All classes of jaxslam and its kernels in an annotation."""
    if isinstance(hint, type) and hint.__module__.partition(".")[0] in ("jaxslam", "jaxslam_kernels"):
        yield hint
    for part in hint if isinstance(hint, list) else get_args(hint):
        yield from classes_in(part)


def signatures(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The functions that a user calls through a public name: itself, or the methods and properties of a class."""
    if inspect.isfunction(value):
        yield name, value
    if not isinstance(value, type) or not value.__module__.startswith("jaxslam"):
        return
    for member, static in inspect.getmembers_static(value):
        function = static.fget if isinstance(static, property) else getattr(static, "__func__", static)
        written = inspect.isfunction(function) and function.__code__.co_filename != "<string>"  # not a dataclass's
        if written and (member in ("__init__", "__call__") or not member.startswith("_")):
            yield f"{name}.{member}", function


def test_types_of_signatures_are_exported() -> None:
    """Users can name every type that they pass or get, and the type of every field of what they get to read."""
    public = {name: getattr(jaxslam, name) for name in dir(jaxslam) if not name.startswith("_")}
    annotated = [pair for name, value in public.items() for pair in signatures(name, value)]
    annotated += [(kind.__name__, kind) for kind in (jaxslam.Map, jaxslam.FrameResult, TrackOutput, jaxslam.Evaluation)]
    assert len(annotated) > 80
    exported = list(public.values())
    missing = {
        f"{place}: {kind.__module__}.{kind.__name__}"
        for place, function in annotated
        for hint in get_type_hints(function).values()
        for kind in classes_in(hint)
        if kind not in exported
    }
    assert not missing
