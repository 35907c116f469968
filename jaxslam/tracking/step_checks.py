"""Validate the arguments of the tracking step: shapes, types and counts.

The checks run while a program is traced, so compiled code contains none of them. A wrong shape or value raises a
`ValueError`, a wrong type a `TypeError`; the message names the argument, the expected value and the given one.
"""

from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxlie import SE3
from jaxslam_kernels.flow.lk_flow import FlowPlan
from jaxslam_kernels.pose.pose_cost import PosePrior

from jaxslam.dynamics.cue import CueResult
from jaxslam.dynamics.object_motion import MotionParams
from jaxslam.sensors.frame_arrays import FrameArrays, check_gray_range, check_mask_range
from jaxslam.tracking.state import TrackParams, TrackPlan, TrackState

if TYPE_CHECKING:
    from jaxslam.tracking.step import FlowResult

_STATE_DTYPE = " as the state"
_FINEST = float(jnp.finfo(jnp.float32).eps)


def check_step(state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan) -> None:
    """Check that the arguments of the step are consistent.

    `check_state` checks the state, and `check_cues` the parameters of cues.

    Raises:
        ValueError: If a shape does not fit the image, the parts of the plan do not go together, or an image that is no
            tracer has gray values from 0 to 1.
        TypeError: If an argument is of another class, or its arrays are of another type than the state's.
    """
    for name, value, cls in (("state", state, TrackState), ("frame", frame, FrameArrays), ("plan", plan, TrackPlan)):
        _check_class(name, value, cls)
    dtype = _state_dtype(state)
    check_plan(plan)
    _check_precision(plan, dtype)
    _check_frame(frame, dtype)
    _check_class("params", params, TrackParams)
    _check_numbers("params", params._replace(cues=(), motion=None), dtype)


def check_cues(state: TrackState, frame: FrameArrays, params: TrackParams, plan: TrackPlan) -> None:
    """Check the parameters of the plan's cues and `motion`, which `follow_points` does not need.

    Raises:
        ValueError: If there are not as many parameters of cues as cues, or no numbers of what may move.
        TypeError: If parameters are of another class or type.
    """
    dtype = _state_dtype(state)
    if len(params.cues) != len(plan.cues):
        raise ValueError(
            f"params.cues: expected {len(plan.cues)}, one for each of plan.cues, got {len(params.cues)};"
            " `with_cue_params` adds those of the settings"
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path(params.cues):
        # A cue may have arrays of any shape, whole numbers, and what is no array.
        if jnp.issubdtype(getattr(leaf, "dtype", np.bool_), jnp.floating):
            check_array(f"params.cues{jax.tree_util.keystr(path)}", leaf, np.shape(leaf), dtype, _STATE_DTYPE)
    if plan.motion is not None:
        _check_class("params.motion", params.motion, MotionParams)
        _check_numbers("params.motion", params.motion, dtype)
        if frame.movable is None:
            raise ValueError("frame.movable: expected numbers of what may move for a plan with `motion`, got None")


def check_array(name: str, value: object, shape: tuple[int, ...], dtype: DTypeLike | None, like: str = "") -> None:
    """Check the shape and the type of an array.

    Args:
        name: Name of the array in the message, such as `frame.depth`.
        value: The given array. A Python number counts as having the expected type, as in JAX arithmetic.
        shape: The shape it must have.
        dtype: The type it must have; any if not given.
        like: Suffix of the message that says what the array must match, such as ` as frame.image`.

    Raises:
        ValueError: If the shape is another one.
        TypeError: If the type is another one, or it is no array.
    """
    try:
        got = jax.typeof(value)
    except TypeError:
        expected = "an array" if dtype is None else f"{jnp.dtype(dtype)} {shape}"
        raise TypeError(f"{name}: expected {expected}{like}, got {type(value).__name__}") from None
    if got.shape != shape:
        raise ValueError(f"{name}: expected {shape}{like}, got {got.shape}")
    if dtype is not None and not _fits(got, jnp.dtype(dtype)):
        raise TypeError(f"{name}: expected {jnp.dtype(dtype)}{like}, got {got.dtype}")


def _fits(got: Any, dtype: jnp.dtype) -> bool:
    """Return whether an array has a type, or is a Python number that converts to it."""
    kinds = (jnp.floating, jnp.integer) if jnp.issubdtype(dtype, jnp.floating) else (jnp.integer,)
    return got.dtype == dtype or (got.weak_type and any(jnp.issubdtype(got.dtype, kind) for kind in kinds))


def _check_class(name: str, value: object, cls: type) -> None:
    if not isinstance(value, cls):
        raise TypeError(f"{name}: expected {cls.__name__}, got {type(value).__name__}")


def _state_dtype(state: TrackState) -> jnp.dtype:
    """Return the floating-point type of a state: the type of its twist."""
    dtype = jax.typeof(state.twist).dtype
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"state.twist: expected a floating-point type, got {dtype}")
    return dtype


