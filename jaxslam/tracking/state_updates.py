"""Update the tracker's state from the map: corrections, loaded keyframes, removed points, and restarts."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxlie import SE3
from jaxslam_kernels.se3 import compose, to_world
from jaxslam_kernels.types import Code, Flag, Pixels, Points, Weights
from jaxtyping import Array, Bool, Float, Int, Num

from jaxslam.tracking.state import TrackPhase, TrackState
from jaxslam.tracking.step_checks import check_array


def apply_map_correction(
    state: TrackState, T_new_old: Float[Array, "7"], T_new_old_keyframes: Float[Array, "k 7"]
) -> TrackState:
    """Apply a correction of the map to the state: everything moves rigidly with its keyframe.

    Args:
        state: The state.
        T_new_old: `(7,)` correction at the camera, `wxyz_xyz`, applied to its pose and the tracked points.
        T_new_old_keyframes: `(k, 7)` correction at each keyframe of the state.

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
    """Load a keyframe of the map into a slot of the state, so that its points are matched again.

    Args:
        state: The state.
        slot: Slot to replace, at least `num_keyframes` so that new keyframes do not overwrite it.
        image: `(h, w)` image of the keyframe.
        T_world_cam: `(7,)` pose of the keyframe, `wxyz_xyz`.
        uv: `(2, n)` positions of the points in the distorted image, pixels; `n` is the number of tracked points.
        X_world: `(3, n)` positions of the points in the world, meters.
        weight: `(n,)` weights of the points; 0 for a slot without a point.
        id: `(n,)` ids of the points.

    Raises:
        ValueError: While tracing, if a shape differs from that of the keyframes of the state.
        TypeError: While tracing, if a type differs: a floating-point image does not fit into integer images.
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
    """Drop points from the state: they are no longer tracked, and no longer matched with keyframes.

    Args:
        state: The state.
        ids: `(m,)` ascending ids of the points; an id may occur more than once.

    Raises:
        ValueError: While tracing, if `ids` is not one-dimensional.
        TypeError: While tracing, if `ids` are not of the type of the ids in the state.
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


def reset_at_pose(
    state: TrackState, T_world_cam: Float[Array, "7"], twist: Float[Array, "6"], keep_keyframes: Flag | bool = False
) -> TrackState:
    """Reset a lost tracker at a pose and a velocity: the next step starts there at once.

    Keyframes of the map can be loaded again with `load_keyframe`.

    Args:
        state: The state.
        T_world_cam: `(7,)` pose to start from, `wxyz_xyz`.
        twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s; 0 if it is not known.
        keep_keyframes: Whether to keep the keyframes: only where their poses relative to the new start are known.

    Raises:
        ValueError: While tracing, if the pose or the velocity has another shape.
        TypeError: While tracing, if one of them is not of the type of the state.
    """
    check_array("T_world_cam", T_world_cam, (7,), state.twist.dtype, " as the state")
    check_array("twist", twist, (6,), state.twist.dtype, " as the state")
    return state._replace(
        T_world_cam=SE3(T_world_cam),
        twist=twist,
        points=state.points._replace(valid=jnp.zeros_like(state.points.valid)),
        keyframes=state.keyframes._replace(weight=jnp.where(keep_keyframes, state.keyframes.weight, 0)),
        phase=jnp.full_like(state.phase, TrackPhase.START),
    )
