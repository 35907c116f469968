"""Changes to the tracker's state from outside: what a map, once corrected, does to what is being tracked."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.se3 import compose, to_world
from jaxslam_kernels.types import Code, Pixels, Points, Weights
from jaxtyping import Array, Bool, Float, Int, Num

from jaxslam.tracking.state import TrackState
from jaxslam.tracking.step_checks import check_array


def apply_map_correction(
    state: TrackState, T_new_old: Float[Array, "7"], T_new_old_keyframes: Float[Array, "k 7"]
) -> TrackState:
    """The state after the world was corrected: everything moves rigidly with the keyframe it hangs on.

    Args:
        state: The state.
        T_new_old: Correction at the camera, `wxyz_xyz`: carries its pose and the points followed.
        T_new_old_keyframes: Correction at each keyframe of the state.

    Raises:
        ValueError: While tracing, if a shape does not fit the state.
        TypeError: While tracing, if a type is not that of the state.
    """
    now, keyframes = SE3(T_new_old), state.keyframes
    check_array("T_new_old", T_new_old, (7,), state.twist.dtype, " as the state")
    each = keyframes.T_world_cam.shape
    check_array("T_new_old_keyframes", T_new_old_keyframes, each, state.twist.dtype, " as the keyframes of the state")
    poses = jax.vmap(lambda correction, pose: compose(SE3(correction), SE3(pose)).wxyz_xyz)(
        T_new_old_keyframes, keyframes.T_world_cam
    )
    X_world = jax.vmap(lambda correction, X: to_world(SE3(correction), X))(T_new_old_keyframes, keyframes.X_world)
    return state._replace(
        T_world_cam=compose(now, state.T_world_cam),
        points=state.points._replace(
            X_world=to_world(now, state.points.X_world), X_anchor=to_world(now, state.points.X_anchor)
        ),
        keyframes=keyframes._replace(T_world_cam=poses, X_world=X_world),
    )


def load_keyframe(
    state: TrackState,
    slot: Code,
    image: Num[Array, "h w"],
    T_world_cam: Float[Array, "7"],
    uv: Pixels,
    X_world: Points,
    weight: Weights,
    id: Int[Array, " n"],
) -> TrackState:
    """The state with a keyframe of the map to look points up in, in place of what was in a slot.

    Args:
        state: The state.
        slot: Which slot, `num_keyframes` or more so that new keyframes leave it alone.
        image: The keyframe's picture.
        T_world_cam: Its pose, `wxyz_xyz`.
        uv: Points in it, pixels as seen; as many as the tracker follows.
        X_world: Where they are in the world, meters.
        weight: How much each counts, 0 for none.
        id: Numbers of the points.

    Raises:
        ValueError: While tracing, if a shape is not that of the keyframes of the state.
        TypeError: While tracing, if a type is not: a picture in floating point has no room in one of whole numbers.
    """
    put = lambda ring, new: lax.dynamic_update_index_in_dim(ring, new.astype(ring.dtype), slot, 0)
    keyframes = state.keyframes
    given = {"T_world_cam": T_world_cam, "uv": uv, "X_world": X_world, "weight": weight, "id": id}
    rings = keyframes._asdict()
    check_array("image", image, keyframes.images.shape[1:], keyframes.images.dtype, " as the keyframes of the state")
    for name, array in given.items():
        check_array(name, array, rings[name].shape[1:], rings[name].dtype, " as the keyframes of the state")
    return state._replace(
        keyframes=keyframes._replace(
            images=put(keyframes.images, image),
            T_world_cam=put(keyframes.T_world_cam, T_world_cam),
            uv=put(keyframes.uv, uv),
            X_world=put(keyframes.X_world, X_world),
            weight=put(keyframes.weight, weight),
            id=put(keyframes.id, id),
        )
    )


def drop_points(state: TrackState, ids: Int[Array, " m"]) -> TrackState:
    """The state without some points: they are followed no longer, and not looked up in keyframes.

    Args:
        state: The state.
        ids: `(m,)` their numbers, ascending; a number may come more than once.

    Raises:
        ValueError: While tracing, if they are not in one row.
        TypeError: While tracing, if they are not of the type of the numbers in the state.
    """
    check_array("ids", ids, (np.size(ids),), state.points.id.dtype)

    def among(numbers: Int[Array, "*shape"]) -> Bool[Array, "*shape"]:
        at = jnp.minimum(jnp.searchsorted(ids, numbers), ids.shape[0] - 1)
        return ids[at] == numbers

    points, keyframes = state.points, state.keyframes
    return state._replace(
        points=points._replace(valid=points.valid & ~among(points.id)),
        keyframes=keyframes._replace(weight=jnp.where(among(keyframes.id), 0, keyframes.weight)),
    )


def reset_at_pose(state: TrackState, T_world_cam: Float[Array, "7"]) -> TrackState:
    """The state of a tracker that is lost and begins anew at a pose: the next step starts there at once.

    Its keyframes are forgotten: nothing says how they lie to where it begins. Those that do can be `reloaded`.

    Args:
        state: The state.
        T_world_cam: `(7,)` the pose, `wxyz_xyz`.

    Raises:
        ValueError: While tracing, if the pose has another shape.
        TypeError: While tracing, if it is not of the type of the state.
    """
    check_array("T_world_cam", T_world_cam, (7,), state.twist.dtype, " as the state")
    return state._replace(
        T_world_cam=SE3(T_world_cam),
        twist=jnp.zeros_like(state.twist),
        points=state.points._replace(valid=jnp.zeros_like(state.points.valid)),
        keyframes=state.keyframes._replace(weight=jnp.zeros_like(state.keyframes.weight)),
        lost_frames=jnp.full_like(state.lost_frames, 2**20),
    )