def check_state(state: TrackState, expected: TrackState) -> None:
    """Check that a state was made for this plan, image size and type.

    Args:
        state: The state.
        expected: Shapes and types, as `jax.eval_shape` gives them, of what `init_state` makes for plan and frame.

    Raises:
        ValueError: If a shape is another one, or there are more or fewer arrays.
        TypeError: If a type is another one.
    """
    kept = expected.keyframes.images
    height, width = kept.shape[1:]
    reference_keyframe = f"init_state({height}, {width}, plan, image_dtype={kept.dtype}, dtype={expected.twist.dtype})"
    try:
        _check_images(state, expected)
        _check_like("state", state, expected)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{error}; make the state with {reference_keyframe}") from None


def _check_images(state: TrackState, expected: TrackState) -> None:
    """Check the images of keyframes first: only they have exactly the shape and type of the frame's image."""
    kept, images = expected.keyframes.images, state.keyframes.images
    check_array("state.keyframes.images", images, kept.shape, None, " for the plan and frame.image")
    check_array("state.keyframes.images", images, kept.shape, kept.dtype, " as frame.image")


def _check_like(name: str, given: Any, expected: Any) -> None:
    """Check that a pytree has the same structure, shapes and types as another one."""
    wanted, came = (dict(jax.tree_util.tree_leaves_with_path(tree)) for tree in (expected, given))
    for path, leaf in wanted.items():
        at = name + jax.tree_util.keystr(path)
        if path not in came:
            raise ValueError(f"{at}: expected {leaf.dtype} {leaf.shape} for the plan, got nothing")
        check_array(at, came[path], leaf.shape, leaf.dtype, " for the plan and the frame")
    more = next((path for path in came if path not in wanted), None)
    if more is not None:
        raise ValueError(f"{name}{jax.tree_util.keystr(more)}: expected nothing there for the plan, got an array")
    if jax.tree.structure(given) != jax.tree.structure(expected):
        raise ValueError(f"{name}: expected {jax.tree.structure(expected)}, got {jax.tree.structure(given)}")


def _check_frame(frame: FrameArrays, dtype: jnp.dtype) -> None:
    image = _checked_image(frame)
    check_array("frame.depth", frame.depth, image.shape, None, " as frame.image")
    check_array("frame.depth", frame.depth, image.shape, dtype, _STATE_DTYPE)
    _check_ignore(frame, image.shape, dtype)
    scalars = ("dt_s", "depth_delay_s", *(() if frame.readout_sign is None else ("readout_sign",)))
    for name in scalars:
        check_array(f"frame.{name}", getattr(frame, name), (), dtype, _STATE_DTYPE)
    if frame.right is not None:
        check_array("frame.right", frame.right, image.shape, image.dtype, " as frame.image")
    if frame.movable is not None:
        check_array("frame.movable", frame.movable, image.shape, None, " as frame.image")
        check_array("frame.movable", frame.movable, image.shape, np.uint8)


def _check_ignore(frame: FrameArrays, shape: tuple[int, ...], dtype: jnp.dtype) -> None:
    """Check that the mask of ignored pixels is `bool`, or floating point from 0 to 1."""
    check_array("frame.ignore", frame.ignore, shape, None, " as frame.image")
    got = jax.typeof(frame.ignore).dtype
    if got not in (np.bool_, dtype):
        raise TypeError(f"frame.ignore: expected bool, or {dtype}{_STATE_DTYPE} from 0 to 1, got {got}")
    if not isinstance(frame.ignore, Tracer):
        check_mask_range("frame.ignore", frame.ignore)


def _checked_image(frame: FrameArrays) -> Any:
    """Return the shape and type of the image, after checking them."""
    try:
        image = jax.typeof(frame.image)
    except TypeError:
        raise TypeError(f"frame.image: expected an array (h, w), got {type(frame.image).__name__}") from None
    if image.ndim != 2:
        raise ValueError(
            f"frame.image: expected one gray image (h, w), got {image.shape};"
            " make color gray, and scan over the frames of a clip"
        )
    if image.dtype != np.uint8 and not jnp.issubdtype(image.dtype, jnp.floating):
        raise TypeError(f"frame.image: expected uint8 or a floating-point type, got {image.dtype}")
    if not isinstance(frame.image, Tracer):
        check_gray_range("frame.image", frame.image)
    return image


def _check_numbers(name: str, params: Any, dtype: jnp.dtype) -> None:
    """Check that parameters are scalars of a type; `distortion` has five numbers, and cues are skipped."""
    for field, value in params._asdict().items():
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            _check_numbers(f"{name}.{field}", value, dtype)
        elif field not in ("cues", "motion"):
            check_array(f"{name}.{field}", value, (5,) if field == "distortion" else (), dtype, _STATE_DTYPE)


