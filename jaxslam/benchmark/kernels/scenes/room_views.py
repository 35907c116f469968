"""Two frames of the rendered room, through which somebody walks, and points of it: what cues of a frame are given."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, SyntheticFrame
from jaxslam.dynamics.cue import CueInput
from jaxslam.geometry.se3 import compose, inverse, to_local, transform
from jaxslam.sensors.camera import Camera

_FRAME, _LATER = 60, 4  # in between, the camera moves by 4 cm, and the person, who hides a quarter of the picture, by 8
_NOISE_PX = 0.2
_SAME_SURFACE = 0.02
_AGREES_PX = 1.5  # as in the tracker


class RoomViews(NamedTuple):
    """Two frames, one after the other, with the truth; `empty` is the second without anybody in the room."""

    camera: Camera
    before: SyntheticFrame
    now: SyntheticFrame
    empty: SyntheticFrame


@cache
def room_views() -> RoomViews:
    """Rendered once a process, 640x480."""
    with jax.enable_x64(False):
        dataset = SyntheticDataset(SyntheticConfig(people=1))
        empty = SyntheticDataset(SyntheticConfig(people=0))
        return RoomViews(
            dataset.camera, dataset.render(_FRAME), dataset.render(_FRAME + _LATER), empty.render(_FRAME + _LATER)
        )


def followed_points(views: RoomViews, num_points: int) -> tuple[CueInput, np.ndarray]:
    """Points all over the first picture that are seen in the second, and `(num_points,)` which of them move.

    Poses are the true ones. A person who walks is carried on as a whole: limbs swing little meanwhile.
    """
    pixel, X_world, X_now, moves = _visible(views, num_points)
    noise = _NOISE_PX * np.random.default_rng(1).normal(size=(2, 2, num_points))
    exact, at_rest = (_seen_now(views, X)[0] for X in (X_now, X_world))
    _, (column, row) = in_picture(views.camera, exact)
    uv, every = exact + noise[1], np.ones(num_points, bool)
    fields: dict[str, Any] = {
        "uv_before": pixel + noise[0],
        "uv": uv,
        "followed": every,
        "masked": ~every,
        "agrees": np.linalg.norm(uv - at_rest, axis=0) < _AGREES_PX,
        "weight": np.ones(num_points),
        "depth_before": views.before.depth_m[pixel[1], pixel[0]],
        "depth": views.now.depth_m[row, column],
        "X_world": X_world,
        "X_anchor": X_world,
        "T_world_before": SE3(jnp.asarray(views.before.T_world_cam, jnp.float32)),
        "T_world_cam": SE3(jnp.asarray(views.now.T_world_cam, jnp.float32)),
        "intrinsics": views.camera.intrinsics(),
        "size": np.array([views.camera.width, views.camera.height]),
        "key": jax.random.key(0),
    }
    return jax.tree.map(_for_jax, CueInput(**fields)), moves


def back_projected(camera: Camera, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """`(3, n)` in the axes of a camera without lens distortion, of pixels `(2, n)` and depths `(n,)` in meters."""
    return np.stack([(uv[0] - camera.cx) / camera.fx, (uv[1] - camera.cy) / camera.fy, np.ones_like(depth)]) * depth


def projected(camera: Camera, X_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels `(2, n)` and depths `(n,)` of points `(3, n)` in front of a camera without lens distortion."""
    x, y, z = X_cam
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]), z


def in_picture(camera: Camera, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`(n,)` which pixels `(2, n)` are in the picture, and `(2, n)` column and row, of the nearest one in it."""
    size = np.array([[camera.width], [camera.height]])
    pixel = np.round(uv).astype(int)
    inside: Any = ((pixel >= 0) & (pixel < size)).all(axis=0)
    return inside, np.clip(pixel, 0, size - 1)


def _visible(views: RoomViews, num_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points that both pictures show: `(2, n)` pixels of the first, `(3, n)` where they are in the world, then and now,
    and `(n,)` which are on the person.
    """
    before, now = views.before, views.now
    v, u = np.unravel_index(np.random.default_rng(0).permutation(before.depth_m.size), before.depth_m.shape)
    X_cam = back_projected(views.camera, np.stack([u, v]), before.exact_depth_m[v, u])
    X_world, actor = transform(before.T_world_cam, X_cam), before.instance_mask[v, u]
    X_now = np.where(actor > 0, transform(_walked(views), X_world), X_world)
    uv, depth = _seen_now(views, X_now)
    inside, (column, row) = in_picture(views.camera, uv)
    same = np.abs(now.exact_depth_m[row, column] / depth - 1) < _SAME_SURFACE
    some = np.flatnonzero(inside & same & (now.instance_mask[row, column] == actor))[:num_points]
    return np.stack([u, v])[:, some], X_world[:, some], X_now[:, some], actor[some] > 0


def _seen_now(views: RoomViews, X_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return projected(views.camera, to_local(views.now.T_world_cam, X_world))


def _walked(views: RoomViews) -> np.ndarray:
    """`(7,)` the motion of the person in the world from the first frame to the second."""
    before, now = (frame.T_world_actor[0] for frame in (views.before, views.now))
    return compose(now, inverse(before))


def _for_jax(leaf: jax.Array | np.ndarray) -> jax.Array:
    """In single precision, if it is a number."""
    array = jnp.asarray(leaf)
    return array.astype(jnp.float32) if jnp.issubdtype(array.dtype, jnp.number) else array
