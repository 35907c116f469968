"""The states of map points while the camera looks at them: on from frame to frame, ahead of the map.

The map is mapping's and never waited for. What the tracker has seen of its points since is kept beside it, by id, and
goes over with the next keyframe; once it comes back in a map, the map has it and it is forgotten here.

Source: Occlusion SLAM, algorithm 1. It looks at the points of one keyframe; a keyframe that is made while a person
stands there does not have the points behind. Those that are blocked are followed on here until they are seen again,
"in any future frame" (section 2.3), whatever keyframe the frames hang on.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.camera import to_pixels
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import DepthImage, Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Float32, Float64, Int8, Int64

from jaxslam.config.cue_sections import OcclusionConfig
from jaxslam.dynamics.occlusion import PointState, States, next_states, occluded_share, state_weights
from jaxslam.geometry.se3 import IDENTITY, to_local
from jaxslam.map.edit import with_states
from jaxslam.map.types import NONE, Map, has, rows, visibility
from jaxslam.runtime.compile_cache import SINGLE_THREAD
from jaxslam.runtime.padding import padded
from jaxslam.runtime.trace_cache import cached_trace
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.tracking.measurement import depth_sigma, measure, predict_pixels
from jaxslam.tracking.state import TrackParams

_DEPTH_SIGMAS, _DEPTH_SHARE = 4.2, 0.02
"""Difference of measured and expected depth from which a point is displaced: three standard deviations of the
difference of two measurements, and a share of the depth for errors of pose and calibration."""
_REACH_PX = 2
"""Around a point, all depth must be of one surface: at an edge, pixels of error in the pose would be one of depth."""
_MAX_BENT = 0.5
"""Share of the picture by which a lens moves a point at most: farther out, its polynomial may fold back inside."""
_MAX_BLOCKED = 512
"""Blocked points of earlier keyframes that are followed on; those of the latest, if there are more."""
_AS_IN_MAP = -1


class StateChanges(NamedTuple):
    """States that points have got since those handed over before.

    Attributes:
        number: Of these changes; it counts on.
        ids: `(c,)` of points, some of which may not be in the map any more.
        states: `(c,)` a `PointState` each.
    """

    number: int
    ids: Int64[np.ndarray, " c"]
    states: Int8[np.ndarray, " c"]


class _Columns(NamedTuple):
    """Points, padded to the size that the program is compiled for, where it finds them without a copy.

    Attributes:
        states: `(n,)` as they are now.
        X_keyframe: `(3, n)` where they are in the axes of the keyframe, meters.
        there: `(n,)` which slots hold a point,
        own: `(n,)` and which of them one that the keyframe saw.
    """

    states: States
    X_keyframe: Points
    there: Mask
    own: Mask


class _VisiblePoints(NamedTuple):
    """The points that are looked at, those of a keyframe first.

    Attributes:
        map: The map they are of.
        keyframe: The keyframe,
        submap: and its submap.
        ids: Of the points.
        columns: What is known of them.
    """

    map: Map
    keyframe: int
    submap: int
    ids: np.ndarray
    columns: _Columns


class PointStates:
    """Has the states of the points of the reference keyframe go on with every frame; of one thread."""

    def __init__(self, config: OcclusionConfig, params: TrackParams, slam_map: Map, most_points: int) -> None:
        """Begin with the states that a map has.

        Args:
            config: Settings.
            params: Camera and the errors of its depth.
            slam_map: To begin with.
            most_points: That a keyframe to come may see; those of the map may see more.
        """
        self._config, self._params = config, params
        by_feature = [len(keyframe.features.octave) for keyframe in slam_map.keyframes]
        tracked = np.bincount(
            slam_map.observations.keyframe[slam_map.observations.feature == NONE], minlength=slam_map.next_keyframe
        )
        most = max([most_points, *(np.array(by_feature, np.int64) + tracked[slam_map.ids]).tolist()])
        self._room = most + _MAX_BLOCKED
        self._state, self._change = np.zeros(0, np.int8), np.zeros(0, np.int64)
        self._number = 1
        self._shown: _VisiblePoints | None = None
        self.arrived(slam_map, 0)

    def compile(self, frame: FrameArrays) -> None:
        """Compile what a frame of this size needs."""
        nothing = np.zeros(0, bool)
        columns = self._columns(np.zeros(0, np.int8), np.zeros((3, 0), np.float32), nothing, nothing)
        jax.block_until_ready(self._after(columns, IDENTITY, np.zeros(6, np.float32), frame))

    def see(
        self, slam_map: Map, keyframe_id: int, T_keyframe_cam: np.ndarray, twist: np.ndarray, arrays: FrameArrays
    ) -> float:
        """Take in a frame whose pose is known.

        Args:
            slam_map: The map that arrived last.
            keyframe_id: The reference keyframe, of that map.
            T_keyframe_cam: `(7,)` where the frame was taken, in its axes.
            twist: `(6,)` velocity of the camera in its own axes.
            arrays: The frame, with what was not trusted in it.

        Returns:
            The share of the points of the keyframe that are OCCLUDED.
        """
        shown = self._points_of(slam_map, keyframe_id)
        after, counted = self._after(shown.columns, T_keyframe_cam, twist, arrays)
        num_changed, share = np.asarray(counted).tolist()
        if num_changed:
            states = np.asarray(after)
            changed = np.flatnonzero(states != np.asarray(shown.columns.states))
            ids = shown.ids[changed]
            self._state[ids], self._change[ids] = states[changed], self._number
            shown = shown._replace(columns=shown.columns._replace(states=after))
        self._shown = shown
        return share

    def weights(self, slam_map: Map, point_ids: np.ndarray) -> Float32[np.ndarray, " n"]:
        """How much points of the map that arrived last count beside each other, 1 on average.

        Only ratios matter to a pose; with that average, its covariance does not become less where many are OCCLUDED.
        """
        weights = state_weights(self._of(slam_map, point_ids), self._config.weight)
        return weights / weights.mean() if len(weights) else weights

    def handed_over(self) -> StateChanges:
        """What has changed since it was asked last, for mapping."""
        ids = np.flatnonzero((self._change == self._number) & (self._state != _AS_IN_MAP))
        changes = StateChanges(self._number, ids, self._state[ids])
        self._number += 1
        return changes

    def arrived(self, slam_map: Map, number: int) -> None:
        """Take in a new map, which has all changes up to a number."""
        more = slam_map.next_point - len(self._state)
        self._state = np.append(self._state, np.full(more, _AS_IN_MAP, np.int8))
        self._change = np.append(self._change, np.zeros(more, np.int64))
        self._state[self._change <= number] = _AS_IN_MAP

    def _of(self, slam_map: Map, point_ids: np.ndarray) -> np.ndarray:
        """The states of points as they are now."""
        ahead = self._state[point_ids]
        return np.where(ahead == _AS_IN_MAP, slam_map.points.state[rows(slam_map.points.ids, point_ids)], ahead)

    def _points_of(self, slam_map: Map, keyframe_id: int) -> _VisiblePoints:
        """What is looked at, anew for every map and every keyframe."""
        shown = self._shown
        if shown is not None and shown.map is slam_map and shown.keyframe == keyframe_id:
            return shown
        submap = int(slam_map.submap[slam_map.row(keyframe_id)])
        own = slam_map.observations.point[slam_map.observations.keyframe == keyframe_id]
        blocked = self._blocked(slam_map) if shown is not None and shown.submap == submap else own[:0]
        ids = np.concatenate([own, blocked[~np.isin(blocked, own)][:_MAX_BLOCKED]])
        X_keyframe = to_local(slam_map.pose(keyframe_id), slam_map.points.X_world[:, rows(slam_map.points.ids, ids)])
        columns = self._columns(
            self._of(slam_map, ids), X_keyframe.astype(np.float32), np.ones(len(ids), bool), np.ones(len(own), bool)
        )
        return _VisiblePoints(slam_map, keyframe_id, submap, ids, columns)

    def _blocked(self, slam_map: Map) -> np.ndarray:
        """Those of the points looked at that are blocked and in the map still, the latest first."""
        ids = self._shown.ids if self._shown is not None else np.zeros(0, np.int64)
        ids = ids[has(slam_map.points.ids, ids)]
        return ids[self._of(slam_map, ids) == PointState.BLOCKED]

    def _columns(self, *columns: np.ndarray) -> _Columns:
        """One column a point, filled up with zeros to the size that the program is compiled for."""
        filled: Any = (jnp.asarray(padded(column, self._room, axis=-1)) for column in columns)
        return _Columns(*filled)

    def _after(
        self, columns: _Columns, T_keyframe_cam: np.ndarray, twist: np.ndarray, arrays: FrameArrays
    ) -> tuple[States, Float[Array, "2"]]:
        motion = T_keyframe_cam.astype(np.float32), twist
        seen = arrays.ignore, arrays.depth, arrays.depth_delay_s
        return _after_frame(columns, *motion, *seen, self._params, guard=self._config.guard)


def with_changes(slam_map: Map, changes: StateChanges) -> Map:
    """The map with changed states of those points that are in it still."""
    there = has(slam_map.points.ids, changes.ids)
    return with_states(slam_map, changes.ids[there], changes.states[there])


def occluded_shares(slam_map: Map) -> Float64[np.ndarray, " k"]:
    """The share of the points that each keyframe saw which are OCCLUDED; 0 of none."""
    seen = visibility(slam_map)
    return (seen @ (slam_map.points.state == PointState.OCCLUDED)) / np.maximum(seen.sum(axis=1), 1)


@partial(jax.jit, static_argnames="guard", compiler_options=SINGLE_THREAD)
@cached_trace
def _after_frame(
    columns: _Columns,
    T_keyframe_cam: Float[Array, "7"],
    twist: Float[Array, "6"],
    ignore: Bool[Array, "h w"],
    depth: DepthImage,
    depth_delay_s: Scalar,
    params: TrackParams,
    *,
    guard: bool,
) -> tuple[States, Float[Array, "2"]]:
    """States after a frame, how many have another state, and the share of the keyframe's own that is OCCLUDED."""
    height, width = ignore.shape
    X_cam = to_camera(SE3(T_keyframe_cam), columns.X_keyframe)
    uv = predict_pixels(X_cam, twist, height, params)
    size = jnp.array([[width], [height]], uv.dtype)
    pixel = jnp.round(uv)
    inside = columns.there & _before_the_lens(X_cam, size, params) & ((pixel >= 0) & (pixel < size)).all(axis=0)
    column, row = jnp.clip(pixel, 0, size - 1).astype(jnp.int32)
    displaced = jnp.zeros_like(inside)
    if guard:
        displaced = _displaced(X_cam[2], uv, twist, depth, depth_delay_s, params)
    states = next_states(columns.states, inside, ignore[row, column], displaced)
    num_changed = jnp.sum(states != columns.states, dtype=jnp.float32)
    return states, jnp.stack([num_changed, occluded_share(states, columns.own)])


