"""Occlusion states of the map points in view, updated with every frame ahead of the map.

The map belongs to mapping and is never waited for. State changes observed by the tracker are kept beside it by point
id and handed over with the next keyframe; once a map with them arrives, they are dropped here.

Source: Occlusion SLAM, algorithm 1. The paper looks at the points of one keyframe; a keyframe that is made while a
person stands in view does not have the points behind. Here blocked points are kept until they are visible again, "in
any future frame" (section 2.3), whatever the reference keyframe of those frames.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxslam_kernels.se3 import to_camera
from jaxslam_kernels.types import DepthImage, Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Bool, Float, Float32, Float64, Int, Int8, Int64

from jaxslam.config.cue_sections import OcclusionConfig
from jaxslam.dynamics.occlusion import PointState, States, next_states, occluded_share, state_weights
from jaxslam.geometry.se3 import IDENTITY, to_local
from jaxslam.geometry.types import Ids, Pose
from jaxslam.map.edit import with_states
from jaxslam.map.partial_map import extract_around, merge_back
from jaxslam.map.point_records import NONE, rows
from jaxslam.map.types import Map, visibility
from jaxslam.runtime.compiled import committed, compiled
from jaxslam.runtime.padding import padded
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.measurement import depth_sigma, expected_pixels, surface_depth
from jaxslam.sensors.sensor_model import SensorModel

_DEPTH_SIGMAS, _DEPTH_SHARE = 4.2, 0.02
"""Difference of measured and expected depth from which a point is displaced: three standard deviations of the
difference of two measurements, and a share of the depth for errors of pose and calibration."""
_MAX_BLOCKED = 512
"""Maximum number of blocked points of earlier keyframes that are kept; if there are more, the latest ones."""
_AS_IN_MAP = -1


class StateChanges(NamedTuple):
    """State changes of points since the previous handover.

    Attributes:
        number: Sequence number of these changes.
        ids: `(c,)` ids of the points, some of which may have left the map.
        states: `(c,)` new `PointState` of each.
    """

    number: int
    ids: Int64[np.ndarray, " c"]
    states: Int8[np.ndarray, " c"]


class _Columns(NamedTuple):
    """Points padded to the compiled size, kept on the device so that no copy is needed.

    Attributes:
        states: `(n,)` current states.
        X_keyframe: `(3, n)` positions in the axes of the keyframe, in meters.
        there: `(n,)` which slots hold a point.
        own: `(n,)` which slots hold a point observed by the keyframe.
    """

    states: States
    X_keyframe: Points
    there: Mask
    own: Mask


class _VisiblePoints(NamedTuple):
    """Points whose states are updated, those of the reference keyframe first.

    Attributes:
        map: The map they belong to.
        keyframe: Id of the reference keyframe.
        submap: Number of its submap.
        ids: Ids of the points.
        columns: Their padded arrays.
    """

    map: Map
    keyframe: int
    submap: int
    ids: Ids
    columns: _Columns


class PointStates:
    """Updates the states of the reference keyframe's points with every frame. Not thread-safe."""

    def __init__(self, config: OcclusionConfig, sensor: SensorModel, slam_map: Map, most_points: int) -> None:
        """Start with the states of a map.

        Args:
            config: Settings.
            sensor: Camera and the error model of its depth.
            slam_map: Map to start with.
            most_points: Maximum number of points that a new keyframe may observe; those of the map may have more.
        """
        self._config, self._sensor = config, sensor
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
        self, slam_map: Map, keyframe_id: int, T_keyframe_cam: Pose, twist: Float[np.ndarray, "6"], arrays: FrameArrays
    ) -> float:
        """Update the states with a frame whose pose is known.

        Args:
            slam_map: The map that arrived last.
            keyframe_id: Id of the reference keyframe in that map.
            T_keyframe_cam: `(7,)` pose of the camera in the axes of the keyframe.
            twist: `(6,)` velocity of the camera in its own axes.
            arrays: The frame, with the pixels to ignore.

        Returns:
            The share of the keyframe's points that are OCCLUDED.
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

    def weights(self, slam_map: Map, point_ids: Int[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
        """Return the relative weights of points of the latest map, 1 on average.

        Only ratios matter to a pose; with an average of 1, its covariance does not shrink where many are OCCLUDED.
        """
        weights = state_weights(self._of(slam_map, point_ids), self._config.weight)
        return weights / weights.mean() if len(weights) else weights

    def handed_over(self) -> StateChanges:
        """Return the changes since the last call, for mapping."""
        ids = np.flatnonzero((self._change == self._number) & (self._state != _AS_IN_MAP))
        changes = StateChanges(self._number, ids, self._state[ids])
        self._number += 1
        return changes

    def arrived(self, slam_map: Map, number: int) -> None:
        """Replace the map by a new one that contains all changes up to this number."""
        more = slam_map.next_point - len(self._state)
        self._state = np.append(self._state, np.full(more, _AS_IN_MAP, np.int8))
        self._change = np.append(self._change, np.zeros(more, np.int64))
        self._state[self._change <= number] = _AS_IN_MAP

    def _of(self, slam_map: Map, point_ids: Int[np.ndarray, " n"]) -> Int8[np.ndarray, " n"]:
        """Return the current states of points."""
        ahead = self._state[point_ids]
        slam_map = slam_map.around(point_ids[:0], point_ids)
        return np.where(ahead == _AS_IN_MAP, slam_map.points.state[rows(slam_map.points.ids, point_ids)], ahead)

    def _points_of(self, slam_map: Map, keyframe_id: int) -> _VisiblePoints:
        """Collect the points to update, again for every new map and every new keyframe."""
        shown = self._shown
        if shown is not None and shown.map is slam_map and shown.keyframe == keyframe_id:
            return shown
        submap = int(slam_map.submap[slam_map.row(keyframe_id)])
        blocked = self._blocked(slam_map) if shown is not None and shown.submap == submap else np.zeros(0, np.int64)
        near = slam_map.around(np.array([keyframe_id]), blocked)
        own = near.observations.point[near.observations.keyframe == keyframe_id]
        ids = np.concatenate([own, blocked[~np.isin(blocked, own)][:_MAX_BLOCKED]])
        X_keyframe = to_local(slam_map.pose(keyframe_id), near.points.X_world[:, rows(near.points.ids, ids)])
        columns = self._columns(
            self._of(near, ids), X_keyframe.astype(np.float32), np.ones(len(ids), bool), np.ones(len(own), bool)
        )
        return _VisiblePoints(slam_map, keyframe_id, submap, ids, columns)

    def _blocked(self, slam_map: Map) -> Ids:
        """Return the collected points that are blocked and still in the map, the latest first."""
        ids = self._shown.ids if self._shown is not None else np.zeros(0, np.int64)
        ids = ids[slam_map.contents.have(ids)]
        return ids[self._of(slam_map, ids) == PointState.BLOCKED]

    def _columns(self, *columns: np.ndarray) -> _Columns:
        """Pad one column per point with zeros to the compiled size."""
        filled: Any = (jnp.asarray(padded(column, self._room, axis=-1)) for column in columns)
        return committed(_Columns(*filled))  # as the states after a frame

    def _after(
        self, columns: _Columns, T_keyframe_cam: Pose, twist: Float[np.ndarray, "6"], arrays: FrameArrays
    ) -> tuple[States, Float[Array, "2"]]:
        motion = T_keyframe_cam.astype(np.float32), twist
        seen = arrays.ignore, arrays.depth, arrays.depth_delay_s, arrays.readout_sign
        return _after_frame(columns, *motion, *seen, self._sensor, guard=self._config.guard)


def with_changes(slam_map: Map, changes: StateChanges) -> Map:
    """Apply state changes to those points that are still in the map."""
    there = slam_map.contents.have(changes.ids)
    ids = changes.ids[there]
    if not len(ids):
        return slam_map
    part = extract_around(slam_map, ids[:0], ids)
    return merge_back(slam_map, part, with_states(part.map, ids, changes.states[there]))


def occluded_shares(slam_map: Map) -> Float64[np.ndarray, " k"]:
    """Return the share of each keyframe's points that are OCCLUDED; 0 for a keyframe without points."""
    seen = visibility(slam_map)
    return (seen @ (slam_map.points.state == PointState.OCCLUDED)) / np.maximum(seen.sum(axis=1), 1)