def check_followed(followed: "FlowResult", expected: "FlowResult") -> None:
    """Check that a result was computed with this plan, image size and type, as `check_state` does; not its prior."""
    _check_class("followed_points", followed, type(expected))
    _check_like("followed_points", followed._replace(prior=None), expected)


def check_cue_result(name: str, result: CueResult, num_points: int, dtype: jnp.dtype) -> None:
    """Check that a cue result has a value of the right type for every point.

    Raises:
        ValueError: If a shape is wrong.
        TypeError: If it is not a `CueResult`, or a type is wrong.
    """
    _check_class(name, result, CueResult)
    for field, of in (("weight", dtype), ("evidence", dtype), ("known", np.bool_)):
        check_array(f"{name}.{field}", getattr(result, field), (num_points,), of, " for every point")


_MIN = {
    "num_points": 1, "num_levels": 2, "num_keyframes": 1, "num_reloaded": 0, "num_sources": 0, "points_per_source": 1,
    "num_hypotheses": 1, "pose_steps": 1,
}  # fmt: skip


def check_plan(plan: TrackPlan) -> None:
    """Check that the parts of a plan are consistent.

    Raises:
        ValueError: If a number is too small, a tolerance is not positive, a side of cells is odd or one of a window
            even, a word is unknown, more keyframes are looked into than there are, or even votes lack regions.
    """
    for name, least in _MIN.items():
        if getattr(plan, name) < least:
            raise ValueError(f"plan.{name}: expected at least {least}, got {getattr(plan, name)}")
    if plan.pose_tolerance is not None and not plan.pose_tolerance > 0:
        raise ValueError(f"plan.pose_tolerance: expected more than 0, or None, got {plan.pose_tolerance}")
    for name, hint in get_type_hints(TrackPlan).items():
        if get_origin(hint) is Literal and getattr(plan, name) not in get_args(hint):
            raise ValueError(f"plan.{name}: expected one of {get_args(hint)}, got {getattr(plan, name)!r}")
    slots = plan.num_keyframes + plan.num_reloaded
    if plan.num_sources > slots:
        raise ValueError(
            f"plan.num_sources: expected at most num_keyframes + num_reloaded, {slots}, got {plan.num_sources}"
        )
    if plan.balance_regions and plan.regions is None:
        raise ValueError("plan.regions: expected a RegionPlan for balance_regions, got None")
    _check_sides(plan)


def _check_sides(plan: TrackPlan) -> None:
    """Check that cell sides are even, because corners are detected on the second level, and window sides odd."""
    cells = {"cell_px": plan.cell_px}
    if plan.motion is not None:
        cells["motion.dense_cell_px"] = plan.motion.dense_cell_px
    for name, side in cells.items():
        if side < 2 or side % 2:
            raise ValueError(f"plan.{name}: expected an even number, at least 2, got {side}")
    for name, flow in _flows(plan).items():
        if flow.seeds < 0:
            raise ValueError(f"plan.{name}.seeds: expected at least 0, got {flow.seeds}")
    for name, level in _levels(plan).items():
        if level.window < 1 or not level.window % 2:
            raise ValueError(f"plan.{name}.window: expected an odd number, got {level.window}")


def _flows(plan: TrackPlan) -> dict[str, FlowPlan]:
    return {"flow": plan.flow, "pair_flow": plan.pair_flow}


def _levels(plan: TrackPlan) -> dict[str, Any]:
    parts = ("coarsest", "middle", "finest")
    of_flows = {f"{name}.{part}": getattr(flow, part) for name, flow in _flows(plan).items() for part in parts}
    return {**of_flows, "look_up": plan.look_up}


def _check_precision(plan: TrackPlan, dtype: jnp.dtype) -> None:
    """Reject tolerances below the resolution of the type, with which no search would ever converge."""
    for name, level in _levels(plan).items():
        if level.tolerance < _FINEST and jnp.finfo(dtype).eps >= _FINEST:
            raise TypeError(
                f"plan.{name}.tolerance: expected state, parameters and frames in float64 for searches that go on to"
                f" {level.tolerance:g} px, as with TrackPlan.exact(), got {dtype}; turn on jax_enable_x64, and give"
                ' init_state, track_params and stack_frames dtype="float64"'
            )


def check_pose(name: str, pose: object) -> None:
    """Check that an argument is a pose, and not, for example, a matrix.

    Raises:
        TypeError: If it is no `jaxlie.SE3`.
    """
    _check_class(name, pose, SE3)


def check_prior(prior: PosePrior, dtype: DTypeLike) -> None:
    """Check that a prior is a pose with its `(6, 6)` information.

    Raises:
        ValueError: If the information has another shape.
        TypeError: If it is no `PosePrior`, or of another type than the state.
    """
    _check_class("prior", prior, PosePrior)
    check_pose("prior.T_world_cam", prior.T_world_cam)
    check_array("prior.information", prior.information, (6, 6), dtype, _STATE_DTYPE)
