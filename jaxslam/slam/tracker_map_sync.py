"""The tracker and the map kept in step: keyframes go to mapping, corrections of the map come back to the tracker.

What the tracker believes of its keyframes is followed here on the host, so that a correction is the difference of two
known poses, and frames and keyframes still on their way to the map hang on those that are in it.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxslam.geometry.se3 import IDENTITY, angle, between, compose, inverse, to_local, transform
from jaxslam.geometry.types import Pose
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map
from jaxslam.mapping.local_mapping import NewKeyframe, TrackedObservations
from jaxslam.runtime.compiled import compiled
from jaxslam.runtime.padding import padded
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.slam.keyframe_reload import MapKeyframe
from jaxslam.tracking.state import TrackOutput, TrackPlan, TrackState, TrackStatus
from jaxslam.tracking.state_updates import apply_map_correction, drop_points, load_keyframe, reset_at_pose

_MIN_MOVE_M, _MIN_TURN = 1e-6, 1e-6
"""A correction below both is none."""

_relocated = compiled(when="warm-up", donate="state")(reset_at_pose)
_carried = compiled(when="warm-up", donate="state")(apply_map_correction)
_reloaded = compiled(when="warm-up", donate="state")(load_keyframe)
_forgotten = compiled(when="warm-up", donate="state")(drop_points)
_AT_ONCE = 1024
"""Points forgotten in one call."""


class AnchoredPose(NamedTuple):
    """A pose that moves with a keyframe.

    Attributes:
        keyframe: Its id.
        T_keyframe_cam: `(7,)` the pose seen from it.
    """

    keyframe: int
    T_keyframe_cam: Pose


class TrackerMapSync:
    """Knows which keyframes the tracker looks into, and where both sides believe them to be."""

    def __init__(self, plan: TrackPlan, slam_map: Map) -> None:
        """Start with a tracker that has no keyframe."""
        self.map = slam_map
        self.reference = NONE
        """The keyframe that the frames hang on now."""
        self._plan = plan
        self._slots = [NONE] * (plan.num_keyframes + plan.num_reloaded)
        self._made = 0
        self._believed: dict[int, np.ndarray] = {}
        self._on_the_way: dict[int, AnchoredPose] = {}
        self._new_submaps: dict[int, int] = {}  # of keyframes on the way that begin one
        self._next = slam_map.next_keyframe
        self._submap = int(slam_map.submap.max(initial=-1)) + 1

    def compile(self, state: TrackState, *, drops_points: bool) -> None:
        """Compile what changes a state.

        Args:
            state: Any state of the tracker; it is used up.
            drops_points: Whether points may have to be dropped.
        """
        identity, nothing = IDENTITY.astype(np.float32), np.zeros(self._plan.num_points, np.float32)
        still = np.zeros(6, np.float32)
        state = _relocated(state, identity, still, np.bool_(False))
        state = _carried(state, identity, np.tile(identity, (len(self._slots), 1)))
        if self._plan.num_reloaded:
            plane, image = np.tile(nothing, (3, 1)), np.zeros(state.keyframes.images.shape[1:], np.uint8)
            places = (identity, plane[:2], plane)
            state = _reloaded(state, np.int32(0), image, *places, nothing, nothing.astype(np.int32))
        if drops_points:
            state = self.drop_points(state, np.zeros(1, np.int64))
        jax.block_until_ready(state)

    def anchor(self, T_world_cam: Pose) -> AnchoredPose:
        """A pose of the tracker, tied to the reference keyframe."""
        return AnchoredPose(self.reference, between(self._believed[self.reference], T_world_cam))

    def pose(self, anchored: AnchoredPose) -> Pose:
        """`(7,)` where a pose is in the map as it is now."""
        return compose(self._in_map(anchored.keyframe), anchored.T_keyframe_cam)

    def in_map(self, T_world_cam: Pose) -> AnchoredPose | None:
        """A pose of the tracker tied to a keyframe that is in the map; `None` if there is none yet."""
        if self.reference == NONE:
            return None
        anchored = self.anchor(T_world_cam)
        while (above := self._on_the_way.get(anchored.keyframe)) is not None:
            anchored = AnchoredPose(above.keyframe, compose(above.T_keyframe_cam, anchored.T_keyframe_cam))
        if anchored.keyframe == NONE:
            return None
        standing_id = self.map.surviving_keyframe(anchored.keyframe)
        return AnchoredPose(standing_id, between(self.map.pose(standing_id), self.pose(anchored)))

    def tracker_pose(self, keyframe_id: int) -> Pose:
        """`(7,)` where the tracker believes a keyframe to be."""
        return self._believed[keyframe_id]

    def set_reference_keyframe(self, keyframe_id: int) -> None:
        """Hang the frames to come on a keyframe of the map."""
        self.reference = keyframe_id
        self._believed.setdefault(keyframe_id, self.map.pose(keyframe_id))

    def reset_at_pose(
        self, state: TrackState, T_world_cam: Pose, twist: Float[np.ndarray, "6"], *, keep_keyframes: bool = False
    ) -> TrackState:
        """The tracker's state reset to a pose and a velocity.

        Args:
            state: The state.
            T_world_cam: `(7,)` pose of the camera.
            twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
            keep_keyframes: Whether the tracker still looks into the same keyframes.
        """
        if not keep_keyframes:
            self._slots = [NONE] * len(self._slots)
        return _relocated(state, T_world_cam.astype(np.float32), twist.astype(np.float32), np.bool_(keep_keyframes))

    def submap_now(self) -> int:
        """Number of the submap that the frames are in."""
        return self._submap if self.reference == NONE else self.submap_of(self.reference)

    def submap_of(self, keyframe_id: int) -> int:
        """Number of the submap that a keyframe is in, also of one that is on its way to the map."""
        while (above := self._on_the_way.get(keyframe_id)) is not None:
            if above.keyframe == NONE:
                return self._new_submaps[keyframe_id]
            keyframe_id = above.keyframe
        return int(self.map.submap[self.map.row(self.map.surviving_keyframe(keyframe_id))])

    @property
    def num_on_the_way(self) -> int:
        """Keyframes handed over that are not in the map yet."""
        return len(self._on_the_way)

    def register_keyframe(
        self, timestamp_ns: int, frame: FrameArrays, output: TrackOutput, recognized: AnchoredPose | None
    ) -> NewKeyframe:
        """The job for mapping that a keyframe of the tracker is.

        Args:
            timestamp_ns: Time of the frame.
            frame: Arrays of the frame.
            output: Output of the tracker for it.
            recognized: Its pose in the map, if tracking began at a recognized place.
        """
        pose = pose_of(output)
        first = int(output.status) == TrackStatus.STARTED and recognized is None
        if first and self.reference != NONE:
            self._submap += 1  # nothing ties the frame to those before
        parent = NONE if first else self.reference
        seen_from = pose if parent == NONE else self.anchor(pose).T_keyframe_cam
        id = self._next
        self._next += 1
        self._believed[id] = pose
        self._on_the_way[id] = AnchoredPose(parent, seen_from)
        if parent == NONE:
            self._new_submaps[id] = self._submap
        self._slots[self._made % self._plan.num_keyframes] = id
        self._made += 1
        self.reference = id
        tracks = tracks_of(output)
        return NewKeyframe(id, timestamp_ns, frame, parent, seen_from, self._submap, np.asarray(output.twist), tracks)

    def apply_map(self, state: TrackState, slam_map: Map) -> tuple[TrackState, np.ndarray]:
        """The tracker's state carried along with a new map.

        Returns:
            The state, and the correction `(7,)` at the camera, from the old world to the new one.
        """
        self.map = slam_map
        self._on_the_way = {id: anchored for id, anchored in self._on_the_way.items() if id >= slam_map.next_keyframe}
        self._new_submaps = {id: submap for id, submap in self._new_submaps.items() if id in self._on_the_way}
        wanted = {id for id in (*self._slots, self.reference, *self._on_the_way) if id != NONE}
        new = {id: self._in_map(id) for id in wanted}
        change = {id: compose(new[id], inverse(self._believed[id])) for id in wanted}
        now = change.get(self.reference, IDENTITY)
        corrections = np.stack([change.get(id, IDENTITY) for id in self._slots])
        both = np.concatenate([corrections, now[None]])
        if np.abs(both[:, 4:]).max() < _MIN_MOVE_M and angle(both).max() < _MIN_TURN:
            self._believed = {id: self._believed[id] for id in wanted}  # small ones add up until they are made
            return state, IDENTITY
        self._believed = new
        return _carried(state, now.astype(np.float32), corrections.astype(np.float32)), now

    def apply_correction(self, state: TrackState, T_new_old: Pose, *, is_keyframe: bool) -> TrackState:
        """The tracker's state with the camera moved, and with it what it saw last; keyframes stay but this frame.

        Args:
            state: The state.
            T_new_old: `(7,)` the change of the camera's pose, in the world.
            is_keyframe: Whether the frame is the tracker's newest keyframe, not handed over yet.
        """
        change = T_new_old.astype(np.float32)
        corrections = np.tile(IDENTITY.astype(np.float32), (len(self._slots), 1))
        if is_keyframe:
            corrections[self._made % self._plan.num_keyframes] = change
        return _carried(state, change, corrections)

    def drop_points(self, state: TrackState, ids: np.ndarray) -> TrackState:
        """The tracker's state without some points, given its numbers of them, however many."""
        for start in range(0, len(ids), _AT_ONCE):
            some = ids[start : start + _AT_ONCE]
            state = _forgotten(state, np.sort(padded(some, _AT_ONCE, fill=some[0])).astype(np.int32))
        return state

    def latest(self) -> list[int]:
        """The keyframes in the tracker's ring."""
        return [id for id in self._slots[: self._plan.num_keyframes] if id != NONE]

    def loaded(self) -> list[int]:
        """The keyframes loaded from the map."""
        return [id for id in self._slots[self._plan.num_keyframes :] if id != NONE]

    def slot_for(self, keyframe_id: int, keep: set[int]) -> int | None:
        """Choose a slot, not among those to keep, for a reloaded keyframe; `None` if it is loaded already or gone."""
        if keyframe_id in self._slots or not self.map.has_keyframe(keyframe_id):
            return None
        free = range(self._plan.num_keyframes, len(self._slots))
        return next((slot for slot in free if self._slots[slot] not in keep), None)

    def load_keyframe(self, state: TrackState, slot: int, keyframe: MapKeyframe) -> TrackState:
        """The tracker's state with a keyframe of the map to look into."""
        pose = self._believed.setdefault(keyframe.keyframe, self._in_map(keyframe.keyframe))
        self._slots[slot] = keyframe.keyframe
        X_world = transform(pose, keyframe.X_cam.astype(np.float64)).astype(np.float32)
        places = (pose.astype(np.float32), keyframe.uv_raw, X_world)
        return _reloaded(state, np.int32(slot), keyframe.image, *places, keyframe.weight, keyframe.id)

    def _in_map(self, keyframe_id: int) -> Pose:
        """Return the pose of a keyframe in the map; one on its way there is placed relative to the one before."""
        anchored = self._on_the_way.get(keyframe_id)
        if anchored is None:
            return self.map.pose(keyframe_id)
        return anchored.T_keyframe_cam if anchored.keyframe == NONE else self.pose(anchored)


def pose_of(output: TrackOutput) -> Pose:
    """`(7,)` the pose, its quaternion of unit length in float64."""
    return compose(np.asarray(output.T_world_cam.wxyz_xyz, np.float64), IDENTITY)


def tracks_of(output: TrackOutput) -> TrackedObservations:
    """Points followed and looked up, in the axes of the camera."""
    pose, found = pose_of(output), output.keyframe_matches
    join = lambda followed, keyframe_matches: np.concatenate(
        [np.asarray(followed), np.asarray(keyframe_matches)], axis=-1
    )
    X_world = join(output.X_world, found.X_world).astype(np.float64)
    return TrackedObservations(
        id=join(output.id, found.id),
        uv_raw=join(output.uv, found.uv),
        X_cam=to_local(pose, X_world).astype(np.float32),
        weight=join(output.weights, found.weight),
    )