@compiled(when="warm-up", static="guard")
def _after_frame(
    columns: _Columns,
    T_keyframe_cam: Float[Array, "7"],
    twist: Float[Array, "6"],
    ignore: Bool[Array, "h w"],
    depth: DepthImage,
    depth_delay_s: Scalar,
    readout_sign: Scalar | None,
    sensor: SensorModel,
    *,
    guard: bool,
) -> tuple[States, Float[Array, "2"]]:
    """Return the states after a frame, the number of changes, and the OCCLUDED share of the keyframe's points."""
    X_cam = to_camera(SE3(T_keyframe_cam), columns.X_keyframe)
    sensor = sensor.for_readout(readout_sign)
    expected = expected_pixels(X_cam, twist, ignore, sensor)
    inside = columns.there & expected.inside
    displaced = jnp.zeros_like(inside)
    if guard:
        displaced = _displaced(X_cam[2], expected.uv, twist, depth, depth_delay_s, sensor)
    states = next_states(columns.states, inside, expected.ignored, displaced)
    num_changed = jnp.sum(states != columns.states, dtype=jnp.float32)
    return states, jnp.stack([num_changed, occluded_share(states, columns.own)])


def _displaced(
    expected: Weights,
    uv: Pixels,
    twist: Float[Array, "6"],
    depth: DepthImage,
    depth_delay_s: Scalar,
    sensor: SensorModel,
) -> Mask:
    """Return which points are displaced: another surface is seen at their pixel, in front or behind.

    If the surface is behind, the point is gone. If it is in front, something outside every mask hides the point, or the
    point itself has come nearer: the two cannot be told apart, so a doubtful point gets the normal weight.

    Args:
        expected: `(n,)` expected depths, in meters.
        uv: `(2, n)` expected pixels.
        twist: Velocity of the camera in its own axes.
        depth: Raw depth image in meters.
        depth_delay_s: Time from the image to its depth, in seconds.
        sensor: Camera and the error model of its depth.
    """
    measured, known = surface_depth(expected, uv, twist, depth, depth_delay_s, sensor)
    tolerance = _DEPTH_SIGMAS * depth_sigma(expected, sensor) + _DEPTH_SHARE * expected
    return known & (jnp.abs(measured - expected) > tolerance)
