"""Localizes a frame in the map: against the local map from an approximate pose, or by place recognition."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from jaxslam.features.image_shift import turn_between
from jaxslam.features.orb import FeaturePlan, Features, Patches, features_of, patches_of
from jaxslam.features.pose_from_matches import PLACE_GATES, PoseGates
from jaxslam.features.view_matching import match_views, match_views_near, pixels_apart
from jaxslam.geometry.se3 import angle, between, compose, inverse, transform
from jaxslam.geometry.types import Pose
from jaxslam.loop_closing.place_index import PlaceIndex
from jaxslam.loop_closing.place_recognition import recognize
from jaxslam.mapping.local_map_tracking import RADII_PX, WIDE_RADII_PX, match_local_map, nearest_keyframes
from jaxslam.mapping.occlusion_states import PointStates
from jaxslam.mapping.vanished_points import FrameDepth, vanished_points
from jaxslam.sensors.frame_arrays import FrameArrays
from jaxslam.sensors.sensor_model import SensorModel
from jaxslam.slam.tracker_map_sync import AnchoredPose, TrackerMapSync, pose_of
from jaxslam.tracking.state import TrackOutput, TrackReason, TrackState, TrackStatus

_PATIENCE_S = 0.02
"""Longest wait for the lock of the place index while lost; the next frame tries again."""
_MOTION_GATES = PoseGates(min_inliers=20, min_cells=8, max_sigma=0.0125)
"""Those of a motion, fewer than of a place: it is predicted, or optical flow goes on from there and finds out if it is
right. On KITTI 06 with every 4th pair, 25 features in 10 cells agree with some motions that are right."""
_MIN_TURN_RAD = 0.02
"""Smallest turn that was not predicted from which it can be why optical flow failed: 10 of 640 pixels."""


class LocalizedPose(NamedTuple):
    """The pose of a frame from matches with map points.

    Attributes:
        anchored: The pose, relative to a keyframe.
        num_matched: Number of points that agree with the pose.
        covariance: `(6, 6)` in the tangent space at the camera: translation (m), then rotation (rad).
    """

    anchored: AnchoredPose
    num_matched: int
    covariance: np.ndarray


class FeatureMotion(NamedTuple):
    """The motion from the last tracked frame to a lost one, from matches of their features.

    Attributes:
        T_last_cam: `(7,)` pose of the lost frame in the axes of the last tracked one.
        T_world_cam: `(7,)` pose of the lost frame, from that of the last tracked one as the map has it now.
        covariance: `(6, 6)` in the tangent space at the camera: translation (m), then rotation (rad).
        num_matched: Number of features that agree with it.
        is_certain: Whether it can be believed by itself: it is near the predicted motion, or enough features agree for
            a place that may be anywhere.
    """

    T_last_cam: Pose
    T_world_cam: Pose
    covariance: np.ndarray
    num_matched: int
    is_certain: bool


class _TrackedFrame(NamedTuple):
    """A frame that was tracked, with its `(6,)` velocity in m/s, then rad/s, and its pose."""

    arrays: FrameArrays
    twist: Float[np.ndarray, "6"]
    anchored: AnchoredPose


def _output_at_pose(
    output: TrackOutput, T_world_cam: Pose, change: Pose, localized: LocalizedPose, weak_inliers: float
) -> TrackOutput:
    """Return the output of a frame at the pose from the local map; it is `OK` if enough points agree with that pose.

    Args:
        output: Output of the tracker for the frame.
        T_world_cam: `(7,)` refined pose.
        change: `(7,)` transform of the world from the tracked pose to the refined one.
        localized: Refined pose with its covariance and number of matches.
        weak_inliers: Number of matches from which the frame is no longer `WEAK`.
    """
    X_world = transform(change, np.asarray(output.X_world, np.float64))
    enough = localized.num_matched >= weak_inliers
    wxyz_xyz: Any = T_world_cam.astype(np.float32)
    return output._replace(
        T_world_cam=SE3(wxyz_xyz),
        X_world=X_world.astype(np.float32),
        covariance=localized.covariance.astype(np.float32),
        status=TrackStatus.OK if enough else output.status,
        reason=TrackReason.NONE if enough else output.reason,
    )


class FrameLocalizer:
    """Localizes frames in the map as the tracker knows it, and relative to the last frame that was tracked.

    Attributes:
        features: Features of the current frame; `None` until `match_tracked` has extracted them.
    """

    def __init__(
        self,
        sensor: SensorModel,
        plan: FeaturePlan,
        link: TrackerMapSync,
        index: PlaceIndex,
        states: PointStates | None,
    ) -> None:
        """Keep what localization needs.

        Args:
            sensor: Noise model of the camera.
            plan: Static sizes of feature extraction.
            link: Map and reference keyframe of the tracker.
            index: Place index, shared with the thread that adds keyframes to it.
            states: Occlusion states of map points; `None` if the settings do not ask for them.
        """
        self._sensor, self._plan, self._link = sensor, plan, link
        self._index, self._states = index, states
        self.features: Features | None = None
        self._of_lost: Features | None = None
        self._patches: Patches | None = None
        """Features extracted from the current frame."""
        self._last: _TrackedFrame | None = None
        self._of_last: Features | None = None

    def begin_frame(self) -> None:
        """Forget the features of the frame before."""
        self.features = self._of_lost = self._patches = None

    def frame_tracked(self, arrays: FrameArrays, anchored: AnchoredPose, twist: Float[np.ndarray, "6"]) -> None:
        """Keep a frame that was tracked.

        Args:
            arrays: The frame; it must not change until another one is tracked.
            anchored: Pose of the camera, relative to a keyframe.
            twist: `(6,)` velocity of the camera in its own axes, m/s, then rad/s.
        """
        # A weak frame has features already; often it is the last one before a loss, which then costs 14 ms less.
        self._last, self._of_last = _TrackedFrame(arrays, twist, anchored), self.features

    def turn_to(self, arrays: FrameArrays, T_last_cam: Pose) -> Pose | None:
        """Estimate how the camera turned since the last tracked frame, from the shift of the whole image.

        Args:
            arrays: The frame.
            T_last_cam: `(7,)` predicted pose of the frame in the axes of the last tracked one.

        Returns:
            `(7,)` pose of the frame in the axes of the last tracked one; `None` if the images do not tell, or tell the
            turn that was predicted.
        """
        if self._last is None:
            return None
        turn = turn_between(np.asarray(self._last.arrays.image), np.asarray(arrays.image), self._sensor)
        return None if turn is None or angle(between(turn, T_last_cam)) < _MIN_TURN_RAD else turn

    def motion_to(self, arrays: FrameArrays, T_last_cam: Pose) -> FeatureMotion | None:
        """Estimate the motion from the last tracked frame to a lost one; `None` if features do not tell.

        Features are matched around where the predicted motion takes them, else wherever they are: for motion that is
        too large for optical flow.

        Args:
            arrays: The frame.
            T_last_cam: `(7,)` predicted pose of the frame in the axes of the last tracked one.
        """
        if self._last is None:
            return None
        last, features = self._features_of_both(self._last, arrays)
        plan, gates = self._plan, _MOTION_GATES
        near = match_views_near(last, features, T_last_cam, self._sensor, WIDE_RADII_PX, plan=plan, gates=gates)
        found = near or match_views(last, features, self._sensor, jax.random.key(0), plan=plan, gates=gates)
        if found is None:
            return None
        # Not from the tracker's state: that is a new one after an interrupted step.
        T_world_cam = compose(self._link.pose(self._last.anchored), found.T_source_cam)
        is_certain = near is not None or found.is_place
        return FeatureMotion(found.T_source_cam, T_world_cam, found.covariance, found.pairs.shape[1], is_certain)

    def pixels_apart(self, first: Pose, second: Pose) -> float:
        """Return how far apart two motions `(7,)` take the features of the last tracked frame, median of pixels.

        `motion_to` must have extracted them; without any, the motions are infinitely far apart.
        """
        assert self._of_last is not None
        return pixels_apart(self._of_last, first, second, self._sensor)

    def match_tracked(
        self,
        state: TrackState,
        arrays: FrameArrays,
        output: TrackOutput,
        weak_inliers: float,
        radii_px: tuple[float, ...],
    ) -> tuple[TrackState, TrackOutput, int]:
        """Refine the pose of a tracked frame against the local map; see `BackEnd.match_local_map`.

        Args:
            state: State of the tracker after the frame.
            arrays: The frame.
            output: Output of the tracker for the frame.
            weak_inliers: Number of matches from which the frame is no longer `WEAK`.
            radii_px: Search radius of each pass around the predicted pixels at octave 0.
        """
        twist = np.asarray(output.twist)
        self.features = features_of(arrays, twist, self._sensor, self._plan, self._patches_of(arrays))
        localized = self._in_local_map(self.features, pose_of(output), radii_px)
        if localized is None:
            return state, output, 0
        T_world_cam = self._link.pose(localized.anchored)
        change = compose(T_world_cam, inverse(pose_of(output)))
        state = self._link.apply_correction(state, change, is_keyframe=bool(output.keyframe))
        return state, _output_at_pose(output, T_world_cam, change, localized, weak_inliers), localized.num_matched

    def relocalize(self, arrays: FrameArrays, predicted: Pose | None) -> tuple[LocalizedPose | None, bool]:
        """Localize a lost frame: near the predicted pose in the local map, then in a wider search, else by its place.

        A pose at which the frame would see through much of the map is none: of a lost frame, the points that agree may
        all be on someone who walks before the camera, and are in the map since they were seen at first.

        Args:
            arrays: The frame.
            predicted: `(7,)` predicted pose; `None` if the camera has been lost for too long to predict one.

        Returns:
            The pose, or `None`; and whether place recognition searched the whole map and found no such place.
        """
        features = self._features_of_lost(arrays)
        if predicted is not None:
            for radii_px in (RADII_PX, WIDE_RADII_PX):
                near = self._in_local_map(features, predicted, radii_px)
                if near is not None and self._fits_map(arrays, near):
                    return near, False
        if np.count_nonzero(features.depth) < PLACE_GATES.min_inliers:
            return None, False
        if not self._index.lock.acquire(timeout=_PATIENCE_S):
            return None, False
        try:
            found = recognize(self._link.map, self._index, features, self._sensor, plan=self._plan)
        finally:
            self._index.lock.release()
        if found is None:
            return None, True
        anchored = AnchoredPose(found.keyframe, found.T_keyframe_cam)
        there = LocalizedPose(anchored, found.num_inliers, found.covariance)
        return (there, False) if self._fits_map(arrays, there) else (None, True)

    def _features_of_both(self, last: _TrackedFrame, arrays: FrameArrays) -> tuple[Features, Features]:
        """Extract the features of the last tracked frame and of the current one, in two threads."""
        if self._of_last is None:
            with ThreadPoolExecutor(1, thread_name_prefix="jaxslam-features") as beside:
                of_last = beside.submit(features_of, last.arrays, last.twist, self._sensor, self._plan)
                self._features_of_lost(arrays)
                self._of_last = of_last.result()
        return self._of_last, self._features_of_lost(arrays)

    def _features_of_lost(self, arrays: FrameArrays) -> Features:
        """Extract the features of the current frame, once, as of a camera at rest."""
        if self._of_lost is None:
            still = np.zeros(6, np.float32)
            self._of_lost = features_of(arrays, still, self._sensor, self._plan, self._patches_of(arrays))
        return self._of_lost

    def _patches_of(self, arrays: FrameArrays) -> Patches:
        """Extract the features of the current frame, once; those that a later mask of it ignores are left out."""
        if self._patches is None:
            self._patches = patches_of(arrays, self._plan)
            return self._patches
        return self._patches.without(np.asarray(arrays.ignore))

    def _fits_map(self, arrays: FrameArrays, found: LocalizedPose) -> bool:
        """Return whether the frame does not see through the map at a pose; without a depth image nothing tells."""
        if arrays.right is not None:
            return True
        T_world_cam = self._link.pose(found.anchored)
        around = nearest_keyframes(self._link.map, T_world_cam, self._link.submap_of(found.anchored.keyframe))
        depth = FrameDepth(np.zeros(6, np.float32), arrays, self._sensor)
        return not vanished_points(self._link.map, around, T_world_cam, depth).contradict_pose

    def _in_local_map(
        self, features: Features, T_world_cam: Pose, radii_px: tuple[float, ...] = RADII_PX
    ) -> LocalizedPose | None:
        """Localize a frame against the local map from an approximate pose; `None` if too few points agree."""
        about = self._link.in_map(T_world_cam)
        if about is None:
            return None
        found = match_local_map(
            self._link.map,
            about.keyframe,
            about.T_keyframe_cam,
            features,
            self._sensor,
            self._plan,
            self._states,
            radii_px,
        )
        if found is None:
            return None
        return LocalizedPose(AnchoredPose(about.keyframe, found.T_origin_cam), len(found.agree), found.covariance)
