"""What `track_step` refuses while it is traced, and how it says so; nothing here is compiled."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxlie import SE3
from small_scene import HEIGHT, PLAN, TRACK, WIDTH, clip, new_state, params, stacked

from jaxslam import FlowPlan, LevelPlan, TrackParams, follow_points, init_state, rollout, track_clips, track_followed
from jaxslam.config.loading import load_config
from jaxslam.dynamics import CueResult
from jaxslam.dynamics.object_motion import MotionPlan
from jaxslam.errors import ConfigError, FrameError
from jaxslam.sensors.frame_arrays import FrameArrays, check_gray_range
from jaxslam.tracking.cue_registry import with_cue_params, with_cues
from jaxslam.tracking.from_config import track_params
from jaxslam.tracking.state import TrackPlan, TrackState
from jaxslam.tracking.state_updates import apply_map_correction, drop_points, load_keyframe, reset_at_pose
from jaxslam.tracking.step import track_step
from jaxslam.tracking.step_checks import check_cue_result

SIZE = (HEIGHT, WIDTH)
USD = load_config("usd").dynamics
SENSOR = params().sensor
FOUR = SENSOR._replace(intrinsics=SENSOR.intrinsics._replace(distortion=jnp.zeros(4)))
INTEGER, BOOL = (SENSOR._replace(readout_s=jnp.ones((), dtype)) for dtype in (jnp.int32, bool))


@pytest.fixture(scope="module")
def frame() -> FrameArrays:
    return jax.tree.map(lambda array: array[0], stacked(clip().frames[:1]))


def refused(
    error: type[Exception], message: str, frame: FrameArrays, *, state: Any = None, given: Any = None, plan: Any = PLAN
) -> None:
    """Both parts of the step refuse it, with the whole of the message."""
    state, given = new_state() if state is None else state, params() if given is None else given
    followed: Any = None
    for call in (
        lambda: track_step(state, frame, given, plan),
        lambda: track_followed(state, frame, followed, given, plan),
    ):
        with pytest.raises(error, match=f"^{re.escape(message)}"):
            call()


class TestFrame:
    @pytest.mark.parametrize("field", ["depth", "ignore", "right", "movable"])
    def test_of_another_size(self, frame: FrameArrays, field: str) -> None:
        dtype = {"depth": np.float32, "ignore": np.bool_}.get(field, np.uint8)
        other: Any = frame._replace(**{field: jnp.zeros((2 * HEIGHT, 2 * WIDTH), dtype)})
        refused(ValueError, f"frame.{field}: expected (120, 160) as frame.image, got (240, 320)", other)

    @pytest.mark.parametrize("shape", [(HEIGHT, WIDTH, 3), (12, HEIGHT, WIDTH)], ids=["color", "clip"])
    def test_image_that_is_not_one_gray_one(self, frame: FrameArrays, shape: tuple[int, ...]) -> None:
        other = frame._replace(image=jnp.zeros(shape, jnp.uint8))
        refused(ValueError, f"frame.image: expected one gray image (h, w), got {shape}", other)

    @pytest.mark.parametrize(
        ("field", "value", "message"),
        [
            ("image", np.zeros(SIZE, np.int32), "image: expected uint8 or a floating-point type, got int32"),
            ("image", None, "image: expected an array (h, w), got NoneType"),
            ("depth", np.zeros(SIZE, np.uint16), "depth: expected float32 as the state, got uint16"),
            ("depth", np.zeros(SIZE, np.float16), "depth: expected float32 as the state, got float16"),
            (
                "ignore",
                np.zeros(SIZE, np.uint8),
                "ignore: expected bool, or float32 as the state from 0 to 1, got uint8",
            ),
            ("ignore", np.zeros(SIZE, np.float16), "ignore: expected bool, or float32 as the state from 0 to 1, got"),
            ("ignore", None, "ignore: expected an array as frame.image, got NoneType"),
            ("right", np.zeros(SIZE, np.float32), "right: expected uint8 as frame.image, got float32"),
            ("movable", np.zeros(SIZE, np.float32), "movable: expected uint8, got float32"),
            ("dt_s", jnp.zeros((), jnp.int32), "dt_s: expected float32 as the state, got int32"),
        ],
    )
    def test_of_another_type(self, frame: FrameArrays, field: str, value: Any, message: str) -> None:
        refused(TypeError, f"frame.{message}", frame._replace(**{field: value}))

    def test_times_of_a_whole_clip(self, frame: FrameArrays) -> None:
        refused(ValueError, "frame.dt_s: expected () as the state, got (3,)", frame._replace(dt_s=jnp.zeros(3)))

    def test_without_labels_for_a_plan_with_motion(self, frame: FrameArrays) -> None:
        plan, given = with_cues(PLAN, USD), with_cue_params(params(), USD)
        state = init_state(HEIGHT, WIDTH, plan)
        message = "frame.movable: expected numbers of what may move for a plan with `motion`, got None"
        refused(ValueError, message, frame, state=state, given=given, plan=plan)

    def test_another_class(self) -> None:
        other: Any = clip().frames[0]
        refused(TypeError, "frame: expected FrameArrays, got Frame", other)


class TestGrayValues:
    def test_from_0_to_1(self, frame: FrameArrays) -> None:
        """A tracer has no values: the step then says `NO_CORNERS`."""
        dim = frame._replace(image=frame.image.astype(jnp.float32) / 255)
        most = float(dim.image.max())
        message = f"frame.image: expected gray values from 0 to 255, got {float(dim.image.min()):.3g} to {most:.3g}"
        refused(ValueError, message, dim, state=new_state(image_dtype=np.float32))

    @pytest.mark.parametrize("image", [np.zeros(SIZE), np.full(SIZE, 1.5), np.full(SIZE, np.nan), np.ones(SIZE, int)])
    def test_that_may_be_right(self, image: np.ndarray) -> None:
        """Black, dim, damaged, or whole numbers."""
        check_gray_range("image", image)

    def test_clips(self) -> None:
        dim = stacked(clip().frames[:2], image_dtype=np.float32)
        arrays: Any = jax.device_get(dim._replace(image=dim.image / 255))
        with pytest.raises(FrameError, match="clips: image of clip 1: expected gray values from 0 to 255, got"):
            track_clips([arrays._replace(image=arrays.image * 255), arrays], params(), PLAN)


class TestSoftMasks:
    @pytest.mark.parametrize(("value", "got"), [(255.0, "0 to 255"), (-0.5, "-0.5 to 0"), (np.nan, "nan to nan")])
    def test_outside_0_to_1(self, frame: FrameArrays, value: float, got: str) -> None:
        ignore = np.zeros(SIZE, np.float32)
        ignore[3, 4] = value
        message = f"frame.ignore: expected values from 0 (trusted) to 1 (ignored), got {got}"
        refused(ValueError, message, frame._replace(ignore=jnp.asarray(ignore)))

    def test_of_clips(self) -> None:
        soft = stacked(clip().frames[:2])
        arrays: Any = jax.device_get(soft._replace(ignore=jnp.full(soft.ignore.shape, 2.0)))
        with pytest.raises(FrameError, match=r"clips: ignore of clip 0: expected values from 0 \(trusted\) to 1"):
            track_clips([arrays], params(), PLAN)
        with pytest.raises(ValueError, match=r"clip\.ignore: expected values from 0 \(trusted\) to 1"):
            rollout(new_state(), arrays, params(), PLAN)


class TestState:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"num_points": 64}, "points.uv: expected (2, 128) for the plan and the frame, got (2, 64)"),
            ({"num_levels": 2}, "pyramid.levels[2]: expected float32 (62, 72) for the plan, got nothing"),
            ({"num_levels": 4}, "pyramid.levels[3]: expected nothing there for the plan, got an array"),
            ({"num_keyframes": 12}, "keyframes.images: expected (7, 120, 160) for the plan and frame.image, got (16,"),
            ({"num_reloaded": 0}, "keyframes.images: expected (7, 120, 160) for the plan and frame.image, got (3,"),
            ({"regions": with_cues(PLAN, load_config().dynamics).regions}, "regions.centers: expected (3, 0) for"),
            ({"motion": with_cues(PLAN, USD).motion}, "motion.stillness: expected (0,) for the plan and the frame"),
        ],
        ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
    )
    def test_of_another_plan(self, frame: FrameArrays, changes: dict[str, Any], message: str) -> None:
        state = init_state(HEIGHT, WIDTH, PLAN._replace(**changes))
        refused(ValueError, f"state.{message}", frame, state=state)

    def test_of_another_size(self, frame: FrameArrays) -> None:
        message = (
            "state.keyframes.images: expected (7, 120, 160) for the plan and frame.image, got (7, 160, 120);"
            " make the state with init_state(120, 160, plan, image_dtype=uint8, dtype=float32)"
        )
        refused(ValueError, message, frame, state=init_state(WIDTH, HEIGHT, PLAN))

    def test_of_another_type_of_image(self, frame: FrameArrays) -> None:
        """Keyframes of whole numbers would hold 0.9 as 0, and pass on no derivative."""
        floating = frame._replace(image=frame.image.astype(jnp.float32))
        message = "state.keyframes.images: expected float32 as frame.image, got uint8; make the state with init_state("
        refused(TypeError, message, floating)

    def test_with_points_in_whole_numbers(self, frame: FrameArrays) -> None:
        state = new_state()
        state = state._replace(points=state.points._replace(uv=state.points.uv.astype(jnp.int32)))
        refused(
            TypeError, "state.points.uv: expected float32 for the plan and the frame, got int32", frame, state=state
        )

    def test_another_class(self, frame: FrameArrays) -> None:
        refused(TypeError, "state: expected TrackState, got tuple", frame, state=tuple(new_state()))


class TestParams:
    @pytest.mark.parametrize(
        ("changes", "error", "message"),
        [
            ({"pixel_sigma": jnp.ones(3)}, ValueError, "pixel_sigma: expected () as the state, got (3,)"),
            ({"sensor": INTEGER}, TypeError, "sensor.readout_s: expected float32 as the state, got int32"),
            ({"sensor": BOOL}, TypeError, "sensor.readout_s: expected float32 as the state, got bool"),
            ({"pixel_sigma": None}, TypeError, "pixel_sigma: expected float32 () as the state, got NoneType"),
            ({"sensor": FOUR}, ValueError, "sensor.intrinsics.distortion: expected (5,) as the state, got (4,)"),
            ({"cues": (jnp.ones(()),)}, ValueError, "cues: expected 0, one for each of plan.cues, got 1"),
        ],
    )  # fmt: skip
    def test_bad_ones(self, frame: FrameArrays, changes: dict[str, Any], error: type[Exception], message: str) -> None:
        refused(error, f"params.{message}", frame, given=params()._replace(**changes))

    def test_cues_without_parameters(self, frame: FrameArrays) -> None:
        plan = with_cues(PLAN, load_config("rts").dynamics)
        message = (
            "params.cues: expected 2, one for each of plan.cues, got 0; `with_cue_params` adds those of the settings"
        )
        refused(ValueError, message, frame, state=init_state(HEIGHT, WIDTH, plan), plan=plan)

    def test_motion_without_parameters(self, frame: FrameArrays) -> None:
        plan, labeled = with_cues(PLAN, USD), frame._replace(movable=jnp.zeros(SIZE, jnp.uint8))
        state = init_state(HEIGHT, WIDTH, plan)
        refused(TypeError, "params.motion: expected MotionParams, got NoneType", labeled, state=state, plan=plan)

    def test_another_class(self, frame: FrameArrays) -> None:
        refused(TypeError, "params: expected TrackParams, got TrackConfig", frame, given=TRACK)

    def test_python_numbers_will_do(self, frame: FrameArrays) -> None:
        """They have the type of what they are computed with."""
        given: Any = params()._replace(pixel_sigma=1.0, outlier_px=20, restart_after=5, weak_inliers=30)
        jax.eval_shape(partial(track_step, plan=PLAN), new_state(), frame._replace(dt_s=0.03), given)


class TestPrecision:
    """One floating-point type for state, parameters and frames; float32 wherever none is asked for."""

    @pytest.mark.slow
    def test_mixed(self, frame: FrameArrays) -> None:
        with jax.enable_x64(True):
            state, given, double = new_state(np.float64), params(np.float64), stacked(clip().frames[:1], np.float64)
            double = jax.tree.map(lambda array: array[0], double)
            refused(TypeError, "frame.depth: expected float64 as the state, got float32", frame, state=state)
            refused(
                TypeError,
                "params.sensor.intrinsics.fx: expected float64 as the state, got float32",
                double,
                state=state,
            )
            refused(TypeError, "frame.depth: expected float32 as the state, got float64", double, given=given)
            plan, dynamics = with_cues(PLAN, load_config().dynamics), load_config().dynamics
            state = init_state(HEIGHT, WIDTH, plan, dtype="float64")
            mixed = with_cue_params(given, dynamics, "float32")
            message = "params.cues[0].times_mean: expected float64 as the state, got float32"
            refused(TypeError, message, double, state=state, given=mixed, plan=plan)
            jax.eval_shape(partial(track_step, plan=plan), state, double, with_cue_params(given, dynamics))

    @pytest.mark.parametrize("dtype", ["float64", np.float64, jnp.float64, np.dtype("float64")])
    def test_named_in_any_way(self, dtype: Any) -> None:
        with jax.enable_x64(True):
            assert init_state(HEIGHT, WIDTH, PLAN, dtype=dtype).twist.dtype == np.float64
            assert track_params(clip().camera, TRACK, dtype).pixel_sigma.dtype == np.float64
            assert init_state(HEIGHT, WIDTH, PLAN).twist.dtype == params().pixel_sigma.dtype == np.float32

    def test_that_cannot_be(self) -> None:
        for make in (partial(init_state, HEIGHT, WIDTH, PLAN), partial(track_params, clip().camera, TRACK)):
            with pytest.raises(TypeError, match="dtype: expected float32 while jax_enable_x64 is off, got float64"):
                make(dtype="float64")
            with pytest.raises(TypeError, match="dtype: expected a floating-point type, got int32"):
                make(dtype=jnp.int32)

    def test_exact_needs_float64(self, frame: FrameArrays) -> None:
        message = "plan.flow.finest.tolerance: expected state, parameters and frames in float64 for searches that go on"
        refused(TypeError, message, frame, plan=PLAN.exact())


class TestPlan:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"cell_px": 11}, "cell_px: expected an even number, at least 2, got 11"),
            ({"num_levels": 1}, "num_levels: expected at least 2, got 1"),
            ({"num_sources": 8}, "num_sources: expected at most num_keyframes + num_reloaded, 7, got 8"),
            ({"new_points": "sometimes"}, "new_points: expected one of ('always', 'keyframes'), got 'sometimes'"),
            ({"balance_regions": True}, "regions: expected a RegionPlan for balance_regions, got None"),
            ({"pose_tolerance": 0.0}, "pose_tolerance: expected more than 0, or None, got 0.0"),
            ({"look_up": LevelPlan(14, 8, 0.05)}, "look_up.window: expected an odd number, got 14"),
            ({"flow": FlowPlan(middle=LevelPlan(10, 5, 0.2))}, "flow.middle.window: expected an odd number, got 10"),
            ({"flow": FlowPlan(seeds=-1)}, "flow.seeds: expected at least 0, got -1"),
            ({"motion": MotionPlan(dense_cell_px=13)}, "motion.dense_cell_px: expected an even number"),
        ],
    )  # fmt: skip
    def test_parts_that_do_not_go_together(self, frame: FrameArrays, changes: dict[str, Any], message: str) -> None:
        plan = PLAN._replace(**changes)
        refused(ValueError, f"plan.{message}", frame, plan=plan)
        with pytest.raises(ValueError, match=re.escape(f"plan.{message}")):
            init_state(HEIGHT, WIDTH, plan)

    @pytest.mark.parametrize("key", ["track.cell_px", "dynamics.motion.dense_cell_px"])
    def test_settings_refuse_odd_cells(self, key: str) -> None:
        with pytest.raises(ConfigError, match=f"{key}: expected an integer >= 8 and <= 80 and a multiple of 2, got 11"):
            load_config(overrides=[f"{key}=11"])

    def test_another_class(self, frame: FrameArrays) -> None:
        refused(TypeError, "plan: expected TrackPlan, got TrackConfig", frame, plan=TRACK)


def _under_jit(call: Callable[..., Any], *arguments: Any) -> None:
    jax.jit(call).lower(*arguments)


def _under_scan(call: Callable[..., Any], state: TrackState, frame: FrameArrays, given: TrackParams) -> None:
    lax.scan(lambda s, f: call(s, f, given), state, jax.tree.map(lambda a: a[None], frame))


def _under_vmap(call: Callable[..., Any], *arguments: Any) -> None:
    jax.vmap(call)(*jax.tree.map(lambda a: jnp.asarray(a)[None], arguments))


def _under_grad(call: Callable[..., Any], state: TrackState, frame: FrameArrays, given: TrackParams) -> None:
    jax.grad(lambda given: call(state, frame, given)[1].residual_px)(given)


@pytest.mark.parametrize("under", [_under_jit, _under_scan, _under_vmap, _under_grad, jax.eval_shape])
def test_under_transformations(frame: FrameArrays, under: Callable[..., Any]) -> None:
    """Shapes are those of one frame there too."""
    other = frame._replace(depth=jnp.zeros((HEIGHT // 2, WIDTH // 2)))
    with pytest.raises(ValueError, match=re.escape("frame.depth: expected (120, 160) as frame.image, got (60, 80)")):
        under(partial(track_step, plan=PLAN), new_state(), other, params())


def test_points_followed_by_another_plan(frame: FrameArrays) -> None:
    """Made abstract: only shapes are looked at."""
    followed = jax.eval_shape(partial(follow_points, plan=PLAN), new_state(), frame, params())
    call = partial(track_followed, plan=PLAN)
    bad = followed._replace(uv=jax.ShapeDtypeStruct((2, 64), np.float32))
    with pytest.raises(ValueError, match=re.escape("followed_points.uv: expected (2, 128) for the plan and the frame")):
        jax.eval_shape(call, new_state(), frame, bad, params())
    with pytest.raises(TypeError, match="followed_points: expected FlowResult, got tuple"):
        jax.eval_shape(call, new_state(), frame, tuple(followed), params())


def test_verdict_that_is_not_of_every_point() -> None:
    good = CueResult(jnp.ones(5), jnp.ones(5), jnp.ones(5, bool))
    dtype = jnp.dtype(jnp.float32)
    check_cue_result("plan.cues[0]", good, 5, dtype)
    with pytest.raises(ValueError, match=re.escape("plan.cues[0].weight: expected (5,) for every point, got ()")):
        check_cue_result("plan.cues[0]", good._replace(weight=jnp.ones(())), 5, dtype)
    with pytest.raises(TypeError, match=re.escape("plan.cues[0].known: expected bool for every point, got float32")):
        check_cue_result("plan.cues[0]", good._replace(known=jnp.ones(5)), 5, dtype)


class TestEdits:
    """Changes to a state from outside."""

    def test_recalled_image_of_another_type_or_size(self) -> None:
        """A picture in floating point was cut off to whole numbers."""
        state, n = new_state(), PLAN.num_points
        rest = (jnp.zeros(7), jnp.zeros((2, n)), jnp.zeros((3, n)), jnp.zeros(n), jnp.zeros(n, jnp.int32))
        with pytest.raises(TypeError, match="image: expected uint8 as the keyframes of the state, got float32"):
            load_keyframe(state, jnp.int32(3), jnp.zeros(SIZE), *rest)
        with pytest.raises(
            ValueError, match=re.escape("image: expected (120, 160) as the keyframes of the state, got")
        ):
            load_keyframe(state, jnp.int32(3), jnp.zeros((60, 80), jnp.uint8), *rest)
        few = (*rest[:1], jnp.zeros((2, 5)), *rest[2:])
        with pytest.raises(
            ValueError, match=re.escape("uv: expected (2, 128) as the keyframes of the state, got (2, 5)")
        ):
            load_keyframe(state, jnp.int32(3), jnp.zeros(SIZE, jnp.uint8), *few)

    def test_poses_and_numbers(self) -> None:
        state = new_state()
        with pytest.raises(ValueError, match=re.escape("T_new_old_keyframes: expected (7, 7) as the keyframes")):
            apply_map_correction(state, jnp.zeros(7), jnp.zeros((3, 7)))
        with pytest.raises(ValueError, match=re.escape("T_world_cam: expected (7,) as the state, got (4, 4)")):
            reset_at_pose(state, jnp.eye(4), jnp.zeros(6))
        with pytest.raises(ValueError, match=re.escape("twist: expected (6,) as the state, got (3,)")):
            reset_at_pose(state, jnp.zeros(7), jnp.zeros(3))
        with pytest.raises(TypeError, match="ids: expected int32, got float32"):
            drop_points(state, jnp.zeros(3))

    def test_first_pose_that_is_no_pose(self) -> None:
        matrix: Any = jnp.eye(4)
        with pytest.raises(TypeError, match=f"T_world_cam: expected {SE3.__name__}, got "):
            init_state(HEIGHT, WIDTH, TrackPlan(), T_world_cam=matrix)
