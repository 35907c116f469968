"""The state of the tracker before the first frame."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxlie import SE3
from jaxslam_kernels.counter_random import COUNTER_RANDOM, seed_words
from jaxslam_kernels.image.pyramid import build_pyramid
from jaxtyping import Array, Int, UInt32

from jaxslam.dynamics.object_motion import no_motion
from jaxslam.dynamics.regions import no_regions
from jaxslam.geometry.se3 import IDENTITY
from jaxslam.runtime.filled_arrays import filled
from jaxslam.runtime.floating_dtype import floating_dtype
from jaxslam.tracking.keyframe_ring import empty_keyframes
from jaxslam.tracking.motion_prediction import VelocityStatistics
from jaxslam.tracking.points import empty_points
from jaxslam.tracking.state import TrackPhase, TrackPlan, TrackState
from jaxslam.tracking.step_checks import check_plan, check_pose

DEFAULT_PLAN = TrackPlan()


def init_state(
    height: int,
    width: int,
    plan: TrackPlan = DEFAULT_PLAN,
    *,
    T_world_cam: SE3 | None = None,
    seed: int | Int[Array, ""] = 0,
    image_dtype: DTypeLike = jnp.uint8,
    dtype: DTypeLike = jnp.float32,
) -> TrackState:
    """Create the state before the first frame: the first frame given to `track_step` starts tracking.

    Args:
        height: Number of rows of the images.
        width: Number of columns of the images.
        plan: Array sizes and search settings, static.
        T_world_cam: Pose of the camera at the first frame; by default the origin of the world.
        seed: Seed of every random choice.
        image_dtype: Type of the images: `uint8`, or floating point to differentiate with respect to them. The step
            rejects other types, because keyframes hold images of this type.
        dtype: Floating-point type of everything else, equal to that of parameters and frames; float32 by default, also
            with `jax_enable_x64`.

    Raises:
        ValueError: If the parts of the plan are inconsistent, or the image is too small for its levels.
        TypeError: If `T_world_cam` is not a pose, or `dtype` is not a floating-point type or is float64 while
            `jax_enable_x64` is off.
    """
    check_plan(plan)
    dtype = floating_dtype(dtype)
    pose = SE3(jax.device_put(IDENTITY.astype(dtype))) if T_world_cam is None else T_world_cam
    check_pose("T_world_cam", pose)
    black = jax.ShapeDtypeStruct((height, width), dtype)
    pyramid = jax.eval_shape(partial(build_pyramid, num_levels=plan.num_levels), black)
    return TrackState(
        pyramid=jax.tree.map(lambda level: filled(level.shape, level.dtype), pyramid),  # black on all levels
        points=empty_points(plan.num_points, dtype),
        keyframes=empty_keyframes(height, width, plan, jnp.dtype(image_dtype), dtype),
        T_world_cam=SE3(pose.wxyz_xyz.astype(dtype)),
        twist=filled(6, dtype),
        velocity=VelocityStatistics(filled(2, dtype), filled(2, dtype)),
        elapsed_s=filled((), dtype),
        since_keyframe_s=filled((), dtype),
        since_keyframe=filled((), jnp.int32),
        phase=filled((), jnp.int32, TrackPhase.START),
        lost_frames=filled((), jnp.int32),
        frame=filled((), jnp.int32),
        next_id=filled((), jnp.int32),
        key=_key_data(seed),
        regions=no_regions(plan.regions, dtype),
        motion=no_motion(plan.motion, plan.num_points, dtype),
    )


def _key_data(seed: int | Int[Array, ""]) -> UInt32[Array, "2"]:
    if isinstance(seed, int):
        return jax.device_put(seed_words(seed))
    return jax.random.key_data(jax.random.key(seed, impl=COUNTER_RANDOM))


@lru_cache(maxsize=32)
def state_shapes(height: int, width: int, plan: TrackPlan, image_dtype: jnp.dtype, dtype: jnp.dtype) -> TrackState:
    """Return the shapes and types of a state for a plan and frames of a size and a type."""
    return jax.eval_shape(partial(init_state, height, width, plan, image_dtype=image_dtype, dtype=dtype))