def _before_the_lens(X_cam: Points, size: Float[Array, "2 1"], params: TrackParams) -> Mask:
    """Which points are in front of the camera, and not so far aside that a lens could only seem to show them."""
    nearest = params.min_depth_m / 2
    straight = to_pixels(params.intrinsics, X_cam[:2] / jnp.maximum(X_cam[2:], nearest))
    near = (straight > -_MAX_BENT * size) & (straight < (1 + _MAX_BENT) * size)
    return (X_cam[2] > nearest) & near.all(axis=0)


def _displaced(
    expected: Weights,
    uv: Pixels,
    twist: Float[Array, "6"],
    depth: DepthImage,
    depth_delay_s: Scalar,
    params: TrackParams,
) -> Mask:
    """Which points are not where they should be: another surface is seen there, in front or behind.

    Behind, the point is gone. In front, something that no mask covers hides it, or it has come nearer itself: nobody
    can tell, and what is in doubt counts once.

    Args:
        expected: `(n,)` depth at which they should be, meters.
        uv: `(2, n)` where they should be seen, pixels.
        twist: Velocity of the camera in its own axes.
        depth: Depth image, meters, as it came.
        depth_delay_s: Seconds from the time of the image to that of the depth.
        params: Camera and the errors of its depth.
    """
    measured = measure(uv, expected, twist, depth, depth_delay_s, params, reach=_REACH_PX).depth
    known = (measured > params.min_depth_m) & (measured < params.max_depth_m)
    tolerance = _DEPTH_SIGMAS * depth_sigma(expected, params) + _DEPTH_SHARE * expected
    return known & (jnp.abs(measured - expected) > tolerance)
